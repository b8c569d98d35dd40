"""Accuracy and speed of inference on simulated data.

    python analysis/benchmarks/inference.py                    # a table
    python analysis/benchmarks/inference.py --json             # one JSON object
    python analysis/benchmarks/inference.py --only cart map    # some of it

Data are simulated by Eq. 13 from fixed seeds, each transition from its own initial state, so that
the model is true. Seconds are this machine's; the ratios compare both sides in one run.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

import arviz as az
import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op

import pbrl_ppl as pp
from pbrl_ppl import Physics
from pbrl_ppl.history import lever
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.model import LazyProblem, LogLikelihoodOp, problem_in
from pbrl_ppl.model.declaration import random_variable
from pbrl_ppl.modes import find_mode
from pbrl_ppl.parameters import WHEEL_PARAMETERS
from pbrl_ppl.physics import PartedSimulator, build_layout
from pbrl_ppl.posterior.store import convergence, group
from pbrl_ppl.sampling.fitting import METHODS

sys.path.insert(0, str(Path(__file__).parent))
from engine import MODELS, ROUNDS, hung, machine, naive

NOISE = np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])  # of motion capture
CART = {"mass": 8.0, "r": 0.3, "mu_c": 0.3, "w_x": -0.25, "w_y": 0.05, "w_theta": 0.3}
CART |= {"mu_x": 0.04, "mu_y": 0.45}
Row = tuple[str, str, str, float]  # key, what, bound, measured


# -- data ------------------------------------------------------------------------------------------


def simulate(
    scene: pp.Scene,
    phi: np.ndarray,
    start: np.ndarray,
    actions: np.ndarray,
    noise: np.ndarray,
    seed: int,
) -> pp.History:
    """Return a history of single transitions (n, k, 6) under wrenches (n, k, 3), by Eq. 13."""
    rng = np.random.default_rng(seed)
    n, k = start.shape[:2]
    end = PartedSimulator(Physics(scene))(phi, start, actions[:, None])[:, 0]
    end = end + noise * rng.standard_normal(end.shape)
    states = np.stack([start, end], axis=1).reshape(-1, 6)
    wrenches = np.stack([actions, np.full_like(actions, np.nan)], axis=1).reshape(-1, 3)
    rows = pd.DataFrame(states, columns=["x", "y", "theta", "vx", "vy", "omega"])
    rows[["force_x", "force_y", "torque"]] = wrenches
    rows["body"] = [body.name for body in scene.dynamic] * (2 * n)
    rows["time"] = np.tile(np.repeat([0.0, scene.time_step], k), n)
    rows["trajectory"] = np.repeat(np.arange(n), 2 * k)
    return pp.History.from_dataframe(rows, scene)


def cart(n: int, noise: np.ndarray = NOISE, seed: int = 0) -> tuple[pp.Scene, pp.History]:
    """The shopping cart, pushed at random; all of phi unknown; 20 substeps."""
    scene = pp.Scene.load(MODELS / "shopping_cart" / "scene.toml").replace(substeps=20)
    rng = np.random.default_rng(seed)
    start = rng.normal(0, [1.0, 1.0, 1.5, 1.2, 1.2, 0.8], (n, 1, 6))
    actions = rng.normal(0, [12.0, 12.0, 2.0], (n, 1, 3))
    phi = build_layout(scene).to_vector(CART)
    return scene, simulate(scene, phi, start, actions, noise, seed + 1)


def apartment(n: int) -> tuple[pp.Scene, pp.History]:
    """Eleven bodies, all pushed at once, n times; Table 1's continuous prior for each."""
    scene = pp.Scene.load(MODELS / "apartment" / "scene.toml")
    layout = build_layout(scene)
    rng = np.random.default_rng(3)
    k = len(scene.dynamic)
    phi = np.array([prior.centre for prior in layout.priors])
    for name, low, high in (("w_theta", -1.4, 1.4), ("mu_x", 0.02, 0.1), ("mu_y", 0.3, 0.6)):
        for i, label in enumerate(layout.labels):
            if label.startswith(f"{name}["):
                phi[i] = rng.uniform(low, high)
    for i, (label, prior) in enumerate(zip(layout.labels, layout.priors, strict=True)):
        if label.startswith(("w_x[", "w_y[")):
            phi[i] = rng.uniform(*(0.6 * np.array(prior.support)))
    start = rng.normal(0, [0.01, 0.01, 0.1, 0.6, 0.6, 0.8], (n, k, 6))
    start[..., :3] += [body.pose for body in scene.dynamic]
    mass = phi[[layout.index("mass", body.name) for body in scene.dynamic]]
    actions = rng.normal(0, [3.0, 3.0, 0.8], (n, k, 3)) * mass[:, None]
    return scene, simulate(scene, phi, hung(scene, start), actions, NOISE, 4)


