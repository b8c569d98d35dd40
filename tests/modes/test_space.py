"""Space of a problem: its transforms, its density, its Laplace approximation."""

from dataclasses import replace

import numpy as np
import pymc as pm
import pytest
from scipy import stats

from pbrl_ppl.likelihood import Problem, along_trajectories, single_transitions
from pbrl_ppl.model import build_model, physics_model, problem_in
from pbrl_ppl.modes import Space, find_mode, trajectory_mode
from pbrl_ppl.modes.space import constrain, unconstrain, uninformed
from pbrl_ppl.parameters import Prior, prior_draws, symmetrised
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

FREE = {"r": 0.0, "mu_c": 0.0}
PUCK = {"mass": 2.0, "r": 0.2, "mu_c": 0.3}
FORCE = tuple(f"constant_force_{name}" for name in ("force_x", "force_y", "torque"))
COVARIANCE = np.array([[1.0, 0.24], [0.24, 0.09]])


def cart_problem(trajectories=3, intervals=6, **options) -> Problem:
    scene = cart_scene(**({"known": {"r": 0.2, "mu_c": 0.3}} | options))
    history = simulated_history(scene, CART, seed=7, trajectories=trajectories, intervals=intervals)
    return Problem.of(Physics.declare(scene), history)


@pytest.fixture(scope="module")
def mode():
    return find_mode(cart_problem(), seed=1)


def pucks(names="a", known=FREE, **options) -> Scene:
    bodies = (Body(name, Shape.circle(0.1), known=known, **options) for name in names)
    return Scene(time_step=0.1, substeps=4, bodies=tuple(bodies))


# -- transforms ------------------------------------------------------------------------------------

PRIORS = [
    (Prior("log_normal", mu=0.3, sigma=0.5), lambda: pm.LogNormal("x", 0.3, 0.5)),
    (Prior("half_normal", sigma=2.0), lambda: pm.HalfNormal("x", 2.0)),
    (
        Prior("truncated_normal", mu=0.1, sigma=1.0, lower=-0.5, upper=1.5),
        lambda: pm.TruncatedNormal("x", 0.1, 1.0, lower=-0.5, upper=1.5),
    ),
    (Prior("normal", mu=1.0, sigma=2.0), lambda: pm.Normal("x", 1.0, 2.0)),
    (Prior("von_mises", mu=0.2, kappa=2.0), lambda: pm.VonMises("x", 0.2, 2.0)),
]


@pytest.mark.parametrize(
    ("prior", "distribution"),
    PRIORS,
    ids=lambda one: one.family if isinstance(one, Prior) else "",
)
def test_unconstrain_is_pymc_s_transform(prior, distribution) -> None:
    """The value and the derivative, by differences; and constrain is its inverse."""
    with pm.Model() as model:
        variable = distribution()
    transform = model.rvs_to_transforms[variable]

    def forward(x: float) -> float:
        if transform is None:
            return x
        value = transform.forward(np.array(x), *variable.owner.inputs)
        return float(value.eval(mode="FAST_COMPILE"))

    for x in (0.05, 0.4, 1.2):
        found, slope = unconstrain(prior, x)
        assert found == pytest.approx(forward(x))
        assert slope == pytest.approx((forward(x + 1e-5) - forward(x - 1e-5)) / 2e-5, rel=1e-6)
        assert constrain(prior, found) == pytest.approx(x)


