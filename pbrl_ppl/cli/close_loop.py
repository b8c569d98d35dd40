"""``pbrl-ppl close-loop``, and ``pbrl-ppl demo``, which runs it on a recording of the package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbrl_ppl.cli import options, terminal
from pbrl_ppl.cli.new import models_folder
from pbrl_ppl.cli.options import command
from pbrl_ppl.cli.terminal import Progress, Result

if TYPE_CHECKING:
    from pbrl_ppl.criticism import Loop
    from pbrl_ppl.history import History
    from pbrl_ppl.reporting import Source
    from pbrl_ppl.scene import Scene


#: How a sentence on laws that were found begins.
_FOUND = "simulations name"


class Method(StrEnum):
    """Samplers of the loop's posteriors."""

    IMPORTANCE = "importance"
    METROPOLIS = "metropolis"
    LAPLACE = "laplace"


Draws = Annotated[int | None, typer.Option(min=100)]


@command("close-loop", 5, "pbrl-ppl close-loop scene.toml train.csv -o report/")
def close_loop(
    context: typer.Context,
    scene: Path,
    train: Path,
    output: options.OutputFolder,
    reading: options.SceneReading,
    progress: Progress,
    test: Path | None = None,
    seed: options.Seed = 1,
    overwrite: bool = False,
    draws: Draws = None,
    method: Method = Method.IMPORTANCE,
    learn_remainder: bool = False,
) -> Result:
    """Find what the declared model lacks, add it, refit, and report before and after.

    Exits with 3 if the chains have not converged: then there is no verdict.

    Parameters
    ----------
    train : TRAIN
        Measured history (.csv, .parquet, .nc).
    output
        Folder for the results.
    test : TEST
        Held-out history; without it, a quarter of TRAIN's trajectories.
    overwrite
        Write to a folder that is not empty.
    draws
        Posterior draws of each chain.
    method
        importance weights proposals by the engine; metropolis runs chains; laplace takes Gaussians
        at the modes, on which the verdict then stands.
    learn_remainder
        Where something stays unexplained, learn a force for it, into remainder.nc; it gets no name.
    """
    terminal.check_can_make(output)  # before the long work, which would be lost
    progress("reading the scene and the histories")
    paths = [train] if test is None else [train, test]
    declared, histories = reading.read(scene, paths)
    catalogue = reading.catalogue()
    progress("loading the sampler")
    import pbrl_ppl.reporting as report
    from pbrl_ppl import criticism

    criticism.check_folder(output, overwrite)
    if learn_remainder:
        criticism.check_scikit_learn()
    settings = {"seed": seed, "draws": draws, "method": method.value, "catalogue": catalogue}
    loop, stopped = _finished(declared, histories, progress, **settings)
    progress("writing the report")
    files = str(scene), str(train), str(test or "")
    source = report.Source(*files, options.command_line(context))
    loop.save(output, overwrite, page=report.render(loop, source))
    contents, words = loop.to_dict() | {"report": output / "report.html"}, ""
    if learn_remainder:
        words, path = _remainder(loop, output, source, seed, progress)
        contents["learned_remainder"] = {"words": words, "posterior": path}
    undecided = terminal.UNDECIDED if loop.verdict == criticism.NOT_CONVERGED else 0
    code = terminal.INTERRUPTED if stopped else undecided
    return Result(contents, report.in_brief(loop, output, words), code)


def _finished(
    scene: Scene, histories: Sequence[History], progress: Progress, **settings: Any
) -> tuple[Loop, bool]:
    """Return the loop, with Gaussians at the modes if it is interrupted while it samples.

    The second value is whether it was. An earlier interrupt ends the command, and says what was
    found.
    """
    from pbrl_ppl import criticism

    names: list[str] = []

    def noted(stage: str) -> None:
        progress(stage)
        if stage.startswith(_FOUND):
            names.append(stage)

    try:
        return criticism.close_loop(scene, *histories, progress=noted, **settings), False
    except criticism.LoopInterrupted as interrupt:
        progress("interrupted: Gaussians at the modes instead; once more ends without a report")
        return interrupt.finish(), True
    except KeyboardInterrupt:
        so_far = f"so far: {'; '.join(names)}; " if names else ""
        advice = "--method laplace, fewer rows or a coarser log take less time"
        raise typer.Exit(terminal.interrupted(f"nothing was written; {so_far}{advice}")) from None


def _remainder(
    loop: Loop, folder: Path, source: Source, seed: int, progress: Progress
) -> tuple[str, Path | None]:
    """Learn a force for the residual and save it with the results.

    Returns what it does, or why there is none, and its file.
    """
    from pbrl_ppl.errors import FitError
    from pbrl_ppl.reporting import render

    path = folder / "remainder.nc"
    path.unlink(missing_ok=True)  # of an earlier run
    try:
        loop = replace(loop, remainder=loop.learn_remainder(seed=seed, progress=progress))
    except FitError as error:
        return str(error), None
    progress("writing the report with it")
    loop.save(folder, overwrite=True, page=render(loop, source))
    return loop.remainder_words, path


@command("demo", 0, "pbrl-ppl demo")
def demo(
    context: typer.Context,
    progress: Progress,
    as_json: bool,
    quiet: bool,
    output: options.OutputFolder = Path("pbrl-ppl-demo"),
    method: Method = Method.LAPLACE,
    seed: options.Seed = 1,
    overwrite: bool = False,
) -> Result:
    """Close the loop on a recording that comes with the package, and write its report.

    A shopping cart is pushed. Its castor resists turning, which the scene does not declare.

    Parameters
    ----------
    output
        Folder for the results.
    method
        laplace takes seconds; importance and metropolis draw from the posterior itself, in minutes.
    overwrite
        Write to a folder that is not empty.
    """
    cart = models_folder() / "shopping_cart"
    if not (as_json or quiet):
        typer.echo(
            "A shopping cart is pushed; the scene does not declare that its castor resists turning."
            "\nThis takes some 30 s on an idle machine, the first time a minute more to compile."
        )
    result = close_loop(
        context, cart / "scene.toml", cart / "recorded" / "train.csv", output,
        options.SceneReading(), progress, cart / "recorded" / "test.csv", method=method, seed=seed,
        overwrite=overwrite,
    )  # fmt: skip
    if quiet or result.code:
        return result
    last = "With a recording of yours: pbrl-ppl new scene.toml --history train.csv"
    return replace(result, shown=[*result.shown, last])
