# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Routines: the truth lies in their regions, a wrong calibration fails, too little says so."""
from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re

from handeye_ros import se3
from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.data import FaceLine, Sample
from handeye_ros.errors import DataError, InputError
from handeye_ros.frames import sensor_axes
from handeye_ros.results.protocol import protocol
from handeye_ros.simulate import gauges
from handeye_ros.simulate.scenario import PlateTarget
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.verification import decision as verification
from handeye_ros.verification import tooth_gauge
from handeye_ros.verification.routines import ROUTINES, settings_for
from handeye_ros.verification.shapes import BAGS, stacked
from handeye_ros.verification.verify import verify
import numpy as np
import pytest
from verifications import bench, measured, result
import yaml

ROOT = Path(__file__).parents[2]
SEEDS = 12


@pytest.mark.thorough
@pytest.mark.parametrize('name', bench.SCENES)
def test_the_truth_lies_in_the_stated_region_and_wrong_calibrations_fail(name):
    inside = failed = 0
    for seed in range(SEEDS):
        right, wrong = bench.trial(name, seed)
        inside += bench.within(right)
        failed += wrong.verdict == 'fail'
        assert right.verdict == 'pass'
        assert wrong.verdict != 'pass'
    assert failed >= SEEDS - 1  # 1 mm and 0.5 degrees may cancel at the points
    assert inside >= SEEDS - 3  # more than 3 of 12 outside a true 95 % region: p = 0.002


def of_lengths(*lengths):
    return Config(noise=bench.NOISE, verify=VerifyConfig(lengths=lengths))


def rendered_step(rng, width, height=0.025):
    """Return recordings of a surface plate, and of a narrow block on it beside which it shows."""
    X, T = gauges.sensor_on_flange(rng), gauges.draw_pose(rng)
    passes = []
    for size, table, z in (((0.2, 0.15), None, 0.0), ((0.03, width), height, height)):
        scenario = replace(SCENARIOS['plane'], stations=(20, 0), tilt=gauges.TILT,
                           target=PlateTarget(size, table=table, clutter=None))
        stops = SCENES['plane'].stops(scenario, rng)
        place = T @ se3.transform(np.eye(3), np.array([0, 0, z]))
        passes.append(bench.take(scenario, X, place, stops, rng))
    return gauges.Measured((), X, (height,), passes=tuple(passes))


def test_of_a_block_on_a_surface_plate_the_nearest_surface_is_taken():
    for seed in range(2):
        rng = np.random.default_rng(seed)
        made = rendered_step(rng, 0.009)
        found = bench.calibration(made.T_flange_sensor, bench.covariance(rng))
        wrong = replace(found, T_flange_sensor=se3.perturb(
            found.T_flange_sensor, np.array([1e-3, 0, 0, 0, 9e-3, 0])))
        right, wrong = bench.runs(ROUTINES['step'], made, (found, wrong), 0.0)
        assert right.verdict == 'pass' and abs(right.quantities[0].error) < 5e-5
        assert right.surface.startswith('recording 2: of 2 surfaces in sight it is the nearest')
        assert wrong.verdict == 'fail'


def test_a_region_of_interest_limits_what_takes_part():
    made, found = measured('sphere')
    X, other = made.T_flange_sensor, []
    for sample in made.bags[0]:  # another ball beside it
        arc = next(f for f in sample.features if hasattr(f, 'radius'))
        away = replace(arc, points=arc.points + [0.05, 0], centre=arc.centre + [0.05, 0])
        other.append(replace(sample, features=(away, arc)))
    centre = np.mean([(s.T_base_flange @ X)[:3, :3] @ [a.centre[0], 0, a.centre[1]]
                      + (s.T_base_flange @ X)[:3, 3] for s in made.bags[0]
                      for a in s.features], axis=0)
    config = with_values(Config(noise=bench.NOISE), {
        'verify.near': [*map(float, centre), 0.03]}, 'test')
    both = replace(made, bags=(tuple(other),))
    assert result('sphere', both, found, config=config).scatter == result(
        'sphere', made, found).scatter


def test_errors_of_the_artefact_are_measured():
    made, found = measured('step')
    longer = replace(made, lengths=(0.025, 0.05, 0.1004))
    report = result('step', longer, found)
    assert report.verdict == 'fail'
    assert report.quantities[2].error == pytest.approx(-4e-4, abs=1e-4)
    assert 'height of face 3' in report.reasons[0]
    made, found = measured('ball_bar')
    report = result('ball_bar', replace(made, lengths=(0.1995,)), found)
    assert report.quantities[2].error == pytest.approx(5e-4, abs=1e-4)


