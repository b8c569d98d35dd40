"""Tables of pages: of a closed loop, and of a posterior."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from pbrl_ppl.criticism import Errors, Law, Loop, SearchLength
from pbrl_ppl.effects import Sensor
from pbrl_ppl.parameters import Prior
from pbrl_ppl.posterior import Comparison, Identifiability
from pbrl_ppl.reporting.posteriors import Parameters
from pbrl_ppl.reporting.style import UNITS
from pbrl_ppl.reporting.words import (
    chance,
    digits_of,
    error,
    model_of,
    number,
    percent,
    plain,
    quantity,
    share,
)
from pbrl_ppl.scene import units_of
from pbrl_ppl.state import STATE, Floats, acceleration_unit

#: Text of a cell of a table, or text and a small note beside it.
Cell = str | tuple[str, str]
T = TypeVar("T")


class PageTable(NamedTuple):
    """A table as a page shows it; on a telephone each row becomes a card.

    Parameters
    ----------
    caption : str
        Title of the table.
    columns : sequence of str
        Their heads.
    rows : sequence of sequence
        Cells, as many as there are columns.
    words : sequence of str
        Heads of columns that hold words; others hold numbers, and the first one the row's name.
    marks : sequence of str
        ``added`` or ``bad`` for rows that stand out; as many as rows, or none.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    words: Collection[str] = ()
    marks: Sequence[str] = ()


def tabulate(
    caption: str,
    items: Iterable[T],
    columns: Mapping[str, Callable[[T], Cell]],
    words: Collection[str] = (),
    mark: Callable[[T], str] = lambda item: "",
) -> PageTable:
    """Tabulate items, one row each; a column is a head and what it shows of an item."""
    items = tuple(items)
    rows = [[cell(item) for cell in columns.values()] for item in items]
    return PageTable(caption, tuple(columns), rows, words, [mark(item) for item in items])


def compare_models(
    caption: str, models: Mapping[str, T], measures: Mapping[str, Callable[[T], str]]
) -> PageTable:
    """Tabulate measures of models, one row a measure, one column a model."""
    rows = [(name, *map(measure, models.values())) for name, measure in measures.items()]
    return PageTable(caption, ("Measure", *models), rows)


def measured_parameters(candidate: Law, loop: Loop) -> tuple[str, ...]:
    """Return a candidate's parameters without those of state dimensions that were not measured."""
    sensors = {effect.name for effect in loop.catalogue if isinstance(effect.stage, Sensor)}
    unseen = {*STATE} - {*loop.after.one_step_rmse} if candidate.effect in sensors else set()
    return tuple(name for name in candidate.units if name not in unseen)


def limits_in_words(candidate: Law, loop: Loop) -> str:
    """Return the detection limit of each parameter as text; empty where there is none.

    A limit beyond what the effect's prior allows is left out: no plausible size would be found.
    """
    priors = {
        parameter.name: parameter
        for effect in loop.catalogue
        if effect.name == candidate.effect
        for parameter in effect.in_si(units_of(loop.scene, candidate.body)).parameters
    }
    limits = {}
    for name in measured_parameters(candidate, loop):
        if name not in candidate.detectable:
            continue
        size, unit = candidate.detectable[name], candidate.units[name]
        null = priors[name].null if name in priors else 0.0
        shown = name not in priors or _plausible(
            priors[name].prior, null, size, candidate.is_upper_limit
        )
        how = "up to " if candidate.is_upper_limit else f"{number(null)} ± " if null else ""
        known = f"{plain(name)} {how}{quantity(size, unit)}"
        limits[name] = known if shown and np.isfinite(size) else ""
    if not any(limits.values()):
        return "no plausible size" if limits else ""
    return ", ".join(text or f"{plain(name)} no plausible size" for name, text in limits.items())


