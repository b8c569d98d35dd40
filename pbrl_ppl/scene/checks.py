"""Checks of a scene's values: each returns the value in canonical form or raises `SceneError`."""

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Real
from typing import Any

from pbrl_ppl.errors import SceneError
from pbrl_ppl.state import STATE

Point = tuple[float, float]
Named = tuple[tuple[str, float], ...]

#: The parameters of a body, in the order of Table 1.
PARAMETER_NAMES = ("mass", "r", "mu_c", "w_x", "w_y", "w_theta", "mu_x", "mu_y")
#: Those of them that a contact needs: all that a kinematic body has.
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


def flag(value: object, where: str) -> None:
    """Refuse what is not a boolean."""
    if not isinstance(value, bool):
        raise SceneError(f"{where} is {value!r}, expected true or false")


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


def vector(value: object, length: int, where: str) -> Any:
    """Return a tuple of this many finite numbers."""
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected {length} numbers")
    numbers = tuple(finite(item, where) for item in value)
    if len(numbers) != length:
        raise SceneError(f"{where} has {len(numbers)} numbers, expected {length}")
    return numbers


def _items(value: object, where: str) -> dict[Any, Any]:
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
    known: Iterable[str],
    check: Callable[[str, object, str], Any],
    what: str = "key",
    hint: str = "",
) -> tuple[tuple[str, Any], ...]:
    """Return the entries of a table in the order of the known names, each checked.

    Parameters
    ----------
    value : object
        A mapping, or pairs.
    where : str
        Name of the table, for messages.
    known : iterable of str
        Names that it may have.
    check : callable
        Takes the name, the value and where it is; returns the value in canonical form.
    what, hint : str
        What a name is, and an addition to the message about an unknown one.
    """
    items, known = _items(value, where), tuple(known)
    for name in items:
        if name not in known:
            raise SceneError(f'unknown {what} "{name}" in {where}{nearest(name, known)}{hint}')
    return tuple(
        (name, check(name, items[name], f"{where}: {name}")) for name in known if name in items
    )


def known_parameters(value: object, where: str) -> Named:
    """Return the known parameters of a body in Table 1's order."""

    def check(name: str, item: object, at: str) -> float:
        if name.startswith("mu_"):
            return unit_interval(item, at)
        return {"mass": positive, "r": not_negative}.get(name, finite)(item, at)

    return table(value, f"known of {where}", PARAMETER_NAMES, check, "parameter")


def stated_noise(value: object) -> Named:
    """Return the known standard deviations of measurement noise, in the order of the state."""
    return table(value, "[noise]", STATE, lambda _, item, at: positive(item, at))


def index_probabilities(value: object, where: str) -> tuple[tuple[str, Named], ...]:
    """Return the probabilities of a joint's first and second body by name."""

    def check(_: str, item: object, at: str) -> Named:
        probabilities = {
            label(n, at): not_negative(p, f"{at} {n}") for n, p in _items(item, at).items()
        }
        if not sum(probabilities.values()) > 0:
            raise SceneError(f"{at} has no name of a probability above 0; add one")
        return tuple(probabilities.items())

    return table(value, f"prior of {where}", ("i_a", "i_b"), check, "index")


def hyper_parameters(
    value: object, where: str, effects: tuple[str, ...]
) -> tuple[tuple[str, Named], ...]:
    """Return the priors' hyper-parameters of a body: in Table 1's order, then its effects'."""
    checks = {"mu": finite, "sigma": positive, "kappa": not_negative}

    def check(_: str, item: object, at: str) -> Named:
        return table(item, at, checks, lambda key, number, place: checks[key](number, place))

    # which parameters an effect has is known where the catalogue is: `prior.build_layout`
    unknown = {str(name) for name in _items(value, f"prior of {where}")} - set(PARAMETER_NAMES)
    declared = sorted(name for name in unknown if name.startswith(tuple(f"{e}_" for e in effects)))
    hint = " (an effect's parameter needs the effect among the body's effects)"
    return table(
        value, f"prior of {where}", (*PARAMETER_NAMES, *declared), check, "parameter", hint
    )
