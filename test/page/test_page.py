# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The page, in a real browser, of the real node fed by a bag; and what it refuses."""
from __future__ import annotations

import json
from pathlib import Path
import socket
import time
from typing import Any

from calibrations import calibration_at
from command import chromium, complaints, free_port, PATIENCE
from handeye_ros.results import printed, report
from handeye_ros.results.calibration_file import read_calibration, write_calibration
from handeye_ros.results.report import SolvedRecording
from handeye_ros.results.truth import true_transform
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('aiohttp', reason='needs aiohttp')
from handeye_ros.page.contents import PAGE_SETTINGS  # noqa: E402
from ros_helpers import Client, parameter, replay, ROOT, running_node, stand_still  # noqa: E402

pytestmark = pytest.mark.ros

LINES = "document.querySelectorAll('#samples li').length"
BAG, CONFIG = ROOT / 'bags' / 'plate', ROOT / 'config' / 'plate.yaml'


def wait(browser: Any, condition: str, what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not browser.execute_script(f'return {condition}'):
        assert time.monotonic() < end, f'waited in vain for {what}'
        time.sleep(0.05)  # the browser needs the processor too


def words(browser: Any, name: str) -> str:
    return str(browser.execute_script('return document.getElementById(arguments[0]).textContent',
                                      name))


def click(browser: Any, selector: str) -> None:
    button = browser.find_element('css selector', selector)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
    button.click()


def press(browser: Any, selector: str, message: str) -> str:
    """Click, and return what the page then says."""
    browser.execute_script("document.getElementById('message').textContent = ''")
    click(browser, selector)
    wait(browser, f"document.getElementById('message').textContent.includes({message!r})",
         f'"{message}", not "{words(browser, "message")}"')
    return words(browser, 'message')


def served(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(('127.0.0.1', port)) == 0


def test_a_calibration_by_clicking_goes_on_after_a_restart(tmp_path: Path, client: Client) -> None:
    port = free_port()
    with_page = ('--params-file', str(CONFIG), '-p', f'page.port:={port}')
    with chromium(1280, 900) as browser:
        with running_node(tmp_path, *with_page):
            client.connect()
            browser.get(f'http://127.0.0.1:{port}/')
            replay(BAG)
            wait(browser, f'{LINES} >= 17', 'all samples')
            count = calibrated(browser, tmp_path)
            assert complaints(browser) == []
        assert 'Traceback' not in (tmp_path / 'node.log').read_text()
        with running_node(tmp_path, *with_page):
            client.until(lambda: served(port), 'the page is there')
            browser.get(f'http://127.0.0.1:{port}/')
            complaints(browser)  # of the time without a node
            client.connect()
            for k in range(2):  # a robot that runs on begins another session by itself
                stand_still(client, 10**18 + 2 * k * 10**9, x=0.1 * k)
            wait(browser, f'{LINES} === 1', 'what its stop gave')
            went_on(browser, count)
            cleared(browser)
            assert complaints(browser) == []
        assert 'Traceback' not in (tmp_path / 'node.log').read_text()


def calibrated(browser: Any, tmp_path: Path) -> int:
    """Compute, save, undo and download; return how many samples are left."""
    wait(browser, "document.getElementById('trouble').textContent.includes('no more profiles')",
         'the trouble of now')
    assert 'no more' not in press(browser, '#take', 'sample'), 'it stays when they come again'
    press(browser, '[data-sample="5"]', 'sample 5 is excluded')
    wait(browser, "document.querySelectorAll('#samples .out').length === 1", 'its line')
    assert 'x, y, z = ' in press(browser, '#compute', 'laser in flange')
    saved = press(browser, '#save', 'wrote ')
    path = tmp_path / 'plate' / 'calibration.yaml'
    assert str(path) in saved
    wait(browser, "document.getElementById('answer-x')", 'the figures')
    calibration = read_calibration(path)
    rows = browser.execute_script("return [...document.querySelectorAll('#figures tbody tr')]"
                                  '.map(r => [...r.cells].map(c => c.textContent))')
    # the page, the report and the command line say the same, figure by figure
    assert rows[:6] == [list(row) for row in printed.transform_rows(calibration)]
    text = report.html(calibration, SolvedRecording(()))
    assert all(figure in text for row in rows[:6] for figure in row[1:3])
    quality = calibration.quality
    assert rows[6:] == [['residual', f'{1e3 * quality.residual_rms:.3f}', '', 'mm'],
                        ['left out', f'{1e3 * quality.holdout_rms:.3f}', '', 'mm'],
                        ['samples used', str(quality.samples_used), '', '']]
    press(browser, '[data-sample="5"]', 'sample 5 is included')
    anew = ("[...document.querySelectorAll('#figures tbody tr')].at(-1).cells[1].textContent "
            f"=== '{quality.samples_used + 1}'")  # it is soon computed again by itself
    wait(browser, "document.getElementById('answer-state').textContent.startsWith('outdated')"
         f' || {anew}', 'the answer is told to be outdated, or computed anew')
    count = browser.execute_script(f'return {LINES}')
    undone(browser, count)
    wait(browser, f'{LINES} === {count - 1}', 'one sample less')
    downloaded(browser)
    return count - 1


def undone(browser: Any, count: int) -> None:
    """Undo: it asks before it removes what another browser has taken; no is no."""
    browser.refresh()  # it is another browser to the page
    wait(browser, f'{LINES} === {count}', 'all samples again')
    click(browser, '#undo')
    wait(browser, "document.getElementById('question').textContent.endsWith('Remove it?')",
         'the question')
    browser.find_element('id', 'no').click()
    refused = json.loads(browser.execute_async_script(
        "fetch('act/remove_last_sample', {method: 'POST', body: '{\"number\": 1}',"
        "headers: {'Content-Type': 'application/json'}}).then(r => r.text()).then(arguments[0])"))
    assert not refused['success'] and 'is the last now' in refused['message']
    assert browser.execute_script(f'return {LINES}') == count
    click(browser, '#undo')
    press(browser, '#yes', 'removed sample')


def fetched(browser: Any, path: str) -> str:
    return str(browser.execute_async_script(
        'fetch(arguments[0]).then(r => r.text()).then(arguments[1])', path))


def downloaded(browser: Any) -> None:
    """Take the files of the answer, and look at the profile of a sample."""
    for link, words in (('yaml', 'format: handeye_ros/calibration/'), ('urdf', '<origin xyz='),
                        ('report.html', 'What was seen at each stop')):
        assert browser.find_elements('css selector', f'#files [href="read/file?name={link}"]')
        assert words in fetched(browser, f'read/file?name={link}')
    browser.find_element('css selector', '#samples summary').click()
    wait(browser, PAINTED.replace('NAME', '#samples [open] canvas'), 'its profile')


def went_on(browser: Any, count: int) -> None:
    """Go on with the session before, with samples taken by hand."""
    setup = json.loads(fetched(browser, 'read/setup'))
    assert len(setup['sessions']) == 1
    assert tuple(one['key'] for one in setup['settings']) == (*PAGE_SETTINGS,)  # in their order
    wait(browser, "!document.getElementById('before').hidden", 'the banner')
    assert words(browser, 'before-text') == f'The previous session holds {count} samples.'
    click(browser, '#continue')
    wait(browser, f'{LINES} === {count}', 'its samples')
    wait(browser, "document.getElementById('answer-x')", 'its answer')
    wait(browser, "document.getElementById('before').hidden", 'no banner')
    press(browser, '[name=mode][value=manual]', 'sampling.mode is manual')
    wait(browser, "document.getElementById('link').textContent === 'samples are taken by hand'",
         'it says so')


@pytest.mark.thorough
def test_the_cell_is_set_and_sessions_change_by_clicking(tmp_path: Path, client: Client) -> None:
    port = free_port()
    with chromium(1280, 900) as browser, running_node(
            tmp_path, '-p', 'target.type:=sphere', '-p', 'profile_topic:=elsewhere', '-p',
            f'page.port:={port}'):
        client.until(lambda: served(port), 'the page is there')
        browser.get(f'http://127.0.0.1:{port}/')
        wait(browser, "document.getElementById('choose').offsetParent", 'that no profiles come')
        click(browser, '#choose')
        wait(browser, "document.getElementById('setup-open').open", 'the settings')
        set_to(browser, 'profile_topic', '/profile')
        set_to(browser, 'target.radius', '0.04')
        wait(browser, "document.getElementById('set-target.radius').value === '0.04'",
             'the form of now')
        client.connect()
        stand_still(client, 10**18)
        stand_still(client, 10**18 + 2 * 10**9, x=0.1)
        wait(browser, f'{LINES} === 1', 'what the first stop gave')
        first = words(browser, 'session').rsplit(' ', 1)[-1]
        click(browser, '#new')
        press_twice(browser)
        wait(browser, f'{LINES} === 0', 'the new session')
        wait(browser, f"document.getElementById('sessions').value === '{first}'", 'the one before')
        press(browser, '#open', 'continuing with ')
        wait(browser, f'{LINES} === 1', 'its stop')
        before = browser.execute_script(SCENE)
        click(browser, '[data-turn="0.3,0"]')
        wait(browser, f'{SCENE[7:]} !== {before!r}', 'that the scene is turned')
        assert complaints(browser) == []


SCENE = "return document.getElementById('scene').toDataURL()"


def set_to(browser: Any, key: str, value: str) -> None:
    """Set a key in the form, as a person does."""
    wait(browser, f"document.getElementById('set-{key}')", 'the form')
    browser.execute_script(
        'const input = document.getElementById(arguments[0]); if (input.options) '
        'input.add(new Option(arguments[1], arguments[1])); input.value = arguments[1];',
        f'set-{key}', value)
    press(browser, f'.setting[data-key="{key}"] button', f'{key} is {value}')


def press_twice(browser: Any) -> None:
    """Answer yes to both questions before a session is left."""
    browser.find_element('id', 'yes').click()
    press(browser, '#yes', 'removed; bags and clocks may start again')


@pytest.mark.thorough
def test_a_verification_by_clicking(tmp_path: Path, client: Client) -> None:
    port, bag = free_port(), ROOT / 'bags' / 'sphere'
    right = tmp_path / 'right.yaml'
    write_calibration(calibration_at(
        true_transform(bag), covariance=np.diag(np.repeat([3e-5, 1.7e-4], 3) ** 2)), right)
    with chromium(1280, 900) as browser, running_node(
            tmp_path, '--params-file', str(ROOT / 'config' / 'sphere.yaml'), '-p',
            f'page.port:={port}', '-p', f'verify.calibration:={right}'):
        client.connect()
        browser.get(f'http://127.0.0.1:{port}/')
        wait(browser, "document.getElementById('set-verify.routine')", 'the settings')
        for radius in ('0.05', '0.04'):
            browser.execute_script(
                "for (const [key, value] of [['routine', 'sphere'], ['radius', arguments[0]]]) {"
                "const input = document.getElementById('set-verify.' + key);"
                "input.value = value; input.dispatchEvent(new Event('change'));}", radius)
            if radius == '0.04':  # which was wrong before: it begins anew
                click(browser, '#verify-start')
            press(browser, '#yes' if radius == '0.04' else '#verify-start', '0 usable stops of 0')
            wait(browser, "!document.getElementById('verify-result').disabled", 'that it goes on')
        assert parameter(client, 'verify.radius') == 0.04
        press(browser, '#verify-result', 'fewer than 4')
        replay(bag)
        wait(browser, "/1[0-9] usable stops/.test(document.getElementById('course').textContent)",
             'the stops that count')
        verdict = press(browser, '#verify-result', 'sphere: PASS')
        wait(browser, "document.getElementById('verdict').textContent", 'it at its place')
        assert verdict.startswith(words(browser, 'verdict'))
        assert 'good' in browser.find_element('id', 'verdict').get_attribute('class')
        wait(browser, "document.getElementById('course').textContent === ''", 'that it has ended')
        assert complaints(browser) == []
    assert 'verdict: pass' in (tmp_path / 'sphere' / 'verification_sphere.yaml').read_text()


PAINTED = ("(() => {const c = document.querySelector('NAME');"
           "const e = document.createElement('canvas');"
           'if (!c) return false; e.width = c.width; e.height = c.height; '
           'return c.toDataURL() !== e.toDataURL()})()')


def cleared(browser: Any) -> None:
    """Clear: it asks twice, and no is no."""
    count = browser.execute_script(f'return {LINES}')
    click(browser, '#clear')
    browser.find_element('id', 'yes').click()
    wait(browser, "document.getElementById('question').textContent.includes('stay on the')",
         'the second question')
    browser.find_element('id', 'no').click()
    assert browser.execute_script(f'return {LINES}') == count
    click(browser, '#clear')
    browser.find_element('id', 'yes').click()
    press(browser, '#yes', 'removed; bags and clocks may start again')
    wait(browser, f'{LINES} === 0', 'no samples')
