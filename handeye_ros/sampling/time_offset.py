"""
The time offset of profiles of a robot that moves: found from nothing, together with the rest.

A profile of stamp t has the pose T(t + dt). The derivative of a condition by dt is that by the
flange's pose times its twist, one more column. A robot may report its rotation later than its
position: T has the position of t + dt and the rotation of t + dt + lag. Far from the truth a fit
with these columns is made from several offsets, on some of the samples, until one explains them.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import islice

from handeye_ros import targets
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.estimation.basis import process_in_time
from handeye_ros.estimation.blocks import Blocks, by_twists, ParameterBlock
from handeye_ros.estimation.linearise import Linear, linearise, Problem
from handeye_ros.estimation.model import Estimate, PoseModel
from handeye_ros.estimation.noise import Noise, TURN_LENGTH, Whitening, whitening
from handeye_ros.estimation.search import guesses, relabelled
from handeye_ros.estimation.solution import retracted
from handeye_ros.estimation.solver import (
    ANNEALING_STEPS,
    believed,
    graduated,
    least_squares,
    NEAR,
    Rows,
    System,
)
from handeye_ros.results.outcome import mounted, ROTATION_LAG, TIME_OFFSET
from handeye_ros.sampling.trajectory import Instants, Trajectory
import numpy as np
from numpy.typing import NDArray

SEED = 0  # of the search: the same samples give the same answer
REACH, STEP = 10, 2  # prior sigmas of the offset that are searched, and between two starts
SOME = 60  # samples of the search
STARTS = 3  # from each offset
MOST = 400  # samples of a solve
NO_POSES = 'no poses tell where the robot was at that time'
CONVINCING = 4.0  # squared residual of the believed share, in variances, of a good start


@dataclass(frozen=True, eq=False)
class Synchronised:
    """
    Samples with the poses of one time offset, and an estimate near their solution.

    rejects: samples at whose time no poses tell where the flange was.
    """

    samples: list[Sample]
    rejects: list[Reject]
    estimate: Estimate | None = None


@dataclass(frozen=True, eq=False)
class Pairing:
    """
    The poses of n samples as a function of the time offset, those of a robot at rest as they are.

    T_base_flange: (n, 4, 4) with the stamps as they are; moving: (n,) whether the robot moved.
    """

    T_base_flange: Array
    stamps: NDArray[np.int64]
    moving: NDArray[np.bool_]
    motion: Trajectory

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> Pairing:
        """Return that of samples, of which some must be of a robot that moves."""
        return cls(np.array([sample.T_base_flange for sample in samples]),
                   np.array([sample.stamp for sample in samples]),
                   np.array([sample.motion is not None for sample in samples]),
                   next(s.motion for s in samples if isinstance(s.motion, Trajectory)))

    def at(self, offset: float, lag: float = 0.0) -> Instants:
        """Return where the flange was at each sample, with an offset and a lag (s)."""
        stamps = self.stamps[self.moving] + round(offset * 1e9)
        found = self.motion.at(stamps)
        if lag:
            late = self.motion.at(stamps + round(lag * 1e9))
            found.T_base_flange[:, :3, :3] = late.T_base_flange[:, :3, :3]
            found.twists[:, 3:] = late.twists[:, 3:]
            found = replace(found, inside=found.inside & late.inside)
        n = len(self.stamps)
        every = Instants(self.T_base_flange.copy(), np.zeros((n, 6)), np.ones(n, dtype=bool))
        for name in ('T_base_flange', 'twists', 'inside'):
            getattr(every, name)[self.moving] = getattr(found, name)
        return every

    def poses_and_twists(self, values: Array) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and twists (n, 6, k) of an offset and a lag, for a PoseModel."""
        return _evaluated(self, tuple(values.tolist()))


@lru_cache(maxsize=8)  # of a step the poses are asked for first, the twists later
def _evaluated(pairing: Pairing, values: tuple[float, ...]) -> tuple[Array, Array]:
    there = pairing.at(*values)
    twists = np.stack([there.twists] * len(values), axis=2)
    twists[:, :3, 1:] = 0.0
    return there.T_base_flange, twists


def problem_of(samples: Sequence[Sample], config: Config) -> Problem:
    """Return the problem of samples; that of a robot that moves with the time offset in it."""
    method = targets.method_for(config)
    problem = Problem(method, mounted(samples, config), method.features.observe(samples), config)
    if not any(sample.motion for sample in samples):
        return problem
    pairing = Pairing.of(samples)
    stds = np.array([config.time_offset_std, config.rotation_lag_std])
    stds = stds[stds > 0]
    model = PoseModel(pairing.poses_and_twists, (TIME_OFFSET, ROTATION_LAG)[:len(stds)],
                      (1,) * len(stds), tuple(stds.tolist()), least=1.0,
                      blocks=partial(errors_in_motion, pairing.stamps))
    values = np.array([*next(s.offsets for s in samples if s.motion), 0.0])[:len(stds)]
    return replace(problem, pose_model=model, pose_values=values)


def errors_in_motion(stamps: NDArray[np.int64], first: Linear) -> Blocks:
    """Return the blocks of the errors of a robot that moves, smooth in time, and of exposure."""
    size, model = first.problem.config.noise.robot_smooth, first.problem.pose_model
    assert model is not None
    here = stamps if model.stations is None else stamps[model.stations]
    functions = process_in_time((here - stamps[0]) * 1e-9)

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        for name, axes, std in (('tracking_position', slice(0, 3), size),
                                ('tracking_rotation', slice(3, 6), size / TURN_LENGTH)):
            twists = np.einsum('xa,nk->nxak', np.eye(6)[:, axes], functions)
            twists = twists.reshape(len(functions), 6, -1)
            yield ParameterBlock(name, by_twists(linear, twists) * std, std, twists=twists,
                                 report=f'{name}_error')
        if linear.problem.config.profile.exposure and linear.problem.method.nuisances:
            yield _exposure(linear)
    return at


