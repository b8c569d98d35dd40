"""``pbrl-ppl new``."""

from __future__ import annotations

import shlex
import shutil
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import jinja2
import numpy as np
import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.terminal import Result, check_file, in_a_line
from pbrl_ppl.errors import (
    HistoryError,
    LayoutError,
    OutputError,
    RecordingWarning,
    SceneError,
)
from pbrl_ppl.scene import WORLD, Actuator, Body, Joint, Recording, Scene, Shape, nearest, toml_of
from pbrl_ppl.state import STATE, VELOCITY, Floats
from pbrl_ppl.system.files import write_atomically, write_text

if TYPE_CHECKING:
    import pandas as pd

#: How ``--body`` writes an outline.
SHAPES = "box:0.9x0.55, circle:0.1 or polygon:0,2/-1,-1/1,-1, in m"


@dataclass(frozen=True)
class Recorded:
    """Bodies and time steps of a recording; by default of none.

    Parameters
    ----------
    names : tuple of str
        In order of appearance.
    time_step : float, optional
        Median time between a body's rows (s), to four digits.
    layout : Recording, optional
        How it is laid out; None where it is a history's.
    said : list of str
        What was seen in it.
    source : str
        Its name in messages.
    joints : tuple of Joint
        Hinges that it shows.
    actuators : tuple of Actuator
        Those of the one body that columns' names give away.
    """

    names: tuple[str, ...] = ()
    time_step: float | None = None
    layout: Recording | None = None
    said: Sequence[str] = ()
    source: str = ""
    joints: tuple[Joint, ...] = ()
    actuators: tuple[Actuator, ...] = ()


def recorded(
    paths: Sequence[Path],
    layout: Recording,
    outlined: Mapping[str, Shape],
    time_step: float | None,
    side: bool,
) -> Recorded:
    """Read bodies, time step and layout from a recording.

    Parameters
    ----------
    paths : sequence of Path
        The recording's files, or folders of them.
    layout : Recording
        What is known of its layout.
    outlined : mapping of str to Shape
        Bodies from options, for a recording that names none.
    time_step : float, optional
        Time between rows (s), for a recording without times.
    side : bool
        Whether it was seen from the side: what falls tells whether the clock is right.

    Raises
    ------
    HistoryError
        If it cannot be read, names no body and no pose or speed, or its times do not rise.
    """
    import pandas as pd

    from pbrl_ppl import history as histories

    asked, name, said = layout, histories.in_words(paths), list[str]()
    source = f"history {name}"
    logs = histories.logs_in(paths, layout)
    frames = histories.read_tables(logs, layout)
    plain = layout == Recording() and all(map(histories.is_history, frames))
    commands = [histories.read_commands(log, layout) for log in logs]
    frame = histories.joined(frames)
    if not plain:
        layout = histories.with_guesses(frame, commands[0], layout, said.append)
        histories.check_states(frame, layout, source)
    names = _names(frame, dict(layout.columns), outlined, source)
    disc = Shape.circle(1.0)  # later commands read it with the scene; any outline will do here
    shapes = {name: outlined.get(name, disc) for name in names}
    scene = Scene(time_step=time_step or 1.0, bodies=tuple(Body(name, disc) for name in names))
    timed = {"time", "duration"} & {*dict(layout.columns), *frame.columns} or layout.time
    if not plain and time_step is None and not timed:
        raise HistoryError(
            f"{source}: it has no column time; say which it is (--columns time=COLUMN, or"
            " duration=COLUMN for times since the row before), or give --time-step"
        )
    parts = [*zip(frames, logs, commands, strict=True)]
    table, layout = _read_with_cures(parts, scene, layout, said, plain=plain)
    table["time"] = pd.to_numeric(table["time"], errors="coerce")
    step = _time_step(table, commands[0], layout, said, source, time_step)
    hung, swinging, shown = _hinges(table, shapes)
    joints, acting = (*hung, *swinging), tuple[Actuator, ...]()
    proposed, seen = histories.propose(table, layout, step, jumps=not swinging)
    shown = [*seen, *shown]
    if not plain and len(names) == 1:
        acting = histories.guessed_actuators(frame, proposed, shapes[names[0]], bool(joints))
    if sent := [one.column or one.name for one in acting]:
        shown.append(f"commands by their names: {', '.join(sent)}; correct [[actuator]]")
    falls = side and not (joints or sent)
    scene = scene.replace(time_step=step, gravity=(0.0, -9.81 * falls))
    found, units, computed = _cures(paths, frame, scene, None if plain else proposed)
    computed |= plain and any(name in STATE[VELOCITY:] for name in units)  # whose units are SI's
    cured = replace(asked, velocities="computed") if computed else asked
    if not plain and (time_step is None or "time" not in units):  # else the step is the user's
        cured = cured.with_entries(units=units)
    if cured != asked:
        again = recorded(paths, cured, outlined, time_step, side)
        return replace(again, said=[*found, *again.said])
    shown += found
    left = () if plain else histories.unused_columns(frame, proposed)
    if unused := [name for name in left if name not in sent]:
        shown.append(f"columns that are not used: {', '.join(unused)}")
    layout_found = None if plain and not shown else proposed
    return Recorded(tuple(names), step, layout_found, [*said, *shown], name, joints, acting)


