"""Tables of a closed loop: errors, residual tests, candidates, and evidence."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from pbrl_ppl.criticism import Candidate, Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.report.evidence import Evidence
from pbrl_ppl.report.limits import limits_in_words, measured_parameters
from pbrl_ppl.report.page import Table
from pbrl_ppl.report.style import UNITS
from pbrl_ppl.report.words import chance, number, percent, plain, quantity

#: Transitions in the table of those that carry most.
_CARRIERS = 8


def error_tables(findings: Loop) -> list[Table]:
    """Held-out errors by state dimension, one interval and a rollout ahead, and in all."""
    tables = []
    seconds = findings.rollout_horizon * findings.scene.time_step
    kinds = [
        ("one_step_rmse", f"One interval ahead, {findings.scene.time_step:g} s"),
        ("rollout_rmse", f"{findings.rollout_horizon} intervals ahead, {number(seconds)} s"),
    ]
    for kind, title in kinds:
        before, after, floor = (
            getattr(errors, kind)
            for errors in (findings.before, findings.after, findings.noise_floor)
        )
        if before:
            rows = [
                _row(findings, name, before[name], after.get(name), floor.get(name), UNITS[name])
                for name in before
            ]
            caption = f"{title} (root mean square error)"
            tables.append(_before_after(findings, caption, "State dimension", rows, "Unit"))
    rows = [
        _row(
            findings, "Error in units of the noise", findings.before.normalised_rmse,
            findings.after.normalised_rmse, findings.noise_floor.normalised_rmse,
        ),
        _row(
            findings, "Log predictive density in nats (more is better)", findings.before.elpd,
            findings.after.elpd, findings.noise_floor.elpd, digits=4,
        ),
    ]  # fmt: skip
    tables.append(_before_after(findings, "Overall", "Measure", rows))
    return tables


def _row(
    findings: Loop, name: str, before: Any, after: Any, floor: Any, *unit: str, digits: int = 3
) -> tuple[str, ...]:
    both = [before, after] if findings.added else [before]
    return (name, *(number(value, digits) for value in (*both, floor)), *unit)


def _before_after(
    findings: Loop, caption: str, name: str, rows: list[tuple[str, ...]], *last: str
) -> Table:
    both = ("Before", "After") if findings.added else ("Declared model",)
    columns = (name, *both, "Noise floor", *last)
    return Table(caption, columns, rows, words=(len(columns) - 1,) if last else ())


def loo_table(findings: Loop) -> Table | None:
    """Leave-one-out cross-validation of both models."""
    loo = findings.loo
    if loo is None:
        return None
    models = [loo.before, loo.after] if findings.added else [loo.before]
    rows = [
        ("elpd_loo (more is better)", *(number(model.elpd_loo, 4) for model in models)),
        ("Standard error", *(number(model.se) for model in models)),
        ("p_loo, the effective number of parameters", *(number(m.p_loo) for m in models)),
        (
            f"How many have a Pareto k above {number(loo.before.good_k, 2)}",
            *(str(model.high_pareto_k) for model in models),
        ),
    ]
    return Table(
        f"{loo.method} (az.loo, az.compare)",
        ("Measure", *(("Before", "After") if findings.added else ("Declared model",))),
        rows,
    )


def acceleration_table(findings: Loop) -> Table:
    """Tabulate the unexplained acceleration and its share of the bodies' acceleration."""
    told = findings.acceleration
    rows = []
    for name, before in told.before.items():
        shares = [told.relative_before[name], told.relative_after[name]]
        values = [before, told.after[name]]
        if not findings.added:
            shares, values = shares[1:], values[:1]
        rows.append(
            (
                name,
                *(number(value) for value in values),
                *(percent(share) for share in shares),
                "rad/s²" if name == "omega" else "m/s²",
                "yes" if told.certain_after.get(name) else "no",
            )
        )
    both = ("Before", "After") if findings.added else ("Declared model",)
    shared = ("Before, share", "After, share") if findings.added else ("Share",)
    return Table(
        "Unexplained acceleration (standard deviation in an interval)",
        ("Velocity", *both, *shared, "Unit", "Significant"),
        rows,
        words=(1 + len(both) + len(shared), 2 + len(both) + len(shared)),
    )


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
    return ", ".join(
        f"{plain(name)} {quantity(candidate.estimate[name], candidate.units[name])}"
        for name in names
        if name in candidate.estimate
    )


def carrier_table(evidence: Evidence) -> Table:
    """The transitions that carry most of the evidence."""
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
