#!/usr/bin/env python3
"""
Draws the page in every state: a real node, a simulated cell that streams, Chromium (needs ROS).

usage: python tools/draw_page.py [--out DIR] [--stops N]

Without --out the four pictures of docs/page.md alone, into docs/figures; else all of them.
"""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
import socket
import sys
import tempfile
import time
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / 'test' / 'support'))
from browser import chromium, complaints  # noqa: E402, I100
from handeye_ros import config as configs  # noqa: E402
from handeye_ros import se3, targets  # noqa: E402
from handeye_ros.guidance.moves import next_move  # noqa: E402
from live_cell import LiveCell  # noqa: E402
import numpy as np  # noqa: E402
from ros_helpers import Client, running_node  # noqa: E402

FIGURES = ROOT / 'docs' / 'figures'
CONFIG = ROOT / 'config' / 'plate.yaml'
PORT = 8799
SIZES = {'phone': (390, 844), 'tablet': (820, 1180), 'desk': (1280, 800)}
# name of the state, size, scheme: those that docs/page.md shows, and what they are called there
SHOWN = {('aim', 'desk', 'light'): 'page', ('solved', 'phone', 'dark'): 'page_phone',
         ('moves', 'tablet', 'light'): 'page_moves', ('dead', 'tablet', 'light'): 'page_dead'}


class Pictures:
    """Takes pictures of each state in all sizes and schemes."""

    def __init__(self, browser: Any, out: Path | None) -> None:
        self.browser, self._out = browser, out

    def take(self, state: str) -> None:
        """Save the pictures of a state."""
        for size, (width, height) in SIZES.items():
            for scheme in ('light', 'dark'):
                name = SHOWN.get((state, size, scheme))
                if self._out or name:
                    self._look(width, height, scheme)
                    for file in [*([self._out / f'{state}_{size}_{scheme}.png'] if self._out
                                   else []), *([FIGURES / f'{name}.png'] if name else [])]:
                        self.browser.save_screenshot(str(file))
                    self._check(f'{state}, {size}', width)
        if self._out:
            self._whole(state)

    def _look(self, width: int, height: int, scheme: str) -> None:
        self.browser.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', {
            'width': width, 'height': height, 'deviceScaleFactor': 1, 'mobile': width < 500})
        self.browser.execute_cdp_cmd('Emulation.setEmulatedMedia', {
            'features': [{'name': 'prefers-color-scheme', 'value': scheme}]})
        time.sleep(0.6)  # a person looks

    def _whole(self, state: str) -> None:
        """Save the whole page as a phone shows it, however long."""
        self._look(390, 844, 'light')
        height = self.browser.execute_script('return document.body.scrollHeight')
        self._look(390, height, 'light')
        self.browser.save_screenshot(str(self._out / f'{state}_whole.png'))

    def _check(self, where: str, width: int) -> None:
        wide = self.browser.execute_script('return document.documentElement.scrollWidth')
        small = self.browser.execute_script(
            "return [...document.querySelectorAll('button, select')].filter(b => b.offsetParent)"
            '.filter(b => { const r = b.getBoundingClientRect(); '
            'return r.width && (r.width < 48 || r.height < 48); })'
            '.map(b => b.id || b.textContent)')
        if wide > width or small:
            print(f'{where}: {wide} px wide, too small: {small}')

    def until(self, condition: str, seconds: float = 60.0) -> None:
        """Wait until the page shows something."""
        end = time.monotonic() + seconds
        while not self.browser.execute_script(f'return Boolean(latest && ({condition}))'):
            if time.monotonic() > end:
                self.browser.save_screenshot(str((self._out or FIGURES) / 'failed.png'))
                raise SystemExit(f'waited in vain for {condition}')
            time.sleep(0.1)

    def click(self, name: str) -> None:
        """Press a button, and wait for the answer."""
        self.browser.execute_script("document.getElementById('message').textContent = ''; "
                                    "shown.message = ''; document.getElementById(arguments[0])"
                                    '.click()', name)
        self.until("!['', '…'].includes(document.getElementById('message').textContent)")
        print(self.browser.execute_script(
            "return document.getElementById('message').textContent"))


@contextmanager
def node(folder: Path, *more: str) -> Iterator[None]:
    """Run a node with a page."""
    with running_node(folder, '--params-file', str(CONFIG), '-p', f'page.port:={PORT}', *more):
        while True:  # the page comes a moment after the node
            with suppress(OSError), socket.create_connection(('127.0.0.1', PORT), 1.0):
                break
        yield


