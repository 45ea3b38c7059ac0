# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether sensor or target moved in the middle of a recording.

If the samples fit no answer, each hypothesis is two parts of the recording, fitted separately. If
they do, a move before station i is two more blocks of nuisance parameters, linearised at the
answer, (14); the steps are those of "A small move" in section 6 of docs/estimator.md. It must be
larger than the smooth error of the robot, and two tests must agree. The Bayes factor: noise and
taus are estimated again with and without the move, since they absorb part of it otherwise. A
permutation test: random orders of the stations must seldom show as clear a move, since robot
errors that are not in the model look like moves in any order.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.checks.hypotheses import (
    DECISIVE_EVIDENCE,
    Explanation,
    FALSE_CAUSE_PROBABILITY,
    Hypothesis,
)
from handeye_ros.data import Array, SEED, TIME_OFFSET
from handeye_ros.errors import DataError
from handeye_ros.estimation.blocks import ParameterBlock, ROBOT_SMOOTH
from handeye_ros.estimation.least_squares import chi2_isf
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, NoiseModel
from handeye_ros.estimation.posterior import Posterior, posterior_at
from handeye_ros.estimation.problem import Estimate, Linearisation, Problem
from handeye_ros.estimation.search import quick_solution, reassigned
from handeye_ros.estimation.solution import cover, Solution, with_noise_reestimated
from handeye_ros.frames import mount_frame, target_frame
from handeye_ros.words import degrees, mm
import numpy as np
from numpy.typing import NDArray

SENSOR, TARGET = range(2)  # a body that moves: an index of derivatives, levers, evidence
POSSIBLE_MOVE = 'possible move'  # its name in a budget of the covariance
CHANGE_POINTS_TRIED = 160  # most change points of the screen (step 1)
FIRST_TRIED = 100  # FIRST_TRIED / n change points go on to step 2
MOVE_STD = np.repeat([2e-3, 5e-3], 3)  # prior 1 sigma of a small move (m, rad)
TIME_STD = 0.01  # of the times that may be wrong instead, 1 sigma (s)
SIZE_FACTORS = (1.0, 0.25)  # factors on MOVE_STD, of equal prior probability
# twice the log of the Bayes factor (Kass and Raftery: positive, 2 to 6), to warn
WARNING_EVIDENCE = 5.0
MIN_MOVE_SIGMAS = 3.0  # smallest move over the robot's smooth error
PARTED_P = 0.01  # largest probability that random stations are the first, or the last, ones
RANDOM_ORDERS, PARTS_EXCHANGED = 200, 40  # of the permutation test
WARNING_P, REFUSAL_P = 0.1, 0.01  # largest p-value of the permutation test: to warn, to refuse


# -- two parts of a recording, where no answer fits all of it


def move_hypotheses(problem: Problem, stamps: Sequence[int]) -> Iterator[Hypothesis]:
    """
    Yield the hypotheses that something moved between two parts of a recording.

    stamps: of the stations.
    """
    n, fewest = len(problem.poses), problem.target.min_samples
    change_points = np.linspace(fewest, n - fewest, 15 if n >= 2 * fewest else 0)
    for station in np.unique(change_points.round().astype(int)).tolist():
        first, second = (quick_solution(problem.subset(part))
                         for part in np.split(np.arange(n), [station]))
        if first and second and ((target_moved := _same_transform(first, second))
                                 or _same_target(first, second)):
            yield Hypothesis(Explanation.of_solutions(stamps, first, second),
                             _move_refusal(first, second, target_moved))


def _move_refusal(first: Solution, second: Solution, target_moved: bool) -> DataError:
    """Return the refusal of a recording in which target or sensor moved between two parts."""
    config = first.full_problem.config
    count, others = (len(part.full_problem.poses) for part in (first, second))
    if target_moved:
        frame, advice = target_frame(config), 'fix the target, and take'
        what = f'target moved in {frame}'
    else:
        frame, advice = mount_frame(config), 'take'
        move = se3.inverse(first.estimate.X) @ second.estimate.X
        what = (f'sensor moved in {frame} by {mm(float(np.linalg.norm(move[:3, 3])))} and '
                f'{degrees(float(se3.angle(move[:3, :3])))}')
    return DataError(
        f'the first {count} samples agree among themselves, and so do the other {others}, but not '
        f'with each other: in between, the {what}, or {frame} became another frame (tool or base '
        f'of the robot switched); {advice} all samples with the same', code='moved')


