"""Bytes that the coverage of what reads them leads."""
from __future__ import annotations

import contextlib
import inspect
import io
from pathlib import Path
import sys
import tempfile
from typing import Any

import atheris
from fuzzing.messages import check_cloud, CONFIGS, GOOD_CLOUD, GOOD_POSE
from handeye_ros.bags import bag
from handeye_ros.bags.messages import pose_from_cdr
from handeye_ros.config import Config
from handeye_ros.errors import HandeyeError


def read_functions() -> list[Any]:
    """Return the functions and methods of what reads messages and bags."""
    modules = [m for name, m in sys.modules.items() if name.startswith('handeye_ros.bags.')]
    classes = [c for module in modules for c in vars(module).values()
               if inspect.isclass(c) and c.__module__ == module.__name__]
    return [function for owner in (*modules, *classes) for function in vars(owner).values()
            if inspect.isfunction(function)
            and function.__module__.startswith('handeye_ros.bags.')]


def guided(seconds: float) -> None:
    """Let atheris lead the bytes; it ends the process at the first failure."""
    for function in read_functions():
        atheris.instrument_func(function)
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / 'x.mcap'

        def one(data: bytes) -> None:
            with contextlib.suppress(HandeyeError):
                pose_from_cdr(data)
            with contextlib.suppress(HandeyeError):
                check_cloud(data, CONFIGS[len(data) % len(CONFIGS)])
            with contextlib.suppress(HandeyeError), contextlib.redirect_stderr(io.StringIO()):
                file.write_bytes(b'\x89MCAP0\r\n' + data)
                bag.read(file, Config())

        corpus = Path(name) / 'corpus'
        corpus.mkdir()
        for number, seed in enumerate((GOOD_CLOUD, GOOD_POSE)):
            (corpus / str(number)).write_bytes(seed)
        atheris.Setup([sys.argv[0], f'-max_total_time={seconds:.0f}', '-timeout=2',
                       '-rss_limit_mb=1024', str(corpus)], one)
        atheris.Fuzz()
