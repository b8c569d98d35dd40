"""Tables of pages: of a closed loop, and of a posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import xarray as xr

from pbrl_ppl.criticism import Candidate, Loop
from pbrl_ppl.effects import Sensor
from pbrl_ppl.parameters import Prior
from pbrl_ppl.posterior import Comparison, Identifiability, interval, scalars
from pbrl_ppl.reporting.evidence import Evidence
from pbrl_ppl.reporting.posterior_summary import Parameters, prior_draws
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


class Table(NamedTuple):
    """A table as a page shows it; on a telephone each row becomes a card.

    Parameters
    ----------
    caption : str
        Title of the table.
    columns : sequence of str
        Their heads.
    rows : sequence of sequence
        Cells, as many as there are columns.
    words : tuple of int
        Columns that hold words; others hold numbers, and the first one the row's name.
    marks : sequence of str
        ``added`` or ``bad`` for rows that stand out; as many as rows, or none.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    words: Sequence[int] = ()
    marks: Sequence[str] = ()


def measured_parameters(candidate: Candidate, loop: Loop) -> tuple[str, ...]:
    """Return a candidate's parameters without those of state dimensions that were not measured."""
    effect = next((other for other in loop.catalogue if other.name == candidate.effect), None)
    names = tuple(candidate.units)
    if effect is None or not isinstance(effect.stage, Sensor):
        return names
    return tuple(name for name in names if name not in STATE or name in loop.residuals_after)


def limits_in_words(candidate: Candidate, loop: Loop) -> str:
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
        shown = name not in priors or _plausible(priors[name].prior, null, size, candidate.caps)
        how = "up to " if candidate.caps else f"{number(null)} ± " if null else ""
        known = f"{plain(name)} {how}{quantity(size, unit)}"
        limits[name] = known if shown and np.isfinite(size) else ""
    if not any(limits.values()):
        return "no plausible size" if limits else ""
    return ", ".join(text or f"{plain(name)} no plausible size" for name, text in limits.items())


def _plausible(prior: Prior, null: float, size: float, caps: bool) -> bool:
    """Return whether the prior reaches a size more than once in 1000 draws.

    The size is a distance from the null value, or a cap.
    """
    draws = _draws(prior)
    reached = draws <= size if caps else np.abs(draws - null) >= size
    return bool(reached.mean() > 1e-3)


@cache
def _draws(prior: Prior) -> Floats:
    return prior.sample(np.random.default_rng(0), 20_000)


def error_tables(loop: Loop) -> list[Table]:
    """Tabulate the held-out errors, one interval and a rollout ahead, and overall."""
    errors = [loop.before, *[loop.after] * bool(loop.added), loop.noise_floor]
    heads, intervals = (*models_of(loop), "Noise floor"), loop.rollout_horizon
    titles = {
        "one_step_rmse": f"One interval ahead, {loop.scene.time_step:g} s",
        "rollout_rmse": f"{intervals} intervals ahead, {number(loop.rollout_seconds)} s",
        "simulated_rmse": "Whole trajectories, simulated from start states fitted to them",
    }
    tables = []
    for kind, title in titles.items():
        sizes = [getattr(each, kind) for each in errors]
        rows = [(d, *(error(size.get(d)) for size in sizes), UNITS[d]) for d in sizes[0]]
        columns = ("State dimension", *heads, "Unit")
        if rows:
            caption = f"{title} (root mean square error)"
            tables.append(Table(caption, columns, rows, words=(len(heads) + 1,)))
    elpd = "Log predictive density in nats (more is better)"
    overall = [
        ("Error in units of the noise", *(error(each.normalised_rmse) for each in errors)),
        (elpd, *(error(each.elpd, 4) for each in errors)),
    ]
    return [*tables, Table("Overall", ("Measure", *heads), overall)]


def models_of(loop: Loop) -> tuple[str, ...]:
    """Return the heads of the columns of one model, or of two."""
    return ("Before", "After") if loop.added else ("Declared model",)


def loo_table(loo: Comparison, columns: Sequence[str]) -> Table:
    """Tabulate the leave-one-out cross-validation of one model, or of two.

    Parameters
    ----------
    loo : Comparison
        The model before and after.
    columns : sequence of str
        Heads of the columns: one for the model before alone, or two.
    """
    models = (loo.before, loo.after)[: len(columns)]
    high = f"How many have a Pareto k above {number(loo.before.good_k, 2)}"
    rows = [
        ("elpd_loo (nats; more is better)", *(number(each.elpd_loo, 4) for each in models)),
        ("Standard error", *(number(each.se) for each in models)),
        ("p_loo, the effective number of parameters", *(number(each.p_loo) for each in models)),
        (high, *(str(each.high_pareto_k) for each in models)),
    ]
    return Table(f"{loo.method} (az.loo)", ("Measure", *columns), rows)


def acceleration_table(loop: Loop) -> Table:
    """Tabulate the unexplained acceleration and its share of the bodies' acceleration."""
    left, models, both = loop.acceleration, models_of(loop), bool(loop.added)
    sizes = [left.before, left.after][not both :]
    shares = [left.relative_before, left.relative_after][not both :]
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
    heads = ("Before, share", "After, share") if both else ("Share",)
    return Table(
        "Unexplained acceleration (standard deviation in an interval)",
        ("Velocity", *models, *heads, "Unit", "Significant"),
        rows,
        words=(1 + 2 * len(models), 2 + 2 * len(models)),
    )


