"""A loop in words: the verdict, and numbers as a reader wants them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from pbrl_ppl.criticism import (
    ADEQUATE,
    NOT_CONVERGED,
    ONE_TRAJECTORY,
    TRIED,
    UNEXPLAINED,
    Added,
    Loop,
)

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

#: The asymptotic distribution of a statistic is not accurate below this p-value.
_SMALLEST_P = 1e-16
#: A held-out error above this many times the noise needs an explanation.
_TOO_LARGE = 1.5


def verdict_in_words(loop: Loop) -> str:
    """Return the verdict in a sentence or two, for a reader without statistics."""
    found = joined(
        f"{added.sentence.rstrip('.')} ({plain(added.effect)}) on the {plain(added.body)}"
        for added in loop.added
    )
    left = loop.unexplained
    rest = "a pattern remains in the errors" if left is None else left.sentence.rstrip(".")
    if loop.verdict == NOT_CONVERGED:
        return (
            "No verdict: the chains have not converged. Take more draws (--draws), or give the"
            " parameters tighter priors."
        )
    if loop.verdict == ADEQUATE:
        return _adequate(loop)
    if loop.verdict == UNEXPLAINED and not found:
        return f"Something is missing that no effect in the catalogue explains: {rest}."
    if loop.verdict == UNEXPLAINED:
        return (
            f"Something was missing: {found}. More is missing that no effect in the catalogue"
            f" explains: {rest}."
        )
    if left is not None:
        return (
            f"Something was missing: {found}. What remains is small, and forecasts do not show it:"
            f" {rest}."
        )
    if len(loop.added) > 1:
        return f"{len(loop.added)} things were missing: {found}."
    return f"Something was missing: {found}."


def _adequate(loop: Loop) -> str:
    """Describe an adequate model: the tests that passed, and negligible but significant misfit."""
    tested = sum(test.tested for test in loop.tests)
    passed = f"the declared model passes all {tested} tests of its residual"
    if untested := [test.name for test in loop.tests if not test.tested]:
        passed += f" that these data can fail (not {joined(untested, 'nor')})"
    # beside what was added the table of candidates has them
    small = "".join(
        f" There is {plain(one.effect)} on the {plain(one.body)}, which changes predictions by"
        f" less than {100 * loop.criteria.negligible:g} %."
        for one in loop.small
    )
    remains = significant_acceleration(loop)
    if remains > 0:
        return (
            f"Adequate to {percent(remains)} of the bodies' acceleration: {passed}. An acceleration"
            " of that size is left unexplained in each interval: significant, but too small to"
            f" matter, or within the error of the engine.{small}"
        )
    missing = "Nothing that matters was" if small else "Nothing was"
    return f"{missing} found missing: {passed}.{small}"


def significant_acceleration(loop: Loop) -> float:
    """Return the largest significant unexplained acceleration over that of the bodies, or 0."""
    left = loop.acceleration
    sizes = (left.relative_after[name] for name, sure in left.certain_after.items() if sure)
    return max(sizes, default=0.0)


def accepted(loop: Loop) -> tuple[Added, ...]:
    """Return the added effects, or none without a verdict."""
    return () if loop.verdict == NOT_CONVERGED else loop.added


def depends_on_records(loop: Loop) -> bool:
    """Return whether the residual depends on a recorded quantity: the dependence test failed."""
    left = loop.unexplained
    return left is not None and not left.depends_on.startswith("nothing")


def error_in_words(loop: Loop) -> str:
    """Explain a held-out error that seems to contradict the verdict; empty if none does."""
    model, after = "revised" if loop.added else "declared", loop.after.normalised_rmse
    if loop.unexplained is not None or significant_acceleration(loop):
        return "The unit is what the measurement noise alone makes, one interval ahead."
    if after > _TOO_LARGE and loop.verdict != NOT_CONVERGED:
        return (
            "The verdict is of the fitted recordings alone: the held-out ones differ from the"
            f" {model} model by {number(after)} times the noise (another load, wear, calibration?)."
        )
    return ""


def caution_in_words(loop: Loop) -> str:
    """Return what to know of added effects of a recording of one trajectory; empty otherwise."""
    single = bool(loop.added) and loop.provenance.get("trajectories") == 1
    return f"{ONE_TRAJECTORY[0].upper()}{ONE_TRAJECTORY[1:]}." if single else ""


def rejected_in_words(loop: Loop) -> str:
    """Return why the leading significant candidates were not added."""
    present = {(added.effect, added.body) for added in loop.added}
    reasons = [
        f"{plain(one.effect)} on the {plain(one.body)} ({one.why})"
        for one in loop.candidates
        if one.why and one.p_value < loop.criteria.try_p and (one.effect, one.body) not in present
    ]
    return f"Not added: {'; '.join(reasons[:TRIED])}." if reasons else ""


def left_out_in_words(loop: Loop) -> str:
    """Return which bad frames were left out of the histories, the first few one by one."""
    first, more = loop.bad_frames[:TRIED], len(loop.bad_frames) - TRIED
    rest = f"; and {more} more (report.json lists them)" if more > 0 else ""
    return f"{'; '.join(first)}{rest}." if first else ""


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
    """Return the significant digits that tell the ends of an interval apart, at least three.

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


