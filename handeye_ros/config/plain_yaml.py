"""YAML of plain values alone, as people write it."""
from __future__ import annotations

from itertools import accumulate
import re
from typing import Any

import yaml

DEEPEST = 100  # nesting of brackets in a YAML file


def yaml_content(text: str) -> Any:
    """Return what a YAML text holds, of plain values alone; raises yaml.YAMLError."""
    # the parser takes seconds for what nobody writes, before it gives up
    depths = accumulate(1 if c in '[{' else -1 for c in re.findall(r'[\[{}\]]', text))
    if max(depths, default=0) > DEEPEST:
        raise yaml.YAMLError('it is nested too deeply')
    try:
        return yaml.safe_load(text)
    except ValueError as error:  # a date or a number that is none
        raise yaml.YAMLError(str(error)) from error
    except RecursionError as error:
        raise yaml.YAMLError('it is nested too deeply') from error
