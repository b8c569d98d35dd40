"""Polynomials in place of the engine: exact on polynomials, close to the engine, safe to use."""

import re
from functools import partial

import arviz as az
import numpy as np
import pymc as pm
import pytest

from pbrl_ppl.likelihood import Problem, along_trajectories
from pbrl_ppl.modes import Space, find_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior.store import group
from pbrl_ppl.sampling import emulator, fit, methods, physics_model
from pbrl_ppl.sampling.emulator import Emulator, Piece, Pieces, emulate
from pbrl_ppl.sampling.ensemble import Posterior, Reference
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
    return Pieces(pieces, [])


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
    told = Emulator(None, two_parts((2, 1)), phi, polynomial(phi), degree)
    fresh = rng.normal([3.0, -1.0, 1e-3], [0.1, 2.0, 1e-4], (5, 3))
    error = np.abs(told(fresh) - polynomial(fresh)).max()
    if degree == 2:
        assert error < 1e-9
    else:
        assert error > 0.01


@pytest.fixture(scope="module")
def contact() -> tuple[Problem, np.ndarray]:
    """Two discs that touch in some transitions, and their parameters."""
    body = partial(Body, shape=Shape.circle(0.3), known={"mu_c": 0.2})
    pair = Scene(time_step=0.1, substeps=4, bodies=(body("one"), body("two")))
    history = simulated_history(
        pair, {"mass": 1.0, "r": 0.5}, seed=2, trajectories=6, intervals=12,
        wrench_sd=(1.5, 1.5, 0.1), poses=[(0.0, 0.0, 0.0), (0.61, 0.0, 0.0)],
    )  # fmt: skip
    problem = Problem.of(Physics.declare(pair), history)
    truth = problem.layout.to_vector({"mass": 1.0, "r": 0.5})
    problem = along_trajectories(problem, truth)
    assert 0.1 < problem.trajectory_noise.touching.mean() < 0.9
    return problem, truth


def test_the_engine_predicts_the_transitions_that_no_polynomial_follows(contact) -> None:
    """Those of contacts, say: exactly, whatever the runs were; the others are emulated."""
    problem, truth = contact
    met = problem.trajectory_noise.touching
    pieces = Pieces.of(problem, np.zeros(len(truth), dtype=bool))
    np.testing.assert_array_equal(pieces.exact[0].rows, np.flatnonzero(met))
    rng = np.random.default_rng(1)
    phi = truth * (1 + 0.02 * rng.standard_normal((80, len(truth))))
    runs = problem.residual(phi)
    told = Emulator(Space(problem, truth), pieces, phi, runs, 2)
    spread = runs.std(axis=0)[~met].max()
    fresh = truth * (1 + 0.02 * rng.standard_normal((5, len(truth))))
    exact, emulated = problem.residual(fresh), told(fresh)
    np.testing.assert_allclose(emulated[:, met], exact[:, met], atol=1e-14)
    assert 0 < np.abs(emulated - exact)[:, ~met].max() < 0.02 * spread
    # a later round finds more of them, and keeps these
    more = pieces.exactly([np.arange(problem.segments.n)])
    assert all(len(piece.rows) == 0 for piece in more.emulated)


def test_every_residual_is_predicted_once(contact, monkeypatch) -> None:
    """By one piece of all bodies, or by one a body where that had too many terms."""
    problem, truth = contact
    rows = np.array([1, 5])
    for most in (250, 10):
        monkeypatch.setattr(emulator, "_MOST", most)
        pieces = Pieces.of(problem, np.zeros(len(truth), dtype=bool)).exactly([rows])
        assert len(pieces.emulated) == (1 if most == 250 else 2)
        count = np.zeros((problem.segments.n, 2))
        for piece in (*pieces.emulated, *pieces.exact):
            count[np.ix_(piece.rows, piece.bodies)] += 1
        assert (count == 1).all()


def test_parameters_that_the_data_do_not_inform_have_no_terms(contact) -> None:
    problem, truth = contact
    mask = np.zeros(len(truth), dtype=bool)
    mask[0] = True
    pieces = Pieces.of(problem, mask)
    for piece in (*pieces.emulated, *pieces.exact):
        assert 0 not in piece.places


