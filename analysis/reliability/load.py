"""Load: long recordings, many fits, slopes of cost.

    python -m reliability.load loop --most 10000   # 10,000 to 100,000 transitions, close-loop
    python -m reliability.load criticise           # 100,000 and a million transitions
    python -m reliability.load fits                # 2,000 fits in one process
    python -m reliability.load slope               # seconds against rows, bodies, laws, candidates

Each case is a line of ``out/reliability/load.jsonl``; the same command goes on with those that are
missing. Seconds are processor seconds with those of children. The cart is the demo's, pushed at
random and back to the middle of its room, with an undeclared angular drag of 1.2 N m s.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.criticism import criticise
from reliability.commands import run, warm

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
OUT = Path("out/reliability")
CART = ROOT / "models" / "shopping_cart" / "scene.toml"
TRUTH = {"mass": 8.0, "r": 0.3, "mu_c": 0.3, "w_x": -0.25, "w_y": 0.05, "w_theta": 0.3,
         "mu_x": 0.04, "mu_y": 0.45, "angular_drag_coefficient": 1.2}  # fmt: skip
NOISE = np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])
Case = Mapping[str, Any]


def cart(rows: int, trajectories: int, seed: int) -> pp.History:
    """Return a recording of the cart, of about ``rows`` transitions in all."""
    scene, rng = pp.Scene.load(CART), np.random.default_rng(seed)
    # steps of the engine are errors that a long recording shows
    fine = replace(scene, substeps=64).with_effects("cart", "angular_drag")
    truth = pp.Transition(fine, TRUTH)
    state = rng.normal(size=(trajectories, 1, 6)) * [2.0, 2.0, 1.0, 0.5, 0.5, 0.5]
    states, pushes = [state], []
    for step in range(rows // trajectories):
        if step % 3 == 0:
            push = rng.normal(0.0, [12.0, 12.0, 2.0], (trajectories, 1, 3))
            push[..., :2] -= 4.0 * state[..., :2] + 6.0 * state[..., 3:5]
        state = truth.predict(state, push[:, None])[:, 0]
        states.append(state)
        pushes.append(push)
    measured = np.stack(states, axis=1) + NOISE * rng.normal(size=(trajectories, len(states), 1, 6))
    return pp.History.of_arrays(measured, scene, np.stack(pushes, axis=1))


def pucks(rows: int, bodies: int, laws: int, seed: int) -> tuple[pp.Scene, pp.History]:
    """Return a scene of pucks that never meet, with declared laws, and four trajectories of it."""
    declared = ("linear_drag", "angular_drag", "constant_force", "constant_torque", "force_gain")
    known = {"r": 0.0, "mu_c": 0.0}
    names = [f"puck{i}" for i in range(bodies)]
    scene = pp.Scene(
        time_step=0.05,
        normal_gravity=9.81,
        bodies=tuple(
            pp.Body(name, pp.Shape.circle(0.1), known=known, effects=declared[:laws])
            for name in names
        ),
    )
    true, given = scene, {"mass": 1.0}
    for name in names if not laws else ():
        true = true.with_effects(name, "linear_drag")
    for law in pp.catalogue:
        if law.name in declared[: max(laws, 1)]:
            value = 1.0 if law.name == "force_gain" else 0.1
            given |= {law.variable(parameter): value for parameter in law.parameters}
    rng, n = np.random.default_rng(seed), rows // 4
    start = rng.normal(size=(4, bodies, 6)) * [0.3, 0.3, 1.0, 0.2, 0.2, 1.0]
    start[..., 0] += 100.0 * np.arange(bodies)
    pushes = rng.normal(0, [1, 1, 0.01], (4, n // 4 + 1, bodies, 3)).repeat(4, axis=1)[:, :n]
    states = np.concatenate(
        [start[:, None], pp.Transition(true, given).predict(start, pushes)], axis=1
    )
    states += rng.normal(size=states.shape) * [1e-3, 1e-3, 2e-3, 5e-3, 5e-3, 1e-2]
    return scene, pp.History.of_arrays(states, scene, pushes)


# -- cases: each yields a name and what is run for it ----------------------------------------------


def by_command(name: str, sizes: tuple[tuple[int, int], ...], most: int) -> Iterator[Case]:
    """Run a command on recordings of the cart: (transitions, trajectories)."""
    for rows, trajectories in sizes:
        if rows <= most:
            case = f"{name}-{rows}-{trajectories}"
            yield {"case": case, "run": partial(_command, name, rows, trajectories)}


def _command(name: str, rows: int, trajectories: int) -> Case:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        cart(rows, trajectories, seed=1).save(folder / "train.nc")
        argv = [name, str(CART), "train.nc"]
        if name == "close-loop":
            cart(max(rows // 10, 60), min(trajectories, 20), seed=2).save(folder / "test.nc")
            argv += ["--test", "test.nc", "-o", "out", "--method", "laplace"]
        ran = run(argv, folder, limit=1500.0)
        said = ran.out.splitlines()[:3]
    return {
        "cpu": ran.cpu,
        "wall": ran.seconds,
        "peak_mb": ran.peak,
        "fault": ran.fault(),
        "told": said,
    }


def apart(function: Callable[[], object]) -> Case:
    """Return the processor seconds and memory of a call in a forked child."""
    child = os.fork()
    if not child:
        code = 1
        try:
            function()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    _, status, usage = os.wait4(child, 0)
    cpu = usage.ru_utime + usage.ru_stime
    fault = f"exit code {status}" if status else ""
    return {"cpu": round(cpu, 2), "peak_mb": round(usage.ru_maxrss / 1024), "fault": fault}


def slopes(most: int) -> Iterator[Case]:
    """Measure three calls against rows, bodies, declared laws, and candidates."""
    some = [law for law in pp.catalogue if law.name != "hidden_obstacle"]
    calls: dict[str, Callable[..., object]] = {
        "fit map": lambda scene, history, catalogue: pp.fit(
            pp.physics_model(scene, history, likelihood="trajectories"),
            method="map", seed=1, progress=False,
        ),
        "criticise": lambda scene, history, catalogue: criticise(
            scene, history, catalogue=catalogue, seed=1
        ),
        "close-loop laplace": lambda scene, history, catalogue: pp.close_loop(
            scene, history, catalogue=catalogue, method="laplace", seed=1
        ),
    }  # fmt: skip
    few = tuple(law for law in some if law.name in ("linear_drag", "angular_drag"))
    sweeps: dict[str, tuple[int, ...]] = {
        "rows": (200, 400, 800, 1600, 3200),
        "bodies": (1, 2, 4, 8),
        "laws": (1, 2, 3, 4, 5),
        "candidates": (4, 8, 16, 32),
    }
    for call, function in calls.items():
        for sweep, sizes in sweeps.items():
            if call == "fit map" and sweep == "candidates":
                continue
            for size in sizes:
                if sweep == "rows" and size > most:
                    continue
                drawn = {"rows": 200, "bodies": 1, "laws": 0}
                if sweep in drawn:
                    drawn[sweep] = size
                catalogue = tuple(some[:size]) if sweep == "candidates" else few
                yield {
                    "case": f"slope-{call}-{sweep}-{size}",
                    "run": lambda f=function, d=drawn, c=catalogue: apart(
                        lambda: f(*pucks(**d, seed=1), c)
                    ),
                }


def fits(count: int) -> Iterator[Case]:
    """Fit in one process, scenes of one to three bodies and laws by turns."""

    def fitted() -> Case:
        seen, begin = [], time.process_time()
        for i in range(count):
            scene, history = pucks(40, 1 + i % 3, i // 3 % 3, seed=i)
            model = pp.physics_model(scene, history, likelihood="transitions")
            pp.fit(model, method="map", seed=1, progress=False)
            if i + 1 in (20, 200) or (i + 1) % (count // 10) == 0:
                seen.append([i + 1, resident(), objects()])
                print(*seen[-1], flush=True)
        return {"cpu": time.process_time() - begin, "seen": seen, "fault": ""}

    yield {"case": f"fits-{count}", "run": fitted}


def resident() -> int:
    """Return the resident memory of this process (MB)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 2**20