@pytest.mark.one_stack
@pytest.mark.parametrize("kind", ["transitions", "scalar", "trajectories"])
def test_points_are_split_and_put_together_again(kind) -> None:
    """Noise that may vanish too, and parameters of each family."""
    scene = cart_scene(effects=("linear_drag", "constant_force"))
    force = dict.fromkeys(FORCE, 0.0)
    truth = CART | force | {"linear_drag_coefficient": 0.5}
    history = simulated_history(scene, truth, seed=7, trajectories=2, intervals=4)
    problem = Problem.of(Physics.declare(scene), history)
    if kind == "scalar":
        problem = problem.with_likelihood(scalar=True)
    rng = np.random.default_rng(1)
    phi = prior_draws(problem.layout.priors, rng, 20)
    if kind == "trajectories":
        problem = along_trajectories(problem, phi[0])
    assert {prior.family for prior in problem.layout.priors} >= {
        "log_normal", "truncated_normal", "von_mises", "half_normal",
    }  # fmt: skip
    free = len(problem.likelihood.free(problem.noise_prior[0]))
    sigma = problem.noise_prior[0] * np.exp(rng.standard_normal((20, free)))
    if kind == "scalar":
        sigma = sigma[:, :1] * np.ones(6)
    space = Space(problem, phi[0])
    q = space.at(phi, sigma)
    assert q.shape == (20, space.size) == (20, problem.layout.size + free)
    for found, given in zip(space.split(q), (phi, sigma), strict=True):
        circles = [p.family == "von_mises" for p in problem.layout.priors]
        if found.shape[-1] == len(circles):
            found, given = (
                np.where(circles, np.cos(each) + 2 * np.sin(each), each) for each in (found, given)
            )
        np.testing.assert_allclose(found, given, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(space.at(*space.split(q)), q, rtol=1e-9, atol=1e-9)
    # one point alone is as one of many
    np.testing.assert_array_equal(space.at(phi[3], sigma[3]), q[3])
    assert space.roots.any() == (kind == "trajectories")


@pytest.mark.one_stack
def test_a_circle_is_cut_opposite_to_the_centre(mode) -> None:
    """Angles a full turn apart are one point; beyond the cut there is no density."""
    problem, place = mode.problem, list(mode.problem.layout.labels).index("w_theta[cart]")
    centre = mode.phi.copy()
    centre[place] = 3.0
    space = Space(problem, centre)
    phi = np.repeat(centre[None], 5, axis=0)
    phi[:, place] = [3.0, -3.0, -0.2, 0.0, 3.0 - 2 * np.pi]
    sigma = np.tile(mode.sigma, (5, 1))
    q = space.at(phi, sigma)
    np.testing.assert_allclose(q[:, place], [3.0, 2 * np.pi - 3.0, 2 * np.pi - 0.2, 0.0, 3.0])
    assert np.isfinite(space.log_density(q)).all()
    # the same wheel, whatever turn
    one = Space(problem, mode.phi)
    np.testing.assert_allclose(space.log_density(q), one.log_density(one.at(phi, sigma)))
    for beyond in (3.0 + np.pi + 1e-6, 3.0 - np.pi - 1e-6):
        q[:, place] = beyond
        assert (space.log_prior(q) == -np.inf).all()


# -- the density -----------------------------------------------------------------------------------


@pytest.mark.parametrize("likelihood", ["sigma per dimension", "scalar sigma", "trajectories"])
def test_the_density_is_pymc_s(likelihood) -> None:
    """Prior, transforms and likelihood, with a prior that distinguishes a wheel's descriptions.

    But for the symmetrised prior of the wheel, and the cube roots of noise that may vanish.
    """
    scene = cart_scene(prior={"w_theta": {"mu": 0.6, "kappa": 0.7}, "mu_x": {"mu": 0.2}})
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=4)
    whole = likelihood == "trajectories"
    sigma = "scalar" if likelihood == "scalar sigma" else "per_dimension"
    options = {"likelihood": "trajectories"} if whole else {"sigma": sigma}
    model = physics_model(scene, history, **options)
    problem = problem_in(model)
    mode = find_mode(single_transitions(problem) if whole else problem, seed=1, rounds=1)
    if whole:
        mode = trajectory_mode(problem, mode.phi)
        problem = mode.problem
        model = build_model(problem)
    layout, space = problem.layout, Space(problem, mode.phi)
    rng = np.random.default_rng(4)
    start = space.at(mode.phi, np.maximum(mode.sigma, 1e-3))
    q = start + 0.3 * rng.standard_normal((5, space.size))
    q[:, layout.size :][:, space.roots] = start[layout.size :][space.roots] * np.exp(
        0.1 * rng.standard_normal((5, space.roots.sum()))
    )
    phi, sigma = space.split(q)
    # the density of a cube root is 3 / root times that of the logarithm, half of it at either sign
    roots = np.log(1.5 / q[:, layout.size :][:, space.roots]).sum(axis=-1)
    ours, likelihoods = space.log_densities(q)
    np.testing.assert_allclose(space.log_prior(q) + likelihoods.sum(axis=1), ours)
    function, theirs = model.compile_logp(mode="FAST_COMPILE"), []
    for point, x, noise in zip(q, phi, sigma, strict=True):
        named = layout.to_dict(point[: layout.size])
        named |= {
            name: np.log(values)
            for name, values in problem.named(x, noise).items()
            if name in problem.noise_variables
        }
        values = {model.rvs_to_values[model[name]].name: v for name, v in named.items()}
        theirs.append(float(function(values)))
    even = symmetrised(layout, phi).sum(axis=-1)
    assert np.abs(even).min() > 0
    # PyMC's constant of a truncated normal distribution has nine digits
    np.testing.assert_allclose(ours - roots - even, theirs, atol=1e-6, rtol=1e-10)