def test_the_three_directions_of_a_step_block_give_one_result():
    rng = np.random.default_rng(3)
    made = gauges.step_directions(rng)
    found = bench.calibration(made.T_flange_sensor, bench.covariance(rng))
    report = result('step', made, found)
    assert report.verdict == 'pass'
    assert [q.name for q in report.quantities] == [
        f'height of face 1 over face 0 of block {k}' for k in (1, 2, 3)]
    assert max(abs(q.error) for q in report.quantities) < 5e-5
    assert result('step', replace(made, lengths=(0.025, 0.05, 0.1005)), found).verdict == 'fail'


def test_the_protocol_says_what_an_inspector_asks_for():
    made, found = measured('ball_bar')
    config = with_values(Config(noise=bench.NOISE), {
        'record.operator': 'A. <Nother>', 'record.artefact_serial': 'KB-17'}, 'test')
    report = verification.values(result('ball_bar', made, found, config, certificate=2e-6))
    page = protocol(yaml.safe_load(yaml.safe_dump(report)))
    for words in ('A. &lt;Nother&gt;', 'KB-17', 'ISO 14253-1', '0.0020 mm', 'PF', 'PS', 'SD'):
        assert words in page
    for q in (q for q in report['quantities'] if q['characteristic'] == 'PS'):
        assert f'{2e3 * (q["value"] - 0.02):.4f} mm' in page  # of the diameter
    assert page.count('left out: ') + report['stations'] == len(report['per_station'])
    assert 'data:image/svg' in page and 'http' not in page


def test_a_protocol_has_a_number_a_date_and_the_file_that_was_verified():
    made, found = measured('ball_bar')
    report = replace(result('ball_bar', made, found), created='2026-11-24T13:00:00+00:00',
                     calibration_file={'path': '/cell/calibration.yaml', 'sha256': 'ab12'})
    page, again, other = (protocol(yaml.safe_load(verification.yaml_text(given))) for given
                          in (report, report, replace(report, verdict='insensitive')))
    numbers = [re.search(r'Protocol <b>(\w+)</b>', text)[1] for text in (page, again, other)]
    assert numbers[0] == numbers[1] != numbers[2]
    for words in ('2026-11-24T13:00', '/cell/calibration.yaml', 'ab12'):
        assert words in page
    assert 'class="good"' in page and 'class="open"' in other and 'class="bad"' not in other


def test_the_bias_of_a_touched_point_is_measured():
    made, found = measured('point')
    moved = replace(made, reference=tuple(np.add(made.reference, [0, 0, 5e-4])))
    report = result('point', moved, found)
    assert report.verdict == 'fail'
    assert report.quantities[2].error == pytest.approx(-5e-4, abs=1e-4)
    unknown = result('point', replace(made, reference=()), found)
    assert unknown.verdict == 'pass' and unknown.quantities[0].error is None


def test_the_spread_of_single_stations_is_reported():
    made, found = measured('point')
    report = [q for q in result('point', made, found).quantities if '3 sigma' in q.name]
    assert [q.name[-1] for q in report] == ['x', 'y', 'z']
    expected = 3 * np.hypot(gauges.AIM, bench.ROBOT.repeatability[0])
    assert np.mean([q.value for q in report]) == pytest.approx(expected, rel=0.4)
    made, found = measured('ball_bar')
    report = [q for q in result('ball_bar', made, found).quantities if 'scatter' in q.name]
    assert len(report) == 2 and all(5e-6 < q.value < 6e-5 for q in report), report
    made, found = measured('square')
    report = [q for q in result('square', made, found).quantities if 'flatness' in q.name]
    assert len(report) == 2 and all(2e-5 < q.value < 3e-4 for q in report), report


def test_a_motion_that_could_not_have_shown_an_error_is_no_pass():
    made, found = measured('plane')
    # all stations with nearly one orientation: a shift of the sensor shows nowhere
    first = made.bags[0][0]
    T = np.array([first.T_base_flange] * 8)
    T[:, :3, 3] += first.T_base_flange[:3, :3] @ found.T_flange_sensor[:3, 1] * np.linspace(
        0, 0.02, 8)[:, None]
    alike = tuple(Sample(k, T[k], first.features) for k in range(8))
    report = result('plane', replace(made, bags=(alike,)), found, tolerance=1e-2)
    assert report.verdict in ('insensitive', 'fail')
    made, found = measured('plane', count=5)
    report = result('plane', made, found)
    assert report.verdict == 'insensitive'
    assert 'would show only from' in report.reasons[0]


