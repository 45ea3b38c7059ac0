# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: what it says, and what a browser shows of it."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import re
from typing import Any

from command import chromium, handeye, PLATE, ROOT, succeeds
from handeye_ros import config, se3
from handeye_ros.bags.recording import read_bag
from handeye_ros.data import Calibration
from handeye_ros.results import calibration_file, report
from handeye_ros.results.report import SolvedRecording, std_of_points, verdict
from handeye_ros.review import solved_recording
import numpy as np
import pytest
from recordings import rewrite, scan

BAG = ROOT / 'bags' / 'plate'
PAINTED = """
const c = document.getElementById('scene');
const copy = document.createElement('canvas');
[copy.width, copy.height] = [c.width, c.height];
const pen = copy.getContext('2d', {willReadFrequently: true});
pen.drawImage(c, 0, 0);
const d = pen.getImageData(0, 0, c.width, c.height).data;
const seen = new Set();
let painted = 0;
for (let i = 0; i < d.length; i += 4) {
  if (d[i] < 250 || d[i + 1] < 250 || d[i + 2] < 250) painted++;
  seen.add((d[i] >> 5) + ',' + (d[i + 1] >> 5) + ',' + (d[i + 2] >> 5));
}
return [painted, seen.size, c.toDataURL()];
"""


