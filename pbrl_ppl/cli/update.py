"""``pbrl-ppl update``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.terminal import Velocities, check_free, interruptible, stages


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
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same answer.")] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that exists.")
    ] = False,
    estimate_velocities: Velocities = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Bring a posterior up to date with new transitions, without a fit from scratch."""
    with interruptible(), stages(quiet) as progress:
        check_free(output, overwrite)
        progress("reading the posterior and the history")
        from pbrl_ppl.history import History
        from pbrl_ppl.posterior import load_posterior, save_posterior, scene_of

        idata = load_posterior(posterior)
        new = History.load(history, scene_of(idata), estimate_velocities=estimate_velocities)
        progress("updating")
        from pbrl_ppl.sampling import updating

        idata = updating.update(idata, new, seed=seed, progress=False)
        save_posterior(idata, output)
        (*_, last) = json.loads(idata.attrs["updates"])
    typer.echo(
        f"{last['did']}: {last['transitions']} transitions, the weights worth {last['share']:.0%}"
        " of the draws"
    )
    typer.echo(f"posterior: {output}")
