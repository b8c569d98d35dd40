"""Checks of a scene's values: each returns the value in canonical form or raises `SceneError`."""

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Real
from typing import Any, TypeVar

from pbrl_ppl.errors import SceneError

Value = TypeVar("Value")
Point = tuple[float, float]
Named = tuple[tuple[str, float], ...]
#: Takes a value and where it is; returns the value in canonical form.
Check = Callable[[object, str], object]

#: The parameters of Table 1 that a contact needs: all that a kinematic body has.
CONTACT_NAMES = ("r", "mu_c")
#: Largest absolute value of a number and smallest positive one, in SI units: their products, such
#: as inertias, stay far from the limits of floating-point numbers.
LARGEST, SMALLEST = 1e18, 1e-18


def nearest(name: object, known: Iterable[str]) -> str:
    """Return ``; did you mean "..."?`` with the known name nearest to this one, or nothing."""
    lower = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(str(name).lower(), list(lower), n=1, cutoff=0.0)
    return f'; did you mean "{lower[close[0]]}"?' if close else ""


@contextmanager
def located(where: str) -> Iterator[None]:
    """Prefix the message of a `SceneError` raised inside with its place."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from None


def finite(value: object, where: str) -> float:
    """Return a finite number, of at most `LARGEST`, as a float."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise SceneError(f"{where} is {value!r}, expected a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SceneError(f"{where} is {number}, expected a finite number")
    if abs(number) > LARGEST:
        raise SceneError(
            f"{where} is {number:g}, expected at most {LARGEST:g} in SI units; check the number and"
            " its unit"
        )
    return number


def positive(value: object, where: str) -> float:
    """Return a number above zero, of at least `SMALLEST`, as a float."""
    number = finite(value, where)
    if number <= 0:
        raise SceneError(f"{where} is {number}, expected more than 0")
    if number < SMALLEST:
        raise SceneError(
            f"{where} is {number:g}, expected at least {SMALLEST:g} in SI units; check the number"
            " and its unit"
        )
    return number


def not_negative(value: object, where: str) -> float:
    """Return a number from zero up as a float."""
    number = finite(value, where)
    if number < 0:
        raise SceneError(f"{where} is {number}, expected 0 or more")
    return number


def unit_interval(value: object, where: str) -> float:
    """Return a number from zero to one as a float."""
    number = finite(value, where)
    if not 0 <= number <= 1:
        raise SceneError(f"{where} is {number}, expected between 0 and 1")
    return number


def flag(value: object, where: str) -> bool:
    """Return a boolean."""
    if not isinstance(value, bool):
        raise SceneError(f"{where} is {value!r}, expected true or false")
    return value


def choice(value: object, where: str, known: Iterable[str], expected: str) -> None:
    """Refuse what is not one of the known names, which ``expected`` lists in words."""
    if value not in (names := tuple(known)):
        raise SceneError(f"{where} is {value!r}, expected {expected}{nearest(value, names)}")


def different(labels: Sequence[str], what: str) -> None:
    """Refuse a name that two parts of a scene have."""
    for name in labels:
        if labels.count(name) > 1:
            raise SceneError(f'scene: two {what} are called "{name}"; rename one')


def label(value: object, where: str) -> str:
    """Return a name: text that is not empty and has no blanks around it or control characters."""
    if not isinstance(value, str):
        raise SceneError(f"{where} is {value!r}, expected text")
    if not value or value != value.strip() or not value.isprintable():
        raise SceneError(f"{where} is {value!r}, expected a name without blanks around it")
    return value


