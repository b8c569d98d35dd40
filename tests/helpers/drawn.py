"""Valid recordings of scenes drawn at random, as files: `drawn_case` by seed, and a strategy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from hypothesis import strategies as st

from pbrl_ppl.effects import attach
from pbrl_ppl.errors import EffectError, HistoryError, SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.parameters import inside
from pbrl_ppl.physics import Physics, check_placement, simulated_recording
from pbrl_ppl.scene import Recording, Scene
from pbrl_ppl.state import POSE, STATE, WRENCH, Bools, Floats, wrapped
from tests.helpers.drawn_scenes import (
    Rng,
    World,
    applicable,
    coordinates,
    log_uniform,
    scene_with_sizes,
    world,
)  # fmt: skip

#: Column of a foreign table for each of a history.
NAMES = {"time": "stamp", "x": "px", "y": "py", "theta": "yaw", "vx": "px_dot", "vy": "py_dot",
         "omega": "yaw_rate", "force_x": "fx", "force_y": "fy", "torque": "tau"}  # fmt: skip
UNITS = {"time": {"s": 1.0, "ms": 1e-3}, "x": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
         "theta": {"rad": 1.0, "deg": np.pi / 180.0}}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A scene and a recording of it, as files."""

    seed: int
    scene: Scene
    table: pd.DataFrame | History
    suffix: str
    #: What was drawn, in words.
    about: str
    #: Arguments of ``pbrl-ppl plan``.
    plan: tuple[str, ...]
    #: Actions of ``pbrl-ppl plan`` (TOML); a recording in which nothing pushes proposes none.
    actions: str

    def write(self, folder: Path) -> str:
        """Write ``scene.toml``, ``actions.toml`` and the recording; return the latter's name."""
        (folder / "scene.toml").write_text(self.scene.to_toml())
        (folder / "actions.toml").write_text(self.actions)
        path = folder / f"train{self.suffix}"
        if isinstance(self.table, History):
            self.table.save(path)
        elif self.suffix == ".parquet":
            self.table.to_parquet(path, index=False)
        else:
            self.table.to_csv(path, index=False)
        return path.name


def cases(most: int = 2500) -> st.SearchStrategy[Case]:
    """Return the strategy of drawn cases with at most so many rows."""
    return st.integers(0, 2**31).map(lambda seed: drawn_case(seed, most))


def drawn_case(seed: int, most: int = 2500) -> Case:
    """Return the case of a seed, with at most ``most`` rows, rarely twice as many."""
    for attempt in range(50):  # a drawn start may be impossible, such as links in each other
        try:
            return _case(seed, np.random.default_rng([seed, attempt]), most)
        except (SimulationError, HistoryError):
            continue
    raise SimulationError(f"seed {seed}: 50 drawn scenes cannot be simulated")


def _case(seed: int, rng: Rng, most: int) -> Case:
    """Return a case, if what is drawn can be simulated."""
    drawn = world(rng)
    scene, about = drawn.scene, [drawn.kind]
    foreign = str(rng.choice(["", "long", "wide"], p=[0.5, 0.25, 0.25]))
    forces = "body" if foreign and rng.random() < 0.1 else "world"
    layout = Recording(forces=forces)
    commands = _commands(rng, drawn, most)
    about += [f"{commands.n_trajectories} trajectories", f"{commands.n_transitions} transitions",
              f"{1.0 / scene.time_step:.0f} Hz", f"{len(scene.bodies)} bodies"]  # fmt: skip
    with_forces = drawn if forces == "world" else replace(
        drawn, scene=scene.replace(recording=layout)
    )  # fmt: skip
    states, truth = _simulated(rng, with_forces, commands)
    about += truth
    measured, noise, told = _measured(rng, drawn, commands, states)
    about += told
    if noise and rng.random() < 0.3:
        scene = scene.replace(noise=noise)
    dataset = commands.dataset.copy()
    dataset["observed"] = dataset["observed"].copy(data=measured)
    dataset["clock"] = dataset["clock"] + float(rng.choice([0.0, 0.0, 12.5]))
    history = History(dataset)
    suffix = str(rng.choice([".csv", ".parquet", ".nc"], p=[0.7, 0.15, 0.15]))
    table: pd.DataFrame | History = history
    if foreign:
        table, layout, told = _foreign(rng, scene, history, foreign, layout)
        scene, suffix = scene.replace(recording=layout), suffix.replace(".nc", ".csv")
        about += [foreign, *told]
    elif suffix != ".nc" and rng.random() < 0.4:
        table = history.to_dataframe().drop(columns="step")
    plan, actions = _plan(drawn, states, bool(np.nan_to_num(commands.dataset["action"]).any()))
    return Case(seed, scene, table, suffix, ", ".join(about), plan, actions)


