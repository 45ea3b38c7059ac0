"""What an answer is good for, in a sentence, and what a person should know beside it."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

from handeye_ros import se3
from handeye_ros.config import NoiseConfig
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature
from handeye_ros.errors import mm
from handeye_ros.results.report.evidence import Evidence
from handeye_ros.results.truth_file import FIELD, field_points
import numpy as np

MANY_REJECTED = 1 / 3  # of the stops
MUCH_WORSE = 4.0  # the left-out error than the residual
SAME = 0.1  # of a 1 sigma: as near lie two answers of the same recording


@dataclass(frozen=True)
class Verdict:
    """
    A sentence, and remarks, one sentence each.

    good: nothing is wrong; mapped: 1 sigma of mapped points (metres), over the points of where.
    """

    good: bool
    sentence: str
    remarks: tuple[str, ...]
    mapped: float
    where: str


def verdict(calibration: Calibration, evidence: Evidence, seen: Array) -> Verdict:
    """Return what is to be said first; seen: points (k, 3) of the sensor frame, may be empty."""
    points, where = (seen, 'the points that were seen') if len(seen) else (field_points(), FIELD)
    mapped = mapped_std(calibration, points)
    wrong = tuple(_wrong(calibration, evidence))
    parent, child = calibration.parent_frame, calibration.child_frame
    if wrong:
        sentence = f'Do not rely on this calibration: {wrong[0]}'
    else:
        sentence = (f'Good for mapping points of {child} into {parent} to {mm(mapped)} (1 sigma '
                    f'in space, over {where}).')
    return Verdict(not wrong, sentence, (*wrong[1:], *_remarks(calibration, evidence)), mapped,
                   where)


def mapped_std(calibration: Calibration, points: Array) -> float:
    """
    Return the 1 sigma in space (metres) of points (k, 3) that are mapped into the parent, RMS.

    A point moves with the perturbation (dt, dr) by dt + dr x (R p).
    """
    arms = points @ calibration.T_flange_sensor[:3, :3].T
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -se3.skew(arms)], axis=2)
    variances = np.einsum('kij,jl,kil->k', J, calibration.covariance, J)
    return float(np.sqrt(variances.mean()))


def stated_noise(noise: NoiseConfig, arm: float) -> float:
    """Return the 1 sigma (metres) of a point so far from the flange that the noise explains."""
    return math.sqrt(noise.sensor ** 2 + noise.distortion ** 2 + noise.robot_translation ** 2
                     + (arm * noise.robot_rotation) ** 2)


def in_plane(features: tuple[Feature, ...]) -> Array:
    """Return the points (k, 2) of the sensor plane that features stand for."""
    found = [_points(feature) for feature in features]
    return np.concatenate(found) if found else np.empty((0, 2))


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
        # one sigma of the same data explains nothing: the same computation gives the same answer
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
