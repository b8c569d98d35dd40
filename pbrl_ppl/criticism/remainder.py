"""Learned remainder: a Gaussian process for a force that no effect explains."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable
from importlib.util import find_spec

import numpy as np
from scipy.linalg import block_diag

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import Stage
from pbrl_ppl.criticism.rivals import posterior_mode
from pbrl_ppl.criticism.search import with_effects
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.effects import LEARNED_REMAINDER, Effect, LearnedRemainder, learned_remainder
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import ACCELERATION
from pbrl_ppl.modes import FilteredMode, trajectory_evidence, trajectory_mode
from pbrl_ppl.posterior import Fit, Idata, group
from pbrl_ppl.posterior import draws as posterior_draws
from pbrl_ppl.sampling import sample
from pbrl_ppl.scene import state_sizes
from pbrl_ppl.state import STATE, Floats, acceleration_unit
from pbrl_ppl.threads import one_blas_thread


def check_scikit_learn() -> None:
    """Raise if scikit-learn, which a learned remainder needs, is not installed.

    Raises
    ------
    FitError
        Names the extra that installs it.
    """
    if find_spec("sklearn") is None:
        raise FitError(
            "a learned remainder needs scikit-learn, which is not installed: pip install"
            " 'pbrl_ppl[remainder]'"
        )


@one_blas_thread
def learn_remainder(
    posterior: Fit | Idata,
    body: str,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    draws: int = 250,
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> Idata:
    """Learn a residual force on a body, with its uncertainty, and refit the model with it.

    The residual acceleration of each step, times mass and moment of inertia, is a force and a
    torque in the body's frame. A Gaussian process of the velocity in that frame (forward, sideways,
    angular) is fitted to each. The leading eigenvectors of its kernel, with standard normal
    weights, go into the model, which is then refitted to whole trajectories with all parameters
    and both noises. So the weights vary from draw to draw as far as the data leave them open. At
    speeds that were not recorded the mean force returns to zero and its spread to that of the
    process, up to a third of the recorded range beyond it; further off it is zero.

    An update by a few new transitions is quick. One by many moves the draws in as many dimensions
    as there are weights, and takes long: learn the remainder again from all data.

    Parameters
    ----------
    posterior : InferenceData, DataTree or Fit
        A posterior of whole trajectories.
    body : str
        The body that lacks a force.
    catalogue : iterable of Effect
        Where the names of the posterior's effects are looked up.
    seed : int
        The same seed gives the same posterior.
    draws : int
        Draws of each of four chains, from the Gaussian at the mode.
    criteria : Criteria
        The gain that a force needs.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    InferenceData or DataTree
        With the remainder as the effect ``learned_remainder``, its table among the attributes.

    Raises
    ------
    FitError
        If no force depends on the velocity, or none is worth its parameters; if the posterior has a
        learned remainder already, or scikit-learn is missing.
    PosteriorError
        If the posterior is of single transitions.
    """
    check_scikit_learn()
    say = progress or (lambda stage: None)
    mode = posterior_mode(Fit.of(posterior, catalogue))
    present = [attached.effect.name for attached in mode.problem.physics.effects]
    if LEARNED_REMAINDER in present:
        raise FitError("posterior: it has a learned remainder already; take one without")
    say(Stage.LEARN)
    effect = _learned(mode, body, seed, criteria)
    say(Stage.REFIT)
    attached = effect.on(body)
    start = with_effects(
        mode, (*mode.problem.physics.effects, attached), {attached: np.zeros(len(attached.labels))}
    )
    refitted = trajectory_mode(*start, mode.sigma)
    if trajectory_evidence(refitted) - trajectory_evidence(mode) < criteria.min_remainder:
        raise FitError(
            f"nothing to learn: a force on {body} that follows its velocity is not worth its"
            " parameters (log-evidence)"
        )
    problem = refitted.problem.with_physics(threads=1)
    fit = sample(problem, method="laplace", seed=seed, draws=draws, start=refitted)
    return fit.posterior


def remainder_in_words(before: FilteredMode, after: Idata) -> str:
    """Return a sentence on what a learned remainder does, from the innovations before it."""
    places = before.problem.likelihood.noise.coordinates.accelerations
    sizes = before.sigma[places], posterior_draws(after)[ACCELERATION].mean(axis=0)
    names = group(after, "posterior")[ACCELERATION]
    worst = int(np.argmax(sizes[0] - sizes[1]))
    name = str(names[names.dims[-1]].values[worst])
    return (
        f"learned remainder, a force without a law: what a step adds unexplained to {name} falls"
        f" from {sizes[0][worst]:.2g} to {sizes[1][worst]:.2g} {acceleration_unit(name)}"
    )


def _learned(
    mode: FilteredMode,
    body: str,
    seed: int,
    criteria: Criteria,
    *,
    most_transitions: int = 400,
    margin: float = 0.3,
    centres: int = 48,
    variance_share: float = 0.9995,
    most_forms: int = 24,
) -> LearnedRemainder:
    """Return the effect with the eigenvectors of each significant force's process.

    The process extends by ``margin`` of the recorded range of speeds beyond it; there it returns to
    zero. Of ``centres`` kernels of each force the eigenvectors with ``variance_share`` of the
    variance are kept, at most ``most_forms``.
    """
    x, forces = residual_forces(mode, body)
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(len(x))[:most_transitions])
    low, high = x.min(axis=0), x.max(axis=0)
    size = np.maximum(high - low, 1e-9 * state_sizes(mode.problem.scene)[3:])
    centres_of, widths, outputs = list[list[float]](), list[list[float]](), list[int]()
    blocks = []
    excess = unexplained_acceleration(mode, criteria)
    missing = {name for name, matters in zip(excess.names, excess.matters, strict=True) if matters}
    for output, y in forces.items():
        if missing.isdisjoint({"omega"} if output == 2 else {"vx", "vy"}):
            continue
        process = _process((x[chosen] - low) / size, y[chosen], seed, criteria.min_remainder)
        if process is None:
            continue
        sd, lengths = process
        centre = rng.uniform(-margin, 1.0 + margin, (centres, x.shape[1]))
        off = (centre[:, None] - centre) / lengths
        values, vectors = np.linalg.eigh(np.exp(-0.5 * (off**2).sum(axis=-1)))
        values, vectors = values[::-1], vectors[:, ::-1]
        enough = int(np.searchsorted(np.cumsum(values) / values.sum(), variance_share)) + 1
        kept = slice(0, min(enough, most_forms))
        blocks.append(sd * vectors[:, kept].T / np.sqrt(values[kept])[:, None])
        centres_of += (low + size * centre).tolist()
        widths += [(size * lengths).tolist()] * centres
        outputs += [output] * centres
    if not blocks:
        raise FitError(
            f"nothing to learn: the unexplained force on {body} is negligible, or does not depend"
            " on its velocity"
        )
    forms = block_diag(*blocks).tolist()
    table = {"centre": centres_of, "width": widths, "output": outputs, "forms": forms}
    return learned_remainder(json.dumps(table))


def _process(
    x: Floats,
    y: Floats,
    seed: int,
    needed: float,
    length_bounds: tuple[float, float] = (0.15, 10.0),
) -> tuple[float, Floats] | None:
    """Return the standard deviation of a force and its length scales; None if it is noise.

    Length scales are shares of the range of recorded speeds; a longer one is a constant.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    scale = float(np.sqrt(np.mean(y**2)))
    if not scale > 0:
        return None
    kernel = ConstantKernel(1.0, (1e-4, 1e2)) * RBF(
        np.full(x.shape[1], 0.5), length_bounds
    ) + WhiteKernel(0.5, (1e-4, 2.0))
    process = GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its bound is no matter
        process.fit(x, y / scale)
    # noise alone with its variance fitted, which is 1 here
    alone = -0.5 * len(y) * (np.log(2 * np.pi) + 1.0)
    if process.log_marginal_likelihood_value_ - alone < needed:
        return None
    fitted = process.kernel_.k1
    return scale * float(np.sqrt(fitted.k1.constant_value)), np.atleast_1d(fitted.k2.length_scale)


