# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What motion is missing is told, in the right words and along the true direction."""
from __future__ import annotations

from dataclasses import replace
import math
import re

from cells import Cell, cell, every_target, exact_cell, refused, settings_of
from handeye_ros import pipeline, se3
from handeye_ros.checks.refusals import rms_turns_and_axes
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.frames import direction_in_words
from handeye_ros.se3 import weakest_direction
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS
from handeye_ros.targets import TARGETS
import numpy as np
import pytest
from quick import long_run

everywhere = pytest.mark.parametrize(('where', 'frame'), [
    ('eye_in_hand', 'flange'), ('eye_on_base', 'base')])


def scenario(name: str, motion: str = 'general', where: str = 'eye_in_hand') -> Scenario:
    return replace(SCENARIOS[name], motion=motion, calibration_type=where)


def refusal(cell: Cell) -> DataError:
    with pytest.raises(DataError) as caught:
        cell.solve()
    assert caught.value.exit_code == 3
    return caught.value


def assert_names(message: str, direction: Array, frame: str, within: float = 0.03) -> None:
    """Check that the first direction that a message names is the true one, in its frame."""
    axis_match = re.search(rf'{frame} ([xyz]) within (\d+) degrees', message)
    if axis_match:
        cosine = abs(direction['xyz'.index(axis_match[1])])
        degrees = math.degrees(math.acos(min(1.0, cosine)))
        assert degrees < int(axis_match[2]) + math.degrees(within)
        return
    match = re.search(rf'the direction \((.*?)\) of {frame}', message)
    assert match, message
    named = np.array([float(c) for c in match[1].split(',')])
    assert abs(named @ direction) / np.linalg.norm(named) > math.cos(within)


# -- motions that are missing


@every_target
@everywhere
@pytest.mark.parametrize('noise', [True, False])
def test_one_orientation_is_refused(name: str, where: str, frame: str, noise: bool) -> None:
    make = cell if noise else exact_cell
    assert refusal(make(scenario(name, 'one_orientation', where))).code == 'one_orientation'


@every_target
@everywhere
@pytest.mark.parametrize(('motion', 'axis'), [('tilt_only', 0), ('yaw_only', 2)])
def test_one_axis_is_named(name: str, where: str, frame: str, motion: str, axis: int) -> None:
    for seed in range(3):
        simulated_cell = cell(scenario(name, motion, where), seed)
        error = refusal(simulated_cell)
        assert error.code == 'one_axis'
        true_axis = simulated_cell.truth.T_flange_sensor[:3, axis]
        assert_names(str(error), true_axis, frame)
        match = re.search(rf'about {frame} ([xyz]) or ([xyz])$', str(error))
        assert match and 'xyz'[int(np.argmax(np.abs(true_axis)))] not in match.groups()


@everywhere
def test_one_orientation_per_edge_is_one_axis(where: str, frame: str) -> None:
    plate_cell = cell(scenario('plate', 'one_orientation_per_edge', where))
    error = refusal(plate_cell)
    assert error.code == 'one_axis'
    poses = plate_cell.problem.poses
    on_edge_p = [s.label == 'p' for s in plate_cell.truth.stops]
    between = poses[on_edge_p.index(True), :3, :3].T @ poses[on_edge_p.index(False), :3, :3]
    turn = se3.log_rotation(between)
    assert_names(str(error), turn / np.linalg.norm(turn), frame)


@pytest.mark.thorough
@every_target
@everywhere
def test_tilts_of_one_degree_are_too_uncertain(name: str, where: str, frame: str) -> None:
    simulated_cell = cell(replace(scenario(name, 'general', where), tilt=math.radians(1)),
                          limits__rotation=0.01)
    error = refusal(simulated_cell)
    assert error.code in ('uncertain', 'one_axis', 'one_orientation')
    assert re.search(rf'\b{frame}\b', str(error)) and 'degrees' in str(error)
    if error.code == 'uncertain':
        turns, axes = rms_turns_and_axes(simulated_cell.problem.poses)
        assert f'turn by only {np.degrees(turns[1]):.3g} degrees RMS about' in str(error)
        assert_names(str(error).split('RMS about')[1], axes[1], frame)


