"""Declaration of a key of the configuration, and its listed form."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, is_dataclass
import math
import re
from typing import Any

NOT_SET = math.nan  # default of a number that changes an answer by its full size: it has none


def key(default: Any, description: str, **limits: Any) -> Any:
    """Declare a key; limits: minimum, maximum (numbers), choices (strings)."""
    return field(default=default, metadata={'description': description, **limits})


@dataclass(frozen=True)
class Parameter:
    """A dotted key with its default and its range."""

    key: str
    default: Any
    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[Any, ...] = ()
    length: tuple[int, ...] = ()  # of a list; empty: any
    whole: bool = False  # a list of whole numbers

    @property
    def unit(self) -> str:
        """Return the unit that the description names, empty if none."""
        match = re.search(r'\((m|rad|s)\)|\bin (m|s)\b', self.description)
        return '' if match is None else match[1] or match[2]


def parameters_of(section: Any, prefix: str) -> Iterable[Parameter]:
    """Yield the keys of a section and of those in it; prefix: before their names."""
    for item in fields(section):
        value = getattr(section, item.name)
        if is_dataclass(value):
            yield from parameters_of(value, f'{prefix}{item.name}.')
        elif item.metadata:
            yield Parameter(f'{prefix}{item.name}', value, **item.metadata)
