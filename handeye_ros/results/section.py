"""A mapping in a file, of which every value is checked before it is used."""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from handeye_ros.results.errors import CalibrationFileError


class Section:
    """A mapping in a file, of which every value is checked before it is used."""

    def __init__(self, path: Path, prefix: str, values: Any) -> None:
        if not isinstance(values, dict):
            what = prefix.rstrip('.') or 'the file'
            raise CalibrationFileError(path, f'{what} is no mapping')
        self.path, self._prefix, self._values = path, prefix, values

    def get(self, key: str, kind: type, default: Any = None) -> Any:
        """Return a value of a kind, or the default where there is none."""
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
        """Tell whether there is a value."""
        return self._values.get(key) is not None

    def section(self, key: str) -> Section:
        """Return a mapping inside."""
        return Section(self.path, f'{self._prefix}{key}.', self.get(key, dict))

    def error(self, key: str, what: str) -> CalibrationFileError:
        """Return the error for a key."""
        return CalibrationFileError(self.path, f'{self._prefix}{key} {what}')