def percent(share: float) -> str:
    """Write a share in per cent, with two significant digits."""
    return f"{number(100 * share, 2)} %"


def chance(p_value: float) -> str:
    """Write a p-value: two significant digits, and a bound below 1e-16.

    Examples
    --------
    >>> chance(0.0312), chance(3e-8), chance(1e-80)
    ('0.031', '3.0e-8', '< 1e-16')
    """
    if p_value < _SMALLEST_P:
        return f"< {_SMALLEST_P:.0e}"
    if p_value < 1e-4:
        return f"{p_value:.1e}".replace("e-0", "e-")
    return number(p_value, 2)


def p_equals(p_value: float) -> str:
    """Write ``p = 0.031`` or ``p < 1e-16``."""
    text = chance(p_value)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def change(before: float, after: float) -> str:
    """Return by how much an error fell or rose."""
    share = 1 - after / before if before > 0 else float("nan")
    if not np.isfinite(share) or abs(share) < 0.005:
        return "did not change"
    return f"{'fell' if share > 0 else 'rose'} by {abs(share) * 100:.0f} %"


def gains_in_words(
    before: Mapping[str, float], after: Mapping[str, float], units: Mapping[str, str]
) -> str:
    """Return how the errors of all state dimensions changed.

    Examples
    --------
    >>> gains_in_words({"x": 0.2, "omega": 1.0}, {"x": 0.1, "omega": 0.1}, {"x": "m"})
    'fell in 2 of 2 state dimensions, most in omega (by 90 %, from 1.00 to 0.100)'
    """
    shares = {d: after[d] / before[d] for d in before if d in after and before[d] > 0}
    if not shares:
        return ""
    best, worst = min(shares, key=shares.__getitem__), max(shares, key=shares.__getitem__)

    def change_of(name: str) -> str:
        size = f"from {number(before[name])} to {quantity(after[name], units.get(name, ''))}"
        return f"{name} (by {100 * abs(1 - shares[name]):.0f} %, {size})"

    fell = sum(share < 0.995 for share in shares.values())
    parts = [f"fell in {fell} of {len(shares)} state dimensions, most in {change_of(best)}"] * (
        fell > 0
    )
    if shares[worst] > 1.005:
        parts.append(f"rose{' most' if fell < len(shares) - 1 else ''} in {change_of(worst)}")
    return "; it ".join(parts) or "did not change"


def joined(parts: Iterable[str], word: str = "and") -> str:
    """Write a list as words: ``a; b, and c``."""
    *most, last = [str(part) for part in parts] or [""]
    return f"{'; '.join(most)}, {word} {last}" if most else last
