"""Time and memory of the loop on a long recording; loop.py runs it in a separate process.

    python analysis/benchmarks/long_loop.py 100000    # transitions; prints one JSON object

The cart of the demo's scene, simulated with an undeclared drag and the noise of motion capture.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

import pbrl_ppl as pp
from pbrl_ppl.state import STATE, WRENCH

sys.path.insert(0, str(Path(__file__).parent))
from engine import MODELS
from inference import CART, NOISE
from loop import closed, told

SCENE = MODELS / "shopping_cart" / "scene.toml"
DRAG = 1.2  # N m s, on turning
INTERVALS, HELD = 30, 3  # of a trajectory, and those that a push is held for
#: Of what is recorded, a tenth as much is held out to judge by.
SHARE_HELD_OUT = 0.1


def recorded(transitions: int, seed: int) -> pd.DataFrame:
    """Return whole trajectories of about ``n`` transitions, in the history format."""
    scene = pp.Scene.load(SCENE).with_effects("cart", "angular_drag")
    rng = np.random.default_rng(seed)
    n = max(1, round(transitions / INTERVALS))
    start = rng.uniform(-1, 1, (n, 1, 6)) * [3.0, 3.0, np.pi, 2.0, 2.0, 1.4]
    pushes = rng.normal(0, [12.0, 12.0, 2.0], (n, INTERVALS // HELD, 1, 3)).repeat(HELD, axis=1)
    truth = pp.Transition(scene, CART | {"angular_drag_coefficient": DRAG})
    states = np.concatenate([start[:, None], truth.predict(start, pushes)], axis=1)[:, :, 0]
    rows = states + NOISE * rng.standard_normal(states.shape)
    unpushed = np.full((n, 1, 3), np.nan)  # after the last row
    frame = pd.DataFrame(rows.reshape(-1, 6), columns=list(STATE))
    frame[list(WRENCH)] = np.concatenate([pushes[:, :, 0], unpushed], axis=1).reshape(-1, 3)
    frame["body"] = "cart"
    frame["trajectory"] = np.repeat(np.arange(n), INTERVALS + 1)
    frame["time"] = np.tile(np.arange(INTERVALS + 1) * scene.time_step, n).round(6)
    return frame


def gigabytes() -> float:
    """Return the peak memory of this process plus that of its largest child.

    On Linux a process's ``ru_maxrss`` begins with that of the process which has started it.
    """
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    status = Path("/proc/self/status")
    if status.exists():
        own = int(status.read_text().split("VmHWM:")[1].split()[0])
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return (own + children) * unit / 1e9


def main() -> None:
    """Make the recording, close the loop and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("transitions", type=int)
    transitions = parser.parse_args().transitions
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recorded(transitions, seed=0).to_csv(folder / "train.csv", index=False)
        held_out = recorded(round(SHARE_HELD_OUT * transitions), seed=1)
        held_out.to_csv(folder / "test.csv", index=False)
        took, found = closed(SCENE, folder)
    print(json.dumps({"seconds": took, "gigabytes": gigabytes(), "told": told(found)}))


if __name__ == "__main__":
    main()
