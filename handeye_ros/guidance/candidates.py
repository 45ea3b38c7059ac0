# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Candidates for the next pose, and the uncertainty of mapped points expected after each.

A station that was taken is a template: the sensor is turned about its anchor (views.anchor_of) and
shifted, so that the anchor appears elsewhere in the field of view. Candidates are drawn at random,
and then around the best of them.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.noise import whitening
from handeye_ros.estimation.problem import linearise, Problem
from handeye_ros.estimation.solve import Solution
from handeye_ros.guidance.rules import Limits, twist_of, Visited
from handeye_ros.guidance.score import Mapping, View, with_rows
from handeye_ros.guidance.views import anchor_of, batch_of, predicted
import numpy as np

TEMPLATES, DRAWN = 6, 240  # stations; candidates of each
ROUNDS, REFINED = 4, 80  # of refinement; candidates of each, around the best
LARGEST_TWIST = 1.6  # rad: about the viewing direction, from the template's
LARGEST_SHIFT = 0.2  # largest shift of the anchor across the laser line, in widths of the view
USEFUL = 0.5  # share of the largest gain: the nearest candidate with as much is taken
LEVER = 0.3  # m/rad: a rotation counts as a distance of so much
NEAR = np.array([0.15, 0.1, 0.1, 0.1, 0.1, 0.3])  # 1 sigma of the choices in each round


@dataclass(frozen=True, eq=False)
class Candidates:
    """
    n poses (n, 4, 4) of the mount, and the uncertainty after a sample at each.

    station: of the template; choices: (n, 6) twist, tilt (2), place (2) and shift as drawn;
    anchors: (n, 2) in the sensor plane; variance: (n,) of mapped points with the
    sample, the nuisance parameters known; problem: of these stations alone.
    """

    station: int
    choices: Array
    poses: Array
    anchors: Array
    variance: Array
    problem: Problem

    def best(self) -> int:
        """Return the index of the best candidate."""
        return int(np.argmin(self.variance))

    def only(self, i: int) -> Candidates:
        """Return a single candidate."""
        rows = slice(i, i + 1)
        return replace(self, choices=self.choices[rows], poses=self.poses[rows],
                       anchors=self.anchors[rows], variance=self.variance[rows],
                       problem=self.problem.subset(np.array([i])))


