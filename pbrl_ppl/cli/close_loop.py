"""``pbrl-ppl close-loop``."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.command_line import command_line
from pbrl_ppl.cli.many import close_loop_many
from pbrl_ppl.cli.outputs import check_can_make
from pbrl_ppl.cli.own_tables import Columns, TimeStep, Units, columns_of, load_own, units_of
from pbrl_ppl.cli.terminal import (
    UNDECIDED,
    AsJson,
    Errors,
    Quiet,
    Seed,
    Substeps,
    Trim,
    Velocities,
    interruptible,
    named_numbers,
    stages,
    stated_noise,
)

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Loop
    from pbrl_ppl.report import Source


class Method(StrEnum):
    """How posteriors are drawn."""

    METROPOLIS = "metropolis"
    LAPLACE = "laplace"


def close_loop(
    context: typer.Context,
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
    seed: Seed = 1,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite",
            help="Write to a folder that has content; with --many, run finished logs again.",
        ),
    ] = False,
    substeps: Substeps = None,
    draws: Annotated[
        int | None, typer.Option(min=100, help="Posterior draws of each chain.")
    ] = None,
    method: Annotated[
        Method,
        typer.Option(
            help="metropolis draws the posteriors; laplace takes Gaussians at the modes, on which"
            " the verdict then stands."
        ),
    ] = Method.METROPOLIS,
    noise: Errors = None,
    estimate_velocities: Velocities = False,
    columns: Columns = None,
    units: Units = None,
    time_step: TimeStep = None,
    trim: Trim = False,
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
    learn_remainder: Annotated[
        bool,
        typer.Option(
            "--learn-remainder",
            help="Where something stays unexplained, learn a force for it, into remainder.nc; it"
            " gets no name.",
        ),
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict. With --many, exits with
    1 if some logs failed.
    """
    if many is not None:
        if not (scene is train is test is None):
            raise typer.BadParameter("SCENE, TRAIN and --test are in the manifest, with --many")
        if trim:
            raise typer.BadParameter("--trim is for one log; leave it, or --many")
        if learn_remainder:
            raise typer.BadParameter("--learn-remainder is for one log; leave it, or --many")
        close_loop_many(
            many, output, jobs=jobs, scheduler=scheduler, as_json=as_json, quiet=quiet,
            again=overwrite, seed=seed, substeps=substeps, draws=draws,
            method=method.value, noise=named_numbers(noise, "--noise", "x=0.002"),
            columns=columns_of(columns or []), units=units_of(units or []), time_step=time_step,
            estimate_velocities=estimate_velocities, command=command_line(context),
        )  # fmt: skip
        return
    if scene is None or train is None:
        raise typer.BadParameter("expected SCENE and TRAIN, or --many MANIFEST")
    if jobs > 1 or scheduler is not None:
        raise typer.BadParameter("--jobs and --scheduler are for --many")
    with interruptible(), stages(quiet) as progress:
        check_can_make(output)  # before the long work, which would be lost
        progress("reading the scene and the histories")
        declared, histories = load_own(
            scene, train, *([] if test is None else [test]),
            estimate_velocities=estimate_velocities, columns=columns, units=units,
            time_step=time_step, trim=trim,
        )  # fmt: skip
        declared = stated_noise(declared, noise)
        if substeps is not None:
            declared = declared.replace(substeps=substeps)
        progress("loading the sampler")
        # nobody is there to see a window
        os.environ.setdefault("MPLBACKEND", "Agg")
        import pbrl_ppl.report as report
        from pbrl_ppl import criticism

        criticism.check_folder(output, overwrite)
        loop = criticism.close_loop(
            declared,
            *histories,
            seed=seed,
            draws=draws,
            method=method.value,
            progress=progress,
        )
        progress("writing the report")
        source = report.Source(str(scene), str(train), str(test or ""), command_line(context))
        loop.save(output, overwrite, page=report.loop_page(loop, source))
        remainder = _remainder(loop, output, source, seed, progress) if learn_remainder else {}
    if as_json:
        print_json(loop.to_dict() | {"report": output / "report.html"} | remainder)
    else:
        words = remainder["learned_remainder"]["words"] if remainder else ""
        for line in report.in_brief(loop, output, words):
            typer.echo(line)
    if loop.verdict == criticism.NOT_CONVERGED:
        raise typer.Exit(UNDECIDED)


def _remainder(
    loop: Loop, folder: Path, source: Source, seed: int, progress: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Learn a force for the residual and save it with the results, or say why there is none."""
    from pbrl_ppl.errors import FitError
    from pbrl_ppl.report import loop_page

    path = folder / "remainder.nc"
    path.unlink(missing_ok=True)  # of an earlier run
    try:
        loop = replace(loop, remainder=loop.learn_remainder(seed=seed, progress=progress))
    except FitError as error:
        return {"learned_remainder": {"words": str(error), "posterior": None}}
    progress("writing the report with it")
    loop.save(folder, overwrite=True, page=loop_page(loop, source))
    return {"learned_remainder": {"words": loop.remainder_words, "posterior": path}}
