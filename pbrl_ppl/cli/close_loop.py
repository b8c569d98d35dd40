"""``pbrl-ppl close-loop``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.command_line import command_line
from pbrl_ppl.cli.outputs import check_can_make
from pbrl_ppl.cli.terminal import (
    UNDECIDED,
    AsJson,
    Errors,
    Quiet,
    SceneFile,
    Seed,
    Substeps,
    Velocities,
    interruptible,
    load_files,
    stages,
    stated_noise,
)

#: Share of the time that is over when a stage begins, as measured on a recorded cart.
SHARES = {
    "loading the sampler": 0.01,
    "looking whether the prior could have made the data": 0.03,
    "fitting the declared model": 0.04,
    "scoring what the model might lack": 0.05,
    "testing what is left": 0.13,
    "sampling the posterior of the declared model": 0.14,
    "sampling the posterior of the revised model": 0.44,
    "comparing errors on held-out data": 0.98,
    "writing the report": 0.99,
}


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
    seed: Seed = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write to a folder that has content.")
    ] = False,
    substeps: Substeps = None,
    draws: Annotated[
        int | None, typer.Option(min=100, help="Posterior draws of each chain.")
    ] = None,
    noise: Errors = None,
    estimate_velocities: Velocities = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict.
    """
    with interruptible(), stages(quiet, SHARES) as progress:
        check_can_make(output)  # before the long work, which would be lost
        progress("reading the scene and the histories")
        declared, history = load_files(scene, train, estimate_velocities)
        held_out = None
        if test is not None:
            _, held_out = load_files(scene, test, estimate_velocities)
        declared = stated_noise(declared, noise)
        if substeps is not None:
            declared = declared.replace(substeps=substeps)
        progress("loading the sampler")
        # nobody is there to see a window
        os.environ.setdefault("MPLBACKEND", "Agg")
        from pbrl_ppl import report
        from pbrl_ppl.criticism import NOT_CONVERGED

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
    if as_json:
        print_json(loop.findings.to_dict() | {"report": output / "report.html"})
    else:
        typer.echo(report.verdict_in_words(loop.findings))
        if unseen := report.unseen_in_words(loop.findings):
            typer.echo(unseen)
        typer.echo(f"report: {output / 'report.html'}")
    if loop.verdict == NOT_CONVERGED:
        raise typer.Exit(UNDECIDED)
