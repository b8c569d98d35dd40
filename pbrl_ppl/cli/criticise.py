"""``pbrl-ppl criticise``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from pbrl_ppl.cli.answers import print_json, print_table
from pbrl_ppl.cli.own_tables import Columns, TimeStep, Units, load_own
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
    stages,
    stated_noise,
    with_substeps,
)

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Candidate


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
