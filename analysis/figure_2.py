"""Fig. 2: the graphical model of a scene, drawn by pm.model_to_graphviz as an SVG.

python analysis/figure_2.py [FILE.svg]
"""

import sys
from itertools import groupby
from pathlib import Path
from typing import Any

import pandas as pd
import pymc as pm

import pbrl_ppl as pp

#: Symbols of the paper's Fig. 2 for the model's variables; Table 1's are all of Phi.
SYMBOLS = {
    **dict.fromkeys(("mass", "r", "mu_c", "w_x", "w_y", "w_theta", "mu_x", "mu_y"), ""),
    "start": "s_t",
    "actions": "a_t",
    "f": "f(s_t, a_t; \u03a6)",
    "sigma": "\u03c3",
    "next_state": "s_{t+1}",
}
TO = Path(__file__).parent / "results" / "figure_2.svg"


def cart_model() -> pm.Model:
    """Return the model of a cart with two pushes: Table 1, the engine as an Op, Eq. 11."""
    cart = pp.Body("cart", pp.Shape.box(0.9, 0.55), wheel=True)
    scene = pp.Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart,))
    state = dict.fromkeys(("x", "y", "theta", "vx", "vy", "omega"), 0.0)
    push = {"force_x": 10.0, "force_y": 0.0, "torque": 0.0}
    rows = [{"trajectory": 0, "step": k, "time": 0.1 * k, "body": "cart"} | state
            | (push if k < 2 else {}) for k in range(3)]  # fmt: skip
    return pp.physics_model(scene, pp.History.from_dataframe(pd.DataFrame(rows), scene))


def with_engine(model: pm.Model) -> pm.Model:
    """Name the Op's output f, so that it is a node of its own."""
    inputs = model["next_state"].owner.inputs
    (predicted, *_) = (each for each in inputs if getattr(each, "ndim", 0) == 4)
    predicted.name = "f"
    model.add_named_variable(predicted, dims=("transition", "step", "body", "state"))
    model.deterministics.append(predicted)
    return model


def drawn(model: pm.Model) -> Any:
    """Return the graph from left to right, with the paper's symbols and Table 1's order."""
    graph = pm.model_to_graphviz(model)
    order = list(SYMBOLS)

    def kind(line: str) -> str:
        return "edge" if " -> " in line else "node" if "shape=" in line else line

    def place(line: str) -> int:
        return order.index(line.split()[0]) if kind(line) in ("edge", "node") else 0

    # PyMC's order within a plate is that of a set
    runs = (sorted(run, key=place) for _, run in groupby(graph.body, key=kind))
    graph.body = [_relabelled(line) for run in runs for line in run]
    graph.attr(rankdir="LR", ranksep="0.6", nodesep="0.1", fontsize="10")
    graph.node_attr = {"fontsize": "12", "margin": "0.05,0.03"}
    return graph


def _relabelled(line: str) -> str:
    for name, symbol in SYMBOLS.items():
        line = line.replace(
            f'label="{name}\n', f'label="{symbol}\n{name}\n' if symbol else f'label="{name}\n'
        )
    line = line.replace("\n~\n", " ~ ").replace("CustomDist_next_state", "Normal(f, sigma)")
    line = line.replace("f ~ Deterministic", "engine, as an Op").replace(' ~ Data"', ' (data)"')
    line = line.replace("Truncated_normal", "TruncatedNormal").replace("Vonmises", "VonMises")
    return line.replace("Lognormal", "LogNormal").replace(
        'label="body (1)"', 'label="\u03a6: body (1)"'
    )


def main(to: Path) -> int:
    """Draw the model; return 2 if a requirement is not installed."""
    try:
        import graphviz
    except ImportError:
        print("figure_2: needs the package graphviz; pip install graphviz", file=sys.stderr)
        return 2
    graph = drawn(with_engine(cart_model()))
    try:
        to.write_bytes(graph.pipe(format="svg"))
    except graphviz.ExecutableNotFound:
        print("figure_2: needs the program dot; install Graphviz (graphviz.org)", file=sys.stderr)
        return 2
    print(to)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else TO))