def _read_with_cures(
    parts: Sequence[tuple[pd.DataFrame, Path, pd.DataFrame | None]],
    scene: Scene,
    layout: Recording,
    said: list[str],
    *,
    plain: bool,
) -> tuple[pd.DataFrame, Recording]:
    """Return logs, each a table, path and commands, as a history's table, and the layout needed.

    What was proposed and repaired is added to ``said``, each once, without the names of logs.
    """

    def say(message: object) -> None:
        text = str(message)
        for _, log, _ in parts:
            text = text.removeprefix(f"history {log}: ")
        if text not in said:
            said.append(text)

    while True:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RecordingWarning)
            try:
                table = _as_history(parts, scene, None if plain else layout)
            except LayoutError as proposal:
                say(proposal)
                before, layout = layout, layout.with_entries(**proposal.entries)
                if layout == before:
                    raise
                continue
        for warning in caught:
            say(warning.message)
        return table, layout


def _as_history(
    parts: Sequence[tuple[pd.DataFrame, Path, pd.DataFrame | None]],
    scene: Scene,
    layout: Recording | None,
) -> pd.DataFrame:
    """Return the tables of logs, each with its commands, as one with a history's columns."""
    from pbrl_ppl import history as histories

    tables = []
    for frame, log, commands in parts:
        source = f"history {log}"
        table = histories.as_history(frame, scene, source, layout, commands=commands)
        for name in ("trajectory", "body"):
            if name not in table:
                raise HistoryError(
                    f"{source}: it has no column {name}; say which it is (--columns {name}=COLUMN)"
                )
        tables.append(table)
    return histories.joined(tables)


def _time_step(
    table: pd.DataFrame,
    commands: pd.DataFrame | None,
    layout: Recording,
    said: list[str],
    source: str,
    given: float | None,
) -> float:
    """Return the time step: as given, or the median one, or that of slower commands.

    A command that is late by less than its own interval is late by a part of one time step.
    """
    from pbrl_ppl.history import command_step

    # pandas 2 warns of a median of missing values alone
    step = float(table.groupby(["trajectory", "body"])["time"].diff().dropna().median())
    if not step > 0:
        raise HistoryError(
            f"{source}: its times do not rise from row to row of a body and trajectory;"
            " correct them, or give --time-step; times since the row before are a column duration"
        )
    step = float(f"{step:.4g}")
    slower = 0.0 if commands is None else command_step(commands, layout)
    if given or slower < 2 * step:
        return given or step
    said.append(
        f"rows are {step:g} s apart and commands {slower:g} s: time_step is the commands', so that"
        " a delay of theirs is a part of it"
    )
    return slower