def _plausible(prior: Prior, null: float, size: float, is_upper_limit: bool) -> bool:
    """Return whether the prior reaches a size more than once in 1000 draws.

    The size is a distance from the null value, or a cap.
    """
    draws = _draws(prior)
    reached = draws <= size if is_upper_limit else np.abs(draws - null) >= size
    return bool(reached.mean() > 1e-3)


@cache
def _draws(prior: Prior) -> Floats:
    return prior.sample(np.random.default_rng(0), 20_000)


def error_tables(loop: Loop) -> list[PageTable]:
    """Tabulate the held-out errors, one interval and a rollout ahead, and overall."""
    errors = dict(zip(models_of(loop), (loop.before, loop.after), strict=False))
    errors["Noise floor"] = loop.noise_floor
    intervals, seconds = loop.forecasts.horizon, number(loop.rollout_seconds)
    titles = {
        "one_step_rmse": f"One interval ahead, {loop.scene.time_step:g} s",
        "rollout_rmse": f"{intervals} intervals ahead, {seconds} s",
        "simulated_rmse": "Whole trajectories, simulated from initial states fitted to them",
    }
    tables = []
    for kind, title in titles.items():
        sizes = [getattr(each, kind) for each in errors.values()]
        rows = [(d, *(error(size.get(d)) for size in sizes), UNITS[d]) for d in sizes[0]]
        caption, heads = f"{title} (root mean square error)", ("State dimension", *errors, "Unit")
        tables += [PageTable(caption, heads, rows, {"Unit"})] * bool(rows)
    overall: dict[str, Callable[[Errors], str]] = {
        "Error in units of the noise": lambda each: error(each.normalised_rmse),
        "Log predictive density in nats (more is better)": lambda each: error(each.elpd, 4),
    }
    return [*tables, compare_models("Overall", errors, overall)]


def models_of(loop: Loop) -> tuple[str, ...]:
    """Return the heads of the columns of one model, or of two."""
    return ("Before", "After") if loop.added else ("Declared model",)


def loo_table(loo: Comparison, columns: Sequence[str]) -> PageTable:
    """Tabulate the leave-one-out cross-validation of one model, or of two.

    Parameters
    ----------
    loo : Comparison
        The model before and after.
    columns : sequence of str
        Heads of the columns: one for the model before alone, or two.
    """
    high = f"How many have a Pareto k above {number(loo.before.good_k, 2)}"
    return compare_models(
        f"{loo.method} (az.loo)",
        dict(zip(columns, (loo.before, loo.after), strict=False)),
        {
            "elpd_loo (nats; more is better)": lambda each: number(each.elpd_loo, 4),
            "Standard error": lambda each: number(each.se),
            "p_loo, the effective number of parameters": lambda each: number(each.p_loo),
            high: lambda each: str(each.high_pareto_k),
        },
    )


def acceleration_table(loop: Loop) -> PageTable:
    """Tabulate the unexplained acceleration and its share of the bodies' acceleration."""
    left, models = loop.acceleration, models_of(loop)
    sizes = (left.before, left.after)[-len(models) :]
    shares = (left.relative_before, left.relative_after)[-len(models) :]
    heads = [f"{model}, share" for model in models] if loop.added else ["Share"]
    rows = [
        (
            name,
            *(number(each[name]) for each in sizes),
            *(share(each[name]) for each in shares),
            acceleration_unit(name),
            "yes" if left.certain_after.get(name) else "no",
        )
        for name in left.before
    ]
    caption = "Unexplained acceleration (standard deviation in an interval)"
    words = ("Unit", "Significant")
    return PageTable(caption, ("Velocity", *models, *heads, *words), rows, words)


def residual_test_table(loop: Loop) -> PageTable:
    """Tabulate the tests of the model's residual."""
    return tabulate(
        f"Tests of the {model_of(loop)} model's residual, on the recordings that it was fitted to",
        loop.tests,
        {
            "Test": lambda test: test.name,
            "Result": lambda test: test.sentence,
            "p": lambda test: chance(test.p_value),
            "Passed": lambda test: yes_or_no(test.passed) if test.tested else "not tested",
        },
        {"Result", "Passed"},
        lambda test: "" if test.passed else "bad",
    )