@every_target
def test_the_weakest_direction_is_reported_and_refused_if_uncertain(name: str) -> None:
    simulated_cell = cell(scenario(name), 2)
    calibration = simulated_cell.solve()
    std, direction = weakest_direction(calibration.covariance)
    assert calibration.quality.weakest_std == pytest.approx(std)
    assert_names(calibration.quality.weakest_direction, direction, 'flange')
    assert np.sqrt(direction @ calibration.covariance[:3, :3] @ direction) == pytest.approx(std)
    assert std >= np.sqrt(np.diag(calibration.covariance)[:3]).max() * (1 - 1e-9)

    with refused('uncertain', f'position along.* {std * 1e3:.3g} mm') as caught:
        simulated_cell.solve(limits__translation=0.99 * std)
    assert_names(str(caught.value), direction, 'flange')
    assert simulated_cell.solve(limits__translation=1.01 * std)
    turn_std = float(np.sqrt(np.linalg.eigvalsh(calibration.covariance[3:, 3:])[2]))
    with refused('uncertain', 'rotation about'):
        simulated_cell.solve(limits__rotation=0.99 * turn_std)


@every_target
def test_samples_that_the_others_do_not_predict_are_refused(name: str) -> None:
    """With few samples the answer follows each of them: only left out does it show its error."""
    simulated_cell = cell(scenario(name))
    few = simulated_cell.samples[:TARGETS[name].min_samples + 3]
    quality = simulated_cell.solve(few).quality
    between = math.sqrt(quality.residual_rms * quality.holdout_rms)
    with refused('left_out', f'by {quality.holdout_rms * 1e3:.3g} mm RMS from what the others'):
        simulated_cell.solve(few, limits__residual=between)
    assert simulated_cell.solve(few, limits__residual=1.01 * quality.holdout_rms)


# -- too few samples


@every_target
def test_too_few_samples_are_refused_with_what_became_of_the_rest(name: str) -> None:
    simulated_cell = cell(scenario(name))
    few_samples = simulated_cell.samples[:TARGETS[name].min_samples - 1]
    rejects = [Reject(i, reason) for i, reason in enumerate(['no edge', 'dark', 'no edge'])]
    with refused('few', f'^{len(few_samples)} .*3 stops .*often: no edge.*check target'):
        pipeline.solve(few_samples, rejects, simulated_cell.config, 'laser')
    with refused('few', r'^0 usable samples \(1 stop gave none, .*take more'):
        pipeline.solve([], rejects[:1], simulated_cell.config, 'laser')


@pytest.mark.parametrize(('name', 'kept'), [
    ('plate', FaceLine), ('plate', EdgePoint), ('line', FaceLine), ('wedge', EdgePoint),
    ('sphere', FaceLine), ('plane', EdgePoint)])
def test_samples_of_another_target_are_refused(name: str, kept: type) -> None:
    samples = cell(name).samples
    one_other = replace(samples[3], features=tuple(
        feature for feature in samples[3].features if isinstance(feature, kept)))
    with refused('features', f'stamp {one_other.stamp} lacks a feature .*the target {name} '):
        cell(name).solve([*samples[:3], one_other, *samples[4:]])


@pytest.mark.thorough
@pytest.mark.parametrize(('angle', 'words'), [
    (1.3, 'only 10 of .* crosses them at less than sampling.min_crossing_angle'),
    (1.5, 'only [23] of .* plate needs 6.* crosses them steeply')])
def test_edges_that_are_crossed_at_too_small_an_angle_are_named(angle: float, words: str) -> None:
    with refused('edges', words):
        cell('plate', 1).solve(sampling__min_crossing_angle=angle)


# -- words


@pytest.mark.parametrize(('direction', 'words'), [
    ([0, 0, 1], 'tool z within 1 degrees'), ([0, -1, 0], 'tool y within 1 degrees'),
    ([1, 0.1, 0], 'tool x within 6 degrees'), ([2, 0.2, 0], 'tool x within 6 degrees'),
    ([1, 1, 0], 'the direction (0.71, 0.71, 0.00) of tool')])
def test_directions_are_named_by_the_nearest_axis(direction: list[float], words: str) -> None:
    assert direction_in_words(np.array(direction, dtype=float), 'tool') == words


# -- the frame of the profiles


@pytest.mark.parametrize(('frame', 'key'), [
    ('flange', 'robot_effector_frame'), ('base', 'robot_base_frame')])
def test_a_frame_of_the_robot_is_refused_by_its_key(frame: str, key: str) -> None:
    sphere_cell = cell('sphere')
    with pytest.raises(DataError, match=f'"{frame}", and {key} is the same'):
        pipeline.solve(sphere_cell.samples, [], sphere_cell.config, frame)
    other_config = replace(sphere_cell.config, **{key: 'tool0'})
    assert pipeline.solve(sphere_cell.samples, [], other_config, frame).child_frame == frame


@pytest.mark.parametrize('seed', [
    2, *long_run(3, 6, 7)])