def _same_transform(first: Solution, second: Solution) -> bool:
    """Return whether two parts may have the same transform: then the target moved between them."""
    covariance = sum(part.transform_covariance * max(part.posterior.reduced_chi_squared, 1.0)
                     for part in (first, second))
    delta = se3.difference(second.estimate.X, first.estimate.X)
    return bool(delta @ np.linalg.solve(covariance, delta) < chi2_isf(FALSE_CAUSE_PROBABILITY, 6))


def _same_target(first: Solution, second: Solution) -> bool:
    """
    Return whether two parts may see the same target: then the sensor moved between them.

    Parts of a few samples, some of them wrong, fit by chance, each with a target of its own. A
    part that leaves its target free, as one edge of a plate does, may see any.
    """
    posteriors = first.posterior, second.posterior
    if not all(posterior.is_determined for posterior in posteriors):
        return True
    # how far the target of the second part is from that of the first, where it is linearised
    estimate = Estimate(second.estimate.X, first.estimate.state)
    at_first = posterior_at(reassigned(second.problem, estimate), estimate, BLOCKS_AS_NOISE)
    away = (at_first.cross_covariance.T @ at_first.prefit_residuals)[6:]
    covariance = (posteriors[0].covariance + at_first.covariance)[6:, 6:]
    square = away @ np.linalg.solve(covariance, away)
    factor = max(*(posterior.reduced_chi_squared for posterior in posteriors), 1.0)
    return bool(square < factor * chi2_isf(FALSE_CAUSE_PROBABILITY, len(away)))


# -- outliers at one end, though one answer fits the others


def outliers_at_one_end(solution: Solution) -> str:
    """
    Return in words that all stations that were dropped are the first, or the last, ones.

    '' if they are not, or if wrong stations in a random order are so too with PARTED_P.
    """
    n, used = len(solution.full_problem.poses), solution.used_stations
    dropped = n - len(used)
    if solution.problem.is_sweep or math.comb(n, dropped) < 2 / PARTED_P:
        return ''
    which, side = {0: ('last', 'before'), dropped: ('first', 'after')}.get(int(used[0]), ('', ''))
    if not which or np.ptp(used) >= n - dropped:
        return ''
    return (f'the {which} {dropped} of {n} samples contradict the {n - dropped} {side} them: the '
            'target or the sensor seems to have moved in between, or the tool or base of the '
            'robot was switched: check that both are fixed firmly, and take all samples again')


# -- a small move, though one answer fits all samples


def with_possible_move(solution: Solution) -> tuple[Solution, str]:
    """
    Return a refined solution, and a warning on a move and its time, '' if there is none.

    With a warning, the covariance covers the transform with that move as well, but where all
    dropped stations are at one end. Raises DataError as require_no_sure_move does.
    """
    move = possible_move(solution)
    require_no_sure_move(move)
    if not move:
        return solution, outliers_at_one_end(solution)
    away = se3.difference(move.moved.estimate.X, move.unmoved.estimate.X)
    with_move = move.moved.covariance[:6, :6] + np.outer(away, away)
    covariance = solution.transform_covariance
    return replace(solution, added_covariances={
        **solution.added_covariances,
        POSSIBLE_MOVE: cover(covariance, with_move) - covariance}), move.in_words()


def possible_move(solution: Solution) -> Move | None:
    """Return the move that may have been, None also with all dropped stations at one end."""
    move = None if outliers_at_one_end(solution) else _likeliest_move(solution)
    if not move or move.evidence < WARNING_EVIDENCE or move.may_be_robot_error:
        return None
    return move if move.permutation_p_value < WARNING_P else None


def require_no_sure_move(move: Move | None) -> None:
    """Raise DataError (moved) for a sure move (step 6 of "A small move" in estimator.md)."""
    if move and move.evidence > DECISIVE_EVIDENCE and move.permutation_p_value < REFUSAL_P:
        raise DataError(move.in_words(), code='moved')


