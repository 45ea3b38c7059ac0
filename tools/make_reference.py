#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes docs/reference.md from the configuration: `.venv/bin/python tools/make_reference.py`."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from handeye_ros.config import AT_START_ONLY, Parameter, parameters

PAGE = Path(__file__).parents[1] / 'docs' / 'reference.md'
HEAD = """\
# Every key of the configuration

A key is a parameter of the node (`ros2 param describe /handeye KEY`), a key of the YAML files in
`config/`, and one of `--set KEY=VALUE` on the command line. `make figures` writes this page from
`handeye_ros/config.py`.
"""
TABLE = '| key | default | values | what it is |\n|---|---|---|---|\n'


def reference() -> str:
    """Return the page: a table of the keys of each section."""
    sections: dict[str, list[Parameter]] = {}
    for parameter in parameters():
        section = parameter.key.rpartition('.')[0]
        sections.setdefault(section, []).append(parameter)
    return HEAD + ''.join(_section(name, found) for name, found in sections.items())


def _section(name: str, found: list[Parameter]) -> str:
    heading = f'`{name}.*`' if name else 'General'
    return f'\n## {heading}\n\n{TABLE}' + ''.join(_rows(found))


def _rows(found: list[Parameter]) -> Iterator[str]:
    for parameter in found:
        shown = 'none' if parameter.default != parameter.default else 'empty' if (
            parameter.default in ('', ())) else f'`{_yaml(parameter.default)}`'
        description = parameter.description.removesuffix(f' In {parameter.unit}.')
        description += ' At start only.' * (parameter.key in AT_START_ONLY)
        yield f'| `{parameter.key}` | {shown} | {_values(parameter)} | {description} |\n'


def _yaml(value: object) -> str:
    """Return a value as it is written in a parameter file."""
    if isinstance(value, tuple):
        return f'[{", ".join(map(_yaml, value))}]'
    return str(value).lower() if isinstance(value, bool) else str(value)


def _values(parameter: Parameter) -> str:
    if parameter.choices:
        values = ', '.join(f'`{choice}`' if choice else 'empty' for choice in parameter.choices)
    elif isinstance(parameter.default, bool):
        values = '`true`, `false`'
    elif parameter.minimum is not None and parameter.maximum is not None:
        values = f'{parameter.minimum:g} to {parameter.maximum:g} {parameter.unit}'.rstrip()
    else:
        values = 'a text'
    if not isinstance(parameter.default, tuple):
        return values
    return f'{_count(parameter.length)} of {values}'


def _count(lengths: Sequence[int]) -> str:
    """Return how many values a list may have."""
    if not lengths:
        return 'any number'
    if len(lengths) > 2:
        return f'{lengths[0]} to {lengths[-1]}'
    return ' or '.join('none' if n == 0 else str(n) for n in lengths)


if __name__ == '__main__':
    PAGE.write_text(reference(), encoding='utf-8')
