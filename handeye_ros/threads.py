# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How many threads the linear algebra of numpy and scipy (BLAS) may use in this process."""
from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

P = ParamSpec('P')
T = TypeVar('T')


@cache
def _controller() -> Any:
    """Return the controller of the thread pools, None without threadpoolctl."""
    try:
        from threadpoolctl import ThreadpoolController
    except ModuleNotFoundError:
        return None
    return ThreadpoolController()


_limits_blas = Lock()  # held by the call that does


def single_threaded(function: Callable[P, T]) -> Callable[P, T]:
    """
    Return the function, run with one BLAS thread.

    A pool of threads makes products of small matrices several times slower. The limit is one of
    the process: of calls at once only the first sets it, and when that returns, what was in force
    before is so again, for the others too.
    """
    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        controller = _controller()
        if controller is None or not _limits_blas.acquire(blocking=False):
            return function(*args, **kwargs)
        try:
            with controller.limit(limits=1):
                return function(*args, **kwargs)
        finally:
            _limits_blas.release()
    return limited