def test_what_must_show_is_an_error_as_large_as_the_tolerance():
    made, found = measured('step', count=12)
    shown = result('step', made, found).smallest_error
    for tolerance, verdict in ((0.8 * shown, 'insensitive'), (2.0 * shown, 'pass')):
        assert result('step', made, found, tolerance=tolerance).verdict == verdict
    made, found = measured('ball_bar')  # a tolerance below the uncertainty is no pass
    assert result('ball_bar', made, found, tolerance=1e-5).verdict != 'pass'


def test_the_calibration_s_claim_takes_no_part_in_the_decision():
    made, found = measured('point')
    vague = replace(found, covariance=1e4 * found.covariance)  # 3 mm, 1 degree
    judged = result('point', made, vague)
    assert judged.verdict == 'pass' and judged.claim_p > 0.5
    assert judged.quantities[0].claimed > 1e-3 > 1e-4 > judged.quantities[0].expanded
    bold = replace(found, covariance=1e-6 * found.covariance)
    off = replace(made, reference=tuple(np.add(made.reference, [0, 0, 1e-4])))
    judged = result('point', off, bold)
    assert judged.verdict == 'pass' and 'larger than the calibration claims' in judged.reasons[0]
    # the certificate's uncertainty is part of the measurement's
    assert result('point', off, bold, certificate=4e-4).verdict == 'undecided'


def test_a_stop_that_contradicts_the_others_is_left_out_and_named():
    made, found = measured('line')
    samples = list(made.bags[0])
    T = samples[4].T_base_flange.copy()
    T[:3, 3] += 2e-3
    samples[4] = replace(samples[4], T_base_flange=T)
    judged = result('line', replace(made, bags=(tuple(samples),)), found)
    assert judged.verdict == 'pass'
    assert [s.name for s in judged.per_station if not s.used] == ['stop 5 of recording 1']
    assert judged.reasons[0].startswith('stop 5 of recording 1 is left out')
    assert judged.stations == len(samples) - 1
    for k in range(0, 14, 2):  # half of them: no outliers, but a disagreement
        samples[k] = replace(samples[k], T_base_flange=se3.perturb(
            made.bags[0][k].T_base_flange, np.append(np.full(3, 6e-5 * (k - 6)), np.zeros(3))))
    with pytest.raises(DataError, match='not what "line" measures'):
        result('line', replace(made, bags=(tuple(samples),)), found)


def test_a_point_is_judged_by_its_own_uncertainty():
    made, found = measured('line')
    samples = list(made.bags[0])
    edge = samples[3].features[1]
    for std, verdict in ((6e-4, 'pass'), (1e-5, None)):
        moved = replace(edge, point=edge.point + 1.2e-3 * edge.direction, std=std)
        samples[3] = replace(samples[3], features=(samples[3].features[0], moved))
        judged = result('line', replace(made, bags=(tuple(samples),)), found)
        if verdict:
            assert judged.verdict == verdict and all(s.used for s in judged.per_station)
        else:
            assert not judged.per_station[3].used


def test_the_wrong_artefact_and_the_same_recording_twice_are_named():
    made, found = measured('sphere')
    arcs = [next(f for f in s.features if hasattr(f, 'radius')) for s in made.bags[0]]
    lines = [FaceLine(a.points.mean(axis=0), np.array([1.0, 0.0]), 4e-3, 1e-5) for a in arcs]
    ball = tuple(replace(s, features=(line,))
                 for s, line in zip(made.bags[0], lines, strict=True))
    with pytest.raises(DataError, match='not what "plane" measures'):
        result('plane', replace(made, bags=(ball,)), found)
    bar, found = measured('ball_bar')
    with pytest.raises(InputError, match='recordings 1 and 2'):
        result('ball_bar', replace(bar, bags=(bar.bags[0],) * 2), found)


def test_a_ball_of_another_size_is_measured_and_the_calibration_is_not_blamed():
    made, found = measured('ball_bar')
    report = result('ball_bar', made, found, radius=bench.RADIUS + 4e-4)
    assert report.verdict == 'fail'
    assert report.quantities[0].value == pytest.approx(bench.RADIUS, abs=5e-5)
    assert 'check the nominal values' in ' '.join(report.reasons)
    assert 'pattern' not in ' '.join(report.reasons)


