"""Joined bodies and bodies on friction: time of an interval, error, and the engine beside it.

    python analysis/benchmarks/tree.py

Errors are root mean squares of angles (rad) or places (m and rad) against the engine's steps
extrapolated from 320 and 1,280 an interval, over 300 (40 for the ring) intervals from one start.
One thread; the best of five rounds.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl import Body, Joint, Physics, Scene, Shape
from pbrl_ppl.history import fill_joints

KNOWN = {"mass": 0.3, "r": 0.2, "mu_c": 0.2}
LAWS = ("quadratic_drag", "pivot_friction", "pivot_damping")


def arms(count: int, time_step: float) -> Scene:
    """Return arms that hang on each other, with drag and both kinds of friction in each hinge."""
    names = ["world", *(f"arm{i}" for i in range(count))]
    shape = Shape.box(0.03, 0.4)
    return Scene(
        time_step=time_step,
        gravity=(0.0, -9.81),
        bodies=tuple(Body(name, shape, known=KNOWN, effects=LAWS) for name in names[1:]),
        joints=tuple(
            Joint("hinge", (names[i + 1], names[i]), (0.0, 0.2), (0.0, -0.2 if i else 0.0))
            for i in range(count)
        ),
    )


def puck() -> Scene:
    """Return a puck on a ring of dry friction."""
    effects = ("sliding_friction", "linear_drag")
    body = Body("puck", Shape.circle(0.1), known=KNOWN, effects=effects)
    return Scene(time_step=0.05, normal_gravity=9.81, bodies=(body,))


def run(
    scene: Scene, values: Mapping[str, float], intervals: int, **settings: object
) -> tuple[NDArray[np.float64], float]:
    """Return predictions, and microseconds of an interval."""
    rng, k, n = np.random.default_rng(0), len(scene.moving), 8
    start, wrenches = np.zeros((n, k, 6)), np.zeros((n, intervals, k, 3))
    if scene.joints:
        start[..., 2] = rng.uniform(-2.0, 2.0, (n, k))
        start[..., [0, 1, 3, 4]] = np.nan
        fill_joints(start[:, None], scene)
        wrenches[..., 2] = 0.05 * rng.normal(size=(n, intervals, k))
    else:
        start[..., 3:] = rng.normal(0.0, (0.5, 0.5, 2.5), (n, k, 3))
        wrenches[...] = rng.normal(0.0, (2.0, 2.0, 0.05), (n, intervals, k, 3))
    physics = Physics.declare(scene, **settings)
    phi = np.array([values[label.split("[")[0]] for label in physics.layout.labels])
    seconds, states = [], physics.predict(phi, start, wrenches)
    for _ in range(5):
        begin = time.perf_counter()
        physics.predict(phi, start, wrenches)
        seconds.append(time.perf_counter() - begin)
    return states, 1e6 * min(seconds) / (n * intervals)


def main() -> None:
    """Print the table."""
    of_arms = {
        "quadratic_drag_coefficient": 0.01,
        "pivot_friction_torque": 0.01,
        "pivot_damping_coefficient": 0.002,
    }
    of_puck = {
        "sliding_friction_mu": 0.2,
        "sliding_friction_radius": 0.07,
        "linear_drag_coefficient": 0.1,
    }
    cases = {
        "one hinge": (arms(1, 0.02), of_arms, 300),
        "one hinge, no dry friction": (
            arms(1, 0.02),
            of_arms | {"pivot_friction_torque": 0.0},
            300,
        ),
        "two hinges": (arms(2, 0.01), of_arms, 300),
        "ring": (puck(), of_puck, 40),
    }
    print("| bodies | us an interval | error | engine: error with 80, 320, 1,280 steps, us |")
    print("|---|---|---|---|")
    for name, (scene, values, intervals) in cases.items():
        states, cost = run(scene, values, intervals)
        engine = {
            steps: run(
                scene, values, intervals, engine="chipmunk", substeps=steps, extrapolate=False
            )
            for steps in (80, 320, 1280)
        }
        limit = (4 * engine[1280][0] - engine[320][0]) / 3
        part = slice(2, 3) if scene.joints else slice(0, 3)

        def error(found: NDArray[np.float64], limit=limit, part=part) -> float:  # type: ignore[no-untyped-def]
            return float(np.sqrt(np.mean((found - limit)[..., part] ** 2)))

        beside = "; ".join(f"{error(found):.0e}, {us:.0f}" for found, us in engine.values())
        print(f"| {name} | {cost:.1f} | {error(states):.0e} | {beside} |", flush=True)


if __name__ == "__main__":
    main()
