"""``pbrl-ppl rehearse``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.options import command
from pbrl_ppl.cli.terminal import Progress, Result, check_file, sizes, table
from pbrl_ppl.files import json_values, write_text

if TYPE_CHECKING:
    from pbrl_ppl.criticism import RehearsedLaw


@command("rehearse", 2, "pbrl-ppl rehearse scene.toml commands.csv --noise x=0.002,y=0.002")
def rehearse(
    scene: Path,
    reading: options.SceneReading,
    progress: Progress,
    commands: Annotated[Path | None, typer.Argument()] = None,
    output: options.OutputFile | None = None,
    given: Annotated[list[str] | None, typer.Option("--set")] = None,
    seed: options.Seed = 0,
    overwrite: bool = False,
) -> Result:
    """Find out before a recording is made which laws it would name, and from which size on.

    The declared model is simulated with the commands and with measurement noise, and each law of
    the catalogue is added in turn.

    Parameters
    ----------
    commands : COMMANDS
        Initial states and wrenches (.csv, .parquet, .nc), as of simulate; proposed if not given.
    output
        The answer (.json), or the simulated recording with its commands (.csv, .parquet, .nc).
    given : NAME=VALUE
        A declared parameter (SI units): mass=8 for all bodies, or 'mass[cart]=8'; repeat. The
        prior's centre if not given.
    """
    if output is not None:
        check_file(output, (".json", ".csv", ".parquet", ".nc"), overwrite)
    values = options.pairs(given, "--set", "mass=8", float)
    progress("reading the scene and the commands")
    declared, histories = reading.read(scene, [] if commands is None else [commands])
    catalogue = reading.catalogue()
    progress("loading the model")
    from pbrl_ppl import criticism
    from pbrl_ppl.posterior import versions

    found = criticism.rehearse(
        declared, *histories, parameters=values, catalogue=catalogue, seed=seed,
        progress=progress,
    )  # fmt: skip
    contents = {key: value for key, value in vars(found).items() if key != "history"}
    contents = {"versions": versions(), **contents}
    if output is not None and output.suffix == ".json":
        write_text(output, json.dumps(json_values(contents), indent=1, allow_nan=False) + "\n")
    elif output is not None:
        found.history.save(output)
    noise = ", ".join(f"{name} {sd:.2g}" for name, sd in found.noise.items())
    columns = {"law": "<", "body": "<", "named from": "<", "of typical": "", "named as": "<"}
    laws = table(
        f"laws that a recording would show; measurement noise (SI): {noise}",
        columns | {"confounded with": "<", "note": "<"},
        (_row(law) for law in found.laws if law.named),
    )
    unseen: dict[str, list[str]] = {}
    for law in found.laws:
        if not law.named:
            unseen.setdefault(law.note, []).append(f"{law.effect} on {law.body}")
    lines = [f"unseen, {why}: {', '.join(names)}" for why, names in unseen.items()]
    lines += [f"written: {output}"] if output is not None else []
    return Result(contents, [laws, *lines])


def _row(law: RehearsedLaw) -> list[str]:
    """Return a law's row of the table."""
    null = {name: f"{law.null[name]:g} ± " for name in law.sizes if law.null[name]}
    found = (*law.sizes.items(), *law.levels.items())
    numbers = ((name, f"{null.get(name, '')}{size:.3g}") for name, size in found)
    typical = f"{100 * law.share:.2g} %" if law.sizes else ""
    named = law.named if law.named != law.effect else ""
    return [
        law.effect, law.body, sizes(numbers, law.units), typical, named,
        ", ".join(law.confounded), law.note,
    ]  # fmt: skip
