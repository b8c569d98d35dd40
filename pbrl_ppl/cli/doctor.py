"""``pbrl-ppl doctor``."""

from __future__ import annotations

import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.commands import command
from pbrl_ppl.cli.terminal import FAILED, interruptible, print_result, stages

#: The compiled and the plain path agree to rounding.
_AGREE = 1e-9


@command("doctor", 13, "pbrl-ppl doctor --json")
def doctor(as_json: options.AsJson = False, quiet: options.Quiet = False) -> None:
    """Report versions, whether the compiled engine loop works, and the number of threads.

    Exits with 1 if the compiled loop is wrong; where there is none, a slow one serves.
    """
    with interruptible(), stages(quiet) as progress:
        progress("loading the packages")
        import threadpoolctl

        from pbrl_ppl.posterior import versions

        found: dict[str, Any] = {"versions": versions(), "platform": platform.platform()}
        progress("trying the engine")
        found["engine"] = _engine()
        found["threads"] = {
            "processors": _processors(),
            **{
                str(pool["user_api"]): int(pool["num_threads"])
                for pool in threadpoolctl.threadpool_info()
            },
        }
        found["package"] = str(Path(__file__).parents[1])
    wrong = found["engine"]["difference"] > _AGREE
    print_result(as_json, found | {"ok": not wrong}, _lines(found))
    if wrong:
        typer.echo("error: the compiled engine loop is wrong here; please report this", err=True)
        raise typer.Exit(FAILED)


def _processors() -> int:
    """Return the number of processors that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _engine() -> dict[str, Any]:
    """Return the engine loop's kind, its difference from the plain loop, and its speed."""
    from pbrl_ppl.physics import Physics, calls
    from pbrl_ppl.scene import Body, Scene, Shape, Wall

    # a puck that hits a wall, so that there are contacts
    puck = Body("puck", Shape.circle(0.1), known=(("r", 0.5), ("mu_c", 0.3)))
    scene = Scene(time_step=0.1, bodies=(puck,), walls=(Wall((1.0, -1.0), (1.0, 1.0)),))
    start = np.zeros((100, 1, 6))
    start[:, 0, 0], start[:, 0, 3] = np.linspace(0.0, 0.8, 100), 2.0
    actions = np.zeros((100, 1, 1, 3))
    fast, slow = Physics(scene), Physics(scene, engine="python")
    states = [physics.predict(np.ones(1), start, actions) for physics in (fast, slow)]
    begin = time.perf_counter()
    fast.predict(np.ones(1), start, actions)
    spent = time.perf_counter() - begin
    return {
        "path": "compiled" if calls.AVAILABLE else "plain",
        "difference": float(np.abs(states[0] - states[1]).max()),
        "microseconds_per_transition": 1e6 * spent / len(start),
    }


def _lines(found: dict[str, Any]) -> list[str]:
    """Return what was found as lines of text."""
    engine = found["engine"]
    slow = "" if engine["path"] == "compiled" else ": a Python loop, slow; no compiled one here"
    shown = found["versions"] | {
        "platform": found["platform"],
        "engine": f"{engine['path']}{slow}, {engine['microseconds_per_transition']:.1f} us a"
        f" transition, {engine['difference']:.1g} from the plain loop",
        "threads": ", ".join(f"{number} {name}" for name, number in found["threads"].items()),
        "package": found["package"],
    }
    return [f"{name:12} {text}" for name, text in shown.items()]
