"""Summary of a closed loop for a terminal: verdict, effects, held-out error, what to do next."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbrl_ppl.criticism import ADEQUATE, NOT_CONVERGED, UNEXPLAINED, Added, Loop
from pbrl_ppl.reporting.style import UNITS
from pbrl_ppl.reporting.words import (
    accepted,
    caution_in_words,
    depends_on_records,
    digits_of,
    diverges,
    error,
    error_in_words,
    joined,
    left_out_in_words,
    number,
    plain,
    quantity,
    remains_in_words,
    verdict_in_words,
)


def in_brief(loop: Loop, folder: str | Path, remainder: str = "") -> list[str]:
    """Return a summary of a closed loop in about ten lines.

    Parameters
    ----------
    loop : Loop
        Result of :func:`pbrl_ppl.close_loop`.
    folder : str or pathlib.Path
        Folder of the results, to name in commands.
    remainder : str
        What a learned remainder does, or why there is none; empty if none was requested.
    """
    folder = Path(folder)
    lines = [f"Verdict: {loop.verdict}. {verdict_in_words(loop)}"]
    lines += [_effect(added) for added in accepted(loop)]
    lines += [caution] if (caution := caution_in_words(loop)) else []
    lines += _errors(loop)
    lines += [f"  {remains}"] if (remains := remains_in_words(loop)) else []
    lines += [f"Left out: {words}"] if (words := left_out_in_words(loop)) else []
    lines += [f"Remainder: {remainder}"] if remainder else []
    lines.append(f"Next: {_next(loop, folder, bool(remainder))}")
    lines.append(f"Report: {folder / 'report.html'}; posteriors before.nc and after.nc beside it.")
    return lines


def _effect(added: Added) -> str:
    """Write the sizes of an effect with their intervals, and the effects confounded with it."""
    sizes = []
    for name, e in added.parameters.items():
        digits = digits_of(*e.hdi)
        low, high = (number(end, digits) for end in e.hdi)
        sizes.append(
            f"{plain(name)} {quantity(e.mean, e.unit, digits)} (94 % interval {low} to {high})"
        )
    name = f"{plain(added.effect)} on the {plain(added.body)}"
    text = f"  {name} ({added.sentence.rstrip('.')}): {', '.join(sizes)}"
    if added.not_separable_from:
        others = joined((plain(name) for name in added.not_separable_from), "or")
        text += f"; these data cannot tell it from {others}"
    return text


def _errors(loop: Loop) -> list[str]:
    """Write the held-out error far ahead that is worst, before and after if something was added."""
    before, after, floor = (
        each.rollout_rmse for each in (loop.before, loop.after, loop.noise_floor)
    )

    def times_floor(name: str) -> float:
        if np.isposinf(after.get(name, 0.0)):
            return float("inf")
        return before[name] / (floor.get(name, 0.0) or np.inf)

    lines = []
    if before:
        name = max(before, key=times_floor)
        seconds = loop.rollout_horizon * loop.scene.time_step
        errors = (before[name], after.get(name, np.nan)) if loop.added else (before[name],)
        unit = f" {UNITS[name]}" * bool(np.isfinite(errors[-1]))
        lines.append(
            f"Held-out error of {name} {number(seconds)} s ahead:"
            f" {' -> '.join(map(error, errors))}{unit} (noise floor {number(floor.get(name))}"
            f" {UNITS[name]})."
        )
    return [*lines, *([f"  {note}"] if (note := error_in_words(loop)) else [])]


def _next(loop: Loop, folder: Path, tried: bool) -> str:
    """Return what to do next."""
    left = loop.unexplained
    if loop.verdict == NOT_CONVERGED:
        return "close the loop again with more --draws, or with tighter priors in the scene."
    if diverges(loop):
        return "open the report, which shows where forecasts diverge; do not plan with this model."
    if left is not None and depends_on_records(loop):
        learn = loop.verdict == UNEXPLAINED and not tried
        return (
            f"open the report, which plots the residual against {left.depends_on}; write an effect"
            f" for it{', or close the loop again with --learn-remainder' if learn else ''}."
        )
    if loop.verdict == UNEXPLAINED:
        return "open the report; record more quantities, or longer."
    if any(added.not_separable_from for added in loop.added):
        return (
            f"pbrl-ppl suggest {folder / 'after.nc'} -o next.csv: a recording that tells these"
            " effects apart."
        )
    if loop.verdict == ADEQUATE:
        return "open the report for the detection limit of each effect."
    return "open the report; plan and update with the posterior after.nc."
