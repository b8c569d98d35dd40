"""Polynomials in place of the engine: exact on polynomials, close to the engine, safe to use."""

from functools import partial

import arviz as az
import numpy as np
import pymc as pm
import pytest

from pbrl_ppl.likelihood import Problem, along_trajectories, single_transitions
from pbrl_ppl.modes import find_mode, trajectory_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior.store import group
from pbrl_ppl.sampling import emulator, fit, methods, physics_model
from pbrl_ppl.sampling.emulator import Emulator, Piece, Pieces, Surrogate, Unpack, emulate
from pbrl_ppl.sampling.starts import gaussian_blocks
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

pytestmark = pytest.mark.one_stack


def two_parts(sizes: tuple[int, int]) -> Pieces:
    """One body a piece, with its own parameters, in the one transition."""
    first, second = sizes
    row = np.array([0])
    pieces = [
        Piece(np.arange(first), np.array([0]), row),
        Piece(first + np.arange(second), np.array([1]), row),
    ]
    return Pieces(pieces, np.zeros(0, dtype=int), lambda phi: phi)


def polynomial(phi: np.ndarray) -> np.ndarray:
    """Residuals, shape (run, transition, H, body, state), each body's of its own parameters."""
    a, b, c = phi.T
    first = np.stack([1 + a, a * b, b**2 - a], axis=-1)
    second = np.stack([c, 2 - c**2, 0 * c], axis=-1)
    return np.stack([first, second], axis=-2)[:, None, None]


@pytest.mark.parametrize("degree", [1, 2])
def test_polynomials_are_exact_up_to_their_degree(degree: int) -> None:
    rng = np.random.default_rng(1)
    phi = rng.normal([3.0, -1.0, 1e-3], [0.1, 2.0, 1e-4], (60, 3))
    told = Emulator(two_parts((2, 1)), phi, polynomial(phi), degree)
    fresh = rng.normal([3.0, -1.0, 1e-3], [0.1, 2.0, 1e-4], (5, 3))
    error = max(np.abs(told(each) - polynomial(each[None])[0]).max() for each in fresh)
    if degree == 2:
        assert error < 1e-9
    else:
        assert error > 0.01


def test_a_part_is_asked_again_when_its_parameters_change() -> None:
    """Parts are remembered one by one; none may be out of date, whatever the order of moves."""
    rng = np.random.default_rng(2)
    phi = rng.normal(size=(60, 3))
    told = Emulator(two_parts((2, 1)), phi, polynomial(phi), 2)
    here = phi[0].copy()
    for place in rng.integers(0, 3, 30):
        here = here.copy()
        here[place] = rng.choice([-0.5, 0.3, 1.0])  # also back to where it was
        np.testing.assert_allclose(told(here), polynomial(here[None])[0], atol=1e-9)


def test_bodies_that_meet_are_emulated_apart_and_the_engine_predicts_their_contacts() -> None:
    """Polynomials of all parameters would need more runs, and follow no kink."""
    body = partial(Body, shape=Shape.circle(0.3), known={"mu_c": 0.2})
    pair = Scene(time_step=0.1, substeps=4, bodies=(body("one"), body("two")))
    history = simulated_history(
        pair, {"mass": 1.0, "r": 0.5}, seed=2, trajectories=6, intervals=12,
        wrench_sd=(1.5, 1.5, 0.1), poses=[(0.0, 0.0, 0.0), (0.61, 0.0, 0.0)],
    )  # fmt: skip
    problem = Problem.of(Physics.declare(pair), history)
    truth = problem.layout.to_vector({"mass": 1.0, "r": 0.5})
    problem = along_trajectories(problem, truth)
    met = problem.trajectory_noise.touching
    assert 0.1 < met.mean() < 0.9
    found = Pieces.of(problem)
    np.testing.assert_array_equal(found.rows, np.flatnonzero(met))
    rng = np.random.default_rng(1)
    phi = truth * (1 + 0.02 * rng.standard_normal((40, len(truth))))
    runs = problem.residual(phi)
    told, spread = Emulator(found, phi, runs, 2), runs.std(axis=0)[~met].max()
    fresh = truth * (1 + 0.02 * rng.standard_normal((5, len(truth))))
    for point in fresh:
        exact, emulated = problem.residual(point), told(point)
        np.testing.assert_allclose(emulated[met], exact[met], atol=1e-14)
        assert 0 < np.abs(emulated - exact)[~met].max() < 0.02 * spread


