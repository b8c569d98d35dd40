"""One log-posterior: PyMC's own, whatever the model; search, plan and evidence use it."""

import numpy as np
import pytest
from pymc.model.transform.conditioning import remove_value_transforms

from pbrl_ppl.likelihood import log_posterior, log_prior
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import Space, find_mode
from pbrl_ppl.modes.noise import profile_sigma
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.posterior import draws, parameter_draws, stored_mode, updated_mode
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Joint, Scene, Shape, state_sizes
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.joints import scene as boxes

CARTS = {
    "light": CART,
    "heavy": CART | {"mass": 40.0},
    "gripping": CART | {"mu_x": 0.3},
    "turned": CART | {"w_theta": 1.0},
}
FEW = {"seed": 5, "trajectories": 2, "intervals": 4}


@pytest.fixture(scope="module")
def history():
    return simulated_history(cart_scene(), CART, **FEW)


def jointed(joint: Joint):
    free = boxes(joint)
    return physics_model(free, simulated_history(boxes(), {}, **FEW))


def library(**options):
    scene = cart_scene()
    sets = ParameterLibrary(CARTS, {"light": 1, "heavy": 5, "gripping": 3, "turned": 1})
    return physics_model(scene, simulated_history(scene, CART, **FEW), library=sets, **options)


MODELS = {
    "wheel": lambda history: physics_model(cart_scene(), history),
    "declared priors": lambda history: physics_model(
        cart_scene(
            prior={"mass": {"mu": 2.0}, "w_theta": {"mu": 0.3, "kappa": 2.0}, "mu_x": {"mu": 0.1}},
            effects=("linear_drag", "constant_force"),
        ),
        history,
    ),
    "scalar sigma": lambda history: physics_model(cart_scene(), history, sigma="scalar"),
    "Student-t": lambda history: physics_model(cart_scene(), history, nu=4.0),
    "joint of unknown bodies": lambda _: jointed(Joint("hinge", known=False)),
    "joint of named bodies": lambda _: jointed(Joint("hinge", ("c", "d"), known=False)),
    "library": lambda _: library(),
    "library, scalar sigma": lambda _: library(sigma="scalar"),
}


@pytest.mark.parametrize("name", MODELS)
def test_it_is_pymc_s(history, name) -> None:
    """At draws from the prior, with every constant: an anchor's depends on its index."""
    model = MODELS[name](history)
    problem, rng, n = problem_in(model), np.random.default_rng(1), 4
    logp = remove_value_transforms(model).compile_logp(mode="FAST_COMPILE")
    median, _ = problem.noise_prior
    typical = median.mean() * np.ones(6) if problem.likelihood.scalar else median
    moved = rng.normal(0.0, 1.0, (n, 1 if problem.likelihood.scalar else 6))
    sigma = typical * np.exp(moved)
    choice = None
    if problem.library is None:
        phi = problem.layout.prior_draws(rng, n)
    else:
        choice = rng.integers(4, size=(n, 1))
        phi = problem.library.table(problem.layout, problem.scene)[:, choice[:, 0]].T
    found = log_posterior(problem, phi, sigma, choice)
    for i in range(n):
        values = problem.named(phi[i], sigma[i]) | (
            {} if choice is None else {"library_index": choice[i]}
        )
        point = {v.name: np.asarray(values[v.name], dtype=v.dtype) for v in model.free_RVs}
        assert found[i] == pytest.approx(float(logp(point)), rel=1e-9, abs=1e-6)


def test_outside_the_support_there_is_none(history) -> None:
    problem = problem_in(physics_model(cart_scene(), history))
    phi = problem.layout.to_vector(CART)
    for label, value in (("mass[cart]", 0.0), ("mu_x[cart]", 1.1), ("w_x[cart]", -3.0)):
        wrong = phi.copy()
        wrong[problem.layout.labels.index(label)] = value
        assert log_prior(problem, wrong, np.ones(6)) == -np.inf


def test_a_mode_s_height_is_the_log_posterior(history) -> None:
    """P(sigma) included; it was left out of the search."""
    problem = problem_in(physics_model(cart_scene(known={"r": 0.2, "mu_c": 0.3}), history))
    mode = find_mode(problem, initial=problem.layout.to_vector(CART))
    assert mode.log_posterior == pytest.approx(
        float(log_posterior(problem, mode.phi, mode.sigma)), rel=1e-12
    )


@pytest.mark.parametrize(
    "options", [{}, {"sigma": "scalar"}, {"nu": 4.0}, {"nu": 4.0, "sigma": "scalar"}], ids=str
)
def test_sigma_is_the_most_probable_one(history, options) -> None:
    """No other sigma is more probable at the same residuals, P(sigma) included.

    With eight transitions the likelihood's own maximum is 6 % larger.
    """
    problem = problem_in(physics_model(cart_scene(), history, **options))
    phi = problem.layout.to_vector(CART)
    sigma = profile_sigma(problem, problem.residual(phi))
    here = log_posterior(problem, phi, sigma)
    if options.get("sigma"):
        assert np.ptp(sigma) == 0.0
    for step in (-0.02, 0.02):
        for d in range(6):
            moved = sigma.copy()
            moved[slice(None) if options.get("sigma") else d] *= np.exp(step)
            assert log_posterior(problem, phi, moved) < here
    # at a maximum the slope by log sigma vanishes
    every = np.ones((2, 1)) * sigma * np.exp(np.array([[-1e-4], [1e-4]]))
    two = [float(log_posterior(problem, phi, each)) for each in every]
    assert abs(two[1] - two[0]) / 2e-4 < 0.01