def _cures(
    paths: Sequence[Path], frame: pd.DataFrame, scene: Scene, layout: Recording | None
) -> tuple[list[str], dict[str, str], bool]:
    """Return what is wrong with units and velocities of a recording, and the entries that cure it.

    Nothing is said of a recording that cannot be read yet.
    """
    from pbrl_ppl import history as histories

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            history = histories.History.load(paths, scene.replace(recording=layout))
        except HistoryError:  # later commands say it
            return [], {}, False
    present = histories.present_units(frame, layout or Recording())
    return histories.layout_cures(history, scene, present)


def _hinges(
    table: pd.DataFrame, shapes: Mapping[str, Shape]
) -> tuple[list[Joint], list[Joint], list[str]]:
    """Return the hinges that measurements of bodies show, and sentences on them.

    Bodies of which angles alone were measured hang in a chain, each by its upper end, circles by
    their centre. Others swing on a circle, and their angle was not measured.
    """
    measured = table.reindex(columns=[*STATE]).notna().groupby(table["body"]).any()
    turns = measured[["theta", "omega"]].any(axis=1)
    alone = turns & ~measured[["x", "y", "vx", "vy"]].any(axis=1)
    names = [name for name in shapes if alone.get(name, False)]
    hung, swinging, said = list[Joint](), list[Joint](), list[str]()
    above, end = WORLD, (0.0, 0.0)
    for name in names:
        *_, low, high = shapes[name].bounds
        top = 0.0 if shapes[name].kind == "circle" else high
        hung.append(Joint("hinge", (name, above), (0.0, top), end))
        above, end = name, (0.0, low)
    if names:
        said.append(
            f"only the angle of {' and '.join(names)} was measured: hung by the upper end"
            " (a circle, as a wheel, by its centre); correct the places of [[joint]]"
        )
    for name, track in table.reindex(columns=["x", "y"]).groupby(table["body"]):
        if measured["theta"][name] or not (circle := _circle(track.to_numpy(float))):
            continue
        x, y, radius = circle
        swinging.append(Joint("hinge", (str(name), WORLD), (0.0, radius), (x, y)))
        said.append(
            f"{name} swings on a circle of {radius:g} m about ({x:g}, {y:g}): hung on a hinge there"
        )
    return hung, swinging, said


def _circle(track: Floats, round_: float = 0.02) -> tuple[float, float, float] | None:
    """Return the centre and radius (m) of a circle that a track swings on, or None.

    It goes back and forth over at least half a radian, off the circle by ``round_`` of its radius
    at most (root mean square).
    """
    track = track[np.isfinite(track).all(axis=1)]
    if len(track) < 20:
        return None
    matrix = np.column_stack([track, np.ones(len(track))])
    (a, b, c), *_ = np.linalg.lstsq(matrix, (track**2).sum(axis=1), rcond=None)
    centre, square = np.array([a, b]) / 2, c + (a**2 + b**2) / 4
    if square <= 0:
        return None
    radius = float(np.sqrt(square))
    arm = track - centre
    off = float(np.sqrt(np.mean((np.linalg.norm(arm, axis=1) - radius) ** 2)))
    angle = np.unwrap(np.arctan2(arm[:, 1], arm[:, 0]))
    crossings = int((np.diff(np.sign(angle - np.median(angle))) != 0).sum())
    if off > round_ * radius or np.ptp(angle) < 0.5 or (crossings < 4 and np.ptp(angle) < 12.0):
        return None
    digits = int(np.ceil(-np.log10(max(off, 1e-6)))) + 1
    return round(float(centre[0]), digits), round(float(centre[1]), digits), round(radius, digits)


