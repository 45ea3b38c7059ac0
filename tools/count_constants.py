#!/usr/bin/env python3
"""
Count the numeric constants of rooms: the numbers that stand behind names of modules.

usage: python tools/count_constants.py [ROOM ...]    (default: estimation checks sampling)

A name in capitals counts once if a number stands in what it is given. Prints how many each module
has, and the sum.
"""
from __future__ import annotations

import ast
from pathlib import Path
import sys

PACKAGE = Path(__file__).parents[1] / 'handeye_ros'


def constants(path: Path) -> list[str]:
    """Return the names of a module's numeric constants."""
    found = []
    for node in ast.parse(path.read_text(encoding='utf-8')).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = [name.id for target in targets for name in ast.walk(target)
                 if isinstance(name, ast.Name) and name.id.isupper()]
        numbers = [leaf for leaf in ast.walk(node.value) if isinstance(leaf, ast.Constant)
                   and isinstance(leaf.value, (int, float)) and not isinstance(leaf.value, bool)]
        found += names if numbers else []
    return found


def main() -> None:
    """Print the counts."""
    total = 0
    for room in sys.argv[1:] or ('estimation', 'least_squares', 'streams', 'checks', 'sampling'):
        for path in sorted((PACKAGE / room).rglob('*.py')):
            names = constants(path)
            total += len(names)
            if names:
                print(f'{len(names):4} {room}/{path.name}: {", ".join(names)}')
    print(f'{total:4} in all')


if __name__ == '__main__':
    main()
