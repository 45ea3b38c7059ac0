# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The report of a calibration: verdict, scene, residuals, profiles and use of an answer.

The file is complete: it opens without a network.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

from handeye_ros import config as configuration
from handeye_ros import se3
from handeye_ros.data import Array, Calibration, StopSnapshot
from handeye_ros.frames import T_sensor_plane
from handeye_ros.results import exports, printed
from handeye_ros.results.calibration_file import config_of
from handeye_ros.results.scene import feature_points, profile_picture, scene, sensor_points
from handeye_ros.results.templates import rendered
from handeye_ros.results.truth import field_points, FIELD_TEXT
from handeye_ros.words import mm
import numpy as np

MUCH_WORSE = 4.0  # ratio of the left-out RMS to that in the fit
SAME_ANSWER = 0.1  # sigmas: two answers of the same recording agree so well


@dataclass(frozen=True, eq=False)
class SolvedRecording:
    """
    The stops of a recording, and the answer from it now.

    calibration: the answer, None where it is refused, and without a recording
    refusal: why the answer is refused, '' if it is not
    missing: why there is no recording, '' if there is one
    """

    stops: tuple[StopSnapshot, ...] = ()
    calibration: Calibration | None = None
    refusal: str = ''
    missing: str = ''


def html(calibration: Calibration, recording: SolvedRecording) -> str:
    """Return the report of a calibration and its recording as HTML."""
    config = config_of(calibration)
    seen = feature_points(f for stop in recording.stops if stop.used for f in stop.features)
    good, sentence = verdict(calibration, recording, sensor_points(seen, config))
    picture = scene(calibration, recording.stops, config)
    return rendered(
        'report.html', c=calibration, good=good, sentence=sentence, printed=printed,
        remarks=list(_remarks(calibration, recording)),
        matrix=exports.FORMATS['matrix'].text(calibration),
        joint=exports.filled_template(calibration, 'joint.xacro.jinja'),
        scene=picture, legend={part['name']: part['color'] for part in picture['parts']}.items(),
        stops=recording.stops, settings=configuration.flatten(config).items(),
        profiles=[profile_picture(seen, ()),
                  *(profile_picture(stop.points, stop.features) for stop in recording.stops)])


def verdict(calibration: Calibration, recording: SolvedRecording, visible: Array
            ) -> tuple[bool, str]:
    """
    Return whether the calibration may be relied on, and a sentence.

    visible: points (k, 3) that were seen, in the sensor frame (m).
    """
    if wrong := disagreement(calibration, recording):
        return False, f'Do not rely on this calibration: {wrong}'
    points, region = (visible, 'the points that were seen') if len(visible) else (
        se3.apply(T_sensor_plane(config_of(calibration)), field_points()), FIELD_TEXT)
    return (True, f'Good for mapping points of {calibration.child_frame} into '
            f'{calibration.parent_frame} to {mm(std_of_points(calibration, points))} (1 sigma in '
            f'space, over {region}).')


def disagreement(calibration: Calibration, recording: SolvedRecording) -> str:
    """Return why the recording contradicts the calibration, '' if it does not."""
    if recording.refusal:
        return f'the recording is refused now: {recording.refusal}'
    if recording.calibration:
        delta = se3.difference(calibration.T_flange_sensor, recording.calibration.T_flange_sensor)
        # the same data give the same answer: their noise explains no difference
        if (np.abs(delta) > SAME_ANSWER * np.sqrt(np.diag(calibration.covariance)) + 1e-9).any():
            return ('the recording gives another answer than the one saved, '
                    f'{np.linalg.norm(delta[:3]) * 1e3:.3f} mm and '
                    f'{math.degrees(np.linalg.norm(delta[3:])):.4f} degrees away: is it the '
                    'recording that was solved, with the same configuration?')
    return ''


def _remarks(calibration: Calibration, recording: SolvedRecording) -> Iterator[str]:
    """Yield what else the reader of a report should know, one sentence each."""
    quality = calibration.quality
    if 'note' in calibration.target:
        yield str(calibration.target['note'])
    if quality.holdout_rms > MUCH_WORSE * quality.residual_rms:
        yield (f'stops that are left out are predicted {mm(quality.holdout_rms)} RMS off, those '
               f'in the fit {mm(quality.residual_rms)}: a few stops carry the answer; add more')
    yield from map(str, calibration.provenance.get('warnings', ()))
    if recording.missing:
        yield recording.missing


def std_of_points(calibration: Calibration, points: Array) -> float:
    """Return the RMS 1 sigma (m) of points (k, 3) of the sensor, mapped into the parent frame."""
    levers = points @ calibration.T_flange_sensor[:3, :3].T
    return float(se3.mapped_std(levers, calibration.covariance))