def names(value: object, where: str) -> tuple[str, ...]:
    """Return a tuple of different names."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected a list of names")
    labels = tuple(label(name, where) for name in value)
    if len(set(labels)) < len(labels):
        raise SceneError(f"{where} {list(labels)} names one twice; drop it")
    return labels


def vector(value: object, where: str, length: int = 2) -> Any:
    """Return a tuple of this many finite numbers."""
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected {length} numbers")
    numbers = tuple(finite(item, where) for item in value)
    if len(numbers) != length:
        raise SceneError(f"{where} has {len(numbers)} numbers, expected {length}")
    return numbers


def items(value: object, where: str) -> dict[object, object]:
    """Return a mapping, or a tuple of pairs without repeated names, as a dict."""
    if isinstance(value, Mapping):
        return dict(value)
    try:
        pairs = [(name, item) for name, item in value]  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise SceneError(f"{where} is {value!r}, expected a table of names and values") from None
    if len(dict(pairs)) < len(pairs):
        raise SceneError(f"{where} gives one name twice; drop one")
    return dict(pairs)


def table(
    value: object,
    where: str,
    checks: Mapping[str, Callable[[object, str], Value]],
    what: str = "key",
    hint: str = "",
) -> tuple[tuple[str, Value], ...]:
    """Return the entries of a table in the order of the known names, each checked.

    Parameters
    ----------
    value : object
        A mapping, or pairs.
    where : str
        Name of the table, for messages.
    checks : mapping of str to callable
        The check of each name that it may have.
    what, hint : str
        What a name is, and an addition to the message about an unknown one.
    """
    entries = items(value, where)
    for name in entries:
        if name not in checks:
            raise SceneError(f'unknown {what} "{name}" in {where}{nearest(name, checks)}{hint}')
    return tuple(
        (name, check(entries[name], f"{where}: {name}"))
        for name, check in checks.items()
        if name in entries
    )


def settle(part: object, where: str, **checks: Check) -> None:
    """Replace attributes of a frozen part of a scene by their canonical form.

    One that is None by default may be None.
    """
    for key, check in checks.items():
        value = getattr(part, key)
        if value is not None or getattr(type(part), key, ...) is not None:
            object.__setattr__(part, key, check(value, f"{where}: {key}"))


def settle_table(
    part: object, where: str, key: str, checks: Mapping[str, Check], what: str, hint: str = ""
) -> None:
    """Replace an attribute of a frozen part of a scene by its canonical form; see `table`."""
    entries = table(getattr(part, key), f"{key} of {where}", checks, what, hint)
    object.__setattr__(part, key, entries)


def not_both(known: Named, prior: Iterable[tuple[str, Named]], where: str) -> None:
    """Refuse a number that is known and has a prior."""
    for name in dict(known).keys() & dict(prior).keys():
        raise SceneError(f"{where}: {name} is in both known and prior; drop one of them")


def hyper_parameters(value: object, where: str) -> Named:
    """Return the hyper-parameters of a prior."""
    return table(value, where, {"mu": finite, "sigma": positive, "kappa": not_negative})


def index_probabilities(value: object, where: str) -> Named:
    """Return the probabilities of a joint's first or second body by name."""
    probabilities = {
        label(n, where): not_negative(p, f"{where} {n}") for n, p in items(value, where).items()
    }
    if not sum(probabilities.values()) > 0:
        raise SceneError(f"{where} has no name of a probability above 0; add one")
    return tuple(probabilities.items())


#: The parameters of a body, in the order of Table 1, and the checks of known ones.
PARAMETERS: Mapping[str, Check] = {
    **{"mass": positive, "r": not_negative, "mu_c": unit_interval},
    **dict.fromkeys(("w_x", "w_y", "w_theta"), finite),
    **dict.fromkeys(("mu_x", "mu_y"), unit_interval),
}
#: Names of a body's mean position.
PLACES = ("x", "y")
#: Names of the natural units of a body, and of its mean position, with their checks.
UNITS: Mapping[str, Check] = {
    **dict.fromkeys(("mass", "length", "time", "force", "torque", "speed"), positive),
    **dict.fromkeys(("turn_rate", "range", "interval"), positive),
    **dict.fromkeys(PLACES, finite),
}
