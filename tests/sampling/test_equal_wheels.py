"""Draws are from the declared posterior where the prior tells a wheel's descriptions apart."""

import warnings

import numpy as np
import pytest
from scipy.special import logsumexp

from pbrl_ppl.errors import ConvergenceWarning
from pbrl_ppl.likelihood import log_prior
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.posterior import convergence, draws
from pbrl_ppl.sampling import fit
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

KNOWN = {name: CART[name] for name in CART if name not in ("w_theta", "mu_x", "mu_y")}
LOOKED_AT = {
    "cos w_theta": lambda phi, turns: np.cos(turns * phi[:, 0]),
    "sin w_theta": lambda phi, turns: np.sin(turns * phi[:, 0]),
    "mu_x": lambda phi, _: phi[:, 1],
    "mu_y": lambda phi, _: phi[:, 2],
    "mu_x < mu_y": lambda phi, _: 1.0 * (phi[:, 1] < phi[:, 2]),
}


def grid() -> np.ndarray:
    """Middles of cells of the angle and both frictions, shape (point, 3)."""
    angle = (np.arange(72) + 0.5) / 72 * 2 * np.pi - np.pi
    share = (np.arange(24) + 0.5) / 24
    return np.stack(np.meshgrid(angle, share, share, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prior", "turns"),
    [
        pytest.param({"w_theta": {"mu": 0.6, "kappa": 0.7}}, 1, id="angle known roughly"),
        # half a turn is the same to this prior: it is folded, and twice the angle has a mean
        pytest.param(
            {"mu_x": {"mu": 0.2, "sigma": 0.4}}, 2, id="frictions differ", marks=pytest.mark.long
        ),
    ],
)
def test_the_posterior_is_the_declared_one(prior, turns) -> None:
    """Against a grid: up to four modes, of which a walk sees one; draws were folded onto one.

    Five means within 4 standard errors: false alarm 3e-4.
    """
    scene = cart_scene(known=KNOWN, prior=prior).replace(substeps=4)
    history = simulated_history(
        scene, CART, seed=3, trajectories=2, intervals=3, noise=np.full(6, 0.3), substeps=4
    )
    model = physics_model(scene, history, sigma="scalar")
    problem = problem_in(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        idata = fit(model, seed=4, draws=1000, tune=500, chains=2, cores=1, progress=False)
    assert max(convergence(idata)[0].values()) < 1.03
    found = problem.layout.to_vectors(draws(idata), 2000)
    ess = min(400.0, *convergence(idata)[1].values())
    phi = grid()
    square = np.concatenate(
        [
            (problem.residual(phi[i : i + 2000]) ** 2).sum((1, 2, 3, 4))
            for i in range(0, len(phi), 2000)
        ]
    )[:, None]
    log_sigma = np.linspace(-4.0, 1.0, 60)
    density = -problem.observations.values.size * log_sigma - 0.5 * square * np.exp(-2 * log_sigma)
    sigma = np.exp(log_sigma)[:, None] * np.ones(6)
    density += log_prior(problem, phi[:1], sigma) + log_sigma
    log_weight = logsumexp(density, axis=1) + problem.layout.log_prior(phi).sum(axis=1)
    weight = np.exp(log_weight - logsumexp(log_weight))
    assert 1.0 / (weight**2).sum() > 200  # the grid is fine enough
    for name, look in LOOKED_AT.items():
        expected, ours = weight @ look(phi, turns), look(found, turns)
        error = ours.std() / np.sqrt(ess)
        assert abs(ours.mean() - expected) < 4 * error + 0.01, (name, ours.mean(), expected)
        assert error < 0.1
