"""Coverage of intervals from simulated trajectories whose errors are not white.

    python analysis/benchmarks/coverage.py                 # this table: 12 cells, 40 replications
    python analysis/benchmarks/coverage.py --only fall     # a rig alone

Falls, pendulums and sliders are integrated by code of their own; their laws are declared. Errors
are AR(0.9), those of an encoder, or a ripple of the force that the model does not know.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.helpers.coloured import ERRORS, RIGS, fitted, standardised

#: Half-width of a 94 % interval, in standard deviations.
HALF_WIDTH = 1.88


def main() -> None:
    """Print how many intervals hold the truth, and the root mean square of errors over sd."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=RIGS, default=list(RIGS))
    parser.add_argument("--replications", type=int, default=40)
    asked = parser.parse_args()
    print("| rig | errors | parameter | held | rms of error / sd | s |\n|---|---|---|---|---|---|")
    for name in asked.only:
        for error in ERRORS:
            begin, rig = time.perf_counter(), RIGS[name]
            modes = [fitted(rig, error, seed) for seed in range(asked.replications)]
            z = np.array([standardised(rig, mode) for mode in modes])
            seconds = time.perf_counter() - begin
            held, rms = (np.abs(z) < HALF_WIDTH).mean(axis=0), np.sqrt((z**2).mean(axis=0))
            for i, label in enumerate(modes[0].problem.layout.labels[: len(held)]):
                law = label.removesuffix("[body]")
                cells = f"{held[i]:.3f} | {rms[i]:.2f} | {seconds:.0f}"
                print(f"| {name} | {error} | {law} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
