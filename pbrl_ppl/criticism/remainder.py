"""A learned remainder: a Gaussian process for the force that no effect explains."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.cross_validation import gain
from pbrl_ppl.criticism.rivals import likeliest_mode
from pbrl_ppl.criticism.stages import Stage
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.effects import LEARNED_REMAINDER, Effect, LearnedRemainder, learned_remainder
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.model import build_model
from pbrl_ppl.modes import Mode, trajectory_mode
from pbrl_ppl.sampling import fit
from pbrl_ppl.state import STATE

Array = NDArray[np.float64]

#: Transitions that the process is fitted to, at most.
_MOST = 400
#: Log marginal likelihood that a force must gain over noise alone, in nats.
_GAIN = 6.0
#: Length scales, as shares of the range of the speeds that were seen; a longer one is a constant.
_SHORTEST, _LONGEST = 0.15, 10.0
#: How far beyond that range the process goes on, as a share of it; there it returns to nothing.
_BEYOND = 0.3
#: Bumps of each force; forms that have this share of its variance, and at most so many.
_BUMPS, _SHARE, _FORMS = 48, 0.9995, 24
#: Of each chain; they are independent.
DRAWS = 250


def learn_remainder(
    posterior: Any,
    body: str,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    draws: int = DRAWS,
    progress: Callable[[str], None] | None = None,
) -> Any:
    """Learn a residual force on a body, with its uncertainty, and refit the model with it.

    What steps add to the velocities beyond the model is, times mass and moment, a force and a
    torque in the body's frame. A Gaussian process of the velocity in that frame (forward, sideways,
    angular) is fitted to each; its kernel's leading forms, with standard normal weights, go into
    the model, which is then fitted anew to whole trajectories with all parameters and both noises.
    So the weights vary from draw to draw as far as the data leave them open; at speeds that were
    not seen the force goes back to nothing in the mean, and its spread to that of the process at
    large, up to a third of the seen range beyond it. Further off it is zero, and says nothing.

    An update by a few new transitions is as quick as any; by many, whose draws have to be moved in
    as many dimensions as there are forms, it takes long: learn the remainder anew from all data.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        Of whole trajectories.
    body : str
        Which body lacks a force.
    catalogue : iterable of Effect
        Where the names of the posterior's effects are looked up.
    seed : int
        The same seed gives the same posterior.
    draws : int
        Of each of four chains, from the Gaussian at the mode.
    progress : callable, optional
        Told the name of each stage.

    Returns
    -------
    InferenceData or DataTree
        With the remainder as the effect ``learned_remainder``, its table among the attributes.

    Raises
    ------
    FitError
        If there is nothing to learn: no force that depends on the velocity, or none that helps on
        trajectories that were left out; if it has one already, or scikit-learn is missing.
    PosteriorError
        If the posterior is of single transitions.
    """
    say = progress or (lambda stage: None)
    with threadpool_limits(1, "blas"):
        mode = likeliest_mode(posterior, tuple(catalogue))
        present = [attached.effect.name for attached in mode.problem.physics.effects]
        if LEARNED_REMAINDER in present:
            raise FitError("posterior: it has a learned remainder already; take one without")
        say(Stage.LEARN)
        effect = _learned(mode, body, seed)
        say(Stage.REFIT)
        refitted = _refitted(mode, effect, body)
        gained = gain(mode, refitted)
        if gained.total < DEFAULT.min_elpd or not gained.certain(DEFAULT.min_elpd_se):
            raise FitError(
                f"nothing to learn: a force on {body} that follows its velocity does not help on"
                " trajectories that were left out"
            )
        model = build_model(refitted.problem.with_physics(threads=1))
        return fit(model, method="laplace", seed=seed, draws=draws, start=refitted, progress=False)


def _refitted(mode: Mode, effect: LearnedRemainder, body: str) -> Mode:
    effects = (*mode.problem.physics.effects, effect.on(body))
    problem = mode.problem.with_physics(effects=effects)
    phi = problem.layout.from_layout(mode.problem.layout, mode.phi)
    phi[[problem.layout.labels.index(label) for label in effect.on(body).labels]] = 0.0
    return trajectory_mode(problem, phi, mode.sigma)


def _learned(mode: Mode, body: str, seed: int) -> LearnedRemainder:
    """The forms of the processes of those forces that are there."""
    x, forces = residual_forces(mode, body)
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(len(x))[:_MOST])
    low, high = x.min(axis=0), x.max(axis=0)
    size = np.maximum(high - low, 1e-9)
    table: dict[str, list[Any]] = {"centre": [], "width": [], "output": []}
    blocks = []
    matters = _matters(mode)
    for output, y in forces.items():
        if not matters[output]:
            continue
        found = _process((x[chosen] - low) / size, y[chosen], seed)
        if found is None:
            continue
        sd, lengths = found
        centre = rng.uniform(-_BEYOND, 1.0 + _BEYOND, (_BUMPS, x.shape[1]))
        off = (centre[:, None] - centre) / lengths
        values, vectors = np.linalg.eigh(np.exp(-0.5 * (off**2).sum(axis=-1)))
        values, vectors = values[::-1], vectors[:, ::-1]
        enough = int(np.searchsorted(np.cumsum(values) / values.sum(), _SHARE)) + 1
        kept = slice(0, min(enough, _FORMS))
        blocks.append(sd * vectors[:, kept].T / np.sqrt(values[kept])[:, None])
        table["centre"] += (low + size * centre).tolist()
        table["width"] += [(size * lengths).tolist()] * _BUMPS
        table["output"] += [output] * _BUMPS
    if not blocks:
        raise FitError(
            f"nothing to learn: what the model leaves of the forces on {body} is too little to"
            " matter, or does not depend on its velocity"
        )
    return learned_remainder(json.dumps(table | {"forms": block_diag(*blocks).tolist()}))


def _matters(mode: Mode) -> tuple[bool, bool, bool]:
    """Whether an acceleration is left that matters, for a force forward, sideways and a torque."""
    left = unexplained_acceleration(mode)
    own = dict(zip(left.names, left.matters.tolist(), strict=True))
    force = own.get("vx", False) or own.get("vy", False)
    return force, force, own.get("omega", False)


def _process(x: Array, y: Array, seed: int) -> tuple[float, Array] | None:
    """Standard deviation of a force, and its length scales; None if it is noise."""
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    except ImportError:
        raise FitError(
            "a learned remainder needs scikit-learn: pip install 'pbrl_ppl[remainder]'"
        ) from None
    scale = float(np.sqrt(np.mean(y**2)))
    if not scale > 0:
        return None
    kernel = ConstantKernel(1.0, (1e-4, 1e2)) * RBF(
        np.full(x.shape[1], 0.5), (_SHORTEST, _LONGEST)
    ) + WhiteKernel(0.5, (1e-4, 2.0))
    process = GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its bound is no matter
        process.fit(x, y / scale)
    # of noise alone, its variance fitted: that of y is 1
    alone = -0.5 * len(y) * (np.log(2 * np.pi) + 1.0)
    if process.log_marginal_likelihood_value_ - alone < _GAIN:
        return None
    fitted = process.kernel_.k1
    return scale * float(np.sqrt(fitted.k1.constant_value)), np.atleast_1d(fitted.k2.length_scale)


def residual_forces(mode: Mode, body: str) -> tuple[Array, dict[int, Array]]:
    """What steps add beyond a model, as forces in a body's frame.

    Returns
    -------
    velocity : ndarray
        In the body's frame, shape (transition, 3), m/s, m/s, rad/s.
    forces : dict of int to ndarray
        Forward and sideways force (N) and torque (N m), by 0, 1 and 2, as far as they are seen.

    Raises
    ------
    FitError
        If there is no such body.
    """
    problem = mode.problem
    names = [moving.name for moving in problem.scene.dynamic]
    if body not in names:
        raise FitError(f"remainder: there is no moving body {body!r}, only {', '.join(names)}")
    index = [moving.name for moving in problem.scene.moving].index(body)
    cells = problem.trajectory_noise.cells
    added = cells.of_residual(problem.residual(mode.phi)) / problem.scene.time_step
    column = {int(place): i for i, place in enumerate(cells.places)}
    places = [column.get(index * len(STATE) + d) for d in (3, 4, 5)]
    theta, vx, vy, omega = problem.segments.start[:, index, 2:].T
    c, s = np.cos(theta), np.sin(theta)
    velocity = np.stack([c * vx + s * vy, c * vy - s * vx, omega], axis=1)
    mass = _mass(problem, mode.phi, body)
    forces: dict[int, Array] = {}
    if places[0] is not None and places[1] is not None:
        ax, ay = added[:, places[0]], added[:, places[1]]
        forces |= {0: mass * (c * ax + s * ay), 1: mass * (c * ay - s * ax)}
    if places[2] is not None:
        moment = mass * problem.scene.body(body).shape.unit_moment
        forces[2] = moment * added[:, places[2]]
    return velocity, forces


def _mass(problem: Problem, phi: Array, body: str) -> float:
    own = problem.scene.body(body)
    known = dict(own.known)
    if "mass" in known:
        return float(known["mass"])
    return float(phi[problem.layout.index("mass", own.owner)])