def test_an_answer_that_is_uncertain_by_millimetres_is_refused(seed: int) -> None:
    """A base that gives way by 0.2 degrees per metre of reach; a plane takes up most of it."""
    plane_cell = cell(FAULTS['plane, wide off-centre'], seed)

    def bent(T: Array) -> Array:
        x, y, _ = T[:3, 3]
        about = np.array([y, -x, 0.0]) * math.radians(0.2)
        return se3.transform(se3.exp_rotation(about), np.zeros(3)) @ T

    given_way = [replace(s, T_base_flange=bent(s.T_base_flange)) for s in plane_cell.samples]
    plane_cell = replace(plane_cell, config=settings_of(plane_cell.scenario))
    with pytest.raises(DataError, match='limits.points'):
        plane_cell.solve(given_way)
    assert plane_cell.error(plane_cell.solve().T_flange_sensor) < 2e-3


@pytest.mark.parametrize(('noise', 'angle'), [(0.0, 30), (3e-5, 30), (3e-5, 15), (3e-5, 45)])
def test_a_plane_seen_at_one_angle_only_is_refused(noise: float, angle: int) -> None:
    """The way along the range and the plane's offset are an exact gauge, with any azimuths."""
    plane_cell, rng = cell('plane'), np.random.default_rng(0)
    X, plane = plane_cell.truth.T_flange_sensor, plane_cell.truth.T_base_target
    tilt, samples = se3.exp_rotation(np.array([math.radians(180 - angle), 0, 0])), []
    for k, sample in enumerate(plane_cell.samples):
        R = plane[:3, :3] @ se3.exp_rotation(
            np.array([0, 0, 2 * math.pi * k / len(plane_cell.samples)])) @ tilt
        R = R @ se3.exp_rotation(np.array([0, 0, rng.uniform(-0.4, 0.4)]))
        away = rng.uniform(0.16, 0.19)
        at = plane[:3, 3] + plane[:3, :2] @ rng.uniform(-0.05, 0.05, 2) - R[:, 2] * away
        S = se3.transform(R, at)
        normal = plane[:3, 2] @ R
        along = np.array([normal[2], -normal[0]]) / math.hypot(normal[0], normal[2])
        face = FaceLine(np.array([0, away + rng.normal(0, noise)]), along, 0.01, 1e-6)
        samples.append(replace(sample, T_base_flange=S @ se3.inverse(X), features=(face,)))
    with pytest.raises(DataError, match=f'see the plane at one angle .{angle} ') as caught:
        plane_cell.solve(samples)
    assert_names(str(caught.value), X[:3, 2], 'flange', 0.05)


def seen_at(sample: Sample, X: Array, place: Array) -> Sample:
    """
    Return a sample whose edge, ball or else middle of the face the sensor sees at a place (2,).

    A value that is not finite leaves that coordinate as it is.
    """
    edges = [f.point for f in sample.features if isinstance(f, EdgePoint)]
    others = [f for f in sample.features if isinstance(f, FaceLine | Arc)]
    by = np.nan_to_num((edges[0] if edges else others[0].centre) - place, nan=0.0)
    shift = se3.transform(np.eye(3), np.array([by[0], 0.0, by[1]]))
    moved = [replace(f, **{key: getattr(f, key) - by for key in (
        ('points', 'centre', 'measured') if isinstance(f, Arc) else ('points', 'centre'))})
        for f in others]
    T = sample.T_base_flange @ X @ shift @ se3.inverse(X)
    return replace(sample, T_base_flange=T, features=(*moved, *(
        replace(f, point=f.point - by) for f in sample.features if isinstance(f, EdgePoint))))


@pytest.mark.parametrize(('name', 'place', 'words'), [
    ('plate', [0.0, 0.18], 'at one point'), ('plane', [0.0, 0.18], 'at one point'),
    ('sphere', [0.0, math.nan], 'on one line')])
@pytest.mark.parametrize('seed', [0, *long_run(1, 2)])
def test_one_place_only_is_refused(name: str, place: list[float], words: str, seed: int) -> None:
    """A sensor that is turned by half about that place sees the same."""
    simulated_cell, rng = cell(name, seed), np.random.default_rng(seed)
    X = simulated_cell.truth.T_flange_sensor
    with refused('views', f'{words}.*near, far, left, right'):
        simulated_cell.solve(seen_at(s, X, np.array(place)) for s in simulated_cell.samples)
    calibration = simulated_cell.solve(
        seen_at(s, X, place + rng.uniform(-5e-3, 5e-3, 2)) for s in simulated_cell.samples)
    assert simulated_cell.error(calibration.T_flange_sensor) < 1e-3
