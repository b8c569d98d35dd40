"""Closed loops in words: the verdict, a summary for a terminal, and numbers for a reader."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pbrl_ppl.criticism import (
    ADEQUATE,
    LARGEST_SHARE,
    NOT_CONVERGED,
    ONE_TRAJECTORY,
    UNEXPLAINED,
    Estimate,
    Law,
    Loop,
    acceleration_in_words,
    share_in_words,
)
from pbrl_ppl.posterior import interval, scalars
from pbrl_ppl.reporting.style import UNITS
from pbrl_ppl.scene import state_sizes
from pbrl_ppl.state import STATE

#: Candidates and bad frames that are listed one by one.
LISTED = 4


def verdict_in_words(loop: Loop) -> str:
    """Return the verdict in a sentence: what was found, how much it helps, what remains.

    It is the first line of the report and of the summary in a terminal.
    """
    if loop.verdict == NOT_CONVERGED:
        named = [_named(one) for one in loop.added]
        so_far = f" (found so far: {listed(named)})" if named else ""
        return (
            f"No verdict: the chains have not converged{so_far}; take more draws (--draws),"
            " Gaussians at the modes (--method laplace), or give the parameters tighter priors."
        )
    return f"{_found(loop)}: {_gained(loop)}; {_remains(loop)}."


def _found(loop: Loop) -> str:
    """Name the main laws that were found, with the size of one that the data can tell."""
    if not loop.added:
        if loop.verdict == UNEXPLAINED:
            return "No effect in the catalogue explains the residual"
        matters = " that matters" if loop.found.small or loop.acceleration.remaining else ""
        return f"Nothing{matters} was found missing"
    first, *more = loop.added
    sentence = listed([_named(one) for one in (first, *more)])
    if not more and has_size(first):
        (size,) = first.parameters.values()
        sentence += f", {with_interval(size)}"
    return f"{sentence[0].upper()}{sentence[1:]}"


def _named(added: Law) -> str:
    """Write an effect and its body, or the effects that fit as well."""
    others = [plain(name) for name in added.not_separable_from]
    if len(others) > 2:
        others = [f"one of {len(others)} others that fit as well"]
    return f"{listed([plain(added.effect), *others], 'or')} on the {plain(added.body)}"


def has_size(added: Law) -> bool:
    """Return whether an effect's size fits into a headline: one number of one effect."""
    return len(added.parameters) == 1 and not added.not_separable_from


def with_interval(size: Estimate, name: str = "94 %") -> str:
    """Write an estimate and its interval, with the digits that tell the ends apart."""
    digits = digits_of(*size.hdi)
    low, high = (number(end, digits) for end in size.hdi)
    return f"{quantity(size.mean, size.unit, digits)} ({name} {low} to {high})"


def _gained(loop: Loop) -> str:
    """Write the held-out error, before and after if something was added."""
    before, after = loop.before.normalised_rmse, loop.after.normalised_rmse
    if np.isposinf(after):
        return "held-out predictions diverge"
    both = f"{error(before)} -> {number(after)}" if loop.added else number(after)
    return f"held-out error {both} times the noise"


def _remains(loop: Loop, small: float = 0.05) -> str:
    """Write what remains, and whether it matters.

    A remainder that forecasts do not show is negligible below the share ``small`` of the bodies'
    acceleration.
    """
    if loop.diverges:
        return f"forecasts of {number(loop.rollout_seconds)} s diverge"
    left, name = loop.unexplained, loop.acceleration.remaining
    where = _where(loop, left.dimension, left.body) if left is not None and left.body else ""
    if loop.verdict == UNEXPLAINED:
        return _unexplained(loop, where)
    if name and not where:
        where = _where(loop, name)
        if loop.acceleration.relative_after[name] >= loop.criteria.negligible:
            return f"what remains, {where}, is no more than the engine's error"
    if where or left is not None:
        at = left.dimension if left is not None and left.dimension else name
        share = loop.acceleration.relative_after.get(at, 0.0)
        said = "is negligible" if share < small else "does not show in forecasts"
        return f"what remains{where and f', {where},'} {said}"
    if _differ(loop):
        return "the recordings that were fitted leave only noise"
    return "only noise remains"


def _differ(loop: Loop, largest: float = 1.5) -> bool:
    """Return whether the held-out error is above ``largest`` times the noise: to be explained."""
    return loop.after.normalised_rmse > largest


def _where(loop: Loop, dimension: str, body: str = "") -> str:
    """Write where something remains, with its acceleration if that is significant."""
    if not dimension:
        return f"on the {plain(body)}"
    where = f"in {dimension}"
    if loop.acceleration.certain_after.get(dimension):
        where = acceleration_in_words(dimension, loop.acceleration.after[dimension])
    return f"{where} of the {plain(body)}" if body else where


