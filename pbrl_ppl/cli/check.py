"""``pbrl-ppl check`` and ``pbrl-ppl criticise``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from pbrl_ppl.cli.options import Columns, TimeStep, Units, load_own
from pbrl_ppl.cli.terminal import (
    AsJson,
    Errors,
    HistoryFile,
    Quiet,
    SceneFile,
    Seed,
    Substeps,
    Trim,
    Velocities,
    interruptible,
    print_json,
    print_table,
    stages,
    stated_noise,
    with_substeps,
)
from pbrl_ppl.state import STATE

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Candidate
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene


def check(
    scene: SceneFile,
    history: HistoryFile,
    estimate_velocities: Velocities = False,
    columns: Columns = None,
    units: Units = None,
    time_step: TimeStep = None,
    trim: Trim = False,
    prior: Annotated[
        bool, typer.Option(help="Whether to compare the data with draws from the prior.")
    ] = True,
    draws: Annotated[int, typer.Option(min=50, help="Draws from the prior.")] = 100,
    seed: Seed = 0,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Read a scene and a history: what is in them, what is missing, whether the prior fits.

    Warns where a velocity and the changes of its position differ by the factor of a unit.
    """
    with interruptible(), stages(quiet) as progress:
        declared, (loaded,) = load_own(
            scene, history, estimate_velocities=estimate_velocities, columns=columns,
            units=units, time_step=time_step, trim=trim,
        )  # fmt: skip
        from pbrl_ppl.history import unit_mismatches, unused_velocities
        from pbrl_ppl.physics import check_history

        check_history(declared, loaded, loaded.segments(1))
        contents = _contents(declared, loaded)
        missing = _missing(loaded)
        unused = unused_velocities(loaded)
        console = Console(highlight=False, quiet=as_json)
        console.print(_listed(contents))
        console.print(_cells(loaded, missing))
        for velocity in unused:
            console.print(velocity.sentence, soft_wrap=True)
        checked = None
        if prior:
            progress("comparing with draws from the prior")
            from pbrl_ppl.criticism import prior_predictive_check, telling_horizon
            from pbrl_ppl.effects import attach
            from pbrl_ppl.model import Problem, build_model

            horizon = telling_horizon(loaded)
            model = build_model(Problem.of(declared, loaded, attach(declared, ()), horizon=horizon))
            checked = prior_predictive_check(model, draws=draws, seed=seed)
            for sentence in checked.summary:
                console.print(f"prior: {sentence}", soft_wrap=True)
    if as_json:
        found = checked and {"passed": not checked.sentences, "sentences": checked.summary}
        numbers = {"trajectories": loaded.n_trajectories, "transitions": loaded.n_transitions}
        cells = {"missing": missing, "velocities_not_used": [vars(each) for each in unused]}
        units_differ = {"unit_mismatches": unit_mismatches(loaded)}
        print_json(contents | numbers | cells | units_differ | {"prior": found})


def _contents(scene: Scene, history: History) -> dict[str, Any]:
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


def _listed(contents: dict[str, Any]) -> Table:
    table = Table(show_header=False, box=None)
    for name, value in contents.items():
        table.add_row(name, value)
    return table


def _missing(history: History) -> dict[str, dict[str, int]]:
    """Missing cells, by body and state dimension."""
    dataset = history.dataset
    # rows after a trajectory's end are padding, not missing measurements
    real = dataset["time"] < dataset["n_rows"]
    missing = (dataset["observed"].isnull() & real).sum(("trajectory", "time"))
    return {
        body: {
            str(name): int(missing.sel(body=body, state=name)) for name in missing["state"].values
        }
        for body in history.bodies
    }


def _cells(history: History, missing: dict[str, dict[str, int]]) -> Table:
    """Table of missing cells."""
    total = int(history.dataset["n_rows"].sum())
    table = Table(title="missing measurements", title_justify="left")
    table.add_column("body")
    for name in STATE:
        table.add_column(name, justify="right")
    for body, counts in missing.items():
        cells = (
            "none" if n == 0 else "all" if n == total else f"{n} of {total}"
            for n in counts.values()
        )
        table.add_row(body, *cells)
    return table


def criticise(
    scene: SceneFile,
    history: HistoryFile,
    noise: Errors = None,
    substeps: Substeps = None,
    seed: Seed = 1,
    estimate_velocities: Velocities = False,
    columns: Columns = None,
    units: Units = None,
    time_step: TimeStep = None,
    trim: Trim = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Rank the effects that the declared model might lack by the score test: no refit, no verdict.

    The score test says which effect's signature the residual looks like; close-loop finds out
    whether that effect helps on data that it has not seen.
    """
    with interruptible(), stages(quiet) as progress:
        progress("reading the scene and the history")
        declared, (loaded,) = load_own(
            scene, history, estimate_velocities=estimate_velocities, columns=columns,
            units=units, time_step=time_step, trim=trim,
        )  # fmt: skip
        declared = with_substeps(stated_noise(declared, noise), substeps)
        progress("loading the model")
        from pbrl_ppl import criticism
        from pbrl_ppl.physics import check_history

        check_history(declared, loaded, loaded.segments(1))
        found = criticism.criticise(declared, loaded, seed=seed, progress=progress)
    if as_json:
        print_json(
            {
                "candidates": [vars(candidate) for candidate in found.candidates],
                "mode": found.mode,
                "unexplained_acceleration": found.unexplained_acceleration,
                "substeps": found.substeps,
            }
        )
        return
    print_table(
        "what the declared model might lack, by the score test",
        ["effect", "<body", "S", "dof", "p (corrected)", "<first estimate"],
        map(_row, found.candidates),
    )
    typer.echo(
        "small p: the residual looks like that effect's signature; close-loop says whether it is"
        " missing"
    )


def _row(candidate: Candidate) -> list[str]:
    sizes = (
        f"{name} {value:.3g} {candidate.units[name].removesuffix('1')}".rstrip()
        for name, value in candidate.estimate.items()
    )
    # where the declared parameters absorb the effect, its size cannot be had
    seen = ", ".join(sizes) if candidate.statistic > 0 else ""
    numbers = [f"{candidate.statistic:.1f}", str(candidate.dof), f"{candidate.p_value:.2g}"]
    return [candidate.effect, candidate.body, *numbers, seen]
