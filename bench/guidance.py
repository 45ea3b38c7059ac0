# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How many stops the advice saves, against poses at random within the same limits.

usage: python bench/guidance.py [--seeds N] [--first S] [--targets plate,line,sphere] [--robot R]
           [--priors none|shipped] [--wanted METRES] [--stops N] [--refused]

Per seed a new cell: rendered profiles (4 a stop), a robot whose repeatability is that of --robot
(common: 0.05 mm and 0.02 degrees; fine: 0.02 mm and 0.004 degrees), and nothing systematic in
it, nor in the settings; with --priors shipped the settings hold the default priors.
One operator goes where the advice says, the other anywhere within guidance.reach,
guidance.tilt and guidance.turn from the same first pose. Both end up turned off by 2 degrees (1
sigma; the moves before the sensor is roughly known: by 4), with the target 3 mm from where it was
to be seen. Where the sensor shows no target, or the laser is nowhere near an edge of it, both try
again, and that counts nothing.
A row per target: the median number of stops, and its quartiles, until points mapped over the
sensor's field of view are off by less than --wanted (0.1 mm), and until their stated 1 sigma is
less; each for the first time, and from then on up to the last of --stops (50). Sessions that
never got there count as all stops, and are told. The error of one session may be small by
luck long before anybody could know: for the first time counts this luck, from then on does not.
ratio: of the medians; paired: the median of the ratios of each seed.
Counts go to stderr as they come. Each solution starts from the one before, and no other answers
are looked for, which takes most of the time of `handeye solve`.

With --refused, sessions with the shipped settings go to every proposal, exactly and off by as much
as above (1 sigma), until the node says that it is enough or for --stops stops: how many stops
gave no sample and why, how many sessions reached enough and at which sample, and the median of the
stated 1 sigma and of the true error of mapped points then (mm), and the worst error.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
import math
import re
import sys

from handeye_ros import config as configs
from handeye_ros import se3, targets
from handeye_ros.config import Config
from handeye_ros.data import EdgePoint, Feature, Profile, Sample
from handeye_ros.errors import DataError, FeatureError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.search import refined_solution, robust_solution
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_poses_of
from handeye_ros.guidance.advice import advise
from handeye_ros.guidance.first_moves import AdvisedMove
from handeye_ros.guidance.view import extremes, learn_view, View, view_levers
from handeye_ros.pipeline import Answer
from handeye_ros.results.truth import errors_against, field_points
from handeye_ros.sampling.edge_shapes import with_common_edge_shape
from handeye_ros.sampling.features import combined_features
from handeye_ros.sampling.input_faults import duplicate_pose_reason
from handeye_ros.sampling.stops import Stop
from handeye_ros.simulate import Scenario, SCENARIOS, sensor, settings, simulate_samples
from handeye_ros.simulate.scenario import PlateTarget, WedgeTarget
from handeye_ros.simulate.scenes import edge_frames, facing, SCENES, SENSOR_FACING
import numpy as np

KNOWN_WELL = 1e-3  # m: 1 sigma of mapped points, from which on the last answer is the start
PROFILES = 4
NEAR_THE_EDGE = 0.015  # m: what is taken for an edge farther away is another, or the view's end
PATIENCE = 40  # tries near a pose that was advised
OPERATORS = ('advice', 'random')
READINGS = ('error, first', 'error, from then on', '1 sigma, first', '1 sigma, from then on')
ROBOTS = {'common': (5e-5, math.radians(0.02)), 'fine': (2e-5, math.radians(0.004))}
# What this cell does not have, and what is therefore not believed in.
KNOWN = {'noise.robot_smooth': 0.0, 'noise.robot_scale': 0.0, 'noise.distortion': 0.0,
         'noise.line_bend': 0.0, 'noise.flatness': 0.0, 'target.radius_std': 1e-6}


