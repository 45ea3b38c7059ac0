# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether sensor or target moved in the middle of a recording.

If the samples fit no answer, two parts of the recording are fitted separately. If they do, a move
after station i is two more blocks of nuisance parameters, linearised at the answer, (14) of
estimator.md. Two tests must agree. The Bayes factor: noise and scales are estimated again with and
without the move, since they absorb part of it otherwise. A permutation test: random orders of the
stations must seldom show as clear a move, since robot errors that are not in the model look like
moves in any order.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.calibration import outliers_at_one_end
from handeye_ros.checks.hypotheses import (
    DECISIVE_EVIDENCE,
    Explanation,
    FALSE_CAUSE_PROBABILITY,
    Hypothesis,
)
from handeye_ros.data import Array, rms
from handeye_ros.errors import DataError, degrees, mm
from handeye_ros.estimation.blocks import ParameterBlock
from handeye_ros.estimation.least_squares import chi2_isf
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, Noise, whitening
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import quick_solution, reassigned
from handeye_ros.estimation.solve import (
    cover,
    Solution,
    solution_at,
    with_noise_reestimated,
)
from handeye_ros.frames import mount_frame, target_frame
import numpy as np
from numpy.typing import NDArray

SENSOR, TARGET = range(2)  # a body that moves: an index of gains, derivatives, arms
POSSIBLE_MOVE = 'possible move'  # its name in a budget of the covariance
MOMENTS_TRIED = 160  # of a small move, most of them, before it is examined
STATIONS_TRIED = 100  # over the number of stations: moments from which the likeliest is sought
MOVE_STD = np.repeat([2e-3, 5e-3], 3)  # prior 1 sigma of a small move (m, rad)
TIME_STD = 0.01  # of the times that may be wrong instead, 1 sigma (s)
SIZE_FACTORS = (1.0, 0.25)  # factors on MOVE_STD, of equal prior probability
# twice the log of the Bayes factor (Kass and Raftery: positive, 2 to 6), to warn
WARNING_EVIDENCE = 5.0
LEAST_MOVE_SIGMAS = 3.0  # smallest move over the robot's smooth error
RANDOM_ORDERS, PARTS_EXCHANGED = 200, 40  # of the permutation test
WARNING_P, REFUSAL_P = 0.1, 0.01  # largest p-value of the permutation test: to warn, to refuse


def move_hypotheses(problem: Problem, stamps: Sequence[int]) -> Iterator[Hypothesis]:
    """
    Yield the hypotheses that something moved between two parts of a recording.

    stamps: of the stations.
    """
    n, fewest = len(problem.poses), problem.target.min_samples
    moments = np.linspace(fewest, n - fewest, 15 if n >= 2 * fewest else 0)
    for k in np.unique(moments.round().astype(int)).tolist():
        first, second = (quick_solution(problem.subset(part))
                         for part in np.split(np.arange(n), [k]))
        if first and second and (_same_transform(first, second) or _same_target(first, second)):
            yield Hypothesis(Explanation.of_solutions(stamps, first, second),
                             _moved_between(first, second))


def _moved_between(first: Solution, second: Solution) -> DataError:
    """Return the refusal of a recording in which something moved between two parts."""
    config, k, rest = first.full_problem.config, *(
        len(part.full_problem.poses) for part in (first, second))
    if _same_transform(first, second):
        frame, advice = target_frame(config), 'fix the target, and take'
        what = f'target moved in {frame}'
    else:
        frame, advice = mount_frame(config), 'take'
        move = se3.inverse(first.estimate.X) @ second.estimate.X
        what = (f'sensor moved in {frame} by {mm(float(np.linalg.norm(move[:3, 3])))} and '
                f'{degrees(float(se3.angle(move[:3, :3])))}')
    return DataError(
        f'the first {k} samples agree among themselves, and so do the other {rest}, but not with '
        f'each other: in between, the {what}, or {frame} became another frame (tool or base of '
        f'the robot switched); {advice} all samples with the same', reason='moved')


def _same_transform(first: Solution, second: Solution) -> bool:
    """Return whether two parts may have the same transform: then the target moved between them."""
    covariance = sum(part.transform_covariance * max(part.variance_factor, 1.0)
                     for part in (first, second))
    delta = se3.difference(second.estimate.X, first.estimate.X)
    return bool(delta @ np.linalg.solve(covariance, delta) < chi2_isf(FALSE_CAUSE_PROBABILITY, 6))


