"""``pbrl-ppl new``."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from pbrl_ppl.cli.answers import print_json
from pbrl_ppl.cli.outputs import check_file
from pbrl_ppl.cli.scene_text import BodyText, scene_text
from pbrl_ppl.cli.terminal import AsJson, Overwrite, Quiet, interruptible
from pbrl_ppl.errors import OutputError, SceneError

#: Where models/ is in an installed package, and in a clone.
_MODELS = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models")
_SHAPES = "box:0.9x0.55 or circle:0.1, in m"


def new(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="The file to write.")] = Path(
        "scene.toml"
    ),
    bodies: Annotated[
        list[str] | None,
        typer.Option("--body", metavar="NAME=SHAPE", help=f"A body and its outline: {_SHAPES}."),
    ] = None,
    wheels: Annotated[
        list[str] | None,
        typer.Option("--wheel", metavar="NAME", help="A body that has a wheel or sticky feet."),
    ] = None,
    side: Annotated[
        bool | None,
        typer.Option("--side/--top", help="Seen from the side (gravity acts in y), or from above."),
    ] = None,
    time_step: Annotated[
        float | None, typer.Option(min=0.0, help="Time between rows of the history (s).")
    ] = None,
    history: Annotated[
        Path | None,
        typer.Option(
            metavar="HISTORY", help="A recording: has the bodies' names and the time step."
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option("--from", metavar="MODEL", help="Copy a model that comes with the package."),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a commented scene, from options or from a few questions; or copy a model.

    What is not given is asked for, if there is a terminal to ask at. Models to copy: apartment,
    namo, pendulum and shopping_cart; recordings that a model has go beside the scene.
    """
    with interruptible():
        check_file(scene, (".toml",), overwrite)
        try:
            if model is not None:
                written = _copied(model, scene, overwrite)
            else:
                written = [scene]
                _write(scene, _asked(bodies or [], wheels, side, time_step, history))
        except typer.Abort:  # Ctrl-C at a question
            raise KeyboardInterrupt from None
    if as_json:
        print_json({"scene": scene, "written": written})
    elif not quiet:
        for path in written:
            typer.echo(f"wrote {path}")
        log = history or (written[-1] if len(written) > 1 else "history.csv")
        typer.echo(f"next: pbrl-ppl check {scene} {log}")


def _copied(model: str, scene: Path, overwrite: bool) -> list[Path]:
    """Copy a model's scene, and its recordings beside it."""
    from pbrl_ppl.scene import nearest

    folder = next((path for path in _MODELS if path.is_dir()), None)
    if folder is None:
        raise OutputError("--from: the models are not installed with this package; clone it")
    known = sorted(path.parent.name for path in folder.glob("*/scene.toml"))
    if model not in known:
        raise SceneError(
            f"--from: there is no model {model!r}, only {', '.join(known)}{nearest(model, known)}"
        )
    copies = {scene: folder / model / "scene.toml"}
    for recording in sorted((folder / model / "recorded").glob("*.csv")):
        copies[scene.with_name(recording.name)] = recording
    for path in copies:
        check_file(path, (".toml", ".csv"), overwrite)
    for path, source in copies.items():
        shutil.copyfile(source, path)
    return list(copies)


def _write(path: Path, text: str) -> None:
    """Write a scene that can be read, whole or not at all."""
    from pbrl_ppl.history import write_atomically
    from pbrl_ppl.scene import Scene

    Scene.from_toml(text)
    write_atomically(path, lambda to: to.write_text(text, encoding="utf-8"))


def _asked(
    given: list[str],
    wheels: list[str] | None,
    side: bool | None,
    time_step: float | None,
    history: Path | None,
) -> str:
    """The scene's text, from options, a recording and answers."""
    shapes = dict(map(_body, given))
    names = list(shapes)
    if history is not None:
        names, measured = _recorded(history)
        time_step = measured if time_step is None else time_step
        for name in shapes:
            if name not in names:
                raise SceneError(
                    f"--body: {history} has no rows of {name!r}, only of {', '.join(names)}"
                )
    asking = not names or any(name not in shapes for name in names) or time_step is None
    if asking and not sys.stdin.isatty():
        lacking = [f"--body {name}={_SHAPES}" for name in names or ["NAME"] if name not in shapes]
        lacking += ["--time-step"] if time_step is None else []
        raise SceneError(f"new: there is no terminal to ask at; give {', '.join(lacking)}")
    if asking and side is None:
        side = typer.prompt("Seen from the top or the side?", default="top") == "side"
    if not names:
        names = [typer.prompt("What is the body that moves called?", default="cart")]
    rolling = list(wheels or [])
    for name in names:
        while name not in shapes:
            answer = typer.prompt(f"Outline of {name} ({_SHAPES})")
            try:
                shapes |= dict([_body(f"{name}={answer}")])
            except SceneError as error:
                typer.echo(str(error), err=True)
        if asking and wheels is None and not side and typer.confirm(f"Has {name} a wheel?"):
            rolling.append(name)
    if time_step is None:
        time_step = typer.prompt("Time between two rows of the recording (s)", type=float)
    for name in rolling:
        if name not in names:
            raise SceneError(f"--wheel: there is no body {name!r}, only {', '.join(names)}")
    return scene_text(
        [BodyText(name, shapes[name], name in rolling) for name in names],
        side=bool(side),
        time_step=time_step,
    )


def _body(text: str) -> tuple[str, str]:
    """Name and shape, as TOML, of ``NAME=box:LENGTHxWIDTH`` or ``NAME=circle:RADIUS``."""
    name, _, shape = text.rpartition("=")
    kind, _, numbers = shape.partition(":")
    try:
        sizes = [float(number) for number in numbers.split("x")]
    except ValueError:
        sizes = []
    if name and kind == "box" and len(sizes) == 2:
        return name, f'{{ kind = "box", size = [{sizes[0]:g}, {sizes[1]:g}] }}'
    if name and kind == "circle" and len(sizes) == 1:
        return name, f'{{ kind = "circle", radius = {sizes[0]:g} }}'
    raise SceneError(f"--body: {text!r} is not NAME=SHAPE with a shape such as {_SHAPES}")


def _recorded(path: Path) -> tuple[list[str], float]:
    """Names of the bodies in a recording, and the median time between its rows (s)."""
    import numpy as np
    import pandas as pd

    from pbrl_ppl.errors import HistoryError
    from pbrl_ppl.history import read_table

    table = read_table(path)
    for name in ("trajectory", "body", "time"):
        if name not in table:
            raise HistoryError(
                f"history {path}: it has no column {name}; give --body and --time-step instead"
            )
    names = [str(name).strip() for name in table["body"].dropna().unique() if str(name).strip()]
    table["time"] = pd.to_numeric(table["time"], errors="coerce")
    steps = table.groupby(["trajectory", "body"])["time"].diff()
    step = float(np.nanmedian(steps)) if steps.notna().any() else float("nan")
    if not names or not step > 0:
        raise HistoryError(
            f"history {path}: its rows name no body, or their times do not go on; correct them, or"
            " give --body and --time-step instead"
        )
    return names, float(f"{step:.6g}")
