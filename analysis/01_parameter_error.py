"""Error of the cart's parameters against the number of transitions.

    python analysis/01_parameter_error.py           # table, and out/parameter_error.png
    python analysis/01_parameter_error.py --histories 20

Random pushes from random states; the mode of the posterior against the truth, median over
histories. Without noise two transitions are mostly enough, as the paper's section 5 has it; noise
of 0.25 (m, rad, m/s, rad/s) is the paper's, more than ten times what motion capture has.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from rich.progress import track

import pbrl_ppl as pp
from pbrl_ppl.model import problem_in
from pbrl_ppl.modes import find_mode

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from inference import CART, cart

NUMBERS = (1, 2, 5, 10, 20, 50, 100, 200)
SIGMAS = (0.0, 0.25)
OUT = Path("out")


def error(transitions: int, sigma: float, seed: int) -> dict[str, float]:
    """Return the absolute errors of one history's mode, relative for the mass."""
    scene, history = cart(transitions, noise=np.full(6, sigma), seed=100 + seed)
    model = pp.physics_model(scene, history, sigma="scalar", threads=2)
    found = find_mode(problem_in(model), seed=1).values
    errors = {name: abs(float(found[name][0]) - CART[name]) for name in ("mu_x", "mu_y", "w_x")}
    return {"mass": abs(float(found["mass"][0]) / CART["mass"] - 1)} | errors


def main() -> None:
    """Measure the errors, print and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--histories", type=int, default=10)
    histories = parser.parse_args().histories
    warnings.simplefilter("ignore")
    cases = [(s, n, h) for s in SIGMAS for n in NUMBERS for h in range(histories)]
    rows = [
        {"sigma": s, "transitions": n} | error(n, s, h)
        for s, n, h in track(cases, "fitting", disable=not sys.stderr.isatty())
    ]
    table = pd.DataFrame(rows).groupby(["sigma", "transitions"]).median()
    print(table.to_string(float_format="{:.2g}".format))
    figure, axes = plt.subplots(1, len(table.columns), figsize=(12, 3), layout="constrained")
    for axis, name in zip(axes, table.columns, strict=True):
        for sigma in SIGMAS:
            own = table.loc[sigma, name]
            axis.loglog(own.index, np.maximum(own, 1e-9), "o-", label=f"sigma {sigma:g}")
        axis.set(xlabel="transitions", title=f"error of {name}" + " (share)" * (name == "mass"))
    axes[0].legend(frameon=False)
    OUT.mkdir(exist_ok=True)
    figure.savefig(OUT / "parameter_error.png", dpi=150)
    print(f"\n{OUT / 'parameter_error.png'}")


if __name__ == "__main__":
    main()
