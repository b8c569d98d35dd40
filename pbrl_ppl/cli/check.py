"""``pbrl-ppl check`` and ``criticise`` of a recording, and ``doctor`` of the installation."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from pbrl_ppl.cli import options
from pbrl_ppl.cli.options import command
from pbrl_ppl.cli.terminal import (
    FAILED,
    interruptible,
    print_json,
    print_result,
    print_table,
    stages,
)
from pbrl_ppl.state import STATE

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Attribution, Candidate, Law
    from pbrl_ppl.effects import Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene


@command("check", 2, "pbrl-ppl check scene.toml train.csv")
def check(
    scene: options.SceneFile,
    history: options.HistoryFile,
    reading: options.SceneReading,
    prior: Annotated[
        bool, typer.Option(help="Whether to compare the data with draws from the prior.")
    ] = True,
    draws: Annotated[int, typer.Option(min=50, help="Draws from the prior.")] = 400,
    seed: options.Seed = 0,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Read a scene and a history: what is in them, what is missing, whether the prior fits.

    Warns where a velocity and the changes of its position differ by the factor of a unit.
    """
    with interruptible(), stages(quiet) as progress:
        declared, (loaded,) = reading.read(scene, [history])
        catalogue = reading.catalogue()
        from pbrl_ppl.history import (
            mass_contradictions,
            unit_mismatches,
            unused_velocities,
            with_units,
        )
        from pbrl_ppl.physics import Physics, check_history

        check_history(declared, loaded, loaded.segments(1))
        contents, missing = _contents(declared, loaded), _missing(loaded)
        unused = unused_velocities(loaded)
        console = Console(highlight=False, quiet=as_json)
        listed = Table(show_header=False, box=None)
        for name, value in contents.items():
            listed.add_row(name, value)
        console.print(listed)
        console.print(_missing_table(missing, int(loaded.dataset["n_rows"].sum())))
        masses = mass_contradictions(declared, loaded)
        for sentence in (*(velocity.sentence for velocity in unused), *masses):
            console.print(sentence, soft_wrap=True)
        sized = with_units(declared, loaded)
        priors = _default_priors(sized, catalogue)
        console.print(_priors_table(priors))
        checked = None
        if prior:
            progress("comparing with draws from the prior")
            from pbrl_ppl.criticism import prior_predictive_check, telling_horizon
            from pbrl_ppl.effects import attach
            from pbrl_ppl.likelihood import Problem

            horizon = telling_horizon(loaded)
            physics = Physics(sized, attach(sized, (), catalogue))
            problem = Problem.of(physics, loaded, horizon=horizon)
            checked = prior_predictive_check(problem, draws=draws, seed=seed)
            for sentence in checked.summary:
                console.print(f"prior: {sentence}", soft_wrap=True)
    if as_json:
        prior_check = checked and {"passed": not checked.sentences, "sentences": checked.summary}
        print_json(
            {
                **contents,
                "trajectories": loaded.n_trajectories,
                "transitions": loaded.n_transitions,
                "missing": missing,
                "velocities_not_used": [vars(column) for column in unused],
                "unit_mismatches": unit_mismatches(loaded),
                "mass_contradictions": masses,
                "typical": {body.name: dict(body.typical) for body in sized.dynamic},
                "default_priors": priors,
                "prior": prior_check,
            }
        )


def _contents(scene: Scene, history: History) -> dict[str, str]:
    """Return what a scene and a history hold, for people."""
    rows = history.dataset["n_rows"].to_numpy()
    intervals = (
        f"{rows.min() - 1}" if rows.min() == rows.max() else f"{rows.min() - 1} to {rows.max() - 1}"
    )
    return {
        "moving bodies": ", ".join(body.name for body in scene.moving),
        "walls, joints": f"{len(scene.walls)}, {len(scene.joints)}",
        "trajectories": f"{history.n_trajectories}",
        "transitions": f"{history.n_transitions} ({intervals} in a trajectory)",
        "time step": f"{scene.time_step:g} s, {scene.substeps} engine steps",
    }


def _missing(history: History) -> dict[str, dict[str, int]]:
    """Return the number of missing measurements, by body and state dimension."""
    dataset = history.dataset
    # rows after a trajectory's end are padding, not missing measurements
    real = dataset["time"] < dataset["n_rows"]
    missing = (dataset["observed"].isnull() & real).sum(("trajectory", "time"))
    return {
        body: {str(n): int(missing.sel(body=body, state=n)) for n in missing["state"].values}
        for body in history.bodies
    }