def _names(
    frame: pd.DataFrame, columns: Mapping[str, str | float], outlined: Iterable[str], source: str
) -> list[str]:
    """Return names of bodies: of columns side by side, of a column, one name, or as outlined."""
    beside = dict.fromkeys(key.rpartition(".")[0] for key in columns if "." in key)
    column = columns.get("body", "body")
    names = list(beside)
    if not beside and column in frame:
        texts = (str(name).strip() for name in frame[column].dropna().unique())
        names = [text for text in texts if text]
    elif not beside and str(column) == columns.get("body"):
        names = [str(column)]
    names = names or list(outlined)
    if not names:
        raise HistoryError(
            f"{source}: no column has the bodies' names; give --body NAME=SHAPE for one body,"
            " --columns body=COLUMN, or --columns NAME.x=COLUMN,... for bodies side by side"
        )
    return names


#: Where models/ is in an installed package, and in a clone.
_MODELS = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "models")


@command("new", 1, "pbrl-ppl new scene.toml --history train.csv --body cart=box:0.9x0.55")
def new(
    *,
    scene: Annotated[Path, typer.Argument()] = Path("scene.toml"),
    bodies: Annotated[list[str] | None, typer.Option("--body")] = None,
    side: Annotated[bool | None, typer.Option("--side/--top")] = None,
    time_step: Annotated[float | None, typer.Option(min=0.0)] = None,
    history: list[Path] | None = None,
    columns: options.Columns,
    commands: str = "",
    topics: Annotated[list[str] | None, typer.Option("--topic")] = None,
    model: Annotated[str | None, typer.Option("--from")] = None,
    overwrite: bool = False,
    quiet: bool,
) -> Result:
    """Write a commented scene, from options and a recording; or copy a model.

    Joints, walls, wheels and what is known of a body are in the scene as examples to uncomment.
    Models to copy: apartment, namo, pendulum and shopping_cart; recordings that a model has go
    beside the scene.

    Parameters
    ----------
    scene : SCENE
        The file to write.
    bodies : NAME=SHAPE
        A body and its outline: box:0.9x0.55, circle:0.1 or polygon:0,2/-1,-1/1,-1, in m.
    side
        Seen from the side (gravity acts in y), or from above.
    time_step
        Time between rows of the history (s).
    history : HISTORY
        A recording: has the bodies' names and the time step. A folder of files, or several files
        (repeat the option), are one.
    commands : FILE
        Commands with times of their own, beside the history.
    topics : NAME=TOPIC,...
        Topics of a body in a ROS bag: cart=/odom.
    model : MODEL
        Copy a model that comes with the package.
    """
    check_file(scene, (".toml",), overwrite)
    named = columns.layout()
    layout = Recording(commands=commands).with_entries(**named, topics=_topics(topics))
    given = (bodies, time_step, history, columns.columns, columns.units)
    if model is not None and (side is not None or any(given)):
        raise SceneError("--from copies a model as it is: omit the other options, or omit --from")
    if not history and (columns.columns or columns.units or commands):
        raise SceneError(
            "--columns, --units and --commands say how a recording is read: add --history"
        )
    recording = Recorded()
    if model is not None:
        written = _copied(model, scene, overwrite)
    else:
        shapes = outlines(bodies or [])
        if history:
            recording = recorded(history, layout, shapes, time_step, bool(side))
        shapes, time_step = _complete(shapes, time_step, recording)
        text = scene_text(shapes, bool(side), time_step, recording)
        Scene.from_toml(text)  # written whole and valid, or not at all
        write_text(scene, text)
        written = [scene]
    shown = [f"wrote {path}" for path in written]
    logs = history or ([written[-1]] if len(written) > 1 else [])
    shown += [f"{recording.source}: {sentence}" for sentence in recording.said]
    if model is None:
        shown += [f"joints, walls, wheels, known masses: uncomment them in {scene}"]
    next_command = ["pbrl-ppl", "check", str(scene), *map(str, logs or [Path("history.csv")])]
    begin = "next" if logs else "next, with your recording"
    shown += [f"{begin}: {shlex.join(next_command)}"]
    return Result({"scene": scene, "written": written}, () if quiet else shown)