@pytest.mark.thorough
def test_the_stated_std_is_that_of_many_trials():
    errors = []
    for seed in range(40):
        right, _ = bench.trial('ball_bar', seed)
        length = right.quantities[2]
        errors.append(length.error / np.hypot(length.std, length.claimed))
    assert 0.75 < np.std(errors) < 1.3  # 40 of chi-squared: 0.78 to 1.22 are 95 %


def test_too_few_stations_wrong_counts_and_no_covariance_are_refused():
    made, found = measured('sphere', count=3)
    with pytest.raises(DataError, match='3 usable stations'):
        result('sphere', made, found)
    for lengths, bags, words in (((0.1,), 1, '2 to 12 bags'), ((0.025,), 6, '3 or 4 or 5 lengths'),
                                 ((0.1,), 3, r'2 lengths \(.*, and got 1')):
        with pytest.raises(InputError, match=words):
            settings_for(ROUTINES['step'], of_lengths(*lengths), bags)
    made, found = measured('plane')
    with pytest.raises(InputError, match='negative variance'):
        result('plane', made, replace(found, covariance=-found.covariance))


def test_the_edge_of_one_line_is_distinguished_from_others():
    made, found = measured('line')
    mixed = []
    for sample in made.bags[0]:
        edge = sample.features[1]
        other = replace(edge, point=edge.point + np.random.default_rng(sample.stamp).uniform(
            0.004, 0.01, 2))
        mixed.append(replace(sample, features=(other, sample.features[0], edge)))
    report = result('line', replace(made, bags=(tuple(mixed),)), found)
    assert report.scatter == result('line', made, found).scatter


def test_results_are_plain_values():
    made, found = measured('step')
    report = result('step', made, found)
    read = yaml.safe_load(verification.yaml_text(report))
    assert read['format'] == verification.FORMAT
    assert read['verdict'] == 'pass'
    assert [q['nominal'] for q in read['quantities']] == list(made.lengths)
    assert read == json.loads(json.dumps(verification.values(report)))


@pytest.mark.parametrize('lengths', [(0.004, 0.02), (0.0155, 0.005), (0.015, 0.0055)])
def test_teeth_of_another_gauge_never_pass(lengths):
    made, found = measured('tooth')
    config = of_lengths(*lengths)
    try:
        report = verify(ROUTINES['tooth'], bench.scanned(made, config), found, config)
    except DataError as refusal:
        assert 'not the gauge' in str(refusal)
        return
    assert report.verdict == 'fail'


def test_of_points_without_noise_none_is_an_outlier():
    made = gauges.tooth(np.random.default_rng(0), replace(gauges.PLAIN, noise=0.0),
                        replace(bench.ROBOT, repeatability=(0.0, 0.0)))
    found = bench.calibration(made.T_flange_sensor, np.diag(bench.STD ** 2))
    config = of_lengths(*made.lengths)
    report = verify(ROUTINES['tooth'], bench.scanned(made, config), found, config)
    assert report.verdict == 'pass' and max(abs(q.error) for q in report.quantities) < 1e-6
    assert report.scatter.points > 0.5 * len(made.passes) * 960


def test_the_noise_of_a_tilted_pass_goes_by_the_angle_of_each_face_to_the_ray():
    made, found = measured('tooth')
    config = of_lengths(*made.lengths)
    seen = stacked(bench.scanned(made, config))
    p = seen.points(found.T_flange_sensor @ sensor_axes(config))
    used = tooth_gauge.fitted(seen, p, config.verify)[0].observations
    near, far = sorted(np.median(used.noise[used.kind == 3 * BAGS + face, 1, 0])
                       for face in (tooth_gauge.RISING, tooth_gauge.FALLING))
    steep = gauges.PLAIN.noise * (1 + 4 * (np.deg2rad(60) / gauges.PLAIN.max_incidence) ** 8)
    assert near < 1.05 * gauges.PLAIN.noise and 0.95 * steep < far < 1.2 * steep


def test_a_height_of_which_no_top_is_seen_is_left_open():
    right, wrong = bench.trial('tooth', 0)  # whose tops lie too far off to be taken for tops
    assert right.quantities[1].std < 3e-6
    assert wrong.verdict == 'fail' and wrong.quantities[1].std == np.inf
