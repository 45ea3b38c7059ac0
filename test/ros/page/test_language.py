"""Every sentence of the page has its German one, and none is left over."""
from __future__ import annotations

from pathlib import Path
import re

import handeye_ros.ros.page

ASSETS = Path(handeye_ros.ros.page.__path__[0]) / 'assets'
SCRIPTS = re.sub(r"'\s*\+\s*'", '', ''.join(
    (ASSETS / name).read_text() for name in ('page.js', 'cell.js', 'profile.js', 'scene.js')))


def in_labels() -> set[str]:
    """Return the strings within calls of label()."""
    found = set()
    for call in re.finditer(r'\blabel\(', SCRIPTS):
        depth, end = 1, call.end()
        while depth:
            depth += {'(': 1, ')': -1}.get(SCRIPTS[end], 0)
            end += 1
        found |= set(re.findall(r"'([^']*)'", SCRIPTS[call.end():end]))
    return {text for text in found if re.search('[a-zA-Z]', text.replace('{0}', ''))}


def values_of(table: str) -> set[str]:
    """Return the values of a table of strings."""
    return set(re.findall(r":\s*'([^']*)'", re.search(
        rf'const {table} = {{(.*?)}};', SCRIPTS, re.DOTALL)[1]))


def test_nothing_is_left_untranslated_or_over() -> None:
    states = values_of('STATES')
    said = in_labels() | values_of('NAMES') | states | {text.split(':')[0] for text in states}
    said |= set(re.findall(r'data-label[^>]*>([^<]+)<', (ASSETS / 'index.html').read_text()))
    german = set(re.findall(r"'([^']*)'\s*:", re.search(
        r'SENTENCES.de = {(.*?)};\n', (ASSETS / 'de.js').read_text(), re.DOTALL)[1]))
    assert said - german == set()
    assert german - said == set()
