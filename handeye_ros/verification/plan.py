"""Planned stops of a verification, and the smallest error that they would detect."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from handeye_ros import output, se3
from handeye_ros.config import Config, ProfileConfig
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import mm
from handeye_ros.frames import sensor_axes
from handeye_ros.results.verification_file import formatted
from handeye_ros.simulate import gauges, SCENARIOS
from handeye_ros.simulate.scenario import RobotModel
from handeye_ros.verification.errors import NoPlanError
from handeye_ros.verification.routines import Routine
from handeye_ros.verification.verification import K, Verification
from handeye_ros.verification.verify import settings_for, stations_of, verify
import numpy as np

TRIES = 8  # sets of stops, of which the one that shows most is proposed
HEIGHTS, BAR, RADIUS = (0.025, 0.05, 0.1), (0.2,), 0.02  # m: defaults of the artefacts
TURNED_OVER = np.diag([-1.0, 1.0, -1.0, 1.0])
HEADER = ('part', 'stop', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')

ARTEFACTS: dict[str, Callable[..., gauges.Measured]] = {
    'line': lambda rng, nominal, **cell: gauges.line(rng, **cell),
    'plane': lambda rng, nominal, **cell: gauges.plane(rng, **cell),
    'square': lambda rng, nominal, **cell: gauges.square(rng, **cell),
    'point': lambda rng, nominal, **cell: gauges.fixed_point(rng, aim=nominal.aim, **cell),
    'sphere': lambda rng, nominal, **cell: gauges.sphere(rng, radius=nominal.radius, **cell),
    'ball_bar': lambda rng, nominal, **cell: gauges.ball_bar(
        rng, length=nominal.lengths[0], radius=nominal.radius, **cell),
    'step': lambda rng, nominal, **cell: gauges.step_block(rng, nominal.lengths, **cell)}


@dataclass(frozen=True, eq=False)
class Plan:
    """
    Stops with their predicted sensitivity.

    expected: the result for a calibration without error; T_base_flange: (n, 4, 4) for each part.
    """

    expected: Verification
    T_base_flange: tuple[Array, ...]


def plan(routine: Routine, calibration: Calibration, config: Config,
         position: Sequence[float], stops: int, turns: float,
         limits: tuple[float, float] = SCENARIOS['plane'].sensor.range) -> Plan:
    """
    Return the best of several sets of stops, simulated with the configured noise.

    position: of the artefact in the base (3,), its face upwards; stops: number at each part;
    turns: largest rotation about each axis of the sensor (rad); limits: nearest and farthest
    distance from the sensor (m). Raises NoPlanError.
    """
    if routine.name not in ARTEFACTS:
        raise NoPlanError(routine.name, list(ARTEFACTS))
    nominal = replace(config.verify, lengths=config.verify.lengths or {
        'step': HEIGHTS, 'ball_bar': BAR}.get(routine.name, ()), reference=(),
        radius=config.verify.radius or RADIUS * (routine.target == 'sphere'))
    standard = replace(config, profile=ProfileConfig(), calibration_type='eye_in_hand',
                       verify=nominal)
    X = calibration.T_flange_sensor @ sensor_axes(config)
    if config.profile.range_sign < 0:  # its zero is taken to be in the middle of the range
        X = X @ TURNED_OVER @ se3.transform(np.eye(3), np.array([0, 0, -np.mean(limits)]))
    exact = replace(calibration, T_flange_sensor=X)
    T_base_artefact = se3.transform(np.eye(3), np.array(position))
    cell: dict[str, Any] = {
        'count': stops, 'tilt': turns, 'mounted': (X, T_base_artefact),
        'sensor': replace(SCENARIOS['plane'].sensor, noise=config.noise.sensor, range=limits),
        'robot': RobotModel((config.noise.robot_translation, config.noise.robot_rotation))}
    plans = []
    for seed in range(TRIES):
        simulated = ARTEFACTS[routine.name](np.random.default_rng(seed), nominal, **cell)
        settings = settings_for(routine, standard, len(simulated.bags))
        observed = [stations_of(routine, bag, exact, settings) for bag in simulated.bags]
        plans.append(Plan(verify(routine, observed, exact, settings),
                          tuple(np.array([s.T_base_flange for s in bag])
                                for bag in simulated.bags)))
    best = min(plans, key=lambda candidate: candidate.expected.smallest_error)
    if config.calibration_type == 'eye_on_base':
        return replace(best, T_base_flange=tuple(map(se3.inverse, best.T_base_flange)))
    return best


def csv_text(best: Plan) -> str:
    """Return the stops as CSV: poses of the flange in the base, metres and quaternions."""
    return output.csv_text(HEADER, (
        (part, stop, *(f'{v:.6f}' for v in (*T[:3, 3], *se3.quaternion(T))))
        for part, poses in enumerate(best.T_base_flange, 1) for stop, T in enumerate(poses, 1)))


def sentences(best: Plan, others: Sequence[Plan]) -> Iterator[str]:
    """Yield the predicted sensitivity, and the number of stops needed, in words."""
    expected, stops = best.expected, len(best.T_base_flange[0])
    parts = f' at each of {len(best.T_base_flange)} parts' if len(best.T_base_flange) > 1 else ''
    yield (f'with these {stops} stops{parts} an error of the calibration of '
           f'{mm(expected.smallest_error)} at the points would show; they are least '
           f'sensitive to the {expected.weakest_direction}')
    for q in expected.quantities:
        if q.nominal is not None:
            yield f'{q.name}: U = {formatted(q.expanded, q.unit)} (k = {K:g})'
    counts = {len(p.T_base_flange[0]): p.expected.smallest_error for p in (best, *others)}
    yield 'stops: error that would show; ' + ', '.join(
        f'{n}: {mm(counts[n])}' for n in sorted(counts))
    enough = [n for n in sorted(counts) if counts[n] <= expected.tolerance]
    if not enough:
        yield (f'none of these is enough for the tolerance of {mm(expected.tolerance)}: turn the '
               'sensor further (--turns), or measure a larger artefact')
    elif enough[0] > stops:
        yield (f'{stops} stops are too few for the tolerance of {mm(expected.tolerance)}: stop '
               f'{enough[0]} times')