@pytest.fixture(scope="module")
def model() -> pm.Model:
    """120 transitions: enough that an engine run costs more than a sampler's own work."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3}).replace(substeps=12)
    history = simulated_history(scene, CART, seed=7, trajectories=6, intervals=20)
    return physics_model(scene, history)


@pytest.fixture(scope="module")
def mode(model):
    return find_mode(model.problem, seed=1)


@pytest.fixture(scope="module")
def reference(mode) -> Reference:
    return Reference.about(Space.of(mode), mode)


@pytest.fixture(scope="module")
def found(mode, reference) -> tuple[Posterior, Reference]:
    result = emulate(Space.of(mode), reference, np.random.default_rng(3))
    assert not isinstance(result, str), result
    return result


def test_it_follows_the_engine_over_the_posterior(mode, found) -> None:
    """Its log-posterior has 0.9 of the log-likelihood, so that weights have no heavy tails."""
    posterior, particles = found
    space = Space.of(mode)
    q = particles.draw(400, np.random.default_rng(4))
    exact = space.log_likelihoods(q, space.residual(q)).sum(axis=1)
    look = posterior.look(q)
    emulated = space.log_likelihoods(q, look).sum(axis=1)
    expected = space.log_priors(q).sum(axis=1) + 0.9 * emulated
    np.testing.assert_allclose(posterior.columns(q, look).sum(axis=1), expected)
    likely = exact > np.quantile(exact, 0.2)  # the Gaussians are wider than the posterior
    assert np.std((emulated - exact)[likely]) < 1.5


def test_the_gaussians_with_it_are_of_its_particles(found) -> None:
    """They replace the Laplace approximation, some of whose widths are off, as proposals."""
    posterior, particles = found
    q = particles.draw(1000, np.random.default_rng(5))
    own = particles.columns(q, particles.look(q)).sum(axis=1)
    gap = posterior.columns(q, posterior.look(q)).sum(axis=1) - own
    weight = np.exp(gap - gap.max())
    assert weight.sum() ** 2 / (weight**2).sum() > 0.05 * 1000


def test_runs_reach_farther_than_the_posterior_and_stay_in_the_support(model, mode) -> None:
    """A kink beyond the first draws was never seen, and a chain beyond it stood still."""
    drawn = mode.draws(np.random.default_rng(2), 200)
    runs = emulator.spread(model.problem, drawn)
    np.testing.assert_array_equal(runs[:200], drawn)
    lower, upper = model.problem.layout.supports(runs)
    assert ((runs >= lower) & (runs <= upper)).all()
    heaviest = list(model.problem.layout.labels).index("mass[cart]")
    assert runs[200:, heaviest].std() == pytest.approx(1.4 * drawn[:, heaviest].std())


def test_errors_count_farther_off_where_the_engine_says_it_is_as_likely() -> None:
    """Of cart-null's kinks an emulator learned one side, whose draws confirmed it."""
    exact = np.array([-1.0, -2.0, -3.0, -4.0, -2.5, -40.0])
    told = exact + np.array([0.1, 0.0, -0.1, 0.0, -6.0, 9.0])
    np.testing.assert_allclose(emulator.errors(told, exact, 4), [0.1, 0.0, -0.1, 0.0, -6.0])


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda z, rng: z + rng.standard_normal(z.shape), "log-likelihood is off by .* nats"),
        (lambda z, rng: z + np.where(rng.random(len(z)) < 0.6, np.nan, 0.0)[:, None, None, None,
         None], "the engine diverges about the mode"),
    ],
    ids=["at random", "diverges"],
)  # fmt: skip
def test_none_where_no_polynomial_is_close(mode, reference, monkeypatch, answer, why) -> None:
    """An engine that answers at random about the mode, or diverges, cannot be emulated."""
    rng, true = np.random.default_rng(5), type(mode.problem).residual

    def wrong(self, phi, engine=None):
        return mode.sigma * answer(true(self, phi, engine) / mode.sigma, rng)

    monkeypatch.setattr(type(mode.problem), "residual", wrong)
    found = emulate(Space.of(mode), reference, np.random.default_rng(3))
    assert isinstance(found, str)
    assert re.search(why, found)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the chains have not converged")  # too short for 400 effective
def test_looking_ahead_changes_nothing_but_the_speed(model, monkeypatch) -> None:
    """The same posterior with the emulator and without.

    Means and squares of 12 parameters agree within 4 Monte Carlo errors: a false alarm 0.2 % of the
    time.
    """
    options = {"seed": 2, "chains": 2, "cores": 1, "progress": False, "tune": 300}
    options["method"] = "metropolis"
    monkeypatch.setattr(methods, "_LITTLE", 0.0)
    ahead = fit(model, draws=800, **options)
    assert float(group(ahead, "sample_stats")["accept"].mean()) > 0.3
    monkeypatch.setattr(methods, "_LITTLE", np.inf)
    plain = fit(model, draws=800, thin=15, **options)
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