def _unexplained(loop: Loop, where: str) -> str:
    """Write where something is unexplained, and whether forecasts show it."""
    left, still = loop.unexplained, " still" * bool(loop.added)
    failed = [test.name for test in loop.tests if not test.passed]
    if left is not None and where:
        depends = f", which depends on {left.depends_on}," * loop.depends_on_records
        text = f"what remains {where}{depends} is{still} unexplained"
        if not where.startswith("in "):
            text = text.removeprefix("what remains ")
    elif failed:
        text = f"the model{still} fails the test of {failed[0]}"
    else:
        text = "held-out forecasts became worse"
    share = max(loop.acceleration.relative_after.values(), default=0.0)
    if loop.forecasts_at_noise and share < LARGEST_SHARE:
        text += ", but forecasts are as good as the noise allows"
    return text


def remains_in_words(loop: Loop) -> str:
    """Return what the tests of the residual found, in a sentence or two; empty without a verdict.

    Negligible effects are named where nothing was added: the table of candidates has the others.
    """
    if loop.verdict == NOT_CONVERGED:
        return ""
    if loop.unexplained is not None:
        left = loop.unexplained
        chance_of = f" ({p_equals(left.p_value)})" if left.body else ""
        return f"{left.sentence[:1].upper()}{left.sentence[1:]}{chance_of}."
    tested = sum(test.tested for test in loop.tests)
    model = model_of(loop)
    passed = f"The {model} model passes all {tested} tests of its residual"
    if untested := [test.name for test in loop.tests if not test.tested]:
        passed += f" that these data can fail (not {listed(untested, 'nor')})"
    if name := loop.acceleration.remaining:
        size, relative = loop.acceleration.after[name], loop.acceleration.relative_after[name]
        passed += (
            f". An acceleration of {acceleration_in_words(name, size)} is left"
            f" unexplained in each interval, {share_in_words(relative)}:"
            " significant, but too small to matter, or within the error of the engine"
        )
    if loop.added or loop.verdict != ADEQUATE:
        return f"{passed}."
    small = "".join(
        f" There is {plain(one.effect)} on the {plain(one.body)}, which changes predictions by"
        f" less than {100 * loop.criteria.negligible:g} %."
        for one in loop.found.small
    )
    return f"{passed}.{small}"


def model_of(loop: Loop) -> str:
    """Return the name of the model of which the page says what remains: revised, or declared."""
    return "revised" if loop.added else "declared"


def error_in_words(loop: Loop) -> str:
    """Explain a held-out error that seems to contradict the verdict; empty if none does."""
    if loop.unexplained is not None or loop.acceleration.remaining:
        return "The noise is that of the measurements alone, one interval ahead."
    if _differ(loop) and loop.verdict != NOT_CONVERGED:
        return (
            "The verdict is of the fitted recordings alone: the held-out ones differ from the"
            f" {model_of(loop)} model by {number(loop.after.normalised_rmse)} times the noise"
            " (another load, wear, calibration?)."
        )
    return ""


def caution_in_words(loop: Loop) -> str:
    """Return what to know of added effects of a recording of one trajectory; empty otherwise."""
    single = bool(loop.added) and loop.data.provenance.get("trajectories") == 1
    return f"{ONE_TRAJECTORY[0].upper()}{ONE_TRAJECTORY[1:]}." if single else ""


def left_out_in_words(loop: Loop) -> str:
    """Return what was left out of the histories, of bad frames the first few one by one."""
    first, more = loop.data.bad_frames[:LISTED], len(loop.data.bad_frames) - LISTED
    rest = f"; and {more} more (report.json lists them)" if more > 0 else ""
    said = "; ".join((*loop.data.drawn, *first))
    return f"{said}{rest}." if said else ""


def moved_most(loop: Loop, kind: str, still: float = 1e-4) -> str:
    """Return the state dimension whose held-out error of a kind changed most; empty if none moves.

    If none changed, that with the largest error over the noise floor. A dimension that moves by
    less than the share ``still`` of its natural size does not move.
    """
    before, after, floor = (getattr(e, kind) for e in (loop.before, loop.after, loop.noise_floor))
    moves = list(before)
    if loop.held_out is not None:
        observed = loop.held_out.dataset["observed"].to_numpy()
        spread = np.fmax.reduce(observed, axis=(0, 1)) - np.fmin.reduce(observed, axis=(0, 1))
        spread = np.nan_to_num(spread).max(axis=0)
        sizes = dict(zip(STATE, spread / state_sizes(loop.scene), strict=True))
        moves = [name for name in before if sizes[name] > still]

    def change(name: str) -> tuple[float, float]:
        first, last = before[name], after.get(name, before[name])
        if np.isposinf(last):
            return np.inf, 0.0
        changed = abs(np.log(max(first, 1e-300) / max(last, 1e-300)))
        return round(float(changed), 2), first / (floor.get(name) or np.inf)

    return max(moves, key=change, default="")