@dataclass(eq=False)
class World:
    """A cell with truth, in which the robot may go anywhere."""

    scenario: Scenario
    config: Config
    rng: np.random.Generator
    T_flange_sensor: np.ndarray
    T_base_target: np.ndarray
    samples: list[Sample] = field(default_factory=list)
    last: Solution | None = None
    refused: list[np.ndarray] = field(default_factory=list)  # poses at which no sample was taken
    seen: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))  # by all profiles

    @property
    def view(self) -> View:
        """Return the field of view, which profiles of anything show."""
        (near, far), half = self.scenario.sensor.range, self.scenario.sensor.half_width
        return learn_view((), np.array([[side * half * z, z] for z in (near, far)
                                        for side in (-1, 1)]))

    def facing(self, edge: int) -> np.ndarray:
        """Return R_target_sensor (3, 3) of a sensor that looks squarely."""
        if self.scenario.scene == 'sphere':
            return np.diag([1.0, -1.0, -1.0])
        if isinstance(self.scenario.target, WedgeTarget):
            return facing(self.scenario.target)
        return edge_frames(self.scenario.target)['pq'[edge]][:3, :3] @ SENSOR_FACING

    def spot(self, edge: int) -> np.ndarray:
        """Return some point (3,) of the target, on an edge if it has any."""
        target = self.scenario.target
        if isinstance(target, WedgeTarget):
            return np.array([self.rng.uniform(0.02, target.length - 0.02), 0.0, 0.0])
        if not isinstance(target, PlateTarget):
            way = np.append(self.rng.uniform(-0.6, 0.6, 2), 1.0)
            return target.radius * way / np.linalg.norm(way)
        length = target.size[edge]
        frame = edge_frames(target)['pq'[edge]]
        return frame[:3, 3] + frame[:3, 0] * self.rng.uniform(0.03, length - 0.03)

    def beside(self, R: np.ndarray, share: float, off: float) -> np.ndarray:
        """Return the point (3,) of a ball that is seen with its middle so far off the plane."""
        radius = self.scenario.target.radius
        y = np.clip(share * radius + off, -0.9 * radius, 0.9 * radius)
        return -R @ [0.0, y, np.sqrt(radius ** 2 - y ** 2)]

    def looking(self, R: np.ndarray, spot: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Return T_base_flange of a sensor turned by R that sees a spot at a place (2,)."""
        T_target_sensor = se3.transform(R, spot - R @ [place[0], 0.0, place[1]])
        return self.T_base_target @ T_target_sensor @ se3.inverse(self.T_flange_sensor)

    def stop(self, T_base_flange: np.ndarray) -> None:
        """Take a sample; raises FeatureError where a node would take none."""
        T = se3.inverse(self.T_base_target) @ T_base_flange @ self.T_flange_sensor
        z, angle = sensor.render(self.scenario.sensor, SCENES[self.scenario.scene].solids(
            self.scenario), T[None])
        shape = (PROFILES, z.shape[1])
        measured = sensor.measure(self.scenario.sensor, np.broadcast_to(z, shape).copy(),
                                  np.broadcast_to(angle, shape), self.rng)
        profiles = [Profile(k, 'laser', points) for k, points in enumerate(
            sensor.plane_points(self.scenario.sensor, measured))]
        self.seen = extremes(np.concatenate([self.seen, profiles[-1].points]))
        used, features = combined_features(profiles, self.config)
        self._look(features, T)
        error = np.repeat(self.scenario.robot.repeatability, 3) * self.rng.normal(size=6)
        sample = Sample(len(self.samples), reported(T_base_flange, error), features, len(used))
        others = [Stop(other.stamp, number=k, result=other)
                  for k, other in enumerate(self.samples, 1)]
        if why := duplicate_pose_reason(sample, others, self.config):
            raise FeatureError(why)
        self.samples.append(sample)

    def _look(self, features: tuple[Feature, ...], T_target_sensor: np.ndarray) -> None:
        """Refuse what a person sees: that the laser is nowhere near an edge of the target."""
        edges = [f.point for f in features if isinstance(f, EdgePoint)]
        target = self.scenario.target
        if not edges or not isinstance(target, PlateTarget):
            return
        p = np.array(edges) @ T_target_sensor[:3, [0, 2]].T + T_target_sensor[:3, 3]
        edges = len(targets.target_for(self.config).edge_kinds)
        frames = list(edge_frames(target).values())[:edges]
        away = [np.linalg.norm((p - frame[:3, 3]) @ frame[:3, 1:3], axis=1) for frame in frames]
        if np.min(away) > NEAR_THE_EDGE:
            raise FeatureError('the laser does not cross the edge')


def reported(T: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return what the robot tells of a flange at T (4, 4): off by an error (6,)."""
    return se3.transform(se3.exp_rotation(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])


def world(target: str, robot: tuple[float, float], seed: int, known: dict[str, float]) -> World:
    """Return a new cell with the first sample taken: roughly square, roughly in the middle."""
    made = SCENARIOS[target]
    made = replace(made, sensor=replace(made.sensor, columns=640),
                   robot=replace(made.robot, repeatability=robot))
    rng = np.random.default_rng(seed)
    _, truth = simulate_samples(made, rng)
    new = World(made, configs.with_values(Config(), settings(made) | known, 'bench'), rng,
                truth.T_flange_sensor, truth.T_base_target)
    nearer = 0.2 if made.scene == 'sphere' else 0.0  # of the view's depth: its top is seen
    middle = new.view.middle - [0, nearer * new.view.size[1]]
    insist(new, lambda: new.looking(new.facing(0) @ turned(rng, 6.0), new.spot(0),
                                    middle + rng.normal(size=2) * 3e-3))
    return new


def turned(rng: np.random.Generator, degrees: float) -> np.ndarray:
    """Return a small random rotation, 1 sigma about each axis."""
    return se3.exp_rotation(np.radians(degrees) * rng.normal(size=3))


def insist(cell: World, pose: Callable[[], np.ndarray | None]) -> None:
    """Take a sample at the first pose at which the target is seen."""
    for _ in range(5000):
        T = pose()
        try:
            if T is not None:
                return cell.stop(T)
        except FeatureError:
            continue
    raise SystemExit('nowhere is the target seen')


def anywhere(cell: World) -> np.ndarray | None:
    """Return a pose near a random one with the target in view, None of one beyond the limits."""
    config, rng = cell.config.guidance, cell.rng
    edge = int(rng.integers(0, 2)) if cell.scenario.scene == 'plate' else 0
    way, tilt = rng.uniform(0, 2 * np.pi), config.tilt * rng.uniform() ** 0.5
    steepest = config.turn if cell.scenario.scene == 'sphere' else (
        np.pi / 2 - cell.config.sampling.min_crossing_angle)
    turn = rng.uniform(-1, 1) * min(config.turn, steepest)
    R = (cell.facing(edge) @ se3.exp_rotation(np.array([0.0, 0.0, turn]))
         @ se3.exp_rotation(tilt * np.array([np.cos(way), np.sin(way), 0.0])))
    place = rng.uniform(*cell.view.box)
    T = cell.looking(R, cell.spot(edge), place)
    first = cell.samples[0].T_base_flange
    turns, tilts = turn_and_tilt((first @ cell.T_flange_sensor)[:3, :3],
                                 (T @ cell.T_flange_sensor)[None, :3, :3])
    allowed = (np.linalg.norm(T[:3, 3] - first[:3, 3]) <= config.reach
               and np.linalg.norm(tilts) <= config.tilt and abs(turns[0]) <= config.turn)
    return missed(cell, T, place, 1.0) if allowed else None


def turn_and_tilt(first: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return turns (n,) about the viewing direction and tilts (n, 2) after them, rad.

    first: (3, 3) of the sensor; R: (n, 3, 3), first @ Exp(0, 0, turn) @ Exp(*tilt, 0).
    """
    q = se3.quaternion(se3.transform(first.T @ R, np.zeros((len(R), 3))))
    turn = 2 * np.arctan2(q[:, 2], q[:, 3])
    about_z = se3.exp_rotation(np.column_stack([np.zeros((len(R), 2)), turn]))
    return turn, se3.log_rotation(np.swapaxes(first @ about_z, 1, 2) @ R)[:, :2]


def missed(cell: World, T: np.ndarray, place: np.ndarray, away: float) -> np.ndarray:
    """
    Return a pose (4, 4) off by so many times what operators are.

    They see where the target is, and where it should be, place (2,): turns are about it.
    """
    turn, shift = turned(cell.rng, 2.0 * away), cell.rng.normal(size=3) * 3e-3 * away
    seen = np.array([place[0], 0.0, place[1]])
    error = se3.transform(turn, seen - turn @ seen + shift)
    return T @ cell.T_flange_sensor @ error @ se3.inverse(cell.T_flange_sensor)


def answer_of(cell: World, solution: Solution | None) -> Answer:
    """Return a solution as the answer that the advice reads."""
    return Answer(cell.samples, solution, solution is not None, None, None)


def advised(cell: World, solution: Solution | None) -> Callable[[], np.ndarray | None]:
    """Return what draws poses near the one that the advice asks for, at last from anywhere."""
    result = advise(cell.samples, cell.config, answer_of(cell, solution), cell.seen)
    tries = iter(range(10**6))

    def near() -> np.ndarray | None:
        count = next(tries)
        if count > PATIENCE:
            return anywhere(cell)
        away = min(1.0 + 0.2 * count, 2.5)  # who sees nothing jogs about
        if result.next_pose:
            return missed(cell, result.next_pose.T_base_flange, result.next_pose.place, away)
        return moved(cell, result.move_from_first_pose, away)

    return near


def moved(cell: World, move: AdvisedMove, away: float) -> np.ndarray:
    """Return the pose after a move by the look of the laser."""
    rng, first = cell.rng, cell.samples[0].T_base_flange @ cell.T_flange_sensor
    shift = rng.normal(size=3) * 3e-3 * away
    R = (cell.T_base_target[:3, :3].T @ first[:3, :3]
         @ se3.exp_rotation(np.array([0.0, 0.0, move.turn]))
         @ se3.exp_rotation(np.append(move.tilt, 0.0)) @ turned(rng, 4.0))
    spot = (cell.beside(R, move.beside, shift[2]) if move.beside else cell.spot(move.edge))
    return cell.looking(R, spot, move.place + shift[:2])


def session(cell: World, operator: str, stops: int) -> np.ndarray:
    """Return error and stated 1 sigma (stops, 2) after each stop, inf without an answer."""
    found = np.full((stops, 2), np.inf)
    while True:
        count = len(cell.samples)
        solution = solved(cell)
        if solution is not None:
            found[count - 1] = error_of(solution, cell), sigma_of(solution, cell)
        if count == stops:
            return found
        insist(cell, advised(cell, solution) if operator == 'advice' else lambda: anywhere(cell))


@dataclass(frozen=True)
class Followed:
    """
    A session that goes where the advice says: stops at proposals, and why some gave no sample.

    enough: the samples at which the node says that they are enough, 0: never; std, error: stated
    1 sigma and true error (m) of points mapped over the field of view at the end.
    """

    stops: int
    why: tuple[str, ...]
    enough: int
    std: float
    error: float


def followed(cell: World, away: float, stops: int) -> Followed:
    """
    Go to each pose that is proposed, off by so much, until enough or for so many stops.

    Nothing is tried again: what is refused counts.
    """
    why, enough = list[str](), 0
    for _ in range(stops):
        advice = advise(cell.samples, cell.config, answer_of(cell, solved(cell)), cell.seen,
                        cell.refused)
        if advice.enough:
            enough = len(cell.samples)
            break
        if advice.next_pose is None:
            insist(cell, lambda move=advice.move_from_first_pose: moved(cell, move, 1.0))
            continue
        T = missed(cell, advice.next_pose.T_base_flange, advice.next_pose.place, away)
        try:
            cell.stop(T)
        except FeatureError as error:
            why.append(str(error))
            cell.refused.append(T)
    known = solved(cell)
    std, off = (math.inf, math.inf) if known is None else (
        sigma_of(known, cell), error_of(known, cell))
    return Followed(len(cell.samples) - 1 + len(why), tuple(why), enough, std, off)


def sigma_of(solution: Solution, cell: World) -> float:
    """Return the stated 1 sigma (m) of points mapped over the field of view."""
    return float(se3.mapped_std(view_levers(solution.estimate.X, cell.view),
                                solution.transform_covariance))


def error_of(solution: Solution, cell: World) -> float:
    """Return the RMS error (m) of points mapped over the field of view."""
    (x0, z0), (x1, z1) = cell.view.box
    return errors_against(solution.estimate.X, cell.T_flange_sensor,
                          field_points((x0, x1), (z0, z1))).mapped_points


def tell_refused(targets_: list[str], seeds: range, stops: int) -> None:
    """Print a row per target and operator; see --refused."""
    print(f'{"target":8} {"operator":10} {"stops":>6} {"refused":>8} {"enough":>8} {"at":>9} '
          f'{"sigma":>8} {"error":>8} {"worst":>8}  reasons')
    for target in targets_:
        for operator, away in (('exact', 0.0), ('2 deg 3 mm', 1.0)):
            made = [followed(world(target, ROBOTS['common'], seed, {}), away, stops)
                    for seed in seeds]
            reasons = Counter(re.sub(r'-?[0-9.]+', '#', why) for one in made for why in one.why)
            at = sorted(one.enough for one in made if one.enough) or [0]
            stds, errors = 1e3 * np.array([(one.std, one.error) for one in made]).T
            result = '; '.join(f'{n} x {text}' for text, n in reasons.most_common(3))
            print(f'{target:8} {operator:10} {sum(one.stops for one in made):6} '
                  f'{sum(reasons.values()):8} {sum(one.enough > 0 for one in made):4}'
                  f'/{len(made):<3} {at[len(at) // 2]:3} ({at[0]}-{at[-1]}) '
                  f'{np.median(stds):8.3f} {np.median(errors):8.3f} {errors.max():8.3f}  {result}',
                  flush=True)


def readings(found: np.ndarray, wanted: float) -> list[int]:
    """Return the numbers of stops (4,), as in READINGS, of a session's (stops, 2)."""
    good = found < wanted
    first = np.where(good.any(axis=0), good.argmax(axis=0) + 1, len(good))
    kept = [min(int(np.flatnonzero(~column).max(initial=-1)) + 2, len(good)) for column in good.T]
    return [int(first[0]), kept[0], int(first[1]), kept[1]]


def solved(cell: World) -> Solution | None:
    """
    Return the solution, None where there is none.

    From the last one, once it is known to KNOWN_WELL; without the search for other answers.
    """
    target, samples = targets.target_for(cell.config), with_common_edge_shape(cell.samples)
    if len(samples) < target.min_samples:
        return None
    problem = Problem(target, mount_poses_of(samples, cell.config), target.observe(samples),
                      cell.config)
    try:
        agreed = robust_solution(problem, np.random.default_rng(0), True,
                                 cell.last.estimate if cell.last else None)
        found = refined_solution(agreed)
    except (DataError, np.linalg.LinAlgError):
        return None
    cell.last = found if sigma_of(found, cell) < KNOWN_WELL else None
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=50)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--targets', default='plate,line,sphere')
    parser.add_argument('--robot', choices=list(ROBOTS), default='common')
    parser.add_argument('--priors', choices=['none', 'shipped'], default='none')
    parser.add_argument('--wanted', type=float, default=1e-4)
    parser.add_argument('--stops', type=int, default=50)
    parser.add_argument('--refused', action='store_true')
    arguments = parser.parse_args()
    if arguments.refused:
        return tell_refused(arguments.targets.split(','), range(
            arguments.first, arguments.first + arguments.seeds), arguments.stops)
    known = KNOWN if arguments.priors == 'none' else {}
    known = known | {'guidance.accuracy': arguments.wanted}
    print(f'{"target":8} {"":8}', *(f'{reading:>22}' for reading in READINGS))
    for target in arguments.targets.split(','):
        counts = []
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            counts.append([readings(session(
                world(target, ROBOTS[arguments.robot], seed, known), operator,
                arguments.stops), arguments.wanted) for operator in OPERATORS])
            print(target, seed, *counts[-1], file=sys.stderr, flush=True)
        tell(target, np.array(counts), arguments.stops)


def tell(target: str, counts: np.ndarray, stops: int) -> None:
    """Print the rows of a target: counts (seeds, operators, readings)."""
    low, middle, high = np.percentile(counts, (25, 50, 75), axis=0)
    never = (counts >= stops).sum(axis=0)
    for i, operator in enumerate(OPERATORS):
        row = [f'{m:.0f} ({a:.0f}-{b:.0f})' + (f', {n} never' if n else '') for m, a, b, n in zip(
            middle[i], low[i], high[i], never[i], strict=True)]
        print(f'{target:8} {operator:8}', *(f'{text:>22}' for text in row))
    for name, ratio in (('ratio', middle[0] / middle[1]),
                        ('paired', np.median(counts[:, 0] / counts[:, 1], axis=0))):
        print(f'{target:8} {name:8}', *(f'{value:22.2f}' for value in ratio), flush=True)


if __name__ == '__main__':
    main()