def residual_test_table(loop: Loop) -> Table:
    """Tabulate the tests of the model's residual."""
    caption = f"Tests of the {model_of(loop)} model's residual, on the recordings that it was"
    passed = [("yes" if t.passed else "no") if t.tested else "not tested" for t in loop.tests]
    rows = [
        (test.name, test.sentence, chance(test.p_value), said)
        for test, said in zip(loop.tests, passed, strict=True)
    ]
    marks = ["" if test.passed else "bad" for test in loop.tests]
    return Table(f"{caption} fitted to", ("Test", "Result", "p", "Passed"), rows, (1, 3), marks)


def candidate_table(loop: Loop) -> Table:
    """Tabulate the candidates: scores, the search's regression for each alone, the decision."""
    added = {(effect.effect, effect.body) for effect in loop.added}
    rows = [
        (
            (plain(one.effect), one.body),
            number(one.statistic),
            str(one.dof),
            chance(one.p_value),
            ", ".join(
                f"{plain(name)} {quantity(one.estimate[name], one.units[name])}"
                for name in measured_parameters(one, loop)
                if name in one.estimate
            ),
            percent(one.identifiable),
            percent(one.simulated_share),
            number(one.simulated_nats),
            limits_in_words(one, loop) or "–",
            one.why or "–",
        )
        for one in loop.candidates
    ]
    marks = ["added" * ((one.effect, one.body) in added) for one in loop.candidates]
    heads = ("Effect", "Score", "Degrees of freedom", "p (corrected)", "First estimate",
             "Identifiable", "Alone: share of simulation error", "Alone: evidence (nats)",
             "Detection limit", "Decision")  # fmt: skip
    return Table("All candidates, those of the largest score first", heads, rows, (4, 8, 9), marks)


def search_tables(loop: Loop) -> list[Table]:
    """Tabulate the best subset of laws of each size, one table a length of simulated pieces."""
    return [
        Table(
            f"Pieces of {rung.rows} interval{'s' * (rung.rows > 1)}, {rung.seconds:.3g} s",
            ("Best subset", "Evidence (nats)", "Error relative to none"),
            [
                (", ".join(map(plain, best.laws)), number(best.nats), number(best.error))
                for best in rung.path
            ],
            marks=["added" if {*best.laws} == {*rung.accepted} else "" for best in rung.path],
        )
        for rung in loop.rungs
    ]


def carrier_table(evidence: Evidence, most: int = 8) -> Table:
    """Tabulate the transitions that carry most of the evidence."""
    gains = evidence.by_transition
    heads = ("Trajectory", "Time (s)", "Gain (nats)", "Mostly in", "Speed (m/s)", "Force x (N)",
             "Force y (N)", "Torque (N m)", "Touching")  # fmt: skip
    rows = [
        (
            str(evidence.trajectory[i]),
            f"{evidence.time[i]:.4g}",
            number(gains[i]),
            evidence.names[int(np.argmax(evidence.nats[i]))],
            number(evidence.speed[i]),
            *map(number, evidence.wrench[i]),
            "yes" if evidence.touching[i] else "no",
        )
        for i in np.argsort(-gains, kind="stable")[:most]
    ]
    return Table(f"The {len(rows)} transitions with most evidence", heads, rows, (3, 8))


def parameter_table(parameters: Parameters) -> Table:
    """Tabulate the posterior of all parameters, in their units."""
    return Table(
        "Posterior of all parameters",
        ("Parameter", "Mean", "sd", "94 % interval", "Unit", "R-hat", "ESS bulk", "ESS tail"),
        [
            (
                (str(label), row["meaning"]),
                number(row["mean"]),
                number(row["sd"]),
                _span(row["lower"], row["upper"]),
                row["unit"],
                number(row["r_hat"], 4),
                number(row["ess_bulk"]),
                number(row["ess_tail"]),
            )
            for label, row in parameters.summary.iterrows()
        ],
        words=(4,),
        marks=["bad" if wrong else "" for wrong in parameters.summary["wrong"]],
    )


def _span(low: float, high: float) -> str:
    """Return an interval as text, with the digits that tell its ends apart."""
    digits = min(digits_of(low, high), 6)
    return f"{number(low, digits)} to {number(high, digits)}"


def width_table(known: Identifiability, parameters: Parameters) -> Table:
    """Tabulate the intervals of each parameter before and after the data."""
    both = [draws(parameters.posterior) for draws in (prior_draws, scalars)]
    units, bad = parameters.summary["unit"], "say nothing beyond the prior"
    data = {"informed": "inform it", "weak": "inform it weakly", "prior only": bad}

    def span(draws: xr.Dataset, name: str) -> str:
        return _span(*interval(draws[name].to_numpy())) if name in draws else "–"

    rows = [
        (
            one.parameter,
            *(span(draws, one.parameter) for draws in both),
            units.get(one.parameter, ""),
            f"{100 * one.ratio:.3g} %",
            data[one.verdict],
        )
        for one in known.parameters
    ]
    return Table(
        "What was believed, and what is known now (94 % intervals)",
        ("Parameter", "Before the data", "After", "Unit", "Width left", "The data"),
        rows,
        words=(3, 5),
        marks=["bad" if row[-1] == bad else "" for row in rows],
    )


def coverage_table(covered: Mapping[str, tuple[float, float, int]]) -> Table:
    """Tabulate the shares of measurements inside leave-one-out predictions."""
    return Table(
        "Measurements inside leave-one-out predictions",
        ("State dimension", "In the central 50 %", "In the central 94 %", "Measurements"),
        [
            (name, f"{100 * half:.1f} %", f"{100 * wide:.1f} %", str(count))
            for name, (half, wide, count) in covered.items()
        ],
    )
