#!/usr/bin/env python3
"""Draws the pictures of docs/page.md: a real node, fed bags/plate, in Chromium (needs ROS)."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
import socket
import sys
import tempfile
import time

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / 'test' / 'support'))
from browser import chromium  # noqa: E402, I100
from ros_helpers import Client, replay, running_node  # noqa: E402

FIGURES = ROOT / 'docs' / 'figures'
PORT = 8799
SIZES = {'phone': (390, 844), 'tablet': (820, 1180), 'desk': (1280, 800)}


def shot(browser: object, name: str, size: str, scheme: str) -> None:
    """Save a picture of the page in a size and a colour scheme."""
    width, height = SIZES[size]
    browser.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', {
        'width': width, 'height': height, 'deviceScaleFactor': 1, 'mobile': size == 'phone'})
    browser.execute_cdp_cmd('Emulation.setEmulatedMedia', {
        'features': [{'name': 'prefers-color-scheme', 'value': scheme}]})
    time.sleep(1.0)  # a person looks
    browser.save_screenshot(str(FIGURES / f'{name}.png'))


@contextmanager
def node(folder: Path, *more: str) -> Iterator[None]:
    """Run a node with a page."""
    with running_node(folder, '--params-file', str(ROOT / 'config' / 'plate.yaml'),
                      '-p', f'page.port:={PORT}', *more):
        while True:  # the page comes a moment after the node
            with suppress(OSError), socket.create_connection(('127.0.0.1', PORT), 1.0):
                break
        yield


def main() -> None:
    """Draw all pictures."""
    client = Client()
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        with node(Path(name)):
            client.connect()
            browser.get(f'http://127.0.0.1:{PORT}/')
            shot(browser, 'page_waiting', 'tablet', 'light')
            replay(ROOT / 'bags' / 'plate')
            browser.find_element('id', 'compute').click()
            end = time.monotonic() + 60
            while not browser.find_elements('id', 'answer-x') and time.monotonic() < end:
                time.sleep(0.2)
            shot(browser, 'page', 'desk', 'light')
            shot(browser, 'page_phone', 'phone', 'dark')
        time.sleep(5.0)
        shot(browser, 'page_dead', 'tablet', 'light')
        with node(Path(name), '-p', 'page.address:=0.0.0.0'):
            browser.get(f'http://127.0.0.1:{PORT}/')
            shot(browser, 'page_token', 'phone', 'light')
    client.close()


if __name__ == '__main__':
    main()