def _rows(rng: Rng, most: int) -> list[int]:
    """Return the numbers of rows of the trajectories."""
    total = log_uniform(rng, 30.0, most) if rng.random() < 0.96 else 2.0 * most
    n = int(np.clip(round(log_uniform(rng, 1.0, 40.0)), 1, max(1, total // 8)))
    rows = np.full(n, np.clip(total / n, 8, 3000))
    if rng.random() < 0.5:
        rows *= rng.uniform(0.3, 1.0, n)
    return np.maximum(rows, 8).astype(int).tolist()


def _commands(rng: Rng, world: World, most: int) -> History:
    """Return the first states and the commands of a recording."""
    scene, size, speed = world.scene, world.size, world.speed
    lengths = _rows(rng, most)
    n, longest, k = len(lengths), max(lengths), len(scene.moving)
    states = np.full((n, longest, k, len(STATE)), np.nan)
    spread = np.array([0.25 * size, 0.25 * size, 1.0, speed, speed, speed / size])
    for i, body in enumerate(scene.moving):
        how = coordinates(scene, body)
        start = np.clip(rng.standard_normal((n, len(STATE))), -2.0, 2.0) * spread
        held = [j for j in scene.joints if not j.known or j.kind == "distance"]
        if body.kinematic:
            _path(rng, world, states[:, :, i])
            continue
        if how == "hinged":
            start[:, 2] *= 0.8 if len(scene.joints) < 3 else 0.3
            start[:, [0, 1, 3, 4]] = np.nan
        elif how == "sliding":
            start[:, [1, 2, 4, 5]] = np.nan
        elif held:
            start[:] = (*(body.pose or (4.0 * size * i, 0.0, 0.0)), 0.0, 0.0, 0.0)
        else:
            start[:, 0] += 4.0 * size * i
            if body.name == "puck":  # beside the chain
                start[:, 0] += 6.0 * size
        states[:, 0, i] = start
    actions = np.zeros((n, longest, k, len(WRENCH)))
    if rng.random() < 0.75:
        actions = _wrenches(rng, world, n, longest)
    times = scene.time_step * np.arange(longest) + np.zeros((n, 1))
    for row, length in zip(times, lengths, strict=True):
        row[length:] = np.nan
    labels = [f"run {i}" for i in range(n)] if rng.random() < 0.2 else None
    return History.of_arrays(states, scene, actions, times, labels=labels)


def _path(rng: Rng, world: World, states: Floats) -> None:
    """Set the path of a body that pushes: from the left through the first body, in place."""
    time = world.scene.time_step * np.arange(states.shape[1])
    speed = world.speed * rng.uniform(0.2, 1.0, (len(states), 1))
    states[..., 0] = np.minimum(-2.0 * world.size + speed * time, 6.0 * world.size)
    states[..., 1] = 0.2 * world.size * rng.uniform(-1.0, 1.0, (len(states), 1))
    states[..., 2] = 0.0


def _wrenches(rng: Rng, world: World, n: int, longest: int) -> Floats:
    """Return commands, some of them zero, shape (trajectory, time, body, 3)."""
    scene = world.scene
    actions = np.zeros((n, longest, len(scene.moving), len(WRENCH)))
    lever = world.force * world.size
    hold = max(1, round(world.size / world.speed / scene.time_step))
    for i, body in enumerate(scene.moving):
        if body.kinematic or rng.random() < 0.2:
            continue
        sizes = np.array([world.force, world.force, 0.3 * lever]) * rng.uniform(0.1, 1.5)
        if scene.actuators_of(body.name):  # in units of the columns
            known = [dict(one.known) for one in scene.actuators_of(body.name)]
            sizes = np.array([1.0 if one else min(lever, 10.0) for one in known] + [0.0] * 3)[:3]
        elif coordinates(scene, body) == "hinged":
            sizes[:2] = 0.0
        sizes *= rng.random(3) < 0.7
        kind = rng.integers(3)
        count = -(-longest // hold)
        steps = rng.uniform(-1.0, 1.0, (n, count, 3)).repeat(hold, axis=1)[:, :longest]
        phase = rng.uniform(0.0, 6.0, (n, 1, 3)) + np.arange(longest)[:, None] / hold
        waves = (steps, np.sin(phase), np.sign(rng.uniform(-1.0, 1.0, (n, 1, 3))) + 0.0 * steps)
        actions[:, :, i] = sizes * waves[kind]
    return actions


def _simulated(rng: Rng, world: World, commands: History) -> tuple[Floats, list[str]]:
    """Return the states under drawn parameters and perhaps a hidden effect, and what is true."""
    scene = scene_with_sizes(world)
    hidden: tuple[str, str] | None = None
    if rng.random() < 0.5:
        body = scene.dynamic[rng.integers(len(scene.dynamic))]
        names = [name for name in applicable(scene, body) if name not in body.effects]
        hidden = (str(rng.choice(names)), body.name)
    told = ["declared " + " ".join(e for b in scene.bodies for e in b.effects)]
    for size in (1.0, 0.3, 0.03, 0.0):
        true = scene
        if hidden is not None and size > 0.0:
            bodies = [replace(b, effects=(*b.effects, hidden[0])) if b.name == hidden[1] else b
                      for b in scene.bodies]  # fmt: skip
            true = scene.replace(bodies=tuple(bodies))
        physics = Physics(true, attach(true))
        null = {label: value for each in physics.effects
                for label, value in zip(each.labels, each.effect.null, strict=False)}  # fmt: skip
        phi = []
        for label, prior in zip(physics.layout.labels, physics.layout.priors, strict=True):
            about = null.get(label, prior.centre)
            share = size * log_uniform(rng, 0.03, 1.0)
            drawn = float(prior.sample(rng, 1)[0])
            phi.append(about if prior.discrete else about + share * (drawn - about))
        values = inside(physics.layout.priors, np.array(phi))
        try:
            (states,) = simulated_recording(physics, values[None], commands)
            # a whip of thin links may leave them deeper in each other than a recording may have
            check_placement(true, states[np.isfinite(states).all(axis=(2, 3))])
        except (SimulationError, HistoryError, EffectError):
            continue
        real = np.isfinite(commands.dataset["clock"].to_numpy())
        if np.nanmax(np.abs(states[real])) < 1e4 * (1.0 + world.speed):
            name = f"hidden {hidden[0]}" if len(true.bodies) and hidden and size else "none hidden"
            return states, [*told, name]
    raise SimulationError("the drawn scene cannot be simulated")


def _measured(
    rng: Rng, world: World, commands: History, states: Floats
) -> tuple[Floats, dict[str, float], list[str]]:
    """Return what was measured, its noise by dimension, and what was done to it."""
    scene, told = world.scene, []
    kinematic = commands.dataset["kinematic"].to_numpy()
    place, rate = log_uniform(rng, 1e-4, 1e-2), log_uniform(rng, 1e-3, 3e-2)
    if scene.joints:
        place *= 0.1
    sd = np.array([place * world.size] * 2 + [place])
    sd = np.concatenate([sd, rate * world.speed * np.array([1.0, 1.0, 1.0 / world.size])])
    if rng.random() < 0.06:
        sd, told = 0.0 * sd, [*told, "exact"]
    noisy = states + ~kinematic[:, None] * sd * rng.standard_normal(states.shape)
    if rng.random() < 0.3:
        unit = world.size * log_uniform(rng, 1e-4, 1e-2) * np.ones(6)
        unit[2] = 2.0 * np.pi / rng.choice([360, 4096])
        unit[3:] = rate * world.speed * np.array([1.0, 1.0, 1.0 / world.size])
        noisy[:, :, ~kinematic] = (unit * np.round(noisy / unit))[:, :, ~kinematic]
        told.append("quantised")
    if rng.random() < 0.4:
        noisy[..., 2] = wrapped(noisy[..., 2])
    if rng.random() < 0.2:
        noisy[..., 2] = np.mod(noisy[..., 2], 2.0 * np.pi)
    if rng.random() < 0.05:
        noisy[..., 3:], told = 0.0, [*told, "velocities all zero"]
    seen = np.isfinite(states) & _columns(rng, world, told)
    if rng.random() < 0.2:
        seen &= rng.random(seen.shape) > rng.uniform(0.02, 0.3)
        told.append("empty cells")
    if rng.random() < 0.15:
        length = seen.shape[1]
        first = int(rng.integers(0, length))
        seen[:, first : first + max(1, length // 6), rng.integers(seen.shape[2])] = False
        told.append("a stretch not seen")
    seen[:, :, kinematic, :3] = True
    noise = {name: float(value) for name, value in zip(STATE, sd, strict=True) if value > 0}
    if noise and rng.random() < 0.5:
        noise = {name: noise[name] for name in rng.choice([*noise], 2, replace=False)}
    return np.where(seen, noisy, np.nan), noise, told


def _columns(rng: Rng, world: World, told: list[str]) -> Bools:
    """Return which state dimensions of which bodies are measured, shape (body, 6)."""
    which = str(rng.choice(["all", "poses", "least", "some", "places"],
                           p=[0.3, 0.35, 0.2, 0.08, 0.07]))  # fmt: skip
    told.append(f"measured: {which}")
    seen = np.ones((len(world.scene.moving), len(STATE)), dtype=bool)
    for i, body in enumerate(world.scene.moving):
        how = coordinates(world.scene, body)
        if which == "poses":
            seen[i, 3:] = False
        elif which == "places":
            seen[i, 2:] = False
        elif which == "some":  # poses as far as a joint does not give them, and some velocities
            seen[i] = rng.random(len(STATE)) < 0.5
            seen[i, :3] |= how == "free"
            seen[i, {"hinged": 2, "sliding": 0}.get(how, 0)] = True
        elif which == "least":
            seen[i] = np.isin(STATE, {"hinged": ["theta"], "sliding": ["x"]}.get(how, POSE))
    return seen


def _foreign(
    rng: Rng, scene: Scene, history: History, kind: str, layout: Recording
) -> tuple[pd.DataFrame, Recording, list[str]]:
    """Return the recording as a table of another program, its layout, and what was done."""
    frame, told, dt = history.to_dataframe().drop(columns="step"), [], scene.time_step
    several = len(scene.moving) > 1
    entries: dict[str, object] = {}
    chance = rng.random()
    if chance < 0.15:
        frame, told = frame[~_lost(rng, frame)], ["lost rows, cut"]
        entries["cut"] = {"gaps": 1.5 * dt}
    elif chance < 0.3:
        lost = _lost(rng, frame, longest=2)
        frame, told = frame[~lost].copy(), ["uneven, resampled"]
        stamps = frame.groupby("trajectory")["time"].transform(lambda t: t - t.iloc[0])
        frame["time"] += 0.1 * dt * np.sin(7.0 * stamps / dt)
        entries["resample"] = True
    columns, units = {}, {}
    scales = {name: (unit := str(rng.choice([*choice])), choice[unit])
              for name, choice in UNITS.items()}  # fmt: skip
    if scales["time"][0] == "ms" and rng.random() < 0.6:
        frame["time"] += 1.7e9 + 0.25
        told.append("ms since 1970")
    actuated = {one.body: [a.name for a in scene.actuators_of(one.body)]
                for one in scene.actuators}  # fmt: skip
    if actuated and not several:
        given = actuated[scene.moving[0].name]
        frame = frame.rename(columns=dict(zip(WRENCH, given, strict=False)))
        frame = frame.drop(columns=[name for name in WRENCH if name in frame])
    elif kind == "wide" and several:
        frame = frame.set_index(["trajectory", "time", "body"]).unstack("body")
        frame.columns = [f"{body}.{name}" for name, body in frame.columns]
        frame = frame.reset_index()
        for body, given in actuated.items():
            frame = frame.rename(columns=dict(zip(
                [f"{body}.{name}" for name in WRENCH], given, strict=False
            )))  # fmt: skip
            frame = frame.drop(columns=[
                f"{body}.{name}" for name in WRENCH if f"{body}.{name}" in frame
            ])  # fmt: skip
    elif actuated:  # columns of their own, on the rows of their body
        for body, given in actuated.items():
            for name, column in zip(WRENCH, given, strict=False):
                frame[column] = frame[name].where(frame["body"] == body)
    if not several:
        frame = frame.drop(columns="body")
    if scene.moving and frame["trajectory"].nunique() == 1 and rng.random() < 0.5:
        frame = frame.drop(columns="trajectory")
    for column in [*frame]:
        body, dot, name = str(column).rpartition(".")
        if name not in NAMES:
            continue
        if name != "time" and not frame[column].notna().any():
            frame = frame.drop(columns=column)
            continue
        unit, scale = scales.get({"y": "x"}.get(name, name), ("", 1.0))
        frame[column] = frame[column] / scale
        new = f"{body}_{NAMES[name]}" if dot else NAMES[name]
        frame = frame.rename(columns={column: new})
        columns[column] = new
        if unit not in ("", "m", "s", "rad"):
            units[column] = unit
    if scales["time"][0] == "ms":
        frame["stamp"] = frame["stamp"].round(3)
    zero = [name for name in frame if str(name).endswith(("fx", "fy", "tau"))
            and not (frame[name].fillna(0.0) != 0.0).any()]  # fmt: skip
    if zero and rng.random() < 0.5:
        frame = frame.drop(columns=zero)
        columns = {key: name for key, name in columns.items() if name not in zero}
    layout = replace(layout, columns=columns, units=units, **entries)
    return frame, layout, told


def _lost(rng: Rng, frame: pd.DataFrame, longest: int = 12) -> Bools:
    """Return which rows are lost: one or two stretches of a recording's inside."""
    times = np.unique(frame["time"])
    lost = np.zeros(len(frame), dtype=bool)
    for _ in range(int(rng.integers(1, 3))):
        length = int(rng.integers(1, longest + 1))
        if len(times) > 16 + 2 * length:
            first = int(rng.integers(8, len(times) - 8 - length))
            lost |= frame["time"].isin(times[first : first + length]).to_numpy()
    return lost


def _plan(world: World, states: Floats, pushed: bool) -> tuple[tuple[str, ...], str]:
    """Return ``--start`` and ``--goal`` near the first measured state, and a file of actions."""
    scene, arguments = world.scene, []
    first = {body.name: states[0, 0, i] for i, body in enumerate(scene.moving)}
    for body in scene.moving:
        numbers = ",".join(f"{value:.6g}" for value in first[body.name][:3])
        arguments.append(f"--start={body.name}={numbers}")
    body = scene.dynamic[0]
    x, y, theta = first[body.name][:3]
    goal = f"{x + 0.5 * world.size:.6g},-,-"
    if coordinates(scene, body) == "hinged":
        goal = f"-,-,{theta + 0.3:.6g}"
    elif coordinates(scene, body) == "free":
        goal = f"{x + 0.5 * world.size:.6g},{y:.6g},-"
    arguments.append(f"--goal={body.name}={goal}")
    if not pushed:
        arguments.append("--actions=actions.toml")
    lever, wait = 0.5 * world.force * world.size, 5.0 * scene.time_step
    wrenches = [f"force = [{force:.6g}, 0.0]" for force in (world.force, -world.force)]
    wrenches += [f"torque = {torque:.6g}" for torque in (lever, -lever, 0.0)]
    actions = [f'[[action]]\nbody = "{body.name}"\n{wrench}\n' for wrench in wrenches]
    return tuple(arguments), f"durations = [{wait:.9g}]\n" + "".join(actions)
