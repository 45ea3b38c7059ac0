"""Pictures for files; matplotlib is asked for only here, and told of where it is missing."""
from __future__ import annotations

from pathlib import Path
from typing import Any

from handeye_ros.errors import UnwritableError
from handeye_ros.scanning.errors import NoMatplotlibError


def figure(rows: int, columns: int, width: float = 9.0, height: float = 3.0) -> tuple[Any, Any]:
    """Return a figure and its axes; width, height: of one plot (inches)."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise NoMatplotlibError from error
    drawing = Figure(figsize=(width * columns, height * rows), layout='constrained')
    return drawing, drawing.subplots(rows, columns)


def save(drawing: Any, path: Path) -> None:
    """Write a figure; the ending of the file says its form. Raises UnwritableError."""
    try:
        drawing.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise UnwritableError(path, str(error)) from error
