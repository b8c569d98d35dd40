"""Checks of a scene's values: each returns the value in canonical form or raises `SceneError`."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Real
from typing import Any

from pbrl_ppl.errors import SceneError
from pbrl_ppl.state import STATE

Point = tuple[float, float]

PARAMETER_NAMES = ("mass", "r", "mu_c", "w_x", "w_y", "w_theta", "mu_x", "mu_y")
"""The parameters of a body, in the order of Table 1."""

CONTACT_NAMES = ("r", "mu_c")
"""Those of them that a contact needs: all that a kinematic body has."""

LARGEST, SMALLEST = 1e9, 1e-12
"""No number of a scene or a recording is larger, and no positive one of a scene smaller, in SI
units: their products, such as inertias, stay far from where floating-point numbers end."""

HYPER_NAMES = ("mu", "sigma", "kappa")
INDEX_NAMES = ("i_a", "i_b")
"""The indices of a joint of unknown bodies."""


def nearest(name: object, known: Iterable[str]) -> str:
    """Return ``; did you mean "..."?`` with the known name nearest to this one, or nothing."""
    lower = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(str(name).lower(), list(lower), n=1, cutoff=0.0)
    return f'; did you mean "{lower[close[0]]}"?' if close else ""


@contextmanager
def located(where: str) -> Iterator[None]:
    """Say in a `SceneError` raised inside where it happened."""
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
    found = tuple(label(name, where) for name in value)
    if len(set(found)) < len(found):
        raise SceneError(f"{where} {list(found)} names one twice; drop it")
    return found


def vector(value: object, length: int, where: str) -> Any:
    """Return a tuple of this many finite numbers."""
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected {length} numbers")
    numbers = tuple(finite(item, where) for item in value)
    if len(numbers) != length:
        raise SceneError(f"{where} has {len(numbers)} numbers, expected {length}")
    return numbers


def _items(value: object, where: str) -> list[tuple[Any, Any]]:
    """Return the pairs of a mapping, or of a tuple of pairs, refusing repeated names."""
    if isinstance(value, Mapping):
        return list(value.items())
    try:
        pairs = [(name, item) for name, item in value]  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise SceneError(f"{where} is {value!r}, expected a table of names and values") from None
    if len({name for name, _ in pairs}) < len(pairs):
        raise SceneError(f"{where} gives one name twice; drop one")
    return pairs


def known_parameters(value: object, where: str) -> tuple[tuple[str, float], ...]:
    """Return the known parameters of a body in Table 1's order."""
    known: dict[str, float] = {}
    for name, item in _items(value, f"{where}: known"):
        if name not in PARAMETER_NAMES:
            raise SceneError(
                f'unknown parameter "{name}" in known of {where}{nearest(name, PARAMETER_NAMES)}'
            )
        number = finite(item, f"{where}: known {name}")
        if name == "mass":
            positive(number, f"{where}: known mass")
        if name == "r" and number < 0:
            raise SceneError(f"{where}: known r is {number}, expected 0 or more")
        if name.startswith("mu_") and not 0 <= number <= 1:
            raise SceneError(f"{where}: known {name} is {number}, expected between 0 and 1")
        known[name] = number
    return tuple((name, known[name]) for name in PARAMETER_NAMES if name in known)


def stated_noise(value: object) -> tuple[tuple[str, float], ...]:
    """Return the errors of measuring that are given, in the order of the state."""
    noise: dict[str, float] = {}
    for name, item in _items(value, "[noise]"):
        if name not in STATE:
            raise SceneError(f'unknown key "{name}" in [noise]{nearest(name, STATE)}')
        noise[name] = positive(item, f"[noise]: {name}")
    return tuple((name, noise[name]) for name in STATE if name in noise)


def index_probabilities(
    value: object, where: str
) -> tuple[tuple[str, tuple[tuple[str, float], ...]], ...]:
    """Return what a joint's first and second index may be: a probability each name."""
    prior: dict[str, tuple[tuple[str, float], ...]] = {}
    for index, table in _items(value, f"{where}: prior"):
        if index not in INDEX_NAMES:
            raise SceneError(
                f'unknown index "{index}" in prior of {where}{nearest(index, INDEX_NAMES)}'
            )
        here = f"{where}: prior {index}"
        given = {label(n, here): not_negative(p, f"{here} {n}") for n, p in _items(table, here)}
        if not sum(given.values()) > 0:
            raise SceneError(f"{here} has no name of a probability above 0; add one")
        prior[index] = tuple(given.items())
    return tuple((index, prior[index]) for index in INDEX_NAMES if index in prior)


def hyper_parameters(
    value: object, where: str, effects: tuple[str, ...]
) -> tuple[tuple[str, tuple[tuple[str, float], ...]], ...]:
    """Return the priors' hyper-parameters of a body: in Table 1's order, then its effects'."""
    prior: dict[str, tuple[tuple[str, float], ...]] = {}
    for name, table in _items(value, f"{where}: prior"):
        # which parameters an effect has is known where the catalogue is: `prior.build_layout`
        if name not in PARAMETER_NAMES and not str(name).startswith(
            tuple(f"{effect}_" for effect in effects)
        ):
            raise SceneError(
                f'unknown parameter "{name}" in prior of {where}{nearest(name, PARAMETER_NAMES)}'
                " (an effect's parameter needs the effect among the body's effects)"
            )
        hyper: dict[str, float] = {}
        for key, item in _items(table, f"{where}: prior {name}"):
            if key not in HYPER_NAMES:
                raise SceneError(
                    f'unknown key "{key}" in prior {name} of {where}{nearest(key, HYPER_NAMES)}'
                )
            check = {"mu": finite, "sigma": positive, "kappa": not_negative}[key]
            hyper[key] = check(item, f"{where}: prior {name} {key}")
        prior[name] = tuple((key, hyper[key]) for key in HYPER_NAMES if key in hyper)
    order = (*PARAMETER_NAMES, *sorted(prior.keys() - set(PARAMETER_NAMES)))
    return tuple((name, prior[name]) for name in order if name in prior)