@pytest.fixture(scope="module")
def model() -> pm.Model:
    """120 transitions: enough that an engine run costs more than a sampler's own work."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3}).replace(substeps=12)
    history = simulated_history(scene, CART, seed=7, trajectories=6, intervals=20)
    return physics_model(scene, history)


def test_it_follows_the_engine_over_the_posterior(model) -> None:
    mode = find_mode(model.problem, seed=1)
    blocks, unpack = gaussian_blocks(model, mode), Unpack(model, model.problem)
    found = emulate(mode, unpack, blocks, 3)
    assert found is not None
    rough = Surrogate(model.problem, unpack, found)
    logp = model.compile_logp()
    wide = emulator.explore(blocks, rough, blocks[0].mean, 2000, np.random.default_rng(4))
    off = []
    for q in wide[::40]:
        phi, sigma, prior = unpack(q)
        exact = model.problem.log_density(model.problem.residual(phi), sigma).sum()
        told = model.problem.log_density(found(phi), sigma).sum()
        assert rough(q) == pytest.approx(prior + 0.9 * told)
        off.append(told - exact)
    assert np.std(off) < 1.5
    assert np.isfinite(logp(model.initial_point()))


def test_runs_reach_farther_than_the_posterior_and_stay_in_the_support(model) -> None:
    """A kink beyond the first draws was never seen, and a chain beyond it stood still."""
    mode = find_mode(model.problem, seed=1)
    drawn = mode.draws(np.random.default_rng(2), 200)
    runs = emulator.spread(model.problem, drawn)
    np.testing.assert_array_equal(runs[:200], drawn)
    lower, upper = model.problem.layout.supports(runs)
    assert ((runs >= lower) & (runs <= upper)).all()
    heaviest = list(model.problem.layout.labels).index("mass[cart]")
    assert runs[200:, heaviest].std() == pytest.approx(2 * drawn[:, heaviest].std())


def test_errors_count_farther_off_where_the_engine_says_it_is_as_likely() -> None:
    """Of cart-null's kinks an emulator learned one side, whose draws confirmed it."""
    exact = np.array([-1.0, -2.0, -3.0, -4.0, -2.5, -40.0])
    told = exact + np.array([0.1, 0.0, -0.1, 0.0, -6.0, 9.0])
    np.testing.assert_allclose(emulator.errors(told, exact, 4), [0.1, 0.0, -0.1, 0.0, -6.0])


def test_none_where_no_polynomial_is_close(model, monkeypatch) -> None:
    """An engine that answers at random about the mode cannot be emulated."""
    mode = find_mode(model.problem, seed=1)
    blocks, unpack = gaussian_blocks(model, mode), Unpack(model, model.problem)
    rng, true = np.random.default_rng(5), model.problem.residual

    def random(phi: np.ndarray) -> np.ndarray:
        residual = true(phi)
        return residual + mode.sigma * rng.standard_normal(residual.shape)

    monkeypatch.setattr(type(model.problem), "residual", lambda self, phi: random(phi))
    assert emulate(mode, unpack, blocks, 3) is None


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the chains have not converged")  # too short for 400 effective
def test_looking_ahead_changes_nothing_but_the_speed(model, monkeypatch) -> None:
    """The same posterior with the emulator and without.

    Means and squares of 12 parameters agree within 4 Monte Carlo errors: a false alarm 0.2 % of the
    time.
    """
    options = {"seed": 2, "chains": 2, "cores": 1, "progress": False, "tune": 300}
    options["method"] = "metropolis"
    ahead = fit(model, draws=800, **options)
    assert float(group(ahead, "sample_stats")["look_ahead_accept"].mean()) > 0.5
    monkeypatch.setattr(methods, "_LITTLE", np.inf)
    plain = fit(model, draws=300, **options)
    assert np.isnan(group(plain, "sample_stats")["look_ahead_accept"]).all()
    first, second = group(ahead, "posterior"), group(plain, "posterior")
    for name in first.data_vars:
        centre = first[name].mean(("chain", "draw"))
        for power in (1, 2):
            means, errors = [], []
            for each in (first, second):
                moment = (each[name] - centre) ** power
                means.append(moment.mean(("chain", "draw")))
                errors.append(az.mcse(moment.to_dataset(name=name))[name])
            gap, error = abs(means[0] - means[1]), np.hypot(*errors)
            assert (gap < 4 * error).all(), (name, power, gap.values, error.values)


@pytest.mark.parametrize("trajectories", [False, True])
def test_a_quadratic_form_stands_for_the_density_at_the_same_noise(trajectories) -> None:
    """White residuals are linear in the polynomials' terms, measured deviations or not."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=6)
    model = physics_model(scene, history, trajectories=trajectories)
    problem = model.problem
    mode = find_mode(single_transitions(problem), seed=1)
    problem = problem if not trajectories else trajectory_mode(problem, mode.phi).problem
    mode = trajectory_mode(problem, mode.phi) if trajectories else mode
    phi = mode.draws(np.random.default_rng(1), 60)
    told = Emulator(Pieces.of(problem), phi, problem.residual(phi), 1)
    q = np.zeros(3)

    def unpack(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        return phi[int(q[0])], mode.sigma * np.exp(q[1]), -1.5

    rough = Surrogate(problem, unpack, told)
    for number, louder in [(0, 0.0), (1, 0.0), (2, 0.0), (2, 0.1), (3, 0.1), (4, 0.1), (0, 0.0)]:
        q[:] = number, louder, 0.0
        density = problem.log_density(told(phi[number]), unpack(q)[1], phi[number]).sum()
        assert rough(q) == pytest.approx(-1.5 + 0.9 * density, rel=1e-9)
