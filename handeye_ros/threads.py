"""
One thread for linear algebra while many small matrices are worked on.

A pool of threads makes products of small matrices several times slower. What the caller set is in
force again afterwards.
"""
from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec('P')
T = TypeVar('T')


@cache
def _controller() -> Any:
    """Return what limits the pools of this process, None where threadpoolctl is missing."""
    try:
        from threadpoolctl import ThreadpoolController
    except ModuleNotFoundError:
        return None
    return ThreadpoolController()


def single_threaded(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function as it is, but with one thread for BLAS while it runs."""
    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        controller = _controller()
        if controller is None:
            return function(*args, **kwargs)
        with controller.limit(limits=1):
            return function(*args, **kwargs)
    return limited