def residual_forces(mode: FilteredMode, body: str) -> tuple[Floats, dict[int, Floats]]:
    """Return the residual accelerations of steps as forces in a body's frame.

    Returns
    -------
    velocity : ndarray
        In the body's frame, shape (transition, 3), m/s, m/s, rad/s.
    forces : dict of int to ndarray
        Forward and sideways force (N) and torque (N m), by 0, 1 and 2, where observed.

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
    coordinates = problem.likelihood.noise.coordinates
    added = coordinates.of_residual(problem.residual(mode.phi)) / problem.scene.time_step
    column = {int(place): i for i, place in enumerate(coordinates.places)}
    places = [column.get(index * len(STATE) + d) for d in (3, 4, 5)]
    theta, vx, vy, omega = problem.segments.start[:, index, 2:].T
    c, s = np.cos(theta), np.sin(theta)
    velocity = np.stack([c * vx + s * vy, c * vy - s * vx, omega], axis=1)
    declared = problem.scene.body(body)
    known = dict(declared.known)
    if "mass" in known:
        mass = float(known["mass"])
    else:
        mass = float(mode.phi[problem.layout.index("mass", declared.owner)])
    forces: dict[int, Floats] = {}
    if places[0] is not None and places[1] is not None:
        ax, ay = added[:, places[0]], added[:, places[1]]
        forces |= {0: mass * (c * ax + s * ay), 1: mass * (c * ay - s * ax)}
    if places[2] is not None:
        moment = mass * declared.shape.unit_moment
        forces[2] = moment * added[:, places[2]]
    return velocity, forces
