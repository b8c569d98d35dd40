"""Checks of a scene's values: each returns the value in canonical form or raises `SceneError`."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

from pbrl_ppl.errors import PbrlError, SceneError
from pbrl_ppl.system.files import parse_toml, read_text, reason

Value = TypeVar("Value")
Point = tuple[float, float]
Named = tuple[tuple[str, float], ...]
#: Takes a value and where it is; returns the value in canonical form.
Check = Callable[[object, str], object]

#: Keys that are not the names of the fields that they set.
RENAMED = {"object_class": "class", "start": "from", "end": "to"}
#: The parameters of Table 1 that a contact needs: all that a kinematic body has.
CONTACT_NAMES = ("r", "mu_c")


def nearest(name: object, known: Iterable[str]) -> str:
    """Return ``; did you mean "..."?`` with the known name nearest to this one, or nothing."""
    lower = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(str(name).lower(), list(lower), n=1, cutoff=0.0)
    return f'; did you mean "{lower[close[0]]}"?' if close else ""


def known(name: str, names: Sequence[str], where: str) -> None:
    """Refuse a name that is none of these, after what ``where`` says of it."""
    if name not in names:
        raise SceneError(f'{where} "{name}"{nearest(name, names)}')


@contextmanager
def located(where: str = "", kind: type[PbrlError] = SceneError) -> Iterator[None]:
    """Raise a `SceneError` from inside with its place before its message, as another ``kind``."""
    try:
        yield
    except SceneError as error:
        raise kind(f"{where}: {error}" if where else str(error)) from None


def is_number(value: object) -> bool:
    """Return whether a value is a number, which true and false are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def whole(value: Any, where: str) -> int:
    """Return a whole number from one up."""
    if not is_number(value) or not isinstance(value, Integral) or int(value) < 1:
        raise SceneError(f"{where} is {value!r}, expected a whole number from 1 up")
    return int(value)


def read_file(path: str | Path, what: str) -> str:
    """Return the text of a file."""
    try:
        return read_text(Path(path))
    except FileNotFoundError:
        raise SceneError(f"{what} {path}: there is no such file; check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        why = reason(error)
        raise SceneError(f"{what} {path}: cannot be read as UTF-8 text: {why}") from None


def document(text: str) -> dict[str, Any]:
    """Return a TOML document."""
    try:
        return parse_toml(text)
    except ValueError as error:
        raise SceneError(f"not TOML: {error}") from None


def finite(value: Any, where: str, *, largest: float = 1e18) -> float:
    """Return a finite number as a float.

    ``largest``: absolute value in SI units, at most: products, such as inertias, stay far from the
    limits of floating-point numbers.
    """
    if not is_number(value):
        raise SceneError(f"{where} is {value!r}, expected a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SceneError(f"{where} is {number}, expected a finite number")
    if abs(number) > largest:
        raise SceneError(
            f"{where} is {number:g}, expected at most {largest:g} in SI units; check the number and"
            " its unit"
        )
    return number


def positive(value: object, where: str, *, smallest: float = 1e-18) -> float:
    """Return a number above zero as a float.

    ``smallest``: value in SI units, at least.
    """
    number = finite(value, where)
    if number <= 0:
        raise SceneError(f"{where} is {number}, expected more than 0")
    if number < smallest:
        raise SceneError(
            f"{where} is {number:g}, expected at least {smallest:g} in SI units; check the number"
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


def instance(kind: type, expected: str) -> Callable[[object, str], Any]:
    """Return the check of a class's instances, which ``expected`` says in words."""

    def check(value: object, where: str) -> object:
        if not isinstance(value, kind):
            raise SceneError(f"{where} is {value!r}, expected {expected}")
        return value

    return check


flag, text = instance(bool, "true or false"), instance(str, "text")


def choice(known: Iterable[str]) -> Check:
    """Return the check of what is one of these names."""
    listed = tuple(known)

    def check(value: object, where: str) -> object:
        if value not in listed:
            expected = " or ".join(listed) + nearest(value, listed)
            raise SceneError(f"{where} is {value!r}, expected {expected}")
        return value

    return check


def different(labels: Sequence[str], what: str) -> None:
    """Refuse a name that two parts of a scene have."""
    for name in labels:
        if labels.count(name) > 1:
            raise SceneError(f'scene: two {what} are called "{name}"; rename one')


def label(value: object, where: str) -> str:
    """Return a name: text that is not empty and has no blanks around it or control characters."""
    name: str = text(value, where)
    if not name or name != name.strip() or not name.isprintable():
        raise SceneError(f"{where} is {value!r}, expected a name without blanks around it")
    return name


def each(check: Check, expected: str = "a list") -> Callable[[object, str], tuple[Any, ...]]:
    """Return the check of a list, which no text and no table is, whose items have one check."""

    def checked(value: object, where: str) -> tuple[object, ...]:
        if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
            raise SceneError(f"{where} is {value!r}, expected {expected}")
        return tuple(check(item, where) for item in value)

    return checked


def names(value: object, where: str) -> tuple[str, ...]:
    """Return a tuple of different names."""
    labels = each(label, "a list of names")(value, where)
    if len(set(labels)) < len(labels):
        raise SceneError(f"{where} {list(labels)} names one twice; drop it")
    return labels


def vector(value: object, where: str, length: int = 2, check: Check = finite) -> Any:
    """Return a tuple of this many finite numbers, each of which has a check."""
    numbers = each(check, f"{length} numbers")(value, where)
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


def entries(check: Check) -> Check:
    """Return the check of a table whose names are free and whose values have one check."""

    def checked(value: object, where: str) -> object:
        pairs = items(value, where).items()
        return tuple((name, check(item, f"{where} of {name}")) for name, item in pairs)

    return checked


def fields_of(kind: type[Any], table: object, where: str) -> dict[str, Any]:
    """Return values of a class's fields from a table whose keys are checked."""
    names = {RENAMED.get(field.name, field.name): field for field in fields(kind)}
    required = [key for key, field in names.items() if field.default is MISSING]
    optional = [key for key in names if key not in required]
    checked = keyed(table, where, required, optional)
    return {names[key].name: value for key, value in checked.items()}


def keyed(
    table: object, where: str, required: Iterable[str], optional: Iterable[str]
) -> dict[str, Any]:
    """Return a table; refuse one with unknown keys or without the required ones."""
    known = [*required, *optional]
    if not isinstance(table, Mapping):
        raise SceneError(f"{where} is {table!r}, expected a table of {', '.join(known)}")
    for key in table:
        if key not in known:
            raise SceneError(f'unknown key "{key}" in {where}{nearest(key, known)}')
    for key in required:
        if key not in table:
            raise SceneError(f'{where} has no "{key}"; add it')
    return dict(table)


def tables(contents: dict[str, Any], key: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the place and the table, for each of an array of tables."""
    array = contents.get(key, [])
    if not isinstance(array, list):
        raise SceneError(f"{key} is not an array of tables; write [[{key}]], with two brackets")
    for number, table in enumerate(array, start=1):
        where = f"[[{key}]] number {number}"
        if isinstance(table, Mapping) and "name" in table:
            where += f' ("{table["name"]}")'
        yield where, table


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
