"""``pbrl-ppl close-loop``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.command_line import command_line
from pbrl_ppl.cli.terminal import (
    UNDECIDED,
    SceneFile,
    Velocities,
    interruptible,
    load_files,
    stages,
    stated_noise,
)


def close_loop(
    context: typer.Context,
    scene: SceneFile,
    train: Annotated[
        Path, typer.Argument(metavar="TRAIN", help="Measured history (.csv, .parquet, .nc).")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")
    ],
    test: Annotated[
        Path | None,
        typer.Option(
            metavar="TEST",
            help="Held-out history; without it, a quarter of TRAIN's trajectories.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write to a folder that has content.")
    ] = False,
    substeps: Annotated[
        int | None, typer.Option(min=1, help="Engine steps per interval, for the scene's.")
    ] = None,
    draws: Annotated[
        int | None, typer.Option(min=100, help="Posterior draws of each chain.")
    ] = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=SD",
            help="Known error of measuring a state dimension (x=0.002, in m; repeat for others).",
        ),
    ] = None,
    estimate_velocities: Velocities = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict.
    """
    with interruptible(), stages(quiet) as progress:
        progress("reading the scene and the histories")
        declared, history = load_files(scene, train, estimate_velocities)
        held_out = None
        if test is not None:
            _, held_out = load_files(scene, test, estimate_velocities)
        declared = stated_noise(declared, noise or [])
        if substeps is not None:
            declared = declared.replace(substeps=substeps)
        progress("loading the sampler")
        # nobody is there to see a window
        os.environ.setdefault("MPLBACKEND", "Agg")
        from pbrl_ppl import report
        from pbrl_ppl.criticism import NOT_CONVERGED

        # before the long work, which would be lost
        report.check_folder(output, overwrite)
        loop = report.close_loop(
            declared,
            history,
            held_out,
            seed=seed,
            draws=draws,
            progress=progress,
        )
        progress("writing the report")
        source = report.Source(str(scene), str(train), str(test or ""), command_line(context))
        loop.save(output, overwrite=overwrite, source=source)
    typer.echo(report.verdict_in_words(loop.findings))
    if unseen := report.unseen_in_words(loop.findings):
        typer.echo(unseen)
    typer.echo(f"report: {output / 'report.html'}")
    if loop.verdict == NOT_CONVERGED:
        raise typer.Exit(UNDECIDED)
