# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is asked of a target; targets/ holds those that there are.

The estimator asks for its conditions, those before it for observations, and checks, calibration
and page for its words.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TYPE_CHECKING

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from handeye_ros.estimation.blocks import ParameterBlock
    from handeye_ros.estimation.problem import Estimate, Linearisation, Observations, Problem


@dataclass(frozen=True)
class Conditions:
    """
    Values g (..., m) in metres that should vanish, (1), and their derivatives.

    dg_dp: (..., m, 3) by the points in the base; dg_dparameters: (..., m, k) by the k parameters
    (not by the entries of the state).
    """

    g: Array
    dg_dp: Array
    dg_dparameters: Array


def target_pose(state: Array) -> Array:
    """Return the pose (..., 4, 4) in the base of a target of a state (..., s)."""
    return state[..., :16].reshape(*state.shape[:-1], 4, 4)


class Target(ABC):
    """
    One target: what it shows, its conditions and its start; the solver is the same for all.

    There are m observations of points p (..., m, 3) in the base, and k parameters of the target.
    Its state (..., 16 + j) is its pose (4, 4) in the base, followed by j measures.

    kinds: names of the conditions, first those on faces, which begin with face (face_kinds)
    parameter_names: names of the parameters: of the pose, then of the measures
    pose_axes: which of x y z rx ry rz, along and about its own axes, are parameters; the others
        leave it the same
    normals: (kinds, 3) by kind, of the surface through the origin on which its points lie
    edge_kinds: the conditions at edges, by their index in kinds, each with its edge, of which
        parallel ones show the same and share a name; a station that shows edges must use one
    min_samples: fewest samples
    unstated_measure: its settings with which its last measure is unknown, where it has one
    loosened_lengths: its settings with which its stated lengths may be wrong, where it has some
    face_count: how many of its faces one view has
    several_in_view: whether a profile may show several candidates, surfaces or pairs of them, of
        which one is the target: a wrong estimate may fit well
    """

    name: str
    kinds: tuple[str, ...]
    parameter_names: tuple[str, ...]
    pose_axes: ClassVar[Sequence[int]]
    normals: ClassVar[Array]
    edge_kinds: ClassVar[Mapping[int, str]] = {}
    min_samples = 6
    unstated_measure: ClassVar[Mapping[str, Any]] = {}
    loosened_lengths: ClassVar[Mapping[str, Any]] = {}
    face_count = 1
    several_in_view = False

    # what samples show of it

    @abstractmethod
    def observe(self, samples: Sequence[Sample]) -> Observations:
        """Return the conditions of the features of samples."""

    def raw_points(self, sample: Sample, points: Array, kind: NDArray[np.intp]
                   ) -> tuple[Array, NDArray[np.intp]]:
        """Return all measured points (k, 2) and kinds for the used observations of a sample."""
        return points, kind

    # for the estimator

    @abstractmethod
    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """
        Yield at least one estimate to start from, best first, computed on demand.

        What the samples do not determine is arbitrary in it.
        """

    @abstractmethod
    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """
        Return the observations with the kinds that fit best; UNUSED for what is on no part of it.

        p: (m, 3) in the base; state: (s,).
        """

    def candidates(self, observations: Observations) -> NDArray[np.intp]:
        """Return the number (m,) of the surface, pair of surfaces, or end in its sample."""
        return observations.feature // self.face_count

    def shows_several(self, observations: Observations) -> bool:
        """Return whether a station shows several surfaces or pairs of them."""
        return self.several_in_view and bool(self.candidates(observations).any())

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """
        Return the conditions g (..., m) of points (..., m, 3) in the target's frame.

        And their derivatives by the points, (..., m, 3), and by the measures (..., j), so
        (..., m, j); kind: (m,). A target whose starts call `shortlisted` must take several states
        at once, others may take one. Here the distances (m) from its surfaces, of a target without
        measures.
        """
        normals = self.normals[kind]
        g = (local * normals).sum(axis=-1)
        return g, np.broadcast_to(normals, local.shape), np.empty((*g.shape, 0))

    def axes(self, R: Array) -> Array:
        """Return the axes (..., 3, 3), in the columns, of the moves of a target turned by R."""
        return R

    def conditions(self, p: Array, kind: NDArray[np.intp], state: Array, config: Config
                   ) -> Conditions:
        """Return what should vanish for points p (..., m, 3) of kinds (m,) in the base."""
        T = target_pose(state)
        R, offset = T[..., :3, :3], p - T[..., None, :3, 3]
        g, dg_dlocal, dg_dmeasures = self.local_conditions(offset @ R, kind, state[..., 16:])
        dg_dp, axes = dg_dlocal @ np.swapaxes(R, -1, -2), self.axes(R)
        wrt_pose = -np.concatenate([dg_dp @ axes, np.cross(offset, dg_dp) @ axes], axis=-1)
        return Conditions(g, dg_dp, np.concatenate(
            [wrt_pose[..., list(self.pose_axes)], dg_dmeasures], axis=-1))

    def measures(self, state: Array) -> dict[str, float]:
        """Return the measures by name, which stated_values may state too; state: (16 + j,)."""
        names = self.parameter_names[len(self.pose_axes):]
        return dict(zip(names, state[16:].tolist(), strict=True))

    def retract(self, state: Array, delta: Array) -> Array:
        """Return the state after a step delta (..., k) in the parameters, m and rad."""
        T = target_pose(state)
        twist, axes = np.zeros((*delta.shape[:-1], 6)), self.axes(T[..., :3, :3])
        twist[..., list(self.pose_axes)] = delta[..., :len(self.pose_axes)]
        step = axes[..., None, :, :] @ twist.reshape(*delta.shape[:-1], 2, 3, 1)
        pose = se3.perturb(T, step.reshape(twist.shape)).reshape(*state.shape[:-1], 16)
        return np.concatenate([pose, state[..., 16:] + delta[..., len(self.pose_axes):]], axis=-1)

    def stated_values(self, config: Config) -> dict[str, tuple[float, float]]:
        """
        Return the stated value and its 1 sigma (m or rad) of parameters by name; here of none.

        With 0 it is exact, else a block of nuisance parameters. All others are unknowns.
        """
        return {}

    @abstractmethod
    def blocks(self, linear: Linearisation) -> Iterable[ParameterBlock]:
        """Return the blocks of nuisance parameters of its own (see blocks.py)."""

    @abstractmethod
    def point_errors(self, linear: Linearisation) -> Array:
        """
        Return derivatives (m, 1) of the residuals by an error of unit variance of each point.

        Conditions on one point share its error. It stands for the target's own blocks during the
        search.
        """

    # for the checks and the answer

    def half_turn_misfit(self, linear: Linearisation) -> tuple[str, float]:
        """
        Return in words the place of the view through which all lines go best, and their misfit.

        The misfit (m RMS) is half of what half a turn of the sensor plane about the place changes.
        """
        # half a turn about a point c makes of a condition r at s, of gradient n, r + 2 n (c - s):
        # -r, as small as before, where all lines go through c, and twice r + n (c - s) beside it
        n, s, r = linear.wrt_point, linear.problem.observations.points, linear.residuals
        c = np.linalg.lstsq(n, (n * s).sum(axis=1) - r, rcond=None)[0]
        return 'at one point', rms(r + ((c - s) * n).sum(axis=1))

    def alike_views_in_words(self, problem: Problem, estimate: Estimate) -> str:
        """Return in words how the views of the target are too much alike, '' if they are not."""
        return ''

    @abstractmethod
    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """
        Return the state, with 1 sigma (k,) of the parameters, as plain values.

        Of these names results/scene.py draws a pose, a point with a direction, a normal with a
        distance, and a centre with a radius; results/printed.py knows the units of names.
        """

    def describe_strays(self, observations: Observations, p: Array, state: Array, config: Config
                        ) -> str:
        """Return in words where observations lie that are not on the target, '' if unknown."""
        return ''
