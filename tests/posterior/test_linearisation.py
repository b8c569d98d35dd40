"""Check of a linearisation against states smoothed again at draws."""

import json
import warnings

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.errors import LinearisationWarning
from pbrl_ppl.likelihood import declared_problem
from pbrl_ppl.model import problem_in
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import from_groups, groups, parameter_draws
from pbrl_ppl.posterior.completion import MOST, complete, linearisation, linearisation_errors
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history


def test_linear_motion_has_no_error() -> None:
    """A puck of unknown mass: next states are linear in the states, whatever the mass."""
    puck = Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3})
    scene = Scene(time_step=0.1, substeps=2, bodies=(puck,))
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=3, intervals=4)
    problem = problem_in(pp.physics_model(scene, history, likelihood="trajectories"))
    rng = np.random.default_rng(1)
    sigma = problem.likelihood.noise.sigma * np.exp(0.3 * rng.normal(size=(5, 9)))
    errors = linearisation_errors(problem, rng.uniform(1.9, 2.1, (5, 1)), sigma)
    assert errors.shape == (5, 3)
    np.testing.assert_allclose(errors, 0.0, atol=1e-5)
    diverged = np.full((1, 1), 1e-200)  # kg
    assert (linearisation_errors(problem, diverged, sigma[:1]) == 0.0).all()


@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")
def test_a_fit_says_where_it_does_not_hold() -> None:
    """A cart linearised at its mode, and at the prior's centre, where the wheel rolls elsewhere."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    history = simulated_history(scene, CART, seed=1, trajectories=6)
    model = pp.physics_model(scene, history, likelihood="trajectories")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", LinearisationWarning)
        idata = pp.fit(model, method="laplace", draws=50, progress=False)
    found = json.loads(idata.attrs["linearisation"])
    assert found["draws"] == 16 and found["sd"] <= MOST
    assert found["sd"] <= found["largest"] and 0 <= found["trajectory"] < 6
    centre = declared_problem(Physics.declare(scene), history, kind="trajectories")
    phi, sigma = parameter_draws(problem_in(model), idata)
    assert linearisation(centre, phi, sigma).sd > 10 * MOST
    data = groups(idata)
    data["constant_data"] = data["constant_data"][["start", "actions"]]
    with pytest.warns(LinearisationWarning, match=r"differs by \S+ nats .* most in trajectory \d"):
        warned = complete(centre, from_groups(data, {}), seed=1, method="laplace")
    assert "linearised where it does not hold" in warned.attrs["warnings"]
