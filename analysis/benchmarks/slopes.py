"""How the loop's time grows with rows, bodies and candidates; three sizes of each.

    python analysis/benchmarks/slopes.py                    # a table, some minutes
    python analysis/benchmarks/slopes.py rows               # one part of it
    python analysis/benchmarks/slopes.py drive              # a linear drive, 24,800 rows at 1 kHz

Processor seconds of ``close_loop`` with ``method="laplace"``, in a process of its own for each
case, with all code compiled before. ``slope`` is that of the seconds' logarithm by the size's.
"""

from __future__ import annotations

import math
import multiprocessing
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.state import STATE, WRENCH

sys.path.insert(0, str(Path(__file__).parent))
from long_loop import SCENE, recorded

#: Law on every body that the scene does not declare, kg/s.
DRAG = 0.4
#: Of the linear drive: mass (kg), viscous friction (N s/m), dry friction (N), force of a zero (N).
DRIVE = (95.0, 203.5, 20.4, -3.2)


def pucks(count: int, rows: int = 30, trajectories: int = 12) -> tuple[pp.Scene, pp.History]:
    """Return pucks that never meet, and a recording of them."""
    names = [f"puck_{i}" for i in range(count)]
    shape = pp.Shape.circle(0.1)
    scene = pp.Scene(time_step=0.05, bodies=tuple(pp.Body(name, shape) for name in names))
    lossy = scene
    for name in names:
        lossy = lossy.with_effects(name, "linear_drag")
    rng = np.random.default_rng(count)
    start = rng.normal(0.0, [0.2, 0.2, 1.0, 1.0, 1.0, 2.0], (trajectories, count, 6))
    start[:, :, 0] += 20.0 * np.arange(count)
    pushes = rng.normal(0.0, [3.0, 3.0, 0.02], (trajectories, rows, count, 3))
    truth = pp.Transition(
        lossy, {"mass": 1.0, "mu_c": 0.2, "r": 0.1, "linear_drag_coefficient": DRAG}
    )
    states = np.concatenate([start[:, None], truth.predict(start, pushes)], axis=1)
    states += 1e-3 * rng.standard_normal(states.shape)
    frame = pd.DataFrame(states.reshape(-1, 6), columns=list(STATE))
    after = np.full((trajectories, 1, count, 3), np.nan)
    frame[list(WRENCH)] = np.concatenate([pushes, after], axis=1).reshape(-1, 3)
    frame["body"] = names * (len(frame) // count)
    frame["time"] = np.tile(np.repeat(np.arange(rows + 1) * scene.time_step, count), trajectories)
    frame["trajectory"] = np.repeat(np.arange(trajectories), (rows + 1) * count)
    return scene, pp.History.from_dataframe(frame.round({"time": 9}), scene)


def cart(transitions: int) -> tuple[pp.Scene, pp.History]:
    """Return the demo's scene, and a recording of about so many transitions."""
    scene = pp.Scene.load(SCENE)
    return scene, pp.History.from_dataframe(recorded(transitions, seed=0), scene)


def drive(rows: int = 24_800, step: float = 1e-3) -> tuple[pp.Scene, pp.History]:
    """Return a linear drive, and a recording at 1 kHz by the closed form.

    Between rows the force is constant, and so is dry friction until the carriage stops.
    """
    mass, viscous, dry, zero = DRIVE
    scene = pp.Scene(
        time_step=step, gravity=(0.0, 0.0),
        bodies=(pp.Body("carriage", pp.Shape.box(0.2, 0.1), known={"mass": mass}),),
        joints=(
            pp.Joint("slider", ("world", "carriage"), (0.0, 0.0), (0.0, 0.0), axis=(1.0, 0.0)),
        ),
    )  # fmt: skip
    rng, frames = np.random.default_rng(0), []
    for trajectory in range(2):
        time_s = np.arange(rows // 2 + 1) * step
        phase = 2.0 * np.pi * (0.3 + 0.02 * trajectory) * time_s
        force = 160.0 * np.sin(phase) + 60.0 * np.sin(2.7 * phase)
        x, v, places = 0.0, 0.0, []
        for pushed in force:
            places.append(x)
            pull = pushed + zero
            left = step
            while left > 0.0 and (v != 0.0 or abs(pull) > dry):
                end = (pull - dry * math.copysign(1.0, v or pull)) / viscous
                span = left
                if v * end < 0.0:
                    span = min(left, mass / viscous * math.log1p(-v / end))
                decay = math.exp(-viscous * span / mass)
                x += end * span + (v - end) * mass / viscous * (1.0 - decay)
                v, left = end + (v - end) * decay, left - span
                v = 0.0 if left > 0.0 else v
        noisy = np.array(places) + 2e-6 * rng.standard_normal(len(places))
        frames.append(
            pd.DataFrame({"x": noisy, "y": 0.0, "theta": 0.0, "force_x": force, "time": time_s})
        )
        frames[-1]["trajectory"], frames[-1]["body"] = trajectory, "carriage"
    frame = pd.concat(frames)
    for name in (*STATE, *WRENCH):
        if name not in frame:
            frame[name] = 0.0 if name in WRENCH else np.nan
    return scene, pp.History.from_dataframe(frame, scene)


def seconds(part: str, size: int) -> tuple[float, str]:
    """Return the processor seconds of a case, and what it found."""
    warnings.simplefilter("ignore")
    catalogue = pp.catalogue
    if part == "rows":
        scene, history = cart(size)
    elif part == "bodies":
        scene, history = pucks(size)
    elif part == "drive":
        scene, history = drive(size)
    else:
        scene, history = cart(1000)
        catalogue = pp.catalogue[:size]
    begin = time.process_time()
    found = pp.close_loop(scene, history, catalogue=catalogue, seed=1, method="laplace")
    names = sorted({one.effect for one in found.added})
    return time.process_time() - begin, f"{found.verdict}: {', '.join(names) or 'nothing'}"


SIZES = {
    "rows": (1000, 4000, 16_000),
    "bodies": (1, 2, 4),
    "candidates": (20, 40, len(pp.catalogue)),
    "drive": (24_800,),
}


def main() -> None:
    """Print a table."""
    print("| what | size | CPU s | found | slope |\n|---|---|---|---|---|")
    for part in sys.argv[1:] or ("rows", "bodies", "candidates"):
        before: tuple[int, float] | None = None
        for size in SIZES[part]:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                took, found = pool.apply(seconds, (part, size))
            slope = ""
            if before is not None:
                slope = f"{np.log(took / before[1]) / np.log(size / before[0]):.2f}"
            before = size, took
            print(f"| {part} | {size} | {took:.0f} | {found} | {slope} |", flush=True)


if __name__ == "__main__":
    main()