def _exposure(linear: Linear) -> ParameterBlock:
    """
    Return the block of how much sooner a face seems to end during an exposure.

    What a profile averages over is of the face only as long as the face is seen: the end moves by
    up to half the exposure times the velocity at which the edge passes, always the same way.
    """
    problem, std = linear.problem, linear.problem.config.profile.exposure / 2
    assert problem.pose_model is not None and problem.method.nuisances is not None
    twists = problem.pose_model.at(problem.pose_values)[1][:, :, :1]
    inwards = np.sign(problem.method.nuisances.feature_errors(linear))
    return ParameterBlock('exposure', inwards * np.abs(by_twists(linear, twists)) * std, std)


def synchronised(samples: Sequence[Sample], config: Config) -> Synchronised:
    """
    Return samples with the poses of the offset that explains those of a robot that moves.

    Of very many some are taken. Raises DataError where no estimate can be started.
    """
    if not any(sample.motion for sample in samples):
        return Synchronised(list(samples), [])
    samples = [samples[i] for i in evenly_chosen(len(samples), MOST)]
    problem = problem_of(samples, config)
    found = _searched(problem.subset(evenly_chosen(len(samples), SOME)),
                      np.random.default_rng(SEED))
    found = _refined(problem.with_pose_values(found.values), found.estimate)
    there, paired, rejects = Pairing.of(samples).at(*found.values), [], []
    for sample, T, inside in zip(samples, there.T_base_flange, there.inside, strict=True):
        if inside:
            paired.append(replace(sample, T_base_flange=T, offsets=tuple(found.values)))
        else:
            rejects.append(Reject(sample.stamp, NO_POSES))
    return Synchronised(paired, rejects, found.estimate)


def _searched(problem: Problem, rng: np.random.Generator) -> _At:
    """Return the best fit from several offsets, the most likely first, or one that convinces."""
    best: _At | None = None
    for offset in sorted(np.arange(-REACH, REACH + 1, STEP), key=abs):
        values = np.zeros(len(problem.pose_values))
        values[0] = offset * problem.config.time_offset_std
        there = problem.with_pose_values(values)
        for start in islice(guesses(there, rng), STARTS):
            found = _refined(there, start)
            best = found if best is None or found.loss < best.loss else best
        if best and believed(best.squares) < CONVINCING:
            break
    assert best is not None
    return best


def _refined(problem: Problem, start: Estimate) -> _At:
    """Return where graduated non-convexity leads to from an estimate, the offset unknown too."""
    def refit(at: _At, weights: Array) -> _At:
        system = System(_At.rows, _At.moved, at.blocks)
        at = least_squares(system, at, np.append(weights, 1.0), ANNEALING_STEPS, NEAR)
        return labelled(at.problem, at.estimate)

    def labelled(now: Problem, estimate: Estimate) -> _At:
        whole = replace(now, observations=problem.observations)
        return _At(relabelled(whole, estimate, now), estimate)

    return graduated(labelled(problem, start), lambda at: at.squares, refit)


@dataclass(frozen=True, eq=False)
class _At:
    """A problem with the labels that fit an estimate; offset and lag are its pose values."""

    problem: Problem
    estimate: Estimate

    @property
    def values(self) -> Array:
        return self.problem.pose_values

    @property
    def prior_stds(self) -> Array:
        assert self.problem.pose_model is not None
        return np.array(self.problem.pose_model.stds)

    @cached_property
    def linear(self) -> Linear:
        return linearise(self.problem, self.estimate)

    @cached_property
    def white(self) -> Whitening:
        return whitening(self.problem, self.linear, Noise())

    @cached_property
    def squares(self) -> Array:
        """Return the mean squared whitened residual (n,) of each sample."""
        station, n = self.problem.observations.station, len(self.problem.poses)
        squares = np.bincount(station, self.white(self.linear.residuals) ** 2, minlength=n)
        return np.asarray(squares / np.maximum(np.bincount(station, minlength=n), 1))

    @property
    def loss(self) -> float:
        return float(np.log1p(self.squares).mean())

    @property
    def blocks(self) -> NDArray[np.intp]:
        """Return the block of each row: its sample, and one of the priors."""
        stations = np.full(len(self.values), len(self.problem.poses))
        return np.append(self.problem.observations.station, stations)

    def rows(self) -> Rows:
        """Return the residuals, the last those of the priors."""
        return Rows(np.append(self.linear.residuals, self.values / self.prior_stds),
                    self._jacobian, lambda: self._whitened)

    def _jacobian(self) -> Array:
        linear, problem, model = self.linear, self.problem, self.problem.pose_model
        assert model is not None
        J = np.hstack([linear.jacobian[:, problem.columns],
                       by_twists(linear, model.at(self.values)[1])])
        priors = np.eye(J.shape[1])[-len(self.values):] / self.prior_stds[:, None]
        return np.vstack([J, priors])

    def _whitened(self, values: Array) -> Array:
        k = len(self.values)
        return np.concatenate([self.white(values[:-k]), values[-k:]])

    def moved(self, step: Array) -> _At:
        """Return the same moved by a step of all unknowns, offset and lag the last of them."""
        k = len(self.values)
        estimate = retracted(self.problem, self.estimate, step[:-k])
        return _At(self.problem.with_pose_values(self.values + step[-k:]), estimate)


def evenly_chosen(n: int, most: int) -> NDArray[np.intp]:
    """Return the indices of at most so many of n samples, evenly spread."""
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(np.intp)
