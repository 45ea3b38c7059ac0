# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, where one is installed."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import shutil
from typing import Any

from command import PATIENCE
import pytest


@contextmanager
def chromium(width: int = 1000, height: int = 1400) -> Iterator[Any]:
    """Give a browser; skips the test where there is none."""
    webdriver = pytest.importorskip('selenium.webdriver', reason='needs selenium')
    program, driver = shutil.which('chromium'), shutil.which('chromedriver')
    if not program or not driver:
        pytest.skip('needs chromium and chromedriver: apt install chromium chromium-driver')
    options = webdriver.ChromeOptions()
    options.binary_location = program
    # as root, and with little shared memory, it starts with these alone
    for word in ('--headless=new', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
                 f'--window-size={width},{height}'):
        options.add_argument(word)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    browser.set_script_timeout(PATIENCE)  # a report is drawn when it is asked for
    try:
        yield browser
    finally:
        browser.quit()


def complaints(browser: Any) -> list[str]:
    """Return what the console holds."""
    return [entry['message'] for entry in browser.get_log('browser')]
