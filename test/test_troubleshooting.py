"""docs/troubleshooting.md has an entry for all that is refused or warned of, in its words."""
from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
import importlib
import re

from command import ROOT
from handeye_ros.errors import (
    DataError,
    HandeyeError,
    InputError,
    NamedCauseError,
    UnusableMessageError,
)
import pytest

pytestmark = pytest.mark.once

PAGE = (ROOT / 'docs' / 'troubleshooting.md').read_text(encoding='utf-8')
ROWS = [line for line in PAGE.splitlines() if line.startswith('|') and '---' not in line
        and not line.startswith('| you read')]
SOURCES = sorted((ROOT / 'handeye_ros').rglob('*.py'))
BLANK = '…'


def classes(kind: type = HandeyeError) -> Iterator[type]:
    for each in kind.__subclasses__():
        yield each
        yield from classes(each)


def said() -> set[str]:
    """Return the names of all errors that are raised: all but those that name a kind only."""
    for file in SOURCES:
        if re.search(r'^class \w+Error\(', file.read_text(encoding='utf-8'), re.MULTILINE):
            parts = file.relative_to(ROOT).with_suffix('').parts
            importlib.import_module('.'.join(parts))
    return {each.__name__ for each in classes()
            if each.__module__.startswith('handeye_ros.')
            and each not in (InputError, DataError, UnusableMessageError, NamedCauseError)}


def text(node: ast.AST) -> str | None:
    """Return a string with … for what is put in, None for what is none."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        return ''.join(v.value if isinstance(v, ast.Constant) else BLANK for v in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return (text(node.left) or BLANK) + (text(node.right) or BLANK)
    return None


@cache
def all_texts() -> str:
    return '\n'.join(found for file in SOURCES
                     for node in ast.walk(ast.parse(file.read_text(encoding='utf-8')))
                     if (found := text(node)))


def warnings() -> Iterator[str]:
    """Yield what is appended to a list of warnings, yielded as a note, or counted as dropped."""
    for file in SOURCES:
        tree = ast.parse(file.read_text(encoding='utf-8'))
        for node in ast.walk(tree):
            given: list[ast.AST] = []
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith('warnings.append'):
                given = [node.args[0]]
            elif isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith('_dropped'):
                given = [node.slice]
            elif file.name == 'frame_notes.py' and isinstance(node, ast.Yield):
                given = [node.value] if node.value else []
            yield from filter(None, map(text, given))


def quoted(row: str) -> list[str]:
    """Return the pieces of what a row says is read."""
    return [piece.strip() for words in re.findall('`([^`]+)`', row.split('|')[1])
            for piece in words.split(BLANK) if len(piece.strip()) > 3]


def test_every_refusal_has_an_entry() -> None:
    listed = set(re.findall(r'<!-- (\w+) -->', PAGE))
    missing, unknown = said() - listed, listed - said()
    assert not missing, 'docs/troubleshooting.md has no entry for these'
    assert not unknown, 'docs/troubleshooting.md has entries for what is not said any more'


@pytest.mark.parametrize('row', ROWS, ids=lambda row: row[2:40])
def test_an_entry_is_in_the_words_that_are_said(row: str) -> None:
    everything = all_texts()
    assert all(piece in everything for piece in quoted(row)), quoted(row)
    assert len(row.split('|')) == 5, 'what is read, why, what to do'


@pytest.mark.parametrize('warning', sorted(set(warnings())))
def test_every_warning_has_an_entry(warning: str) -> None:
    pieces = [piece for row in ROWS for piece in quoted(row) if '<!--' not in row]
    assert any(piece in warning for piece in pieces), warning
