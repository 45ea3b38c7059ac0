# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Data of the report: the stops of a recording with their results, and the verdict."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
import math
from pathlib import Path

from handeye_ros import config as configuration
from handeye_ros import se3
from handeye_ros.config import Config, NoiseConfig
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature
from handeye_ros.errors import mm
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.truth_file import FIELD, field_points
import numpy as np

MANY_REJECTED = 1 / 3  # of the stops
MUCH_WORSE = 4.0  # ratio of the cross-validation error to the residual
SAME = 0.1  # sigmas: two answers of the same recording agree so well


@dataclass(frozen=True, eq=False)
class StopSnapshot:
    """
    A stop of the robot.

    number: counted from 1; T_mount: (4, 4) pose of the mount of the sensor in the frame where the
    target is fixed; points: (n, 2) of one of its profiles, in the sensor plane; features: of the
    profiles; reason: why it was not used, empty if it was. residuals, left_out: (k,) of its
    measured points (metres), with and without it in the fit; empty where it was not used. samples:
    stamps of the samples of a robot that moved.
    """

    number: int
    stamp: int
    T_mount: Array
    points: Array
    features: tuple[Feature, ...] = ()
    reason: str = ''
    residuals: Array = field(default_factory=lambda: np.empty(0))
    left_out: Array = field(default_factory=lambda: np.empty(0))
    samples: tuple[int, ...] = ()

    @property
    def used(self) -> bool:
        """Return whether it is part of the answer."""
        return not self.reason


@dataclass(frozen=True, eq=False)
class Evidence:
    """
    The stops of a recording, and its answer.

    calibration: None where the recording is refused; refusal: the reason for it. missing: why
    there is no recording to show. sweep: (n, 3) of the samples of a robot that moved: time since
    the first (s), RMS residual (m), speed of the flange (m/s).
    """

    stops: tuple[StopSnapshot, ...] = ()
    calibration: Calibration | None = None
    refusal: str = ''
    missing: str = ''
    sweep: Array = field(default_factory=lambda: np.empty((0, 3)))


def recording_of(calibration: Calibration, folder: Path) -> tuple[Path | None, str]:
    """
    Return the recording or session that a calibration names, or None and why it is missing.

    folder: of the calibration's file; a relative path is looked for from here, from there and
    from the folders above it.
    """
    advice = 'so its stops are not shown: name the recording with --bag'
    for item in calibration.provenance.get('inputs', ()):
        name = item.get('path') or item.get('session')
        if not name:
            continue
        absolute = folder.absolute()
        places = [place / name for place in (Path(), absolute, *absolute.parents)]
        path = next((place for place in places if place.exists()), None)
        if path is None:
            return None, f'{name} is not there, {advice}'
        if path.is_file() and input_values(path)['sha256'] != item.get('sha256'):
            return None, f'{path} has changed since it was solved, {advice}'
        return path, ''
    return None, f'the calibration names no recording, {advice}'


def config_of(calibration: Calibration) -> Config:
    """Return the configuration stored in a calibration."""
    return configuration.from_provenance(calibration.provenance.get('config'))


def use_config(calibration: Calibration, config: Config | None = None) -> Config:
    """Return the configuration to measure with a calibration: its own or config, at rest."""
    config = config or config_of(calibration)
    if calibration.time_offset:
        config = replace(config, time_offset=calibration.time_offset.value)
    mode = config.sampling.mode if not config.sampling.moving else 'still'
    return replace(config, sampling=replace(config.sampling, mode=mode))


@dataclass(frozen=True)
class Verdict:
    """
    A sentence, and remarks, one sentence each.

    good: nothing is wrong; mapped: 1 sigma of mapped points (metres), over a region in words.
    """

    good: bool
    sentence: str
    remarks: tuple[str, ...]
    mapped: float
    region: str


def verdict(calibration: Calibration, evidence: Evidence, visible: Array) -> Verdict:
    """Return the verdict; visible: points (k, 3) in the sensor frame, may be empty."""
    points, region = field_points(), FIELD
    if len(visible):
        points, region = visible, 'the points that were seen'
    mapped = mapped_std(calibration, points)
    problems = tuple(_wrong(calibration, evidence))
    parent, child = calibration.parent_frame, calibration.child_frame
    if problems:
        sentence = f'Do not rely on this calibration: {problems[0]}'
    else:
        sentence = (f'Good for mapping points of {child} into {parent} to {mm(mapped)} (1 sigma '
                    f'in space, over {region}).')
    remarks = (*problems[1:], *_remarks(calibration, evidence))
    return Verdict(not problems, sentence, remarks, mapped, region)


def mapped_std(calibration: Calibration, points: Array) -> float:
    """
    Return the RMS 1 sigma (metres) of points (k, 3) mapped into the parent frame.

    A point moves with the perturbation (dt, dr) by dt + dr x (R p).
    """
    arms = points @ calibration.T_flange_sensor[:3, :3].T
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -se3.skew(arms)], axis=2)
    variances = np.einsum('kij,jl,kil->k', J, calibration.covariance, J)
    return float(np.sqrt(variances.mean()))


def stated_noise(noise: NoiseConfig, arm: float) -> float:
    """Return the 1 sigma (metres) of a point at a distance from the flange, by the noise."""
    return math.sqrt(noise.sensor ** 2 + noise.distortion ** 2 + noise.robot_translation ** 2
                     + (arm * noise.robot_rotation) ** 2)


def in_plane(features: tuple[Feature, ...]) -> Array:
    """Return points (k, 2) of the sensor plane that represent features."""
    points = [_points(feature) for feature in features]
    return np.concatenate(points) if points else np.empty((0, 2))


def _points(feature: Feature) -> Array:
    if isinstance(feature, EdgePoint):
        return feature.point[None]
    if isinstance(feature, FaceLine):
        return feature.centre + np.outer([-1.7, 0, 1.7], feature.spread * feature.direction)
    return feature.points if isinstance(feature, Arc) else np.empty((0, 2))


def _wrong(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    if evidence.refusal:
        yield f'the recording is refused now: {evidence.refusal}'
    if evidence.calibration:
        delta = se3.difference(calibration.T_flange_sensor, evidence.calibration.T_flange_sensor)
        # the same data give the same answer: their noise explains no difference
        if (np.abs(delta) > SAME * np.sqrt(np.diag(calibration.covariance)) + 1e-9).any():
            yield ('the recording gives another answer than the one saved, '
                   f'{np.linalg.norm(delta[:3]) * 1e3:.3f} mm and '
                   f'{math.degrees(np.linalg.norm(delta[3:])):.4f} degrees away: is it the '
                   'recording that was solved, with the same configuration?')


def _remarks(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    quality = calibration.quality
    if 'note' in calibration.target:
        yield str(calibration.target['note'])
    total = quality.samples_used + quality.samples_rejected
    if quality.samples_rejected > MANY_REJECTED * total:
        yield (f'{quality.samples_rejected} of {total} stops were not used: see the reasons below '
               'before you trust the rest')
    if quality.holdout_rms > MUCH_WORSE * quality.residual_rms:
        yield (f'stops that are left out are predicted {mm(quality.holdout_rms)} RMS off, those '
               f'in the fit {mm(quality.residual_rms)}: a few stops carry the answer; add more')
    yield from map(str, calibration.provenance.get('warnings', ()))
    if evidence.missing:
        yield evidence.missing