def _missing_table(missing: dict[str, dict[str, int]], rows: int) -> Table:
    """Return a table of missing measurements; a body has `rows` of each state dimension."""
    table = Table(title="missing measurements", title_justify="left")
    table.add_column("body")
    for name in STATE:
        table.add_column(name, justify="right")
    words = {0: "none", rows: "all"}
    for body, counts in missing.items():
        table.add_row(body, *(words.get(n, f"{n} of {rows}") for n in counts.values()))
    return table


def _default_priors(scene: Scene, catalogue: Sequence[Effect]) -> dict[str, dict[str, str]]:
    """Return the priors of effects that depend on the recording's units, by body and variable."""
    from pbrl_ppl.effects import candidates

    sized = {(effect.name, p.name) for effect in catalogue for p in effect.parameters if p.scale}
    priors: dict[str, dict[str, str]] = {body.name: {} for body in scene.dynamic}
    for attached in candidates(scene, (), catalogue):
        effect = attached.effect
        for parameter in effect.parameters:
            if (effect.name, parameter.name) in sized:
                words = parameter.prior.in_words(parameter.unit)
                priors[attached.body][effect.variable(parameter)] = words
    return priors


def _priors_table(priors: dict[str, dict[str, str]]) -> Table:
    """Return a table of default priors, a column for each body."""
    table = Table(title="default priors of effects, from the recording", title_justify="left")
    table.add_column("parameter")
    for body in priors:
        table.add_column(body)
    for name in dict.fromkeys(name for priors_of in priors.values() for name in priors_of):
        table.add_row(name, *(priors_of.get(name, "") for priors_of in priors.values()))
    return table