def _same_target(first: Solution, second: Solution) -> bool:
    """
    Return whether two parts may see the same target: then the sensor moved between them.

    Parts of a few samples, some of them wrong, fit by chance, each with a target of its own. A
    part that leaves its target free, as one edge of a plate does, may see any.
    """
    if not (first.is_determined and second.is_determined):
        return True
    near = Estimate(second.estimate.X, first.estimate.state)
    after = solution_at(reassigned(second.problem, near), near, BLOCKS_AS_NOISE)
    # both parts in one fit: two transforms, and the target in common
    own, other = first.jacobian, after.jacobian
    J = np.vstack([np.insert(own, [6] * 6, 0.0, axis=1), np.insert(other, [0] * 6, 0.0, axis=1)])
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    r = np.concatenate([first.prefit_residuals, after.prefit_residuals])
    rest = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
    more = rest @ rest - first.sum_of_squares - second.sum_of_squares
    factor = max(first.variance_factor, second.variance_factor, 1.0)
    return bool(more < factor * chi2_isf(FALSE_CAUSE_PROBABILITY, first.unknowns - 6))


def with_possible_move(agreed: Solution) -> tuple[Solution, str]:
    """
    Return a solution, and a warning on a move and its time, '' if there is none.

    The likeliest move of either and the noise with it are estimated in turn, until it stays. With
    a warning, the covariance covers the transform with that move as well. Stations dropped at one
    end of the recording alone are such a warning, without further tests. Raises DataError (moved)
    where the evidence is decisive.
    """
    if parted := outliers_at_one_end(agreed):
        return agreed, parted
    n, conservative, config = len(agreed.used), agreed.conservative, agreed.full_problem.config
    if n < agreed.problem.target.min_samples + 4:  # too few to tell a move from an outlier
        return agreed, ''
    sweep = agreed.problem.pose_model is not None
    margin = max(2, n // PARTS_EXCHANGED) if sweep else 2
    few, many = (np.unique(np.linspace(margin, n - margin, count).round().astype(int))
                 for count in (PARTS_EXCHANGED, MOMENTS_TRIED))
    found_without = [conservative]
    if not sweep:  # of a few stations, estimated noise absorbs a move; configured may be too large
        found_without.append(solution_at(agreed.problem, agreed.estimate, Noise()))
    first = np.max([_gains(solution, many)[0] for solution in found_without], axis=0)
    if first.max() < -WARNING_EVIDENCE:  # evidence against a move
        return agreed, ''
    # the likeliest move against none, and against wrong times; a moment a few profiles off leaves
    # an error that only a much worse robot would explain
    starts = many[np.argsort(-first, axis=0)[:max(STATIONS_TRIED // n, 1)]]
    body, k, moved = _likeliest(agreed, starts, np.arange(margin, n - margin + 1))
    unmoved = with_noise_reestimated(conservative)
    others = [with_noise_reestimated(conservative, (block,)) for block in
              _wrong_times(conservative, k + margin * np.arange(-2, 3))]
    evidence = min(other.deviance for other in (unmoved, *others)) - moved.deviance
    shift, turn, size = _size(moved, body)
    # a smaller move may be part of the robot's smooth error, which a move can only explain
    smooth = min(max((b.std * one.prior_scale(b) for b in one.blocks if b.name == 'robot_smooth'),
                     default=0.0) for one in (moved, unmoved))
    # that error of a sweep is smooth in time, as a move is
    least = max(LEAST_MOVE_SIGMAS * smooth, config.noise.robot_smooth if sweep else 0.0)
    if evidence < WARNING_EVIDENCE or size < least:
        return agreed, ''
    # errors of the robot look like a move in any order of the samples
    in_time, *random = _gains(solution_at(agreed.problem, agreed.estimate, moved.noise), few,
                              RANDOM_ORDERS).max(axis=(1, 2))
    p_value = float(np.mean(random >= in_time))
    if p_value >= WARNING_P:
        return agreed, ''
    what, frame = (('sensor', mount_frame(config)) if body == SENSOR
                   else ('target', target_frame(config)))
    sentence = (
        f'after the first {agreed.used[k]} of {len(agreed.full_problem.poses)} samples '
        f'the {what} seems to have moved in {frame} by about {mm(shift)} and {degrees(turn)}, or '
        'the tool or base of the robot was switched, or robot or sensor drift: check that it is '
        'fixed firmly, and take all samples again')
    if evidence > DECISIVE_EVIDENCE and p_value < REFUSAL_P:
        raise DataError(sentence, reason='moved')
    # with the warning: the covariance that covers the transform with the move, too
    away = se3.difference(moved.estimate.X, unmoved.estimate.X)
    with_move = moved.covariance[:6, :6] + np.outer(away, away)
    more = cover(agreed.transform_covariance, with_move) - agreed.transform_covariance
    added = {**agreed.added_covariances, POSSIBLE_MOVE: more}
    return replace(agreed, added_covariances=added), sentence


def _likeliest(agreed: Solution, starts: NDArray[np.intp], moments: NDArray[np.intp]
               ) -> tuple[int, int, Solution]:
    """
    Return the body that moved, before which station, and the solution with that move.

    starts: (s, 2) stations from which each body's is sought, among all moments.
    """
    conservative, tried = agreed.conservative, dict[tuple[int, int], Solution]()
    for (_, body), station in np.ndenumerate(starts):
        move = body, int(station)
        while move not in tried:
            further = _blocks_of_move(conservative, *move)
            tried[move] = with_noise_reestimated(conservative, further)
            # noise and scales estimated with the move do not absorb it: its time is clearer
            again = solution_at(agreed.problem, agreed.estimate, tried[move].noise)
            move = body, int(moments[np.argmax(_gains(again, moments)[0, :, body])])
    (body, k), moved = min(tried.items(), key=lambda move: move[1].deviance)
    return body, k, moved


def _size(moved: Solution, body: int) -> tuple[float, float, float]:
    """Return shift (m), turn (rad) of the move in a solution, and that of the points seen (m)."""
    step = moved.nuisance[:6] * np.repeat([block.std for block in moved.blocks[:2]], 3)
    seen = step[:3] + np.cross(step[3:], _levers(moved)[body])
    return (float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:])),
            rms(np.linalg.norm(seen, axis=1)))


def _blocks_of_move(solution: Solution, body: int, station: int) -> tuple[ParameterBlock, ...]:
    """
    Return two blocks of nuisance parameters: translation (m) and rotation vector of a move.

    body: SENSOR, in the mount, or TARGET, in the base; station: the first after the move.
    """
    columns = _wrt_moves(solution)[body]
    columns[solution.problem.observations.station < station] = 0.0
    return tuple(ParameterBlock(name, columns[:, axes], float(MOVE_STD[axes][0]),
                                largest_variance=1.0)
                 for name, axes in (('translation', slice(0, 3)), ('rotation', slice(3, 6))))


def _wrong_times(solution: Solution, stations: NDArray[np.intp]) -> tuple[ParameterBlock, ...]:
    """
    Return the errors of the times of a sweep that may look like a move; none of stops.

    A clock that jumps before one or more of some stations, near which a move is likeliest, and
    profiles whose points are taken one after the other.
    """
    problem, rows = solution.problem, solution.problem.observations
    if problem.pose_model is None:
        return ()
    by_time = solution.linear.wrt_twists(problem.pose_twists[:, :, :1])
    jump, along = rows.station[:, None] >= stations, rows.points[:, :1]
    return (ParameterBlock('times', np.hstack([by_time * jump, by_time * along / rms(along)])
                           * TIME_STD, TIME_STD, largest_variance=1.0),)


def _wrt_moves(solution: Solution) -> Array:
    """Return the derivatives (2, m, 6) by moves of sensor and target, in prior sigmas."""
    linear = solution.linear
    about = np.cross(_levers(solution)[TARGET], linear.wrt_base)
    steps = np.stack([linear.jacobian[:, :6], np.hstack([linear.wrt_base, about])])
    return np.asarray(steps * MOVE_STD)


def _levers(solution: Solution) -> tuple[Array, Array]:
    """Return the points (m, 3) from what a sensor, and a target, turns about when it moves."""
    p = solution.problem.points_in_base(solution.linear.estimate.X)
    return solution.linear.lever, p - p.mean(axis=0)


def _gains(solution: Solution, moments: NDArray[np.intp], random_orders: int = 0) -> Array:
    """
    Return 2 log Bayes factors (1 + orders, k, 2) of moves of sensor and target, (14).

    Before each of the k moments: in the order of time, and in random orders of the parts between.
    """
    whiten, J = whitening(solution.linear, solution.noise), solution.jacobian
    D = np.array([whiten(columns) for columns in _wrt_moves(solution)])
    scale = np.sqrt(np.diag(solution.covariance))  # m, rad and sigmas differ by 1e5
    values, axes = np.linalg.eigh(solution.covariance / scale / scale[:, None])
    root = (axes * np.sqrt(np.maximum(values, 0.0)) * scale[:, None]).T
    parts = np.split(np.arange(len(J)), np.searchsorted(
        solution.problem.observations.station, moments))
    # sums over each part: D'D, C^(1/2) A'D, D'e
    sums = (np.array([np.swapaxes(D[:, rows], 1, 2) @ D[:, rows] for rows in parts]),
            np.array([root @ (J[rows].T @ D[:, rows]) for rows in parts]),
            np.array([solution.postfit_residuals[rows] @ D[:, rows] for rows in parts]))
    rng, n = np.random.default_rng(0), len(parts)
    gains = []
    for order in (np.arange(n), *(rng.permutation(n) for _ in range(random_orders))):
        # over all parts after each moment
        own, cross, y = (np.cumsum(one[order[::-1]], axis=0)[-2::-1] for one in sums)
        information = own - np.swapaxes(cross, 2, 3) @ cross  # that the other parameters leave
        evidence = []
        for size in SIZE_FACTORS:
            M = np.eye(6) + size ** 2 * information
            step = size ** 2 * np.linalg.solve(M, y[..., None])[..., 0]
            evidence.append((y * step).sum(axis=2) - np.linalg.slogdet(M)[1])
        gains.append(np.max(evidence, axis=0) - 2 * np.log(len(SIZE_FACTORS)))
    return np.array(gains)
