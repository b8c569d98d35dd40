"""Linear algebra in one thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of many small matrices, for which BLAS would start threads in vain.

    They wait for each other in a loop: beside other work on the same processors, such as a second
    fit, most of the time goes there.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _pools().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _pools() -> Any:
    """The libraries' thread pools, which it takes 2 ms to find."""
    return ThreadpoolController()
