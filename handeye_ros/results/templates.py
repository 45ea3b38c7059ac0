# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The pages and other texts of results, by their templates in results/assets."""
from __future__ import annotations

from typing import Any

from handeye_ros import __version__
from handeye_ros.output import now_text


def rendered(template: str, **values: Any) -> str:
    """Return a page, or another text, by the name of its template; values: what it shows."""
    from jinja2 import Environment, PackageLoader, select_autoescape, StrictUndefined
    from markupsafe import Markup
    texts = Environment(loader=PackageLoader('handeye_ros.results', 'assets'),
                        autoescape=select_autoescape(('html', 'xacro.jinja')),
                        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
                        keep_trailing_newline=True)
    texts.policies['json.dumps_kwargs'] = {'ensure_ascii': False}
    texts.globals['source'] = lambda name: Markup(texts.get_template(name).render())
    return texts.get_template(template).render(
        version=__version__, now=now_text(), **values)
