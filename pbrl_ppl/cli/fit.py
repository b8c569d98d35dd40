"""``pbrl-ppl fit``."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbrl_ppl.cli.answers import print_json, print_table
from pbrl_ppl.cli.outputs import check_file
from pbrl_ppl.cli.own_tables import Columns, TimeStep, Units, load_own
from pbrl_ppl.cli.terminal import (
    INTERRUPTED,
    UNDECIDED,
    AsJson,
    Errors,
    HistoryFile,
    Overwrite,
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
from pbrl_ppl.errors import ConvergenceWarning, FitError

if TYPE_CHECKING:
    import pandas as pd


def fit(
    scene: SceneFile,
    history: HistoryFile,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="The posterior file (.nc).")
    ],
    trajectories: Annotated[
        bool,
        typer.Option(
            "--trajectories/--transitions",
            help="Likelihood of whole trajectories, as of close-loop, or of single transitions"
            " from exact states (the paper's Eq. 11).",
        ),
    ] = True,
    horizon: Annotated[
        int, typer.Option(min=1, help="Intervals that are predicted, with --transitions.")
    ] = 1,
    scalar: Annotated[
        bool, typer.Option("--scalar-sigma", help="One sigma for all, with --transitions.")
    ] = False,
    nu: Annotated[
        float | None,
        typer.Option(min=0.1, help="Degrees of freedom of Student-t noise; else Gaussian."),
    ] = None,
    noise: Errors = None,
    substeps: Substeps = None,
    method: Annotated[
        str,
        typer.Option(help="metropolis, paper, demetropolisz, smc, nuts, laplace or map."),
    ] = "metropolis",
    draws: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="Posterior draws of each chain.")
    ] = None,
    tune: Annotated[
        int | None, typer.Option(min=0, max=1_000_000, help="Tuning draws of each chain.")
    ] = None,
    chains: Annotated[int | None, typer.Option(min=1, max=1000, help="Chains.")] = None,
    thin: Annotated[int | None, typer.Option(min=1, max=10_000, help="Steps a draw.")] = None,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Go on where this posterior's chains ended."),
    ] = None,
    seed: Seed = 1,
    estimate_velocities: Velocities = False,
    columns: Columns = None,
    units: Units = None,
    time_step: TimeStep = None,
    trim: Trim = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Fit the declared model to a history: a posterior file, and a table of it.

    Exits with 3 if the chains have not converged, and with 130 if it was interrupted; the draws
    so far are kept.
    """
    with interruptible(), stages(quiet) as progress:
        check_file(output, (".nc",), overwrite)
        if trajectories and (horizon > 1 or scalar):
            raise FitError("--horizon and --scalar-sigma are of single transitions: --transitions")
        progress("reading the scene and the history")
        declared, (loaded,) = load_own(
            scene, history, estimate_velocities=estimate_velocities, columns=columns,
            units=units, time_step=time_step, trim=trim,
        )  # fmt: skip
        declared = with_substeps(stated_noise(declared, noise), substeps)
        progress("loading the sampler")
        os.environ.setdefault("MPLBACKEND", "Agg")
        import pbrl_ppl.report as report
        from pbrl_ppl import sampling
        from pbrl_ppl.physics import check_history
        from pbrl_ppl.posterior import group, load_posterior, save_posterior

        check_history(declared, loaded, loaded.segments(1))
        earlier = None if resume is None else load_posterior(resume)
        progress("looking for the mode, then sampling")
        model = _declared(
            sampling.physics_model, declared, loaded, horizon=horizon, nu=nu,
            sigma="scalar" if scalar else "per_dimension", trajectories=trajectories,
            around=earlier if trajectories else None, seed=seed,
        )  # fmt: skip
    # the sampler has a bar of its own
    with interruptible() as interrupts, warnings.catch_warnings(record=True) as caught:
        with redirect_stdout(sys.stderr):
            idata = sampling.fit(
                model, method=method, seed=seed, draws=draws, tune=tune, chains=chains, thin=thin,
                resume=earlier, progress=not quiet,
            )  # fmt: skip
        save_posterior(idata, output)
    cut = bool(interrupts) or "interrupted" in idata.attrs
    for warning in caught:
        if not (cut and "was interrupted" in str(warning.message)):
            warnings.warn(warning.message, stacklevel=1)
    converged = not any(issubclass(warning.category, ConvergenceWarning) for warning in caught)
    table = _summary(report.summary, idata)
    if as_json:
        print_json(_contents(output, idata, table, converged))
    else:
        print_table(None, ["parameter", *table.columns], _rows(table))
        typer.echo(f"posterior: {output}")
    if cut:
        kept = group(idata, "posterior").sizes
        typer.echo(
            f"interrupted; {kept['draw']} draws of each of {kept['chain']} chains are kept in"
            f" {output}; --resume {output} goes on",
            err=True,
        )
        raise typer.Exit(INTERRUPTED)
    if not converged:
        raise typer.Exit(UNDECIDED)


def _declared(physics_model: Any, *args: Any, **options: Any) -> Any:
    """The model; its refusal of an option is the user's to cure."""
    try:
        return physics_model(*args, **options)
    except ValueError as error:
        raise FitError(f"fit: {error}") from None


def _summary(summary: Callable[[Any], pd.DataFrame], idata: Any) -> pd.DataFrame:
    """A row for each parameter; of a mode, its place alone."""
    from pbrl_ppl.posterior import scalars

    if "max_rhat" not in idata.attrs:
        import pandas as pd

        places = {str(name): float(value) for name, value in scalars(idata).mean().items()}
        return pd.DataFrame({"mean": places})
    table = summary(idata)
    table.insert(4, "ess", table[["ess_bulk", "ess_tail"]].min(axis=1))
    return table.drop(columns=["ess_bulk", "ess_tail"])


def _rows(table: pd.DataFrame) -> list[list[str]]:
    """The summary for reading."""
    digits = {"ess": ".0f", "r_hat": ".3f"}
    return [
        [str(name), *(f"{value:{digits.get(str(column), '.4g')}}" for column, value in row.items())]
        for name, row in table.iterrows()
    ]


def _contents(output: Path, idata: Any, table: pd.DataFrame, converged: bool) -> dict[str, Any]:
    return {
        "posterior": output,
        "converged": converged if "max_rhat" in idata.attrs else None,
        "max_rhat": idata.attrs.get("max_rhat"),
        "min_ess": idata.attrs.get("min_ess"),
        "parameters": {str(name): row.to_dict() for name, row in table.iterrows()},
        "warnings": json.loads(idata.attrs["warnings"]),
    }
