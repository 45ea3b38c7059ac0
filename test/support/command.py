# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs the command line as a user does, processes that outlive no test, benches, a browser."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
import io
from pathlib import Path
import shutil
import signal
import socket
import subprocess
import sys
from typing import Any
from unittest import mock

from handeye_ros.cli import main
import pytest

ROOT = Path(__file__).parents[2]
PLATE = ROOT / 'config' / 'plate.yaml'
PATIENCE = 150.0  # s until something that does not happen fails the test


def bench_of(name: str) -> Any:
    """Return the module of a bench."""
    with mock.patch.object(sys, 'path', [str(ROOT / 'bench'), *sys.path]):
        return import_module(name)


@contextmanager
def running(command: Sequence[Any], end: int = signal.SIGTERM,
            **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Run a command; end: the signal that ends it with the block, if it runs still."""
    process = subprocess.Popen(command, **options)
    try:
        yield process
        process.send_signal(end)
        process.wait(PATIENCE)
    finally:
        process.kill()
        process.wait()
        for stream in filter(None, (process.stdout, process.stderr)):
            stream.close()


def run_python(*arguments, **options):
    """Run Python to the end of a program, in the root unless cwd says otherwise."""
    return subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True,
                          check=False, **({'cwd': ROOT} | options))


def handeye(*arguments, cwd, before=''):
    """Run `handeye` in a folder; before: code that runs first, then in a process of its own."""
    command = ['handeye', *map(str, arguments)]
    if before:
        program = f'import sys; sys.path.insert(0, {str(ROOT)!r}); {before}\n' \
                  'from handeye_ros.cli import main; main()'
        return run_python('-c', program, *command[1:], cwd=cwd)
    streams = [io.TextIOWrapper(io.BytesIO(), 'utf-8', write_through=True) for _ in range(2)]
    with (chdir(cwd), redirect_stdout(streams[0]), redirect_stderr(streams[1]),
          mock.patch.object(sys, 'argv', command), pytest.raises(SystemExit) as end):
        main()
    output = [stream.buffer.getvalue().decode() for stream in streams]
    return subprocess.CompletedProcess(command, end.value.code or 0, *output)


def succeeds(*arguments, cwd):
    """Run `handeye` as above, and check that it ends well."""
    run = handeye(*arguments, cwd=cwd)
    assert run.returncode == 0, run.stderr
    return run


def assert_refused(run, code, *words):
    """Check that a run ended with a sentence that holds the words, and without an answer."""
    assert run.returncode == code, run.stderr
    assert 'Traceback' not in run.stderr
    assert 1 <= len(run.stderr.splitlines()) <= 3, run.stderr
    assert run.stdout == ''
    for word in words:
        assert word in run.stderr


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


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
