"""Numbers of bodies from options such as ``cart=-2,0,1.57``."""

from __future__ import annotations

from collections.abc import Sequence

from pbrl_ppl.errors import GoalError


def pose(text: str, bodies: Sequence[str], option: str) -> tuple[str, list[float]]:
    """A body and its numbers from ``BODY=X,Y,THETA``; the body may be left out if there is one.

    A coordinate that is free, ``-``, is None.
    """
    name, separator, numbers = text.rpartition("=")
    if not separator:
        if len(bodies) > 1:
            raise GoalError(f"{option} {text}: say which body: {bodies[0]}={text}")
        name = bodies[0]
    values = []
    for number in numbers.split(","):
        try:
            values.append(None if number.strip() == "-" else float(number))
        except ValueError:
            raise GoalError(
                f"{option} {text}: {number.strip()!r} is not a number; expected BODY=X,Y,THETA"
            ) from None
    if option == "--start" and None in values:
        raise GoalError(f"{option} {text}: a start has no free coordinates; give a number for -")
    return name.strip(), values  # type: ignore[return-value]