@command("criticise", 4, "pbrl-ppl criticise scene.toml train.csv")
def criticise(
    scene: options.SceneFile,
    history: options.HistoryFile,
    reading: options.SceneReading,
    seed: options.Seed = 1,
    simulate: Annotated[
        bool,
        typer.Option(
            "--simulate",
            help="Search for missing laws by simulation error, on short pieces, then longer ones.",
        ),
    ] = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Rank the effects that the declared model might lack by the score test: no refit, no verdict.

    The score test says which effect's signature the residual looks like; close-loop finds out
    whether that effect helps on data that it has not seen. With --simulate, pieces of trajectories
    are simulated without process noise: on each length a regression proposes the best subset of
    laws, and refits decide. A main law takes at least a fifth off the error of the longest pieces.
    """
    with interruptible(), stages(quiet) as progress:
        progress("reading the scene and the history")
        declared, (loaded,) = reading.read(scene, [history])
        catalogue = reading.catalogue()
        progress("loading the model")
        from pbrl_ppl import criticism
        from pbrl_ppl.physics import check_history

        if simulate:
            simulated = criticism.attribute(
                declared, loaded, catalogue=catalogue, seed=seed, progress=progress
            )
        else:
            check_history(declared, loaded, loaded.segments(1))
            ranking = criticism.criticise(
                declared, loaded, catalogue=catalogue, seed=seed, progress=progress
            )
    if simulate:
        _print_laws(simulated, as_json)
        return
    if as_json:
        print_json(
            {
                "candidates": [vars(candidate) for candidate in ranking.candidates],
                "mode": ranking.mode,
                "unexplained_acceleration": ranking.unexplained_acceleration,
                "substeps": ranking.substeps,
            }
        )
        return
    print_table(
        "what the declared model might lack, by the score test",
        ["effect", "<body", "S", "dof", "p (corrected)", "<first estimate"],
        map(_candidate_row, ranking.candidates),
    )
    typer.echo(
        "small p: the residual looks like that effect's signature; close-loop says whether it is"
        " missing"
    )


def _print_laws(attribution: Attribution, as_json: bool) -> None:
    """Print the search on each length of pieces, the laws found, and the simulation error."""
    if as_json:
        print_json(vars(attribution))
        return
    for rung in attribution.rungs:
        print_table(
            f"best subsets of laws on pieces of {rung.seconds:.3g} s, intervals: {rung.rows}",
            ["laws", "nats", "error relative to none"],
            ([", ".join(best.laws), f"{best.nats:.1f}", f"{best.error:.3f}"] for best in rung.path),
        )
        typer.echo(f"accepted: {', '.join(rung.accepted) or 'none'}")
        typer.echo(f"dropped: {', '.join(rung.dropped) or 'none'}\n")
    print_table(
        "laws that the simulation error of trajectories shows",
        ["law", "<body", "<kind", "nats", "share of error", "<size"],
        map(_law_row, attribution.laws),
    )
    print_table(
        f"simulation error over {attribution.seconds:.3g} s (SI)",
        ["state", "declared", "with them", "autocorrelation (rows)"],
        (
            [
                name,
                f"{error:.3g}",
                f"{attribution.after[name]:.3g}",
                f"{attribution.correlated[name]:.1f}",
            ]
            for name, error in attribution.before.items()
        ),
    )
    rejected = (f"rejected {law}: {why}" for law, why in attribution.rejected.items())
    for sentence in (*attribution.sentences, *rejected):
        typer.echo(sentence)


def _law_row(law: Law) -> list[str]:
    sizes = (
        f"{name} {value:.3g} ± {law.sd[name]:.2g} {law.units[name].removesuffix('1')}".rstrip()
        for name, value in law.estimate.items()
    )
    numbers = [f"{law.nats:.1f}", f"{100 * law.share:.2g} %"]
    kind = "main" if law.main else "small"
    return [law.effect, law.body, kind, *numbers, ", ".join(sizes)]


def _candidate_row(candidate: Candidate) -> list[str]:
    sizes = (
        f"{name} {value:.3g} {candidate.units[name].removesuffix('1')}".rstrip()
        for name, value in candidate.estimate.items()
    )
    # where the declared parameters absorb the effect, its size is not identifiable
    seen = ", ".join(sizes) if candidate.statistic > 0 else ""
    numbers = [f"{candidate.statistic:.1f}", str(candidate.dof), f"{candidate.p_value:.2g}"]
    return [candidate.effect, candidate.body, *numbers, seen]


@command("doctor", 13, "pbrl-ppl doctor --json")
def doctor(as_json: options.AsJson = False, quiet: options.Quiet = False) -> None:
    """Report versions, whether the compiled engine loop works, and the number of threads.

    Exits with 1 if the compiled loop is wrong; where there is none, a slow one serves.
    """
    with interruptible(), stages(quiet) as progress:
        progress("loading the packages")
        import threadpoolctl

        from pbrl_ppl.posterior import versions

        facts: dict[str, Any] = {"versions": versions(), "platform": platform.platform()}
        progress("trying the engine")
        facts["engine"] = _engine()
        facts["threads"] = {
            "processors": _processors(),
            **{
                str(pool["user_api"]): int(pool["num_threads"])
                for pool in threadpoolctl.threadpool_info()
            },
        }
        facts["package"] = str(Path(__file__).parents[1])
    wrong = facts["engine"]["difference"] > 1e-9  # the paths agree to rounding
    print_result(as_json, facts | {"ok": not wrong}, _doctor_lines(facts))
    if wrong:
        typer.echo("error: the compiled engine loop is wrong here; please report this", err=True)
        raise typer.Exit(FAILED)


def _processors() -> int:
    """Return the number of processors that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _engine() -> dict[str, Any]:
    """Return the engine loop's kind, its difference from the plain loop, and its speed."""
    from pbrl_ppl.physics import Physics, calls
    from pbrl_ppl.scene import Body, Scene, Shape, Wall

    # a puck that hits a wall, so that there are contacts
    puck = Body("puck", Shape.circle(0.1), known=(("r", 0.5), ("mu_c", 0.3)))
    scene = Scene(time_step=0.1, bodies=(puck,), walls=(Wall((1.0, -1.0), (1.0, 1.0)),))
    start = np.zeros((100, 1, 6))
    start[:, 0, 0], start[:, 0, 3] = np.linspace(0.0, 0.8, 100), 2.0
    actions = np.zeros((100, 1, 1, 3))
    fast, slow = Physics(scene), Physics(scene, engine="python")
    states = [physics.predict(np.ones(1), start, actions) for physics in (fast, slow)]
    begin = time.perf_counter()
    fast.predict(np.ones(1), start, actions)
    spent = time.perf_counter() - begin
    return {
        "path": "compiled" if calls.AVAILABLE else "plain",
        "difference": float(np.abs(states[0] - states[1]).max()),
        "microseconds_per_transition": 1e6 * spent / len(start),
    }


def _doctor_lines(facts: dict[str, Any]) -> list[str]:
    """Return what was found as lines of text."""
    engine = facts["engine"]
    slow = "" if engine["path"] == "compiled" else ": a Python loop, slow; no compiled one here"
    shown = facts["versions"] | {
        "platform": facts["platform"],
        "engine": f"{engine['path']}{slow}, {engine['microseconds_per_transition']:.1f} us a"
        f" transition, {engine['difference']:.1g} from the plain loop",
        "threads": ", ".join(f"{number} {name}" for name, number in facts["threads"].items()),
        "package": facts["package"],
    }
    return [f"{name:12} {text}" for name, text in shown.items()]