@dataclass(frozen=True, eq=False)
class Move:
    """
    A move of sensor or target before one of the stations that a solution uses.

    solution: that is tested
    body: SENSOR, in the mount, or TARGET, in the frame that it is fixed in
    station: the first one after the move, of those used
    moved: its posterior with the move as two more blocks, noise and taus estimated again
    unmoved: the same without the move
    """

    solution: Solution
    body: int
    station: int
    moved: Posterior
    unmoved: Posterior

    @cached_property
    def evidence(self) -> float:
        """Return 2 log B against no move and, of a sweep, wrong times (step 3)."""
        alternatives = [self.unmoved]
        if self.solution.problem.is_sweep:
            near = self.station + _margin(self.solution) * np.arange(-2, 3)
            reported = self.solution.report_posterior
            alternatives.append(
                with_noise_reestimated(reported, (_wrong_times(reported, near),)))
        least = min(other.minus_2_log_marginal for other in alternatives)
        return least - self.moved.minus_2_log_marginal

    @cached_property
    def displacement(self) -> Array:
        """
        Return the translation (m) and rotation vector (rad) of the move, (6,).

        Of the sensor in the axes of the mount, of the target in those of the frame that it is
        fixed in; see _levers.
        """
        return np.asarray(self.moved.nuisance[:6] * MOVE_STD)  # its blocks are the first

    @property
    def may_be_robot_error(self) -> bool:
        """Return whether the points move no more than the robot's smooth error may be (step 4)."""
        translation, turn = np.split(self.displacement, 2)
        shifts = translation + np.cross(turn, _levers(self.moved.linear)[self.body])
        # the smaller estimate of that error, as a move can only explain it
        smooth = min(max((block.std * each.prior_tau(block) for block in each.blocks
                          if block.name == ROBOT_SMOOTH), default=0.0)
                     for each in (self.moved, self.unmoved))
        smallest = MIN_MOVE_SIGMAS * smooth
        if self.solution.problem.is_sweep:  # its error is smooth in time, as a move is
            smallest = max(smallest, self.solution.full_problem.config.noise.robot_smooth)
        return rms(np.linalg.norm(shifts, axis=1)) < smallest

    @cached_property
    def permutation_p_value(self) -> float:
        """Return the share of random orders of the stations with as clear a move (step 5)."""
        solution = self.solution
        in_time, *in_random_orders = _move_evidence(
            posterior_at(solution.problem, solution.estimate, self.moved.noise),
            _change_points(solution, PARTS_EXCHANGED), RANDOM_ORDERS).max(axis=(1, 2))
        return float(np.mean(in_random_orders >= in_time))

    def in_words(self) -> str:
        """Return what moved, when, by how much, and what to do."""
        config, poses = self.solution.full_problem.config, self.solution.full_problem.poses
        what, frame = (('sensor', mount_frame(config)) if self.body == SENSOR
                       else ('target', target_frame(config)))
        shift, turn = np.linalg.norm(self.displacement.reshape(2, 3), axis=1).tolist()
        count = self.solution.used_stations[self.station]
        clocks = ', or a clock jumped' if self.solution.problem.is_sweep else ''
        return (f'after the first {count} of {len(poses)} samples the {what} seems to have moved '
                f'in {frame} by about {mm(shift)} and {degrees(turn)}, or the tool or base of the '
                f'robot was switched, or robot or sensor drift{clocks}: check that it is fixed '
                'firmly, and take all samples again')