@pytest.mark.one_stack
def test_trajectories_mix_the_parts() -> None:
    """All parameters are one block, and the noise is by blocks of either transform."""
    scene = pucks("ab", effects=("linear_drag",))
    truth = {"mass": [2.0, 3.0], "linear_drag_coefficient": [0.5, 1.0]}
    history = simulated_history(scene, truth, seed=3, trajectories=5, intervals=1)
    problem = Problem.of(Physics.declare(scene), history)
    phi = problem.layout.to_vector(truth)
    noisy = along_trajectories(problem, phi)
    assert len(Space(problem, phi).blocks) == 3
    space = Space(noisy, phi)
    whole, *noises = space.blocks
    np.testing.assert_array_equal(whole, np.arange(problem.layout.size))
    assert len(noises) == 2
    assert sorted(np.concatenate(noises)) == list(range(space.phi_size, space.size))


@pytest.mark.one_stack
def test_there_is_no_density_where_numbers_end() -> None:
    problem = cart_problem(2, 3)
    phi = problem.layout.to_vector(CART)
    space = Space(problem, phi)
    q = np.tile(space.at(phi, np.ones(6)), (2, 1))
    q[:, : space.phi_size] = [[1e4], [-1e4]]
    assert (space.log_density(q) == -np.inf).all()


@pytest.mark.one_stack
def test_a_root_of_either_sign_is_the_same_noise() -> None:
    """A Gaussian of a cube root has a share below zero."""
    problem = cart_problem(2, 4)
    phi = problem.layout.to_vector(CART)
    problem = along_trajectories(problem, phi)
    space = Space(problem, phi)
    q = np.tile(space.at(phi, problem.noise_prior[0]), (2, 1))
    q[1, space.phi_size :][space.roots] *= -1
    np.testing.assert_array_equal(*space.split(q)[1])
    here, mirrored = space.log_density(q)
    assert np.isfinite(here) and mirrored == here


# -- parameters that the data do not inform --------------------------------------------------------


@pytest.mark.one_stack
def test_whether_a_parameter_is_informed_does_not_depend_on_its_unit(mode) -> None:
    """The derivative by a mass of 1e6 kg is small, and times the mass it is not."""
    place = list(mode.problem.layout.labels).index("mass[cart]")
    assert not uninformed(mode).any()
    phi, jacobian = mode.phi.copy(), mode.jacobian.copy()
    phi[place] *= 1e6
    jacobian[:, place] /= 1e6
    assert not uninformed(replace(mode, phi=phi, jacobian=jacobian)).any()


@pytest.mark.one_stack
def test_silent_parameters_are_drawn_from_the_prior() -> None:
    """Nothing touches the puck: r is not informed. Kolmogorov-Smirnov: false alarm 1e-4."""
    scene = pucks(known={"mu_c": 0.3})
    history = simulated_history(scene, PUCK, seed=3, trajectories=6, intervals=2)
    problem = Problem.of(Physics.declare(scene), history)
    space = Space.of(find_mode(problem, seed=1))
    labels = list(problem.layout.labels)
    place = labels.index("r[a]")
    assert list(np.flatnonzero(space.uninformed)) == [place]
    assert place not in space.informed and len(space.informed) == space.size - 1
    q = np.tile(space.at(space.centre, problem.noise_prior[0]), (4000, 1))
    before = q.copy()
    drawn = space.prior_draws(q, np.random.default_rng(1))
    np.testing.assert_array_equal(q, before)
    np.testing.assert_array_equal(drawn[:, space.informed], q[:, space.informed])
    prior = problem.layout.priors[place]
    r = space.split(drawn)[0][:, place]
    assert prior.family == "log_normal"
    assert stats.kstest(np.log(r), stats.norm(prior.mu, prior.sigma).cdf).pvalue > 1e-4
    # and no density includes it
    assert np.ptp(space.log_density(drawn[:50])) < 1e-9
    informed = Space(problem, space.centre)
    assert np.ptp(informed.log_density(drawn[:50])) > 0.1


# -- the Laplace approximation ---------------------------------------------------------------------


