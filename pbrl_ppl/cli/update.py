"""``pbrl-ppl update``."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.outputs import check_file
from pbrl_ppl.cli.own_tables import Columns, Resample, Units, columns_of, units_of, without_ends
from pbrl_ppl.cli.terminal import (
    UNDECIDED,
    AsJson,
    Overwrite,
    Quiet,
    Seed,
    Trim,
    Velocities,
    interruptible,
    stages,
)
from pbrl_ppl.errors import ConvergenceWarning


def update(
    posterior: Annotated[
        Path, typer.Argument(metavar="POSTERIOR", help="Posterior file (.nc); it has the scene.")
    ],
    history: Annotated[
        Path, typer.Argument(metavar="HISTORY", help="What was recorded since (.csv, ...).")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="The new posterior file.")
    ],
    seed: Seed = 1,
    estimate_velocities: Velocities = False,
    columns: Columns = None,
    units: Units = None,
    resample: Resample = False,
    trim: Trim = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Bring a posterior up to date with new transitions, without a fit from scratch.

    Exits with 3 if the new posterior has not converged.
    """
    names, measures = columns_of(columns or []), units_of(units or [])
    with interruptible(), stages(quiet) as progress:
        check_file(output, (".nc",), overwrite)
        progress("reading the posterior and the history")
        from pbrl_ppl.history import History
        from pbrl_ppl.posterior import load_posterior, save_posterior, scene_of

        idata = load_posterior(posterior)
        scene = scene_of(idata)
        new = History.load(
            history, scene, estimate_velocities=estimate_velocities, columns=names,
            units=measures, resample=resample,
        )  # fmt: skip
        new = without_ends(new, scene, f"history {history}", trim=trim)
        progress("updating")
        from pbrl_ppl.sampling import updating

        caught: list[type[Warning]] = []
        with warnings.catch_warnings():
            show = warnings.showwarning

            def shown(
                message: Warning | str, category: type[Warning], *place: Any, **more: Any
            ) -> None:
                caught.append(category)
                show(message, category, *place, **more)  # at once: a refit takes long

            warnings.showwarning = shown
            idata = updating.update(idata, new, seed=seed, progress=False)
        if "interrupted" in idata.attrs:  # half a posterior is no ground for the next update
            raise KeyboardInterrupt
        save_posterior(idata, output)
        (*_, last) = json.loads(idata.attrs["updates"])
    converged = not any(issubclass(category, ConvergenceWarning) for category in caught)
    if as_json:
        print_json(last | {"posterior": output, "converged": converged})
    else:
        typer.echo(
            f"{last['did']}: {last['transitions']} transitions, the weights worth"
            f" {last['share']:.0%} of the draws"
        )
        typer.echo(f"posterior: {output}")
    if not converged:
        raise typer.Exit(UNDECIDED)
