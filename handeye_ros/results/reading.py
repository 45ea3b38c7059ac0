# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reads YAML files of results: each value is checked, and each refusal names file and key."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from handeye_ros import __version__
from handeye_ros.config import yaml_content
from handeye_ros.errors import InputError
import yaml


def unusable(path: Path, reason: str) -> InputError:
    """Return the error for a file that cannot be used."""
    return InputError(f'{path} cannot be used: {reason}')


def content_of(path: Path) -> Any:
    """Return the content of a YAML file; raises InputError."""
    try:
        return yaml_content(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise unusable(path, error.strerror or str(error)) from error
    except (yaml.YAMLError, ValueError) as error:
        raise unusable(path, 'it is not valid YAML') from error


def require_format(path: Path, text: str, kind: str, newest: int = 1) -> None:
    """Raise InputError for another format than the kind and its numbers up to the newest."""
    number = text.removeprefix(kind)
    if number == text or not number.isdecimal():
        raise unusable(path, f'its format is "{text}", expected {kind}{newest}')
    if int(number) > newest:
        raise unusable(path, f'its format {text} is newer than this version of handeye_ros '
                             f'({__version__}) can read; update the package')


class Section:
    """A mapping in a file; each value is checked on access."""

    def __init__(self, path: Path, prefix: str, values: Any) -> None:
        if not isinstance(values, dict):
            section_name = prefix.rstrip('.') or 'the file'
            raise unusable(path, f'{section_name} is no mapping')
        self.path, self._prefix, self._values = path, prefix, values

    def get(self, key: str, kind: type, default: Any = None) -> Any:
        """Return a value of a type, or the default if it is missing."""
        value = self._values.get(key, default)
        if value is None:
            raise self.error(key, 'is missing')
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise self.error(key, f'is {value!r}, expected {kind.__name__}')
        return value

    def number(self, key: str) -> float:
        """Return a finite number."""
        value = float(self.get(key, float))
        if not math.isfinite(value):
            raise self.error(key, f'is {value}')
        return value

    def has(self, key: str) -> bool:
        """Return whether there is a value."""
        return self._values.get(key) is not None

    def section(self, key: str) -> Section:
        """Return a nested mapping."""
        return Section(self.path, f'{self._prefix}{key}.', self.get(key, dict))

    def error(self, key: str, problem: str) -> InputError:
        """Return the error for a key."""
        return unusable(self.path, f'{self._prefix}{key} {problem}')