def _likeliest_move(solution: Solution) -> Move | None:
    """
    Return the likeliest move, None where there is evidence against any or stations are few.

    The screen, step 1, is followed by step 2: the move and the noise with it are estimated in
    turn, until the same move is the likeliest.
    """
    problem, reported, n = solution.problem, solution.report_posterior, len(solution.used_stations)
    if n < problem.target.min_samples + 4:  # too few to tell a move from an outlier
        return None
    posteriors = [reported]
    if not problem.is_sweep:
        # of a few stations, estimated noise absorbs a move; configured may be too large
        posteriors.append(posterior_at(problem, solution.estimate, NoiseModel()))
    change_points = _change_points(solution, CHANGE_POINTS_TRIED)
    evidence = np.max([_move_evidence(each, change_points)[0] for each in posteriors], axis=0)
    if evidence.max() < -WARNING_EVIDENCE:
        return None
    first_tried = change_points[np.argsort(-evidence, axis=0)[:max(FIRST_TRIED // n, 1)]]
    # a moment a few profiles off leaves an error that only a much worse robot would explain
    all_change_points = _change_points(solution, n)
    tried = dict[tuple[int, int], Posterior]()
    for (_, body), first in np.ndenumerate(first_tried):
        station = int(first)
        while (body, station) not in tried:
            moved = with_noise_reestimated(reported, _blocks_of_move(reported, body, station))
            tried[body, station] = moved
            # noise and taus estimated with the move do not absorb it: its time is clearer
            again = posterior_at(problem, solution.estimate, moved.noise)
            evidence = _move_evidence(again, all_change_points)[0, :, body]
            station = int(all_change_points[np.argmax(evidence)])
    (body, station), moved = min(tried.items(), key=lambda item: item[1].minus_2_log_marginal)
    return Move(solution, body, station, moved, with_noise_reestimated(reported))


def _margin(solution: Solution) -> int:
    """Return the fewest stations before and after a move."""
    return (max(2, len(solution.used_stations) // PARTS_EXCHANGED)
            if solution.problem.is_sweep else 2)


def _change_points(solution: Solution, count: int) -> NDArray[np.intp]:
    """Return at most a number of stations, evenly spaced, before which something may move."""
    margin, n = _margin(solution), len(solution.used_stations)
    return np.unique(np.linspace(margin, n - margin, count).round().astype(int))


def _blocks_of_move(posterior: Posterior, body: int, station: int) -> tuple[ParameterBlock, ...]:
    """Return two blocks of nuisance parameters: translation (m) and rotation vector of a move."""
    columns = _wrt_moves(posterior.linear)[body]
    columns[posterior.problem.observations.station < station] = 0.0
    return tuple(ParameterBlock(name, columns[:, axes], float(MOVE_STD[axes][0]),
                                largest_tau_squared=1.0)
                 for name, axes in (('translation', slice(0, 3)), ('rotation', slice(3, 6))))


def _wrong_times(posterior: Posterior, stations: NDArray[np.intp]) -> ParameterBlock:
    """
    Return the errors of the times of a sweep that may look like a move.

    A clock that jumps before one or more of some stations, near which a move is likeliest, and
    profiles whose points are taken one after the other.
    """
    problem, observations = posterior.problem, posterior.problem.observations
    assert problem.pose_model  # of a sweep
    time = problem.pose_model.names.index(TIME_OFFSET)
    wrt_time = posterior.linear.wrt_twists(problem.pose_twists[:, :, [time]])
    after, along = observations.station[:, None] >= stations, observations.points[:, :1]
    columns = np.hstack([wrt_time * after, wrt_time * along / rms(along)])
    return ParameterBlock('times', columns * TIME_STD, TIME_STD, largest_tau_squared=1.0)


def _wrt_moves(linear: Linearisation) -> Array:
    """Return the derivatives (2, m, 6) by moves of sensor and target, in prior sigmas."""
    wrt_turn = np.cross(_levers(linear)[TARGET], linear.wrt_base)
    wrt_move = np.stack([linear.jacobian[:, :6], np.hstack([linear.wrt_base, wrt_turn])])
    return np.asarray(wrt_move * MOVE_STD)


def _levers(linear: Linearisation) -> tuple[Array, Array]:
    """
    Return the points (m, 3) from what a sensor, and a target, turns about when it moves.

    Of the sensor from its origin, in the axes of the mount; of the target from the middle of the
    points, in the axes of the base.
    """
    p = linear.problem.points_in_base(linear.estimate.X)
    return linear.lever, p - p.mean(axis=0)


def _move_evidence(posterior: Posterior, change_points: NDArray[np.intp],
                   random_orders: int = 0) -> Array:
    """
    Return the evidence 2 log B (1 + orders, k, 2) for moves of sensor and target, (14).

    Before each of the k change points: in the order of time, and in random orders of the parts
    between.
    """
    A, gain, e = posterior.jacobian, posterior.cross_covariance, posterior.postfit_residuals
    D = [posterior.whitening(columns) for columns in _wrt_moves(posterior.linear)]
    parts = np.split(np.arange(len(A)), np.searchsorted(
        posterior.problem.observations.station, change_points))
    # of each part D' times D, A, A C and e
    products = np.array([[wrt_move[rows].T @ np.hstack(
        [wrt_move[rows], A[rows], gain[rows], e[rows, None]]) for wrt_move in D]
        for rows in parts])
    rng, n = np.random.default_rng(SEED), len(parts)
    evidence = []
    for order in (np.arange(n), *(rng.permutation(n) for _ in range(random_orders))):
        after = np.cumsum(products[order[::-1]], axis=0)[-2::-1]  # all parts after each moment
        D_D, D_A, D_A_C, y = np.split(after, np.cumsum([6, A.shape[1], A.shape[1]]), axis=3)
        information = D_D - D_A_C @ np.swapaxes(D_A, 2, 3)  # that the other parameters leave
        of_sizes = []
        for size in SIZE_FACTORS:
            M = np.eye(6) + size ** 2 * information
            square = size ** 2 * (y * np.linalg.solve(M, y)).sum(axis=(2, 3))
            of_sizes.append(square - np.linalg.slogdet(M)[1])
        evidence.append(np.max(of_sizes, axis=0) - 2 * np.log(len(SIZE_FACTORS)))
    return np.array(evidence)
