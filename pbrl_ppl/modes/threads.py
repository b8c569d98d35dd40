"""Limit of BLAS to one thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of many small matrices to run BLAS in one thread.

    Threads would spin while they wait for each other, which costs most of the time beside other
    work on the same processors.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _pools().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _pools() -> Any:
    """Return the controller of the thread pools; finding them takes 2 ms."""
    return ThreadpoolController()
