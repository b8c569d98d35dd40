"""Findings in words: the verdict, and numbers as a reader wants them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pbrl_ppl.criticism import (
    ADEQUATE,
    DEFAULT,
    NOT_CONVERGED,
    TRIED,
    UNEXPLAINED,
    Candidate,
    Findings,
)
from pbrl_ppl.model import ACCELERATION
from pbrl_ppl.posterior import draws, group

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

#: A size in SI units beyond which nothing is: what the data would show from here on, they never do.
_NEVER = 1e6


def remainder_in_words(before: Any, after: Any) -> str:
    """What a learned remainder does, from the posteriors without and with it."""
    sizes = [draws(each)[ACCELERATION].mean(axis=0) for each in (before, after)]
    names = group(after, "posterior")[ACCELERATION]
    worst = int(np.argmax(sizes[0] - sizes[1]))
    name = str(names[names.dims[-1]].values[worst])
    unit = "rad/s²" if name == "omega" else "m/s²"
    return (
        f"learned remainder, a force without a law: what a step adds unexplained to {name} falls"
        f" from {sizes[0][worst]:.2g} to {sizes[1][worst]:.2g} {unit}"
    )


def verdict_in_words(findings: Findings) -> str:
    """Say the verdict in a sentence or two, for a reader who knows no statistics."""
    found = joined(
        f"{added.sentence.rstrip('.')} ({plain(added.effect)}) on the {plain(added.body)}"
        for added in findings.added
    )
    left = findings.unexplained
    rest = "a pattern remains in the errors" if left is None else left.sentence.rstrip(".")
    if findings.verdict == NOT_CONVERGED:
        return (
            "No verdict: the chains have not converged. Take more draws (--draws), or give the"
            " parameters tighter priors."
        )
    if findings.verdict == ADEQUATE:
        return (
            "Nothing was found missing: what the declared model leaves passed all tests that were"
            f" made ({joined(test.name for test in findings.tests)}).{_small(findings)}"
        )
    if findings.verdict == UNEXPLAINED and not found:
        return f"Something is missing that no effect in the catalogue explains: {rest}."
    if findings.verdict == UNEXPLAINED:
        return (
            "Something is missing that no effect in the catalogue explains. The nearest that it has"
            f" is {found}; with that added, {rest}."
        )
    if left is not None:
        return f"Something was missing: {found}. A pattern remains that nothing explains: {rest}."
    if len(findings.added) > 1:
        return f"{len(findings.added)} things were missing: {found}."
    return f"Something was missing: {found}."


def _small(findings: Findings) -> str:
    """Say what is there without mattering; beside what was added the table of candidates does."""
    return "".join(
        f" There is {plain(one.effect)} on the {plain(one.body)}, which changes predictions by"
        " less than 1 %."
        for one in findings.small
    )


def rejected_in_words(findings: Findings) -> str:
    """Say why the leading candidates, of those that chance does not explain, were not added."""
    there = {(added.effect, added.body) for added in findings.added}
    told = [
        f"{plain(one.effect)} on the {plain(one.body)} ({one.why})"
        for one in findings.candidates
        if one.why and one.p_value < DEFAULT.try_p and (one.effect, one.body) not in there
    ]
    return f"Not added: {'; '.join(told[:TRIED])}." if told else ""


def unseen_in_words(findings: Findings) -> str:
    """Say how small an effect must be for these data not to show it; nothing of those shown.

    An obstacle has no size without a place: what has none is named, for nothing was said of it.
    """
    there = {(added.effect, added.body) for added in findings.added}
    there |= {(small.effect, small.body) for small in findings.small}
    sizes, silent = [], []
    for candidate in findings.candidates:
        if (candidate.effect, candidate.body) in there:
            continue
        of = f" of the {plain(candidate.body)}" if len(findings.scene.dynamic) > 1 else ""
        for name, size in candidate.detectable.items():
            which = plain(candidate.effect)
            if len(candidate.detectable) > 1:
                which = f"{which} ({plain(name)})"
            sizes.append(f"{which}{of} {_unseen(candidate, name, size)}")
        if not candidate.detectable:
            silent.append(f"{plain(candidate.effect)}{of}")
    text = f"These data would not show: {'; '.join(sizes)}." if sizes else ""
    rest = f"Nothing can be said of how large these would have to be: {'; '.join(silent)}."
    return f"{text} {rest if silent else ''}".strip()


def _unseen(candidate: Candidate, name: str, size: float) -> str:
    if size > _NEVER:
        return "of any size"
    return f"{'above' if candidate.caps else 'below'} {quantity(size, candidate.units[name])}"


def plain(name: str) -> str:
    """Write a catalogue name as words."""
    return name.replace("_", " ")


def number(value: float | None, digits: int = 3) -> str:
    """Write a number for a reader: three significant digits, no exponent below a million.

    Examples
    --------
    >>> number(419.04), number(0.00123456), number(2.0), number(float("nan"))
    ('419', '0.00123', '2.00', '–')
    """
    if value is None or not np.isfinite(value):
        return "–"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(_RAISED)}".replace("-", "−")
    places = digits - 1 - int(np.floor(np.log10(abs(value)))) if value else 0
    return f"{value:,.{max(places, 0)}f}".replace("-", "−")


def digits_of(low: float, high: float) -> int:
    """Significant digits that tell the ends of an interval apart, at least three.

    Examples
    --------
    >>> digits_of(2.81, 3.19), digits_of(1.1987, 1.2013)
    (3, 5)
    """
    width = abs(high - low)
    if not np.isfinite(width) or width == 0:
        return 3
    return int(min(max(3, np.ceil(np.log10(max(abs(low), abs(high)) / width)) + 2), 9))


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """Write a number with its unit, which is "1" where there is none."""
    return f"{number(value, digits)} {unit.removesuffix('1')}".rstrip()


def chance(p_value: float) -> str:
    """Write a p-value: two digits, and no pretence of exactness where it underflowed.

    Examples
    --------
    >>> chance(0.0312), chance(1e-80), chance(0.0)
    ('0.031', '1.0 × 10⁻⁸⁰', '< 10⁻³⁰⁰')
    """
    return "< 10⁻³⁰⁰" if p_value < 1e-300 else number(p_value, 2)


def odds(p_value: float) -> str:
    """Write a p-value as odds: how often chance alone does it."""
    if p_value < 1e-300:
        return "less than once in 10³⁰⁰ times"
    if p_value > 0.1:
        return f"in {100 * p_value:.0f} % of all cases"
    if p_value > 1e-6:
        return f"once in {1 / p_value:,.0f} times"
    power = int(np.floor(-np.log10(p_value)))
    return f"less than once in 10{str(power).translate(_RAISED)} times"


def change(before: float, after: float) -> str:
    """Say by how much an error fell."""
    share = 1 - after / before if before > 0 else float("nan")
    if not np.isfinite(share) or abs(share) < 0.005:
        return "did not change"
    return f"{'fell' if share > 0 else 'rose'} by {abs(share) * 100:.0f} %"


def gains_in_words(
    before: Mapping[str, float], after: Mapping[str, float], units: Mapping[str, str]
) -> str:
    """Say how the errors of all state dimensions changed: how many fell, the most and the least.

    Examples
    --------
    >>> gains_in_words({"x": 0.2, "omega": 1.0}, {"x": 0.1, "omega": 0.1}, {"x": "m"})
    'fell in 2 of 2 state dimensions: most in omega (by 90 %, from 1.00 to 0.100), least in x (by 50 %, from 0.200 to 0.100 m)'
    """  # noqa: E501
    shares = {d: after[d] / before[d] for d in before if d in after and before[d] > 0}
    if not shares:
        return ""
    order = sorted(shares, key=lambda dimension: shares[dimension])
    fell = sum(share < 0.995 for share in shares.values())

    def told(name: str) -> str:
        size = f"from {number(before[name])} to {quantity(after[name], units.get(name, ''))}"
        part = change(before[name], after[name]).removeprefix("fell ")
        return f"{name} ({part}, {size})"

    text = f"fell in {fell} of {len(shares)} state dimensions: most in {told(order[0])}"
    return text if len(order) == 1 else f"{text}, least in {told(order[-1])}"


def joined(parts: Iterable[str], word: str = "and") -> str:
    """Write a list as words: ``a; b, and c``."""
    *most, last = [str(part) for part in parts] or [""]
    return f"{'; '.join(most)}, {word} {last}" if most else last
