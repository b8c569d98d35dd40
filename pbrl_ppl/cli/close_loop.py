"""``pbrl-ppl close-loop``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.many import close_loop_many
from pbrl_ppl.cli.own_tables import Columns, TimeStep, Units, columns_of, load_own, units_of
from pbrl_ppl.cli.terminal import (
    UNDECIDED,
    Velocities,
    interruptible,
    noise_of,
    stages,
    stated_noise,
)


def close_loop(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")
    ],
    scene: Annotated[
        Path | None, typer.Argument(metavar="SCENE", help="Scene file (.toml).")
    ] = None,
    train: Annotated[
        Path | None,
        typer.Argument(metavar="TRAIN", help="Measured history (.csv, .parquet, .nc)."),
    ] = None,
    test: Annotated[
        Path | None,
        typer.Option(
            metavar="TEST",
            help="Held-out history; without it, a quarter of TRAIN's trajectories.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite",
            help="Write to a folder that has content; with --many, run finished logs again.",
        ),
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
    columns: Columns = None,
    units: Units = None,
    time_step: TimeStep = None,
    many: Annotated[
        Path | None,
        typer.Option(
            metavar="MANIFEST",
            help="Many logs in place of SCENE and TRAIN: a CSV file with the columns name, scene,"
            " train, test, kind. The same command goes on after an interrupt.",
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Logs at a time, with --many.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A Dask scheduler that has the workers, for --many."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict. With --many, exits with
    1 if some logs failed.
    """
    names, measures = columns_of(columns or []), units_of(units or [])
    if many is not None:
        if not (scene is train is test is None):
            raise typer.BadParameter("SCENE, TRAIN and --test are in the manifest, with --many")
        close_loop_many(
            many, output, jobs=jobs, scheduler=scheduler, quiet=quiet, again=overwrite, seed=seed,
            substeps=substeps, draws=draws, noise=noise_of(noise or []), columns=names,
            units=measures, time_step=time_step, estimate_velocities=estimate_velocities,
        )  # fmt: skip
        return
    if scene is None or train is None:
        raise typer.BadParameter("expected SCENE and TRAIN, or --many MANIFEST")
    if jobs > 1 or scheduler is not None:
        raise typer.BadParameter("--jobs and --scheduler are for --many")
    with interruptible(), stages(quiet) as progress:
        progress("reading the scene and the histories")
        declared, history, held_out = load_own(
            scene, train, test, estimate_velocities, names, measures, time_step
        )
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
        loop.save(output, overwrite=overwrite)
    typer.echo(report.verdict_in_words(loop.findings))
    if unseen := report.unseen_in_words(loop.findings):
        typer.echo(unseen)
    typer.echo(f"report: {output / 'report.html'}")
    if loop.verdict == NOT_CONVERGED:
        raise typer.Exit(UNDECIDED)