def furniture(n: int, joined: bool) -> tuple[pp.Scene, pp.History]:
    """Four bodies on wheels, all of them pushed; a hinge, or nothing, couples cart and trailer.

    The scene says nothing of what is joined, and all of phi is unknown. Either way they begin end
    to end, and in motion.
    """
    # name: size, mass, pose, w_x, w_y, w_theta, mu_x, mu_y
    table = {
        "cart": ((0.9, 0.55), 8.0, (0.0, 0.0, 0.0), (-0.25, 0.05, 0.3, 0.04, 0.45)),
        "trailer": ((0.8, 0.5), 5.0, (-0.79, 0.0, 0.0), (-0.2, 0.0, -0.2, 0.05, 0.4)),
        "table": ((1.2, 0.7), 12.0, (2.3, 0.8, 0.2), (0.3, -0.1, 0.5, 0.03, 0.5)),
        "shelf": ((0.9, 0.35), 6.0, (-0.3, 2.0, -0.2), (0.2, 0.05, 1.0, 0.06, 0.35)),
    }
    front, back = (-0.42, 0.0), (0.37, 0.0)  # anchors on the cart and on the trailer
    bodies = tuple(
        pp.Body(name, pp.Shape.box(*size), wheel=True, pose=pose)
        for name, (size, _, pose, _) in table.items()
    )
    scene = pp.Scene(
        time_step=0.1, normal_gravity=9.81, bodies=bodies, joints=(pp.Joint("hinge", known=False),)
    )
    hinge = pp.Joint("hinge", ("cart", "trailer"), front, back)
    truth = scene.replace(joints=(hinge,) if joined else ())
    layout = build_layout(truth)
    mass = np.array([row[1] for row in table.values()])
    wheel = zip(WHEEL_PARAMETERS, np.transpose([row[3] for row in table.values()]), strict=True)
    phi = layout.to_vector({"mass": mass, "r": 0.2, "mu_c": 0.3} | dict(wheel))
    rng = np.random.default_rng(0)
    start = np.zeros((n, 4, 6))
    start[..., :3] = [row[2] for row in table.values()]
    start[..., 2] += rng.normal(0, 0.12, (n, 4))
    at_cart, at_trailer = lever(start[:, 0], front)[0], lever(start[:, 1], back)[0]
    start[:, 1, :2] = start[:, 0, :2] + at_cart - at_trailer
    pushes = rng.normal(0, [6.0, 6.0, 1.5], (2, n, 1, 4, 3)) * mass[:, None]
    start = PartedSimulator(Physics(truth))(phi, start, pushes[0])[:, 0]
    return scene, simulate(truth, phi, start, pushes[1, :, 0], NOISE, 1)


# -- what is measured ------------------------------------------------------------------------------


def seconds(function: Callable[[], object]) -> tuple[float, object]:
    """Return the time of one call, and its result."""
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


def fitted(scene: pp.Scene, history: pp.History, **options) -> tuple[float, object]:
    """Return the seconds of a whole fit, with mode and compilation, and the posterior."""
    return seconds(
        lambda: pp.fit(
            pp.physics_model(scene, history, threads=1), seed=1, progress=False, **options
        )
    )


def sampled(scene: pp.Scene, history: pp.History, **options) -> tuple[float, float, float]:
    """Return the seconds of a whole fit, its largest R-hat and least ESS."""
    return judged(*fitted(scene, history, **options))


def judged(took: float, idata: object) -> tuple[float, float, float]:
    """Return seconds, largest R-hat and least ESS of a finished fit."""
    r_hat, ess = convergence(idata)
    return took, max(r_hat.values()), min(ess.values())


def fit_rows(key: str, what: str, most: int, measured: tuple[float, float, float]) -> Iterator[Row]:
    """Return the three rows of a fit from the result of ``sampled``."""
    took, r_hat, ess = measured
    yield f"{key}_seconds", f"{what}: seconds, mode and compilation included", f"<= {most}", took
    yield f"{key}_max_rhat", f"{what}: largest R-hat", "<= 1.01", r_hat
    yield f"{key}_min_ess", f"{what}: least bulk or tail ESS", ">= 400", ess


def measure_cart() -> Iterator[Row]:
    """All of phi and sigma from 360 transitions."""
    what = "cart, 360 transitions x 20 substeps, 4 chains"
    yield from fit_rows("cart", what, 60, judged(*cart_posterior()))