def test_an_exact_fit_has_the_prior_s_sigma(history) -> None:
    """Two cells without residual: the likelihood alone would make sigma vanish."""
    problem = problem_in(physics_model(cart_scene(), history.select([0])))
    sigma = profile_sigma(problem, np.zeros_like(problem.observations.values))
    median, spread = problem.noise_prior
    count = problem.observations.measured.sum((0, 1, 2))
    expected = np.maximum(
        median * np.exp(-(spread**2) * (count + 1)), 1e-9 * np.array(state_sizes(problem.scene))
    )
    np.testing.assert_allclose(sigma, expected, rtol=1e-6)


def test_the_evidence_s_coordinates_have_the_same_density(history) -> None:
    """In them it is the log-posterior with the volume of the change of coordinates."""
    problem = problem_in(physics_model(cart_scene(), history))
    mode = find_mode(problem, initial=problem.layout.to_vector(CART), rounds=1)
    space = Space(problem, mode.phi)
    z = space.at(mode.phi, mode.sigma) + np.random.default_rng(2).normal(0, 0.1, (4, space.size))
    step = 1e-5
    volume = np.zeros(4)
    for i in range(z.shape[1]):
        ends = [
            np.hstack(space.split(z + sign * step * np.eye(z.shape[1])[i]))[:, i]
            for sign in (-1, 1)
        ]
        volume += np.log(np.abs(ends[1] - ends[0]) / (2 * step))
    phi, sigma = space.split(z)
    expected = log_posterior(problem, phi, sigma) + volume
    np.testing.assert_allclose(space.log_density(z), expected, atol=2e-3)


@pytest.mark.filterwarnings("ignore:the chains have not converged")  # so few draws
def test_the_plan_s_draw_is_the_most_probable() -> None:
    """As after an update over a library; the prior decides of draws with equal likelihoods.

    It is that of sigma, and of which set a body has.
    """
    model = library()
    idata = fit(model, seed=1, draws=200, chains=2, progress=False)
    posterior = idata["posterior"]
    likelihood = idata["log_likelihood"]["next_state"]
    likelihood.values[...] = 0.0
    problem = problem_in(model)
    median, spread = problem.noise_prior
    posterior["sigma"].values[...] = median * 30.0
    table = problem.library.table(problem.layout, problem.scene)
    for i, where in enumerate([(0, 7), (1, 5), (0, 3)]):
        # the second is the most probable set, at a likely sigma; the third at an unlikely one
        which = [0, 1, 1][i]
        posterior["library_index"].values[where] = which
        posterior["sigma"].values[where] = median * [1.0, 1.0, 20.0][i] * np.exp(-(spread**2))
        for block, place in problem.layout.slices():
            posterior[block.name].values[where] = table[place, which]
    phi, sigma = parameter_draws(problem, idata)
    choice = draws(idata)["library_index"].astype(np.intp)
    begin = stored_mode(problem, idata)
    best = updated_mode(problem, begin, (phi, sigma, choice), np.zeros(len(phi)))
    assert best.sets == {"cart": problem.library.names[1]}
    np.testing.assert_array_equal(list(best.parameters.values()), table[:, 1])
    np.testing.assert_allclose(list(best.noise.values()), median * np.exp(-(spread**2)))


def test_the_plan_knows_an_anchor_s_prior_by_its_index() -> None:
    """An anchor on a small body has a denser prior than one in the world."""
    model = jointed(Joint("hinge", known=False))
    layout = problem_in(model).layout
    phi = np.zeros((2, layout.size))
    phi[:, layout.index("i_b", "joint1")] = 1, 4
    one, other = layout.log_prior(phi)[:, layout.index("b_x", "joint1")]
    block = next(block for block in layout.blocks if block.name == "b_x")
    expected = [block.conditional[0][i].log_density(np.array(0.0)) for i in (1, 4)]
    np.testing.assert_allclose((one, other), expected)
    assert one > other + 1.0


def test_pucks_without_unknowns_have_the_noise_s_prior_alone() -> None:
    puck = Body("puck", Shape.circle(0.1), known={"mass": 1.0, "r": 0.2, "mu_c": 0.3})
    scene = Scene(time_step=0.1, substeps=4, bodies=(puck,))
    history = simulated_history(scene, {}, **FEW)
    problem = problem_in(physics_model(scene, history))
    median, spread = problem.noise_prior
    found = log_prior(problem, np.zeros(0), median)
    expected = (-np.log(spread * np.sqrt(2 * np.pi)) - np.log(median)).sum()
    assert found == pytest.approx(expected)
    assert problem.with_likelihood(scalar=True).noise_prior[1] == spread