def objects() -> Mapping[str, int]:
    """Return the types of which the collector knows most objects."""
    import gc

    gc.collect()
    counts = Counter(type(one).__name__ for one in gc.get_objects())
    return {"all": counts.total(), **dict(counts.most_common(4))}


# -- all -------------------------------------------------------------------------------------------


def exponents(results: list[Case]) -> Iterator[str]:
    """Yield the exponent of each sweep: the slope of log seconds against log size."""
    sweeps: dict[str, list[tuple[float, float]]] = {}
    for one in results:
        if one["case"].startswith(("slope-", "close-loop-", "criticise-")) and not one["fault"]:
            if one["case"].startswith("slope-"):
                sweep, _, size = one["case"].rpartition("-")
            else:
                sweep, size = one["case"].split("-1")[0], one["case"].rsplit("-", 2)[1]
            sweeps.setdefault(sweep, []).append((float(size), one["cpu"]))
    for sweep, points in sweeps.items():
        if len(points) > 1:
            size, cpu = np.log(np.array(sorted(points))).T
            listed = ", ".join(
                f"{np.exp(a):.0f}: {np.exp(b):.2f} s" for a, b in zip(size, cpu, strict=True)
            )
            yield f"{sweep}: exponent {np.polyfit(size, cpu, 1)[0]:.2f} ({listed})"


def main() -> None:
    """Run what is missing, and print all results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["loop", "criticise", "fits", "slope", "show"])
    parser.add_argument("--most", type=int, default=10**6, help="transitions, at most")
    parser.add_argument("--count", type=int, help="fits")
    given = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    path = OUT / "load.jsonl"
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    sizes = ((1000, 10), (3000, 10), (10_000, 100), (30_000, 100), (100_000, 100), (100_000, 1))
    cases = {
        "loop": lambda: by_command("close-loop", sizes, given.most),
        "criticise": lambda: by_command("criticise", (*sizes[:5], (10**6, 100)), given.most),
        "fits": lambda: fits(given.count or 2000),
        "slope": lambda: slopes(given.most),
        "show": lambda: iter(()),
    }[given.part]()
    warnings.simplefilter("ignore")
    warm()
    done = {one["case"] for one in results}
    for case in cases:
        if case["case"] in done:
            continue
        result = {"case": case["case"], **case["run"]()}
        result["parent_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        with path.open("a") as file:
            file.write(json.dumps(result) + "\n")
        results.append(result)
        print(json.dumps(result)[:600], flush=True)
    print(*exponents(results), sep="\n")
    faults = [one["case"] for one in results if one["fault"]]
    print(f"{len(results)} tries, {len(faults)} faults {' '.join(faults)}")


if __name__ == "__main__":
    main()