@pytest.fixture(scope='module')
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the calibration of a plate and its report."""
    folder = tmp_path_factory.mktemp('solved')
    succeeds('solve', BAG, '--config', PLATE, '--out', folder, cwd=ROOT)
    run = handeye('report', folder, cwd=ROOT)
    assert (run.returncode, run.stdout) == (0, f'wrote {folder / "report.html"}\n'), run.stderr
    return folder


@pytest.mark.thorough
def test_a_recording_of_another_target_is_told(solved: Path, tmp_path: Path) -> None:
    run = succeeds('report', solved, '--bag', ROOT / 'bags/sphere', '--out', 'r.html',
                   cwd=tmp_path)
    assert run.stderr.startswith('warning: the recording is refused now: as set, no sample fits')


@pytest.fixture(scope='module')
def calibration(solved: Path) -> Calibration:
    return calibration_file.read_calibration(solved / 'calibration.yaml')


@pytest.fixture(scope='module')
def recording(calibration: Calibration) -> SolvedRecording:
    return solved_recording(calibration, BAG)


@pytest.fixture(scope='module')
def page(solved: Path) -> Iterator[Any]:
    with chromium() as browser:
        browser.get((solved / 'report.html').as_uri())
        yield browser


def text_of(page: Any, name: str) -> str:
    return str(page.find_element('id', name).get_attribute('textContent'))


@pytest.mark.once
def test_the_report_opens_without_a_network(solved: Path) -> None:
    text = (solved / 'report.html').read_text()
    plain = re.sub(r'base64,[A-Za-z0-9+/=]+', '', text)
    assert not re.search(r'(src|href)="(?!data:)', plain) and '@import' not in plain
    assert 'http' not in plain
    assert len(text.encode()) < 8e6


def test_the_report_shows_the_same_numbers_as_the_file(page, calibration):
    T, std = calibration.T_flange_sensor, np.sqrt(np.diag(calibration.covariance))
    result = page.find_elements('css selector', '#transform td.number')
    values = np.array([cell.text for cell in result], dtype=float).reshape(6, 2)
    np.testing.assert_allclose(values[:3, 0], T[:3, 3] * 1e3, atol=5e-4)
    np.testing.assert_allclose(values[:3, 1], std[:3] * 1e3, atol=5e-4)
    np.testing.assert_allclose(values[3:, 0], np.degrees(se3.rpy(T)), atol=5e-5)
    left_out = float(text_of(page, 'left_out'))
    assert left_out == pytest.approx(calibration.quality.holdout_rms * 1e3, abs=5e-4)
    assert calibration.provenance['inputs'][0]['sha256'] in text_of(page, 'inputs')


def test_the_scene_is_drawn_and_turns(page: Any) -> None:
    painted, colors, before = page.execute_script(PAINTED)
    assert painted > 3000 and colors > 10
    canvas = page.find_element('id', 'scene')
    from selenium.webdriver import ActionChains
    ActionChains(page).move_to_element(canvas).click_and_hold().move_by_offset(
        90, 40).release().perform()
    painted, _, after = page.execute_script(PAINTED)
    assert painted > 3000 and after != before


def test_what_was_not_used_is_shown_with_its_reason(calibration, recording):
    reason = 'no edge <was> seen'
    stops = tuple(replace(stop, reason=reason) if stop.number == 3 else stop
                  for stop in recording.stops)
    samples = tuple(replace(s, used=False, reason=reason) if i == 2 else s
                    for i, s in enumerate(calibration.samples))
    text = report.html(replace(calibration, samples=samples), replace(recording, stops=stops))
    assert text.count('no edge &lt;was&gt; seen') == 3  # counted, below the profile, in the list
    assert 'Stop 3:\nnot used: no edge' in text


def test_each_stop_agrees_as_the_file_says(calibration, recording):
    stated = {s.stamp: s.residual for s in calibration.samples}
    agreements = {stop.stamp: stop.agreement for stop in recording.stops if stop.agreement}
    assert {stamp: agreement.residual for stamp, agreement in agreements.items()} == pytest.approx(
        stated)
    left_out = np.array([agreement.left_out for agreement in agreements.values()])
    assert (left_out > list(stated.values())).all()


def test_a_recording_that_says_something_else_is_reported(calibration, recording):
    T = se3.perturb(calibration.T_flange_sensor, np.array([1e-3, 0, 0, 0, 0, 0]))
    moved = replace(calibration, T_flange_sensor=T)
    reliable, sentence = verdict(moved, recording, np.empty((0, 3)))
    assert not reliable
    assert sentence.startswith('Do not rely on this calibration: the recording gives another '
                               'answer than the one saved, 1.000 mm')
    refused = solved_recording(calibration, ROOT / 'bags' / 'one_orientation')
    assert ('Do not rely on this calibration: the recording is refused now: all poses share'
            in report.html(calibration, refused))


def test_mapped_points_are_as_uncertain_as_draws_say(calibration: Calibration) -> None:
    points = np.array([[0.0, 0.0, 0.16], [0.02, 0.0, 0.19]])
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(6), calibration.covariance, 4000)
    T = calibration.T_flange_sensor
    spread = [se3.apply(se3.perturb(T, d), points) - se3.apply(T, points) for d in draws]
    rms = float(np.sqrt((np.array(spread) ** 2).sum(axis=2).mean()))
    assert std_of_points(calibration, points) == pytest.approx(rms, rel=0.05)


def test_a_moved_recording_is_found_and_a_changed_one_is_refused(
        calibration, tmp_path, monkeypatch):
    def named(path: str) -> Calibration:
        inputs = [{**calibration.provenance['inputs'][0], 'path': path}]
        return replace(calibration, provenance={**calibration.provenance, 'inputs': inputs})

    (tmp_path / 'bag').symlink_to(BAG)
    file = next(path for path in (tmp_path / 'bag').iterdir() if path.suffix == '.mcap')
    relative = named(f'bag/{file.name}')
    monkeypatch.chdir('/')
    recording = solved_recording(relative, None, tmp_path / 'out' / 'plate')
    assert not recording.missing and len(recording.stops) == len(calibration.samples)
    assert 'is not there' in solved_recording(relative, None, Path('/')).missing
    (tmp_path / 'plate.mcap').write_text('another')
    changed = solved_recording(named(str(tmp_path / 'plate.mcap')), None)
    assert 'has changed since it was solved' in changed.missing


def test_a_recording_in_several_files_is_shown_whole(calibration: Calibration, tmp_path: Path
                                                     ) -> None:
    _, messages = scan(BAG)
    for k in range(3):
        rewrite(BAG, tmp_path / f'plate_{k}.mcap', messages[k * 1100:(k + 1) * 1100])
    inputs = read_bag(tmp_path, config.load(PLATE)).inputs
    named = replace(calibration, provenance={**calibration.provenance, 'inputs': inputs})
    recording = solved_recording(named, None)
    assert len(inputs) == 3 and len(recording.stops) == len(calibration.samples)


def test_a_calibration_from_files_has_a_report_too(calibration: Calibration) -> None:
    result = {**config.flatten(config.Config()), 'target.type': 'points',
              'calibration_type': 'eye_on_base'}
    files = replace(calibration, provenance={**calibration.provenance, 'config': result})
    recording = solved_recording(files, None)
    assert 'solved from files' in recording.missing
    assert 'id="scene"' in report.html(files, recording)
