"""Tables of a closed loop: errors, residual tests, candidates, and evidence."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np

from pbrl_ppl.criticism import Candidate, Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.report.evidence import Evidence
from pbrl_ppl.report.limits import limits_in_words, measured_parameters
from pbrl_ppl.report.page import Table
from pbrl_ppl.report.style import UNITS
from pbrl_ppl.report.words import chance, number, percent, plain, quantity

#: Transitions in the table of those with the largest gains.
_CARRIERS = 8
T = TypeVar("T")


def error_tables(loop: Loop) -> list[Table]:
    """Tabulate held-out errors by state dimension, one interval and a rollout ahead, and in all."""
    step = loop.scene.time_step
    seconds = number(loop.rollout_horizon * step)
    kinds = {
        "one_step_rmse": f"One interval ahead, {step:g} s",
        "rollout_rmse": f"{loop.rollout_horizon} intervals ahead, {seconds} s",
    }
    models = (*_both(loop, loop.before, loop.after), loop.noise_floor)
    columns = (*_both(loop, *_heads(loop)), "Noise floor")
    tables = []
    for kind, title in kinds.items():
        errors = [getattr(model, kind) for model in models]
        rows = [
            (name, *(number(error.get(name)) for error in errors), UNITS[name])
            for name in errors[0]
        ]
        heads = ("State dimension", *columns, "Unit")
        if rows:
            caption = f"{title} (root mean square error)"
            tables.append(Table(caption, heads, rows, words=(len(heads) - 1,)))
    rows = [
        ("Error in units of the noise", *(number(model.normalised_rmse) for model in models)),
        (
            "Log predictive density in nats (more is better)",
            *(number(model.elpd, 4) for model in models),
        ),
    ]
    return [*tables, Table("Overall", ("Measure", *columns), rows)]


def _both(loop: Loop, before: T, after: T) -> tuple[T, ...]:
    """Return both values, or the first alone if nothing was added."""
    return (before, after) if loop.added else (before,)


def _heads(loop: Loop) -> tuple[str, str]:
    """Return the heads of both models' columns."""
    return ("Before" if loop.added else "Declared model", "After")


def loo_table(loop: Loop) -> Table | None:
    """Tabulate the leave-one-out cross-validation of both models."""
    loo = loop.loo
    if loo is None:
        return None
    models = _both(loop, loo.before, loo.after)
    rows = [
        ("elpd_loo (more is better)", *(number(model.elpd_loo, 4) for model in models)),
        ("Standard error", *(number(model.se) for model in models)),
        ("p_loo, the effective number of parameters", *(number(m.p_loo) for m in models)),
        (
            f"How many have a Pareto k above {number(loo.before.good_k, 2)}",
            *(str(model.high_pareto_k) for model in models),
        ),
    ]
    heads = ("Measure", *_both(loop, *_heads(loop)))
    return Table(f"{loo.method} (az.loo, az.compare)", heads, rows)


def acceleration_table(loop: Loop) -> Table:
    """Tabulate the unexplained acceleration and its share of the bodies' acceleration."""
    sizes = loop.acceleration
    rows = [
        (
            name,
            *map(number, _both(loop, before, sizes.after[name])),
            *map(percent, _both(loop, sizes.relative_before[name], sizes.relative_after[name])),
            "rad/s²" if name == "omega" else "m/s²",
            "yes" if sizes.certain_after.get(name) else "no",
        )
        for name, before in sizes.before.items()
    ]
    shares = ("Before, share", "After, share") if loop.added else ("Share",)
    heads = ("Velocity", *_both(loop, *_heads(loop)), *shares, "Unit", "Significant")
    caption = "Unexplained acceleration (standard deviation in an interval)"
    return Table(caption, heads, rows, words=(len(heads) - 2, len(heads) - 1))


def residual_test_table(findings: Loop) -> Table:
    """Tabulate the tests of the model's residual."""
    which = "revised" if findings.added else "declared"
    return Table(
        f"Tests of the {which} model's residual, on the recordings that it was fitted to",
        ("Test", "Result", "p", "Passed"),
        [
            (
                test.name,
                test.sentence,
                chance(test.p_value),
                ("yes" if test.passed else "no") if test.tested else "not tested",
            )
            for test in findings.tests
        ],
        words=(1, 3),
        marks=["" if test.passed else "bad" for test in findings.tests],
    )


def candidate_table(findings: Loop, effects: Iterable[Effect]) -> Table:
    """Tabulate the candidates of the first round."""
    effects = tuple(effects)
    added = {(each.effect, each.body) for each in findings.added}
    return Table(
        "Candidates of the first round, best first",
        ("Effect", "Score", "Degrees of freedom", "p (corrected)", "First estimate",
         "Identifiable", "Detection limit", "Decision"),
        [
            (
                (plain(candidate.effect), candidate.body),
                number(candidate.statistic),
                str(candidate.dof),
                chance(candidate.p_value),
                _estimates(candidate, measured_parameters(candidate, findings, effects)),
                percent(candidate.identifiable),
                limits_in_words(candidate, findings, effects) or "–",
                candidate.why or "–",
            )
            for candidate in findings.candidates
        ],
        words=(4, 6, 7),
        marks=[
            "added" if (each.effect, each.body) in added else "" for each in findings.candidates
        ],
    )  # fmt: skip


def _estimates(candidate: Candidate, names: Iterable[str]) -> str:
    """Return the first estimates of some parameters with their units."""
    return ", ".join(
        f"{plain(name)} {quantity(candidate.estimate[name], candidate.units[name])}"
        for name in names
        if name in candidate.estimate
    )


def carrier_table(evidence: Evidence) -> Table:
    """Tabulate the transitions with the largest gains in log predictive density."""
    gains = evidence.by_transition
    shown = np.argsort(-gains, kind="stable")[:_CARRIERS]
    return Table(
        f"The {len(shown)} transitions that tell most",
        ("Trajectory", "Time (s)", "Gain (nats)", "Mostly in", "Speed (m/s)",
         "Force x (N)", "Force y (N)", "Torque (N m)", "Touching"),
        [
            (
                str(evidence.trajectory[i]),
                f"{evidence.time[i]:.4g}",
                number(float(gains[i])),
                evidence.names[int(np.argmax(evidence.nats[i]))],
                number(float(evidence.speed[i])),
                *(number(float(value)) for value in evidence.wrench[i]),
                "yes" if evidence.touching[i] else "no",
            )
            for i in shown
        ],
        words=(3, 8),
    )  # fmt: skip
