"""Where chains begin."""

import numpy as np
import pytest

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import Space, find_mode
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import parameter_draws
from pbrl_ppl.sampling import fit
from pbrl_ppl.sampling.methods import METHODS, SamplerRun, dispersed, prior_starts
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

pytestmark = pytest.mark.one_stack


@pytest.fixture(scope="module")
def mode():
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=6)
    return find_mode(Problem.of(Physics.declare(scene), history), seed=1)


def test_chains_begin_two_standard_deviations_from_the_mode(mode) -> None:
    """In the sampler's space, within the support; the same seed gives the same starts."""
    problem, space = mode.problem, Space.of(mode)
    starts = dispersed(mode, np.random.default_rng(1), 400)
    phi = problem.layout.to_vectors({k: np.array([s[k] for s in starts]) for k in starts[0]}, 400)
    assert np.isfinite(problem.layout.log_prior(phi)).all()
    mean, covariance = space.laplace(mode)
    q = space.at(phi, np.array([start["sigma"] for start in starts]))
    z = (q - mean) @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    # the standard deviation of 400 has an error of 3.5 %
    np.testing.assert_allclose(z.std(axis=0), 2.0, rtol=0.18)
    again = dispersed(mode, np.random.default_rng(1), 400)
    for one, other in zip(starts, again, strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])


@pytest.mark.filterwarnings("ignore:the chains have not converged")
def test_chains_go_on_at_their_last_draws(mode) -> None:
    model = physics_model(mode.problem.scene, mode.problem.data.history)
    idata = fit(model, start=mode, method="laplace", draws=12, chains=2, progress=False)
    problem = problem_in(model)
    phi, sigma = (each.reshape(2, 12, -1)[:, -1] for each in parameter_draws(problem, idata))
    method = METHODS["metropolis"]
    job = SamplerRun(problem, method, None, resume=idata, seed=1, cores=1, progress=print)
    for start, last in zip(job.starts(), zip(phi, sigma, strict=True), strict=True):
        for name, value in problem.named(*last).items():
            np.testing.assert_array_equal(start[name], value)


def test_chains_over_a_library_begin_anywhere_in_the_prior(mode) -> None:
    """Sets by their probabilities: 400 draws of 0.2, false alarm 1e-4."""
    library = ParameterLibrary({"light": CART, "heavy": CART | {"mass": 40.0}}, {
        "light": 1, "heavy": 4,
    })  # fmt: skip
    model = physics_model(cart_scene(), mode.problem.data.history, library=library)
    starts = prior_starts(problem_in(model), np.random.default_rng(2), 400)
    share = np.mean([start["library_index"] for start in starts])
    assert abs(share - 0.8) < 4 * np.sqrt(0.16 / 400)
    np.testing.assert_array_equal(starts[0]["sigma"], problem_in(model).noise_prior[0])
    with pytest.raises(FitError, match="has no library"):
        prior_starts(mode.problem, np.random.default_rng(2), 4)