@cache
def cart_posterior() -> tuple[float, object]:
    """Return the cart's fit, made once for all rows that need it."""
    return fitted(*cart(360))


def measure_update() -> Iterator[Row]:
    """One more transition for the cart's posterior."""
    _, idata = cart_posterior()
    _, more = cart(1, seed=2)
    times = [
        seconds(lambda i=i: pp.update(idata, more, seed=i, progress=False))[0]
        for i in range(ROUNDS)
    ]
    what = "cart posterior of 4 x 800 draws and 360 transitions, one more: seconds"
    yield "update_seconds", what, "<= 1", float(np.median(times))


def measure_apartment() -> Iterator[Row]:
    """Eleven bodies under the continuous prior."""
    what = "11 bodies, continuous prior, 30 transitions per body"
    measured = sampled(*apartment(30))
    yield from fit_rows("apartment", what, 600, measured)


def measure_map() -> Iterator[Row]:
    """The mode alone, two threads."""
    scene, history = cart(360)
    model = pp.physics_model(scene, history, threads=2)
    find_mode(problem_in(model), seed=0)  # compiled code and worlds are there
    took = float(
        np.median([seconds(lambda: find_mode(problem_in(model), seed=1))[0] for _ in range(ROUNDS)])
    )
    yield "map_seconds", "mode of the same data: seconds", "<= 0.25", took
    try:
        from mujoco_sysid import sysid_seconds
    except ImportError as error:
        print(f"map_over_mujoco is left out: {error}; pip install -e '.[bench]'", file=sys.stderr)
        return
    theirs = sysid_seconds()
    what = "the same / MuJoCo's sysid, seven parameters of one body, as many steps"
    yield "map_over_mujoco", f"{what} ({theirs:.2g} s)", "", took / theirs


def measure_noise_free() -> Iterator[Row]:
    """Two random transitions without noise; the worst of ten histories."""
    errors, friction = [], []
    for seed in range(10):
        scene, history = cart(2, noise=np.zeros(6), seed=seed)
        mode = find_mode(problem_in(pp.physics_model(scene, history)), seed=1)
        found = dict(zip(mode.problem.layout.labels, mode.phi, strict=True))
        errors.append(abs(found["mass[cart]"] / CART["mass"] - 1))
        friction += [abs(found[f"{name}[cart]"] - CART[name]) for name in ("mu_x", "mu_y")]
    what = "noise-free cart, two transitions, worst of ten: error of"
    yield "noise_free_mass_error", f"{what} the mass (share)", "<= 0.001", max(errors)
    yield "noise_free_friction_error", f"{what} mu_x, mu_y", "<= 0.01", max(friction)


class PythonLoop(Op):
    """Naive baseline: pymunk stepped from Python, with a new Space for each transition."""

    __props__ = ()

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    def make_node(self, phi: pt.TensorVariable) -> Apply:
        """Phi in, next states (transition, 1, 1, 6) out."""
        return Apply(self, [pt.as_tensor_variable(phi)], [pt.dtensor4()])

    def perform(self, node: Apply, inputs: list, outputs: list) -> None:
        """Step every transition."""
        problem, segments = self.problem, self.problem.segments
        values = dict(zip((b.name for b in problem.layout.blocks), inputs[0], strict=True))
        outputs[0][0] = naive(
            segments.start,
            segments.actions,
            values,
            problem.scene.dynamic[0].shape,
            problem.scene.walls,
            problem.physics.substeps,
        )


def plain_model(model: pm.Model) -> pm.Model:
    """Return the same model on the Python loop."""
    problem = problem_in(model)
    loop = PythonLoop(problem)
    with pm.Model(coords=model.coords) as plain:
        phi = pt.concatenate(
            [random_variable(b.name, b.priors, "body") for b in problem.layout.blocks]
        )
        median, spread = problem.noise_prior
        sigma = pm.LogNormal("sigma", mu=np.log(median), sigma=spread, dims="state")
        logp = LogLikelihoodOp(LazyProblem(problem))(
            problem.observations.values, loop(phi), sigma, phi
        )
        pm.Potential("likelihood", logp.sum())
    return plain