class Operator:
    """Goes where the node says."""

    def __init__(self, cell: LiveCell, pictures: Pictures) -> None:
        self.cell, self._pictures = cell, pictures
        self._config = configs.load(CONFIG)

    def goal(self) -> np.ndarray:
        """Return where to go: to the proposed pose, or as the first moves say."""
        world, taken = self.cell.world, self._pictures.browser.execute_script(
            'return latest.samples.filter(s => s.taken).length')
        found = self._pictures.browser.execute_script(
            'return latest.guidance.translation && [latest.guidance.translation, '
            'latest.guidance.rotation]')
        if found:
            return se3.from_quaternion(*map(np.array, found))
        move = next_move(taken, targets.method_for(self._config), self._config, world.view)
        R = (world.T_base_target[:3, :3].T @ (self.cell.first @ world.T_flange_sensor)[:3, :3]
             @ se3.exp_rotation(np.array([0.0, 0.0, move.turn]))
             @ se3.exp_rotation(np.append(move.tilt, 0.0)))
        return world.looking(R, world.spot(move.edge), move.place)

    def stop(self) -> None:
        """Go there, and wait until it counts."""
        before = 'latest.samples.length'
        count = self._pictures.browser.execute_script(f'return {before}')
        self.cell.go(self.goal())
        self._pictures.until(f'{before} > {count}')
        self._pictures.until('latest.guidance && latest.guidance.sample >= '
                             'Math.max(0, ...latest.samples.filter(s => s.taken)'
                             '.map(s => s.number)) && !latest.session.working')


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', type=Path)
    parser.add_argument('--stops', type=int, default=16)
    options = parser.parse_args()
    client = Client()
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        pictures = Pictures(browser, options.out)
        with node(Path(name), '-p', 'page.address:=0.0.0.0'):
            browser.get(f'http://127.0.0.1:{PORT}/')
            pictures.take('token')
        with node(Path(name), '-p', 'profile_topic:=/wrong', '-p', 'guidance.accuracy:=2e-4'):
            browser.get(f'http://127.0.0.1:{PORT}/')
            pictures.until('latest.profiles.trouble')
            pictures.take('waiting')
            cell = LiveCell(client, 'plate')
            pictures.until("latest.profiles.trouble.includes('/profile')")
            pictures.take('wrong_topic')
            calibrate(cell, pictures, options.stops)
            cell.close()
        pictures.until("document.body.classList.contains('old')")
        pictures.take('dead')
        print(*complaints(browser), sep='\n')
    client.close()


def calibrate(cell: LiveCell, pictures: Pictures, stops: int) -> None:
    """Go the whole way of a calibration."""
    browser, operator = pictures.browser, Operator(cell, pictures)
    browser.execute_script("ask('set', {profile_topic: '/profile'}, $('take'))")
    pictures.until('latest.samples.filter(s => s.taken).length === 1')
    operator.stop()
    pictures.take('moves')
    while not browser.execute_script('return latest.scene.next'):
        operator.stop()
    cell.go(operator.goal(), 0.6)
    pictures.take('aim')
    for _ in range(stops):
        operator.stop()
    pictures.take('sampling')
    cell.go(cell.T @ se3.transform(se3.exp_rotation(np.array([0.0, 2.0, 0.0])), np.zeros(3)))
    pictures.until('latest.motion.still > 1')
    pictures.click('take')
    pictures.take('refused')
    pictures.click('compute')
    browser.execute_script("document.querySelector('#samples details').open = true")
    pictures.take('solved')
    browser.execute_script("ask('set', {'verify.routine': 'plane'}, $('take')).then(readCell)")
    pictures.until("latest.verification.routine === 'plane'")
    pictures.click('verify-start')
    world = cell.world
    for turn in np.arange(12):
        tilt = np.array([0.6 * np.cos(2.4 * turn), 0.6 * np.sin(2.4 * turn), 0.5 * turn])
        before = browser.execute_script('return latest.verification.running')
        cell.go(world.looking(world.facing(0) @ se3.exp_rotation(tilt), world.spot(0),
                              (world.view.low + world.view.high) / 2))
        pictures.until(f'latest.verification.running !== {before!r}')
    pictures.click('verify-result')
    pictures.take('verified')
    pictures.click('save')
    pictures.take('saved')


if __name__ == '__main__':
    main()
