"""Summary of a closed loop for a terminal: verdict, effects, held-out error, what to do next."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbrl_ppl.criticism import ADEQUATE, NOT_CONVERGED, UNEXPLAINED, Added, Loop
from pbrl_ppl.report.style import UNITS
from pbrl_ppl.report.words import (
    accepted,
    caution_in_words,
    depends_on_records,
    digits_of,
    error_in_words,
    joined,
    left_out_in_words,
    number,
    plain,
    quantity,
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
    left, folder = loop.unexplained, Path(folder)
    lines = [f"Verdict: {loop.verdict}. {verdict_in_words(loop)}"]
    lines += [_effect(added) for added in accepted(loop)]
    lines += [caution] if (caution := caution_in_words(loop)) else []
    lines += _errors(loop)
    if left is not None and left.body:
        lines.append(f"Where: {left.dimension} of the {plain(left.body)}.")
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
    text = f"  {plain(added.effect)} on the {plain(added.body)}: {', '.join(sizes)}"
    if added.not_separable_from:
        others = joined((plain(name) for name in added.not_separable_from), "or")
        text += f"; these data cannot tell it from {others}"
    return text


def _errors(loop: Loop) -> list[str]:
    """Write the held-out errors, before and after if something was added."""
    before, after, floor = loop.before, loop.after, loop.noise_floor

    def both(one: float, two: float) -> str:
        return f"{number(one)} -> {number(two)}" if loop.added else number(one)

    text = f"Held-out error: {both(before.normalised_rmse, after.normalised_rmse)} times the noise"
    far = {
        name: error / (floor.rollout_rmse.get(name, 0.0) or np.inf)
        for name, error in before.rollout_rmse.items()
    }
    if far:
        name = max(far, key=far.__getitem__)
        seconds = loop.rollout_horizon * loop.scene.time_step
        text += (
            f"; of {name} {number(seconds)} s ahead"
            f" {both(before.rollout_rmse[name], after.rollout_rmse.get(name, np.nan))}"
            f" {UNITS[name]} (noise floor {number(floor.rollout_rmse.get(name))})"
        )
    note = error_in_words(loop)
    return [f"{text}.", *([f"  {note}"] if note else [])]


def _next(loop: Loop, folder: Path, tried: bool) -> str:
    """Return what to do next."""
    left = loop.unexplained
    if loop.verdict == NOT_CONVERGED:
        return "close the loop again with more --draws, or with tighter priors in the scene."
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