@dataclass(frozen=True, eq=False)
class Search:
    """How candidates are drawn and compared; last: T_base_flange of the last sample."""

    solution: Solution
    view: View
    limits: Limits
    mapping: Mapping
    visited: Visited
    last: Array

    def draw(self, rng: np.random.Generator) -> list[Candidates]:
        """Return candidates from some stations, empty if none keeps the feature in view."""
        candidates = []
        for station in templates(self.solution.problem):
            drawn = self.judged(station, _drawn(DRAWN, self.limits, rng))
            candidates += [drawn] if len(drawn.poses) else []
        return candidates

    def refined(self, drawn: list[Candidates], rng: np.random.Generator) -> Candidates:
        """Return candidates around a near and useful one of those drawn (at least one)."""
        best, start = self._nearest_useful(drawn)
        for _ in range(ROUNDS):
            choices = best.choices[start] + NEAR * rng.normal(size=(REFINED, 6))
            choices[:, 3:] = np.clip(choices[:, 3:], -1.0, 1.0)
            more = self.judged(best.station, choices)
            if len(more.poses) and more.variance.min() < best.variance[start]:
                best, start = more, more.best()
        return best if start == best.best() else best.only(start)

    def _nearest_useful(self, drawn: list[Candidates]) -> tuple[Candidates, int]:
        """Return the nearest candidate with at least the share USEFUL of the best gain."""
        variance = float(self.mapping.variance(self.solution.reported[:6, :6]))
        gains = [variance - part.variance for part in drawn]
        least = USEFUL * max(float(gain.max()) for gain in gains)
        distances = [np.where(gain >= least, self._distance(part.poses), np.inf)
                     for part, gain in zip(drawn, gains, strict=True)]
        nearest = min(range(len(drawn)), key=lambda i: float(distances[i].min()))
        return drawn[nearest], int(np.argmin(distances[nearest]))

    def _distance(self, poses: Array) -> Array:
        """Return the distances (n,) of poses (n, 4, 4) from the last sample (m), with LEVER."""
        flange = poses if self.limits.in_hand else se3.inverse(poses)
        return np.asarray(np.linalg.norm(flange[:, :3, 3] - self.last[:3, 3], axis=1)
                          + LEVER * se3.angle(self.last[:3, :3].T @ flange[:, :3, :3]))

    def judged(self, station: int, choices: Array) -> Candidates:
        """Return the feasible candidates of choices (n, 6)."""
        problem, estimate = self.solution.problem, self.solution.estimate
        X = estimate.X
        T_sensor, anchors = self._sensors(problem.poses[station] @ X, anchor_of(problem, station),
                                          choices)
        poses = T_sensor @ se3.inverse(X)
        flange = poses if self.limits.in_hand else se3.inverse(poses)
        kept = np.flatnonzero(self.limits.allow(poses, X) & self.visited.allow(flange))
        obs = problem.observations
        template = replace(problem, observations=obs.select(obs.station == station))
        batch, stations = predicted(batch_of(template, estimate, poses[kept], anchors[kept]),
                                    self.view.inner(), self.visited.careful)
        kept, good = kept[stations], batch.problem
        return Candidates(station, choices[kept], poses[kept], batch.anchors,
                          self.mapping.variance(with_rows(self.solution, self._rows(good))),
                          good)

    def _sensors(self, T_sensor: Array, anchor: Array, choices: Array) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) of the sensor, and the anchor (n, 2) seen from each."""
        view, first = self.view.inner(), self.limits.first[:3, :3] @ self.solution.estimate.X[
            :3, :3]
        twist = twist_of(first, T_sensor[None, :3, :3])[0] + choices[:, 0]
        zero = np.zeros(len(choices))
        R = first @ se3.exp_rotation(np.column_stack([zero, zero, twist])) @ se3.exp_rotation(
            np.column_stack([choices[:, 1:3], zero]))
        anchors = (view.low + view.high) / 2 + choices[:, 3:5] * view.size / 2
        anchor = T_sensor[:3, [0, 2]] @ anchor + T_sensor[:3, 3]  # in what carries the target
        anchor = anchor + LARGEST_SHIFT * view.size[0] * choices[:, 5:] * T_sensor[:3, 1]
        in_sensor = np.column_stack([anchors[:, 0], zero, anchors[:, 1]])
        return se3.transform(R, anchor - np.einsum('nij,nj->ni', R, in_sensor)), anchors

    def _rows(self, batch: Problem) -> Array:
        """Return the whitened derivatives (n, c, u) by the unknowns."""
        if not len(batch.poses):
            return np.zeros((0, 1, len(batch.columns)))
        linear = linearise(batch, self.solution.estimate)
        noise = replace(self.solution.noise, lumped=True)  # blocks as errors of the station
        rows = whitening(linear, noise)(linear.jacobian[:, batch.columns])
        return rows.reshape(len(batch.poses), -1, rows.shape[1])


def _drawn(count: int, limits: Limits, rng: np.random.Generator) -> Array:
    """Return choices (n, 6), evenly distributed; half of the tilts are the largest."""
    turn = rng.uniform(0.0, 2 * np.pi, count)
    tilt = limits.tilt * np.minimum(np.sqrt(rng.uniform(0.0, 2.0, count)), 0.99)
    return np.column_stack([
        rng.uniform(-LARGEST_TWIST, LARGEST_TWIST, count), tilt * np.cos(turn),
        tilt * np.sin(turn), rng.uniform(-1.0, 1.0, (count, 3))])


def templates(problem: Problem) -> list[int]:
    """Return some stations, at least one of each combination of conditions."""
    obs = problem.observations
    stations = np.unique(obs.station)
    kinds = [tuple(obs.kind[obs.station == i]) for i in stations]
    groups = [stations[[k == kind for k in kinds]] for kind in dict.fromkeys(kinds)]
    share = max(1, TEMPLATES // len(groups))
    return [int(group[i]) for group in groups
            for i in np.unique(np.linspace(0, len(group) - 1, share).astype(int))]