def measure_ratio() -> Iterator[Row]:
    """Measure effective draws per second: ours / pm.Metropolis on the Python loop.

    How many draws of pm.Metropolis an effective one takes is the sampler's affair: measured on the
    fast Op. How long a draw takes on the Python loop is measured on the Python loop.
    """
    scene, history = cart(360)
    model = pp.physics_model(scene, history)
    took, _, ess = judged(*cart_posterior())
    mode = find_mode(problem_in(model), seed=1)
    point = problem_in(model).layout.to_dict(mode.phi) | {"sigma": mode.sigma}
    quiet = {"chains": 2, "cores": 1, "progressbar": False, "compute_convergence_checks": False}
    with model:
        trace = pm.sample(
            draws=1500, tune=1500, step=pm.Metropolis(), initvals=point, random_seed=1, **quiet
        )
    least = min(float(v.min()) for v in az.ess(group(trace, "posterior")).data_vars.values())
    share = least / 3000
    with plain_model(model):
        step = pm.Metropolis()
        short = {"step": step, "initvals": point, "random_seed": 1} | quiet | {"chains": 1}
        few, _ = seconds(lambda: pm.sample(draws=2, tune=0, **short))
        more, _ = seconds(lambda: pm.sample(draws=8, tune=0, **short))
    a_draw = (more - few) / 6
    ratio = (ess / took) / (share / a_draw)
    yield (
        "ess_per_second_ratio",
        f"ESS per second / pm.Metropolis on a Python loop ({a_draw:.2g} s, ESS {share:.2g} a draw)",
        ">= 100",
        ratio,
    )


#: Wall-clock seconds that each method is given, the mode apart: the effort is the same for all.
EFFORT = 60.0
#: Draws a chain of a first run, and twice as many of a second: their difference is a draw's cost.
PILOT = {"smc": 100, "metropolis": 20}
_CHAINS, _MOST_DRAWS = 4, 200_000


def measure_methods() -> Iterator[Row]:
    """Measure effective draws per second of every method in the same time.

    Tuning draws are in the proportion to draws that each method has by default.
    """
    scene, history = cart(30)
    model = pp.physics_model(scene, history)
    mode = find_mode(problem_in(model), seed=1)
    options = {"seed": 1, "start": mode, "progress": False, "chains": _CHAINS}
    for method, few in PILOT.items():
        share = METHODS[method].tune / METHODS[method].draws

        def run(draws: int, method: str = method, share: float = share) -> tuple[float, object]:
            tune = math.ceil(share * draws)
            return seconds(lambda: pp.fit(model, method=method, draws=draws, tune=tune, **options))

        run(few)  # compiled code is there
        (less, _), (more, _) = run(few), run(2 * few)
        a_draw = max((more - less) / few, EFFORT / _MOST_DRAWS)
        draws = max(few, int(few + (EFFORT - less) / a_draw))
        took, r_hat, ess = judged(*run(draws))
        what = f"cart, 30 transitions, {_CHAINS} chains, {method}: least ESS per second"
        how = f"{took:.0f} s, {draws} draws a chain, ESS {ess:.0f}, R-hat {r_hat:.2f}"
        yield f"ess_per_second_{method}", f"{what} ({how})", "", ess / took


def measure_joint() -> Iterator[Row]:
    """Which of four bodies are joined, with the default fit of all parameters at once."""
    what = "which of four bodies a hinge joins, 20 transitions: probability of"
    for key, joined in (("joint", "cart-trailer"), ("joint_null", "none")):
        scene, history = furniture(20, joined != "none")
        model = pp.physics_model(scene, history)
        took, idata = seconds(partial(pp.fit, model, seed=1, progress=False))
        found = pp.joint_probabilities(idata)["joint1"][joined]
        r_hat = max(convergence(idata)[0].values())
        yield f"{key}_probability", f"{what} the truth, {joined}", "> 0.99", found
        yield f"{key}_seconds", f"the same: seconds (largest R-hat {r_hat:.2f})", "<= 60", took


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "cart": measure_cart,
    "update": measure_update,
    "map": measure_map,
    "noise_free": measure_noise_free,
    "ratio": measure_ratio,
    "methods": measure_methods,
    "apartment": measure_apartment,
    "joint": measure_joint,
}


def measure(
    parts: Mapping[str, Callable[[], Iterator[Row]]],
    description: str | None,
    usual: Sequence[str] = (),
) -> None:
    """Measure the parts that the command line asks for, or the usual ones or all, and print."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(usual or parts))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = (row for name in arguments.only for row in parts[name]())
    if arguments.json:
        print(json.dumps({key: float(value) for key, _, _, value in rows}))
        return
    print(f"{machine()}\n\n| what | bound | measured |\n|---|---|---|")
    for key, what, bound, value in rows:
        print(f"| {what} [`{key}`] | {bound} | {value:.3g} |", flush=True)


if __name__ == "__main__":
    measure(PARTS, __doc__)
