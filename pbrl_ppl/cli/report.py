"""``pbrl-ppl report``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.options import command_line
from pbrl_ppl.cli.terminal import (
    AsJson,
    Overwrite,
    Quiet,
    check_file,
    interruptible,
    print_json,
    stages,
)
from pbrl_ppl.errors import PosteriorError


def report(
    context: typer.Context,
    posterior: Annotated[
        Path, typer.Argument(metavar="POSTERIOR", help="Posterior file (.nc); all that is needed.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="The page; POSTERIOR with .html if not given."
        ),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Diagnose a posterior on one self-contained page: chains, prior, predictions, LOO."""
    with interruptible(), stages(quiet) as progress:
        page = posterior.with_suffix(".html") if output is None else output
        check_file(page, (".html",), overwrite)
        progress("reading the posterior")
        # nobody is there to see a window
        os.environ.setdefault("MPLBACKEND", "Agg")
        from pbrl_ppl.posterior import load_posterior
        from pbrl_ppl.report import Source, render_posterior, write_page

        idata = load_posterior(posterior)
        progress("computing and drawing")
        try:
            text = render_posterior(idata, source=Source(command=command_line(context)))
        except PosteriorError as error:
            raise PosteriorError(f"{posterior}: {error}") from error
        write_page(page, text)
    if as_json:
        print_json({"report": page})
    else:
        typer.echo(f"report: {page}")
