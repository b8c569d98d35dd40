"""``pbrl-ppl report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.commands import command
from pbrl_ppl.cli.terminal import check_file, interruptible, print_result, stages
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.files import write_text


@command("report", 8, "pbrl-ppl report cart.nc")
def report(
    context: typer.Context,
    posterior: options.PosteriorFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="The page; POSTERIOR with .html if not given."
        ),
    ] = None,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Diagnose a posterior on one self-contained page: chains, prior, predictions, LOO."""
    with interruptible(), stages(quiet) as progress:
        page = posterior.with_suffix(".html") if output is None else output
        check_file(page, (".html",), overwrite)
        progress("reading the posterior")
        from pbrl_ppl.posterior import load_posterior
        from pbrl_ppl.reporting import Source, render_posterior

        idata = load_posterior(posterior)
        progress("computing and drawing")
        try:
            text = render_posterior(idata, source=Source(command=options.command_line(context)))
        except PosteriorError as error:
            raise PosteriorError(f"{posterior}: {error}") from error
        write_text(page, text)
    print_result(as_json, {"report": page}, [f"report: {page}"])
