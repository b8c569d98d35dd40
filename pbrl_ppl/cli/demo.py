"""``pbrl-ppl demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.close_loop import Method, close_loop
from pbrl_ppl.cli.commands import command
from pbrl_ppl.cli.new import models_folder


@command("demo", 0, "pbrl-ppl demo")
def demo(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")
    ] = Path("pbrl-ppl-demo"),
    method: Annotated[
        Method,
        typer.Option(
            help="laplace takes seconds; importance and metropolis draw from the posterior itself,"
            " in minutes."
        ),
    ] = Method.LAPLACE,
    seed: options.Seed = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write to a folder that has content.")
    ] = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Close the loop on a recording that comes with the package, and write its report.

    A shopping cart is pushed. Its castor resists turning, which the scene does not declare.
    """
    cart = models_folder() / "shopping_cart"
    if not (as_json or quiet):
        typer.echo(
            "A shopping cart is pushed; the scene does not declare that its castor resists turning."
        )
    close_loop(
        context,
        cart / "scene.toml",
        cart / "recorded" / "train.csv",
        output,
        options.SceneReading(),
        cart / "recorded" / "test.csv",
        method=method,
        seed=seed,
        overwrite=overwrite,
        as_json=as_json,
        quiet=quiet,
    )
    if not (as_json or quiet):
        typer.echo("With a recording of yours: pbrl-ppl new scene.toml --history train.csv")