def _topics(texts: list[str] | None) -> dict[str, tuple[str, ...]]:
    """Return the topics of each body from ``--topic NAME=TOPIC,...``."""
    topics = {}
    for text in texts or ():
        name, _, listed = text.partition("=")
        if not (name and listed):
            raise SceneError(f"--topic: {text!r} is not NAME=TOPIC, such as cart=/odom")
        topics[name] = tuple(listed.split(","))
    return topics


def models_folder() -> Path:
    """Return the folder of the models that come with the package.

    Raises
    ------
    OutputError
        If it is not there.
    """
    folder = next((path for path in _MODELS if path.is_dir()), None)
    if folder is None:
        raise OutputError("the models are not installed with this package; clone it")
    return folder


def _copied(model: str, scene: Path, overwrite: bool) -> list[Path]:
    """Copy a model's scene, and its recordings beside it."""
    folder = models_folder()
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
        write_atomically(path, partial(shutil.copyfile, source))
    return list(copies)


def _complete(
    given: Mapping[str, Shape], time_step: float | None, found: Recorded
) -> tuple[dict[str, Shape], float]:
    """Return shapes and time step, from options and a recording that give all of them."""
    names = [*(found.names or given)]
    time_step = found.time_step if time_step is None else time_step
    for name in given:
        if name not in names:
            raise SceneError(
                f"--body: the history has no rows of {name!r}, only of {', '.join(names)}"
            )
    lacking = [f"--body {name}={SHAPES}" for name in names or ["NAME"] if name not in given]
    lacking += ["--time-step"] if time_step is None else []
    if lacking or time_step is None:
        raise SceneError(f"new: options are missing; give {', '.join(lacking)}")
    return {name: given[name] for name in names}, time_step


def scene_text(shapes: Mapping[str, Shape], side: bool, time_step: float, found: Recorded) -> str:
    """Return a commented scene as TOML.

    Bodies of which angles alone were measured hang in a chain, each by its upper end.

    Examples
    --------
    >>> text = scene_text(outlines(["cart=box:0.9x0.55"]), False, 0.1, Recorded())
    >>> Scene.from_toml(text).moving[0].shape
    Shape(kind='box', size=(0.9, 0.55), radius=None, vertices=None)
    """
    actuators = [replace(one, body=next(iter(shapes))) for one in found.actuators]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pbrl_ppl", "cli"), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    return environment.get_template("scene.toml.jinja").render(
        shapes={name: vars(shape) for name, shape in shapes.items()},
        side=side, time_step=time_step, joints=found.joints,
        actuators=actuators, recording=found.layout, said=map(in_a_line, found.said),
        entry=lambda key, value: toml_of([("", {key: value})]).strip(),
    )  # fmt: skip


def outlines(texts: Iterable[str]) -> dict[str, Shape]:
    """Return shapes by name from ``NAME=box:LENGTHxWIDTH`` and the like.

    Examples
    --------
    >>> outlines(["arm=box:0.03x0.2"])["arm"].size
    (0.03, 0.2)
    """
    shapes: dict[str, Shape] = {}
    for text in texts:
        name, _, outline = text.rpartition("=")
        kind, _, rest = outline.partition(":")
        if name in shapes:
            raise SceneError(f"--body: {name!r} is given twice; leave one out")
        try:
            if not name:
                raise ValueError
            if kind == "box":
                width, height = map(float, rest.split("x"))
                shapes[name] = Shape.box(width, height)
            elif kind == "circle":
                shapes[name] = Shape.circle(float(rest))
            elif kind == "polygon":
                corners = [corner.split(",") for corner in rest.split("/")]
                shapes[name] = Shape.polygon([(float(x), float(y)) for x, y in corners])
            else:
                raise ValueError
        except SceneError:  # of a shape's numbers
            raise
        except ValueError:
            raise SceneError(
                f"--body: {text!r} is not NAME=SHAPE with a shape such as {SHAPES}"
            ) from None
    return shapes
