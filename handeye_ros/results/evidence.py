# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a report shows: the stops of a recording with their part in the answer; the verdict."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
import math
from pathlib import Path

from handeye_ros import se3
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature
from handeye_ros.errors import mm
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.truth_file import FIELD, field_points
import numpy as np

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
    stamps of its samples, many where the robot moved; of a reject its own.
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


@dataclass(frozen=True)
class Verdict:
    """A sentence, and remarks, one sentence each; good: nothing is wrong."""

    good: bool
    sentence: str
    remarks: tuple[str, ...]


def verdict(calibration: Calibration, evidence: Evidence, visible: Array) -> Verdict:
    """Return the verdict; visible: points (k, 3) in the sensor frame, may be empty."""
    remarks = tuple(_remarks(calibration, evidence))
    if wrong := _wrong(calibration, evidence):
        return Verdict(False, f'Do not rely on this calibration: {wrong}', remarks)
    points, region = (visible, 'the points that were seen') if len(visible) else (
        field_points(), FIELD)
    return Verdict(
        True, f'Good for mapping points of {calibration.child_frame} into '
        f'{calibration.parent_frame} to {mm(mapped_std(calibration, points))} (1 sigma in space, '
        f'over {region}).', remarks)


def _wrong(calibration: Calibration, evidence: Evidence) -> str:
    """Return why the recording contradicts the calibration, '' if it does not."""
    if evidence.refusal:
        return f'the recording is refused now: {evidence.refusal}'
    if evidence.calibration:
        delta = se3.difference(calibration.T_flange_sensor, evidence.calibration.T_flange_sensor)
        # the same data give the same answer: their noise explains no difference
        if (np.abs(delta) > SAME * np.sqrt(np.diag(calibration.covariance)) + 1e-9).any():
            return ('the recording gives another answer than the one saved, '
                    f'{np.linalg.norm(delta[:3]) * 1e3:.3f} mm and '
                    f'{math.degrees(np.linalg.norm(delta[3:])):.4f} degrees away: is it the '
                    'recording that was solved, with the same configuration?')
    return ''


def _remarks(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    quality = calibration.quality
    if 'note' in calibration.target:
        yield str(calibration.target['note'])
    if quality.holdout_rms > MUCH_WORSE * quality.residual_rms:
        yield (f'stops that are left out are predicted {mm(quality.holdout_rms)} RMS off, those '
               f'in the fit {mm(quality.residual_rms)}: a few stops carry the answer; add more')
    yield from map(str, calibration.provenance.get('warnings', ()))
    if evidence.missing:
        yield evidence.missing


def mapped_std(calibration: Calibration, points: Array) -> float:
    """
    Return the RMS 1 sigma (metres) of points (k, 3) mapped into the parent frame.

    A point moves with the perturbation (dt, dr) by dt + dr x (R p).
    """
    arms = points @ calibration.T_flange_sensor[:3, :3].T
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -se3.skew(arms)], axis=2)
    variances = np.einsum('kij,jl,kil->k', J, calibration.covariance, J)
    return float(np.sqrt(variances.mean()))


def in_plane(features: Iterable[Feature]) -> Array:
    """Return points (k, 2) of the sensor plane that represent features: ends, edges, arcs."""
    lines, spots = drawn(features)
    return np.concatenate([np.empty((0, 2)), *lines, *spots])


def drawn(features: Iterable[Feature]) -> tuple[list[Array], list[Array]]:
    """Return the lines (n, 2) and the single points (1, 2) of features in the sensor plane."""
    lines, spots = [], []
    for f in features:
        if isinstance(f, FaceLine):  # of evenly spread points the ends are sqrt(3) spreads away
            lines.append(f.centre + np.outer([-1, 0, 1], math.sqrt(3) * f.spread * f.direction))
        elif isinstance(f, Arc):
            lines.append(f.points)
        elif isinstance(f, EdgePoint):
            spots.append(f.point[None])
    return lines, spots