def yes_or_no(said: object) -> str:
    """Write yes or no."""
    return "yes" if said else "no"


def candidate_table(loop: Loop) -> PageTable:
    """Tabulate the candidates: scores, the search's regression for each alone, the decision."""
    added = {(effect.effect, effect.body) for effect in loop.added}

    def estimate(one: Law) -> str:
        return ", ".join(
            f"{plain(name)} {quantity(one.estimate[name], one.units[name])}"
            for name in measured_parameters(one, loop)
            if name in one.estimate
        )

    return tabulate(
        "All candidates, those of the largest score first",
        loop.candidates,
        {
            "Effect": lambda one: (plain(one.effect), one.body),
            "Score": lambda one: number(one.statistic),
            "Degrees of freedom": lambda one: str(one.dof),
            "p (corrected)": lambda one: chance(one.p_value),
            "First estimate": estimate,
            "Identifiable": lambda one: percent(one.identifiable),
            "Alone: share of simulation error": lambda one: percent(one.simulated_share),
            "Alone: evidence (nats)": lambda one: number(one.simulated_nats),
            "Detection limit": lambda one: limits_in_words(one, loop) or "–",
            "Decision": lambda one: one.why or "–",
        },
        {"First estimate", "Detection limit", "Decision"},
        lambda one: "added" * ((one.effect, one.body) in added),
    )


def search_table(loop: Loop) -> PageTable:
    """Tabulate what the search found on pieces of each length."""
    columns: dict[str, Callable[[SearchLength], str]] = {
        "Intervals": lambda one: str(one.rows),
        "Seconds": lambda one: number(one.seconds),
        "Error before": lambda one: ", ".join(
            f"{name} {quantity(error, UNITS[name])}" for name, error in one.error.items()
        ),
        "Accepted": lambda one: ", ".join(map(plain, one.accepted)) or "–",
        "Dropped": lambda one: ", ".join(map(plain, one.dropped)) or "–",
    }
    words = ("Error before", "Accepted", "Dropped")
    return tabulate("The search by length of pieces", loop.found.lengths, columns, words)


def parameter_table(parameters: Parameters) -> PageTable:
    """Tabulate the posterior of all parameters, in their units."""
    return tabulate(
        "Posterior of all parameters",
        parameters.summary.rename_axis("label").reset_index().to_dict("records"),
        {
            "Parameter": lambda row: (str(row["label"]), row["meaning"]),
            "Mean": lambda row: number(row["mean"]),
            "sd": lambda row: number(row["sd"]),
            "94 % interval": lambda row: _span(row["lower"], row["upper"]),
            "Unit": lambda row: row["unit"],
            "R-hat": lambda row: number(row["r_hat"], 4),
            "ESS bulk": lambda row: number(row["ess_bulk"]),
            "ESS tail": lambda row: number(row["ess_tail"]),
        },
        {"Unit"},
        lambda row: "bad" if row["wrong"] else "",
    )


def _span(low: float, high: float) -> str:
    """Return an interval as text, with the digits that tell its ends apart."""
    digits = min(digits_of(low, high), 6)
    return f"{number(low, digits)} to {number(high, digits)}"


def width_table(known: Identifiability) -> PageTable:
    """Tabulate how much narrower the data made each parameter."""
    data = {"informed": "inform it", "weak": "inform it weakly"}
    return tabulate(
        "What the data say of each parameter",
        known.parameters,
        {
            "Parameter": lambda one: one.parameter,
            "Width left": lambda one: f"{100 * one.ratio:.3g} %",
            "The data": lambda one: data.get(one.verdict, "say nothing beyond the prior"),
        },
        {"The data"},
        lambda one: "bad" * (one.verdict == "prior only"),
    )
