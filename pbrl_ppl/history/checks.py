"""Recordings as commands read them: with warnings of wrong units, angles, clocks and commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

import numpy as np

from pbrl_ppl.errors import warn
from pbrl_ppl.history.bad_frames import trimmed, unmodelled_ends
from pbrl_ppl.history.conversion import TableReading
from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import GAUSSIAN, column_noise, hung_bodies
from pbrl_ppl.history.logs import Paths, in_words
from pbrl_ppl.history.measures import TIME, unit_size, zero_angle
from pbrl_ppl.history.units import rate_factor, unit_mismatches, units_that_differ
from pbrl_ppl.history.velocities import unused_velocities
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import THETA, VELOCITY, Floats, wrapped


def read_scene(
    path: Path,
    *,
    noise: Mapping[str, float] | None = None,
    substeps: int | None = None,
    time_step: float | None = None,
) -> Scene:
    """Return the scene of a file, with other settings where they are given."""
    scene = Scene.load(path)
    given = {"substeps": substeps, "time_step": time_step}
    others = {name: value for name, value in given.items() if value is not None}
    return scene.replace(noise=dict(scene.noise) | dict(noise or {}), **others)


def read_recording(
    path: Paths, scene: Scene, *, trim: bool = False, **reading: Unpack[TableReading]
) -> History:
    """Return the history of files as `History.load` does, and warn of what looks wrong.

    Warns where velocities and changes of positions differ by the factor of a unit, and of rows at
    trajectory ends that belong to no model. With ``trim``, here or in the scene's ``[recording]``,
    these are left out. A warning names four of them.
    """
    history = History.load(path, scene, **reading)
    path = in_words(path)
    for sentence in (*unit_mismatches(history), *angle_warnings(history, scene)):
        warn(f"history {path}: {sentence}", UserWarning)
    ends = unmodelled_ends(history, scene)
    if not ends:
        return history
    trim = trim or (scene.recording is not None and scene.recording.trim)
    named = "; ".join(map(str, ends[:4]))
    more = f"; and {len(ends) - 4} more" if len(ends) > 4 else ""
    cure = "left out" if trim else "no command or contact explains it: --trim leaves the rows out"
    warn(f"history {path}: {named}{more}: {cure}", UserWarning)
    return trimmed(history, ends) if trim else history


def layout_cures(
    history: History, scene: Scene, present: Mapping[str, str]
) -> tuple[list[str], dict[str, str], bool]:
    """Return what is wrong with a recording's units and velocities, and the entries that cure it.

    Parameters
    ----------
    history, scene : History, Scene
        What was measured; the scene's gravity and free bodies tell a wrong clock.
    present : mapping of str to str
        Units in which columns were read, if not SI units.

    Returns
    -------
    said : list of str
        A sentence on each finding.
    units : dict of str to str
        Those that cure it.
    computed : bool
        Whether velocities are best left out.
    """
    said, units, computed = angle_warnings(history, scene), dict[str, str](), False
    if clock := wrong_clock(history, scene):
        return [clock.sentence(scene)], {"time": clock.unit(present.get("time", "s"))}, False
    alone = len(history.bodies) == 1
    for (body, _), (sentence, cures) in units_that_differ(history).items():
        said.append(sentence)
        cured = {k if alone else f"{history.bodies[body]}.{k}": v for k, v in cures.items()}
        units |= {key: unit for key, unit in cured.items() if key not in present}
    unused = unused_velocities(history)
    rates = history.dataset["observed"].isel(state=slice(VELOCITY, None))
    measured = int(rates.notnull().any(("trajectory", "time")).sum())
    for velocity in unused:
        said.append(velocity.sentence)
        if velocity.fault and velocity.fault.factor:
            key = velocity.state if alone else f"{velocity.body}.{velocity.state}"
            size = unit_size(velocity.state, present[key]) if key in present else 1.0
            units[key] = velocity.unit(size or 1.0)
        else:  # of computed and late ones others may be good
            computed |= velocity.fault is not None or len(unused) == measured
    return said, units, computed


def angle_warnings(history: History, scene: Scene) -> list[str]:
    """Return a sentence on each body whose angle looks like one of another convention.

    Parameters
    ----------
    history : History
        What was measured.
    scene : Scene
        Has gravity and the hinges.

    Examples
    --------
    ::

        angle_warnings(history, scene)
        ["theta of arm swings to both sides by 23 rad: looks like deg: units = { theta = "deg" }"]
    """
    sentences = []
    hung = hung_bodies(scene)
    for i, body in enumerate(scene.moving):
        states = history.dataset["observed"].to_numpy()[:, :, i]
        action = np.nan_to_num(history.dataset["action"].to_numpy()[:, :, i])
        angles = [run[np.isfinite(run)] for run in states[..., THETA]]
        angles = [run for run in angles if len(run) > 8]
        if not angles:
            continue
        if sentence := _degrees(angles, hinged=body.name in hung and bool(any(scene.gravity))):
            sentences.append(f"theta of {body.name} {sentence}")
        elif (rate_factor(states, THETA, scene.time_step) or 0.0) < 0:
            sentences.append(
                f"theta of {body.name} falls where omega is positive, and rises where it is"
                ' negative: one of them is clockwise: theta = "-COLUMN" in columns'
            )
        elif body.name in hung[:1] and any(scene.gravity) and not action.any():
            rest = _rest(angles)
            off = float(wrapped(np.asarray(rest - zero_angle(scene, body.name, "hanging"))))
            if abs(off) > 0.5:
                sentences.append(
                    f"{body.name} comes to rest {np.degrees(off):.0f} degrees from hanging: say"
                    " what the angle's zero is: theta = { column = ..., zero = ... } in columns,"
                    ' "hanging", "horizontal", "upright" or the number of the column at theta 0'
                )
    return sentences


def _degrees(angles: list[Floats], *, hinged: bool, counts: float = 1440.0) -> str:
    """Return why angles in rad look like degrees or counts; empty if they do not.

    Whole numbers that range over more than ``counts`` are no angles in rad or degrees.
    """
    steps = np.concatenate([np.abs(np.diff(run)) for run in angles])
    every = np.concatenate(angles)
    if (every == np.round(every)).all() and np.ptp(every) > counts:
        return (
            f"goes from {every.min():.6g} to {every.max():.6g} rad in whole numbers: looks like"
            ' counts: say how many there are to a turn: units = { theta = "8192/turn" }'
        )
    wraps = (steps > 340.0) & (steps < 360.5)
    if wraps.any() and np.median(steps) < 36.0:
        return 'jumps by 360 between rows: looks like deg: units = { theta = "deg" }'
    middle = float(np.median(every))
    size = float(np.quantile(np.abs(every - middle), 0.9))
    turned = np.ptp(every) > 2.0 * np.pi  # not an angle in rad that wraps at 0 or half a turn
    crossings = sum(int((np.diff(np.sign(run - middle)) != 0).sum()) for run in angles)
    if hinged and turned and np.pi < size <= 180.0 and crossings >= 4 and _hangs(angles):
        return (
            f'swings to both sides by {size:.2g} rad: looks like deg: units = {{ theta = "deg" }}'
        )
    return ""


def _hangs(angles: list[Floats], better: float = 2.0) -> bool:
    """Return whether angles accelerate as a pendulum's do in degrees, not as in radians.

    Differences are over as many rows as either explains best: of few they are noise.

    ``better``: by this factor of the squared residual.
    """
    left = [(np.inf, np.inf)]
    for lag in (1, 2, 4, 8, 16):
        long = [run for run in angles if len(run) > 2 * lag + 4]
        parts = [(run[: -2 * lag], run[lag:-lag], run[2 * lag :]) for run in long]
        if not parts:
            break
        before, place, after = (np.concatenate(part) for part in zip(*parts, strict=True))
        y, ahead = before - 2.0 * place + after, after - before
        rest = []
        for turn in (place, np.radians(place)):
            design = np.column_stack([np.sin(turn), np.cos(turn), ahead, np.ones(len(y))])
            off = y - design @ np.linalg.lstsq(design, y, rcond=1e-9)[0]
            rest.append(float(off @ off) / max(float(y @ y), 1e-300))
        left.append((rest[0], rest[1]))
    radians, degrees = min(left, key=min)
    return radians > better * degrees


def _rest(angles: list[Floats], steady: float = 0.05) -> float:
    """Return the angle that trajectories end at, at rest; NaN where they do not."""
    ends = [run[-max(len(run) // 10, 4) :] for run in angles]
    both = zip(angles, ends, strict=True)
    places = [float(np.median(end)) for run, end in both if np.ptp(end) < steady * np.ptp(run)]
    return float(np.median(places)) if places and np.ptp(places) < 0.3 else float("nan")


@dataclass(frozen=True)
class WrongClock:
    """A clock that runs too fast or too slow, by the fall of a body.

    Attributes
    ----------
    body : str
        Name of the body.
    acceleration : float
        The body's along gravity (m/s^2).
    factor : float
        How many seconds the clock counts in a second.

    Examples
    --------
    >>> clock = WrongClock("ball", 0.153, 8.0)
    >>> clock.unit(), clock.unit("ms"), clock.unit("240/s")
    ('8/s', '8/ms', '1920/s')
    """

    body: str
    acceleration: float
    factor: float

    def unit(self, present: str = "s") -> str:
        """Return the unit of time that cures it, from the unit in which the times were read."""
        number, _, unit = present.rpartition("/")
        unit = unit if number or unit in TIME else "s"
        return f"{self.factor * float(number or 1):.10g}/{unit}"

    def sentence(self, scene: Scene) -> str:
        """Return what the fall shows, and the entries of the scene that cure it."""
        units = dict(scene.recording.units) if scene.recording else {}
        pace = self.factor if self.factor > 1 else 1 / self.factor
        square = f"1/{pace**2:g}" if self.factor > 1 else f"{pace**2:g} times"
        return (
            f"{self.body} falls with {self.acceleration:.3g} m/s^2, {square} that of gravity: the"
            f" clock runs {pace:g} times too {'fast' if self.factor > 1 else 'slow'}, as of a film"
            f' at another frame rate: units = {{ time = "{self.unit(units.get("time", "s"))}" }} in'
            f" [recording] and time_step = {scene.time_step / self.factor:.6g} in [world]"
        )


def wrong_clock(history: History, scene: Scene) -> WrongClock | None:
    """Return how a body's free fall contradicts the clock; None where it does not, or none falls.

    A body falls freely that is on no joint, is sent no command and has no actuator. Its
    acceleration along gravity is regressed on the drag of its motion; impacts are left out. It must
    be within 15 % of gravity over the square of a ratio, with a standard error of less than 10 %.

    Parameters
    ----------
    history : History
        What was measured.
    scene : Scene
        Has gravity, and says which bodies are free.
    """
    gravity = float(np.hypot(*scene.gravity))
    held = {name for joint in scene.joints for name in joint.bodies or ()}
    if not gravity or any(joint.bodies is None for joint in scene.joints):
        return None
    down = np.array(scene.gravity) / gravity
    for body in scene.dynamic:
        data = history.dataset.sel(body=body.name)
        sent = np.nan_to_num(data["action"].to_numpy())
        if body.name in held or scene.actuators_of(body.name) or sent.any():
            continue
        fall, error = _fall(data["observed"].to_numpy()[..., :2], down, scene.time_step)
        # ratios of the frame rates of a camera and of its film
        ratios = [ratio**sign for ratio in (2.0, 4.0, 8.0, 10.0) for sign in (1, -1)]
        factor = min(ratios, key=lambda one: abs(np.log(max(fall, 1e-300) * one**2 / gravity)))
        if abs(fall * factor**2 / gravity - 1) < 0.15 and error < 0.1 * fall:
            return WrongClock(body.name, fall, factor)
    return None


def _fall(places: Floats, down: Floats, dt: float, *, clear: float = 0.05) -> tuple[float, float]:
    """Return the acceleration along ``down`` (m/s^2) and its standard error.

    ``places`` has the shape (trajectory, time, 2).

    Differences are over as many rows as it takes for noise to be the share ``clear`` of them.
    """
    places = np.nan_to_num(places) if np.isnan(places).all(axis=(0, 1)).sum() == 1 else places
    along = places @ down
    noise, lag = column_noise(along, robust=True), 1
    while True:
        change = along[:, 2 * lag :] - 2 * along[:, lag:-lag] + along[:, : -2 * lag]
        seen = np.abs(change[np.isfinite(change)])
        if len(seen) < 8:
            return 0.0, np.inf
        if np.median(seen) > np.sqrt(6.0) * noise / clear or 12 * lag > along.shape[1]:
            break
        lag *= 2
    velocity = (places[:, 2 * lag :] - places[:, : -2 * lag]) / (2 * lag * dt)
    ahead, speed = velocity @ down, np.linalg.norm(velocity, axis=-1)
    design = np.stack([np.ones_like(ahead), ahead, speed * ahead], axis=-1).reshape(-1, 3)
    y = change.ravel() / (lag * dt) ** 2
    kept = np.isfinite(y) & np.isfinite(design).all(axis=1)
    best = np.zeros(3)
    for _ in range(4):  # impacts are far from the rest
        if kept.sum() < 8:
            return 0.0, np.inf
        x = design[kept] / np.maximum(np.abs(design[kept]).max(axis=0), 1e-300)
        best, *_ = np.linalg.lstsq(x, y[kept], rcond=1e-9)
        rest = y[kept] - x @ best
        size = GAUSSIAN * float(np.median(np.abs(rest)))
        within = np.abs(rest) <= max(4.0 * size, 1e-9)
        # white noise leaves differences of neighbouring rows independent
        error = float(np.sqrt(2.0 * np.mean(rest**2) * np.linalg.pinv(x.T @ x)[0, 0]))
        kept[kept] = within
        if within.all():
            break
    return float(best[0]), error


def command_shifts(history: History, scene: Scene) -> dict[str, int]:
    """Return by how many rows bodies answer commands later than they were logged.

    Accelerations are regressed on the commands of each shift, on positions, speeds and a constant.
    A shift counts if it explains far more than any other (30 nats), and if the commands of the rows
    beside it explain hardly more: a delay by a part of a row, or a lag, is a law of an actuator.

    Parameters
    ----------
    history, scene : History, Scene
        What was measured, and where commands act.

    Returns
    -------
    dict of str to int
        Rows by body, negative where a body moves before the command; those without are left out.
    """
    hung, found = hung_bodies(scene), {}
    for body in scene.dynamic:
        data = history.dataset.sel(body=body.name)
        pose = data["observed"].to_numpy()[..., :3].astype(float)
        angle = pose[..., THETA]
        pose[..., THETA] = np.where(np.isfinite(angle), np.unwrap(np.nan_to_num(angle)), np.nan)
        sent = data["action"].to_numpy().astype(float)
        for d in (THETA,) if body.name in hung else range(3):
            pushes = _pushes(scene, body.name, pose, sent, d)
            if shift := _shift(pose[..., d], pushes, turns=d == THETA):
                found[body.name] = shift
                break
    return found


def shift_sentence(scene: Scene, body: str, rows: int) -> str:
    """Return how commands are shifted, with the entry that moves them back."""
    clocks = dict(scene.recording.time) if scene.recording else {}
    offset = float(clocks.get("offset", 0.0)) + rows * scene.time_step
    named = f'commands = "{clocks["commands"]}", ' if "commands" in clocks else ""
    count = f"{abs(rows)} row{'s' * (abs(rows) > 1)}"
    cause = f"before its commands: they were logged {count} late"
    if rows > 0:
        cause = f"after its commands: they were logged {count} early, or an actuator delays them"
    return (
        f"{body} moves {count} {cause}: time = {{ {named}offset = {offset:.6g} }} in [recording]"
        " moves them"
    )


def _pushes(scene: Scene, name: str, pose: Floats, sent: Floats, d: int) -> Floats:
    """Return the commands that may accelerate a dimension, shape (command, trajectory, time)."""
    actuators = scene.actuators_of(name)
    if not actuators:
        return sent[..., d][None]
    along = [column for column, one in zip(np.moveaxis(sent, -1, 0), actuators, strict=False)
             if one.kind != "servo"]  # fmt: skip
    if d == THETA or not along:
        return np.array(along).reshape(len(along), *sent.shape[:-1])
    angle = pose[..., THETA]
    parts = (np.cos(angle), np.sin(angle)) if np.isfinite(angle).any() else (np.ones_like(angle),)
    return np.array([part * column for part in parts for column in along])


def _shift(place: Floats, pushes: Floats, *, turns: bool, most: int = 3) -> int:
    """Return the shift by at most so many rows that is clear and of whole rows; 0 without one."""
    n = place.shape[1]
    if not len(pushes) or n < 4 * most + 2:
        return 0
    rows = np.arange(most + 1, n - most - 2)
    here, before, after = place[:, rows], place[:, rows - 1], place[:, rows + 1]
    y = (after - 2 * here + before).ravel()
    rest = [np.ones_like(y), here.ravel(), (after - before).ravel()]
    if turns:
        rest += [np.sin(here).ravel(), np.cos(here).ravel()]
    moved = {
        s: np.stack([(p[:, rows - 1 - s] + p[:, rows - s]).ravel() for p in pushes], axis=1)
        for s in range(-most - 1, most + 2)
    }
    whole = np.column_stack([y, *rest, *moved.values()])
    kept = np.isfinite(whole).all(axis=1)
    if kept.sum() < 40 or not any(np.ptp(one[kept], axis=0).any() for one in moved.values()):
        return 0
    base = np.stack([column[kept] for column in rest], axis=1)
    base = base / np.maximum(np.abs(base).max(axis=0), 1e-300)

    def fit(*shifts: int) -> tuple[float, Floats]:
        x = np.column_stack([base, *(moved[s][kept] for s in shifts)])
        best, *_ = np.linalg.lstsq(x, y[kept], rcond=1e-9)
        off = y[kept] - x @ best
        size = max(float(off @ off), 1e-18 * float(y[kept] @ y[kept]), 1e-300)
        return -0.5 * len(off) * np.log(size), best[base.shape[1] :]

    each = {s: fit(s)[0] for s in range(-most, most + 1)}
    best = max(each, key=each.__getitem__)
    joint, found = fit(best - 1, best, best + 1)
    weights = found.reshape(3, -1)
    size = weights[:, int(np.abs(weights[1]).argmax())]
    off = float((size[2] - size[0]) / size.sum()) if size.sum() else np.inf
    is_clear = each[best] - max(size for s, size in each.items() if s != best) >= 30.0
    is_whole = abs(off) <= 0.15 and joint - each[best] <= 0.1 * (each[best] - each[0])
    return best if is_clear and is_whole else 0