@pytest.mark.one_stack
def test_laplace_is_exact_where_the_engine_is_linear_and_the_prior_normal() -> None:
    """A constant force on a free body of known mass: least squares, at the mode's noise."""
    scene = pucks(known={"mass": 2.0, "r": 0.2, "mu_c": 0.3}, effects=("constant_force",))
    truth = dict(zip(FORCE, (0.4, -0.3, 0.001), strict=True))
    history = simulated_history(scene, truth, seed=3, trajectories=3, intervals=2, substeps=4)
    problem = Problem.of(Physics.declare(scene), history)
    mode = find_mode(problem, seed=1)
    priors = problem.layout.priors
    assert {prior.family for prior in priors} == {"normal"}
    p = len(priors)
    at = np.concatenate([np.zeros((1, p)), np.eye(p)])
    z = problem.whitened(at, np.tile(mode.sigma, (p + 1, 1))).reshape(p + 1, -1)
    slope = (z[1:] - z[0]).T
    np.testing.assert_allclose(  # it is linear
        problem.whitened(2 * np.ones(p), mode.sigma).ravel(),
        z[0] + 2 * slope.sum(axis=1),
        atol=1e-7,
    )
    sd = np.array([prior.sigma for prior in priors])
    precision = slope.T @ slope + np.diag(sd**-2.0)
    mu = np.array([prior.mu for prior in priors])
    expected = np.linalg.solve(precision, mu / sd**2 - slope.T @ z[0])
    mean, covariance = Space.of(mode).laplace(mode)
    expected_sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(
        covariance[:p, :p] / np.outer(expected_sd, expected_sd),
        np.linalg.inv(precision) / np.outer(expected_sd, expected_sd),
        atol=1e-3,
    )
    # the mode's own search ends within 0.02 nats
    np.testing.assert_allclose(mean[:p] / expected_sd, expected / expected_sd, atol=0.02)
    np.testing.assert_allclose(covariance[:p, p:], 0.0)
    # of log sigma, half the inverse of the number of measurements and the prior's precision
    counts = problem.observations.measured.sum((0, 1, 2))
    noise = 1.0 / (2.0 * counts + problem.noise_prior[1] ** -2.0)
    np.testing.assert_allclose(np.diag(covariance)[p:], noise)


class Bump(Space):
    """A space with a density of its own."""

    def log_density(self, q):
        return self.problem(q)

    @property
    def phi_size(self) -> int:
        return 2

    @property
    def _circles(self) -> list[int]:
        return []


def space_with(density) -> Space:
    return Bump(density, np.zeros(2))


def gaussian(q):
    """Log-density of a correlated Gaussian with standard deviations of 1 and 0.3."""
    return -0.5 * np.einsum("...i,ij,...j->...", q, np.linalg.inv(COVARIANCE), q)


@pytest.mark.one_stack
def test_a_gaussian_s_covariance_stays_as_it_is() -> None:
    found = space_with(gaussian).widened(np.zeros(2), COVARIANCE)
    np.testing.assert_array_equal(found, COVARIANCE)


@pytest.mark.one_stack
def test_it_is_widened_where_the_posterior_falls_off_more_slowly() -> None:
    """A bump at the top is ten times as narrow as the rest, on one side or on both."""
    narrow = np.diag([0.01, 0.01])

    def bumps(q):
        wide = -0.5 * (q**2).sum(axis=-1)
        steep = np.where(q[:, 1] > 0, -0.5 * 99 * q[:, 1] ** 2, 0.0)
        return wide + steep + 1e-3 * np.exp(-50 * (q**2).sum(axis=-1))

    found = np.sqrt(np.diag(space_with(bumps).widened(np.zeros(2), narrow)))
    assert 0.5 < found[0] < 2.0  # 1
    assert 0.3 < found[1] < 1.0  # 1 on one side, 0.1 on the other


@pytest.mark.one_stack
@pytest.mark.parametrize(
    "known", [PUCK, {"mu_c": 0.3, "mass": 2.0}], ids=["all known", "uninformed"]
)
def test_a_space_of_the_noise_alone(known) -> None:
    """Of a body of which all is known, or of which the data inform nothing."""
    scene = pucks(known=known)
    history = simulated_history(scene, PUCK, seed=3, trajectories=6, intervals=2)
    problem = Problem.of(Physics.declare(scene), history)
    mode = find_mode(problem, seed=1)
    mask = np.ones(problem.layout.size, dtype=bool)
    space = Space(problem, mode.phi, mask)
    assert list(space.informed) == list(range(space.phi_size, space.size))
    mean, covariance = space.laplace(mode)
    np.testing.assert_array_equal(space.widened(mean, covariance), covariance)


@pytest.mark.one_stack
@pytest.mark.parametrize("off", [-1e-3, 0.0, 1e-3])
def test_a_mode_opposite_to_the_centre(off) -> None:
    """Half a turn of a wheel of known frictions changes nothing; about it nothing is infinite."""
    problem = cart_problem(known={name: CART[name] for name in CART if name != "w_theta"})
    mode = find_mode(problem, initial=np.array([0.1]))
    space = Space(problem, mode.phi)
    half = replace(mode, phi=mode.phi + np.pi + off)
    mean, covariance = space.laplace(half)
    own = Space(problem, half.phi).laplace(half)[1]
    assert np.isfinite(mean).all()
    np.testing.assert_allclose(covariance[0, 0], own[0, 0], rtol=1e-3)
    assert np.isfinite(space.widened(mean, covariance)).all()