def held_out_in_words(loop: Loop) -> str:
    """Return the held-out error in the unit of the dimension that moved most; empty without one."""
    whole = loop.held_out is not None and bool(loop.after.simulated_rmse)
    kind = "simulated_rmse" if whole else "rollout_rmse"
    if not (name := moved_most(loop, kind)):
        return ""
    before = getattr(loop.before, kind)[name]
    after = getattr(loop.after, kind).get(name, np.nan)
    said, last = (f"{error(before)} -> {error(after)}", after) if loop.added else ("", before)
    said = said or error(before)
    said += f" {UNITS[name]}" * bool(np.isfinite(last))
    if loop.added and 0.0 < after < before < np.inf:
        said += f", {100 * (1 - after / before):.3g} % less"
    seconds, start = loop.rollout_seconds, "ahead"
    if whole and loop.held_out is not None:
        rows = int(loop.held_out.dataset["n_rows"].max()) - 1
        seconds, start = rows * loop.scene.time_step, "from fitted initial states"
    floor = getattr(loop.noise_floor, kind).get(name)
    if floor is not None and floor < before:  # a floor above the error says nothing
        said += f" (noise floor {number(floor)} {UNITS[name]})"
    return f"Held-out error of {name} {number(seconds)} s {start}: {said}."


def left_aside_in_words(loop: Loop) -> list[str]:
    """Return sentences on laws that were found and not added, with their shares of the error."""
    said = [
        f"{_law(one.effect, one.body)} takes {percent(one.simulated_share)} off the error of the"
        " longest simulations: too little to be added."
        for one in loop.found.lesser
    ]
    if loop.found.hypotheses:
        names = [
            f"{_law(one.effect, one.body)} ({percent(one.simulated_share)})"
            for one in loop.found.hypotheses
        ]
        said.append(
            f"Of what remains one of these would take a part off: {listed(names, 'or')}; few rigs"
            " have it, so it was not added: declare it to try."
        )
    return [f"{one[:1].upper()}{one[1:]}" for one in said]


def gains_inferred(loop: Loop) -> list[str]:
    """Return the gains that the scene leaves to be inferred, with their intervals."""
    said = []
    for label, values in scalars(loop.posterior_after).items():
        name = str(label)
        if "gain" in name.partition("[")[0].split("_") and name not in added_labels(loop):
            low, high = interval(values.to_numpy())
            digits = digits_of(low, high)
            ends = f"94 % {number(low, digits)} to {number(high, digits)}"
            said.append(f"{plain(name)} {number(float(np.mean(values)), digits)} ({ends})")
    return said


def added_labels(loop: Loop) -> tuple[str, ...]:
    """Return the labels of the parameters of added effects."""
    return tuple(f"{e.effect}_{name}[{e.body}]" for e in loop.added for name in e.parameters)


def _law(effect: str, body: str) -> str:
    """Write an effect and its body."""
    return f"{plain(effect)} on the {plain(body)}"


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
        raised = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa} × 10{str(int(exponent)).translate(raised)}".replace("-", "−")
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


def percent(share: float | None) -> str:
    """Write a share in per cent, with two significant digits; a dash where there is none."""
    return "–" if share is None else f"{number(100 * share, 2)} %"


def chance(p_value: float, smallest: float = 1e-16) -> str:
    """Write a p-value: two significant digits, and a bound where its asymptotics are inaccurate.

    Examples
    --------
    >>> chance(0.0312), chance(3e-8), chance(1e-80)
    ('0.031', '3.0e-8', '< 1e-16')
    """
    if p_value < smallest:
        return f"< {smallest:.0e}"
    if p_value < 1e-4:
        return f"{p_value:.1e}".replace("e-0", "e-")
    return number(p_value, 2)


def p_equals(p_value: float) -> str:
    """Write ``p = 0.031`` or ``p < 1e-16``."""
    text = chance(p_value)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def error(value: float | None, digits: int = 3) -> str:
    """Write an error, which is infinite where predictions diverge.

    Examples
    --------
    >>> error(0.1234), error(float("inf")), error(float("nan"))
    ('0.123', 'diverged', '–')
    """
    return "diverged" if value is not None and np.isposinf(value) else number(value, digits)


def share(relative: float) -> str:
    """Write a share of the bodies' acceleration; of bodies that hardly accelerate a bound.

    Examples
    --------
    >>> share(0.0123), share(300.6)
    ('1.2 %', '> 100 %')
    """
    return percent(relative) if relative < LARGEST_SHARE else "> 100 %"


def listed(parts: Iterable[str], word: str = "and") -> str:
    """Write a list as words: ``a, b and c``."""
    *most, last = [str(part) for part in parts] or [""]
    return f"{', '.join(most)} {word} {last}" if most else last
