"""What needs a gradient works with the engine's: find_MAP, NUTS, least squares."""

import warnings

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.optimize import least_squares

from pbrl_ppl.errors import ConvergenceWarning
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.posterior.store import group
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

TRUTH = {"mass": 3.0, "linear_drag_coefficient": 2.0, "constant_force_force_x": 1.0}
TRUTH |= {"constant_force_force_y": -0.5}
TWO = {"mass": 3.0, "linear_drag_coefficient": 2.0}


def problem_of(noise: float = 0.01):
    """A drifting body with drag on a slope: smooth in every parameter."""
    puck = Body(
        "puck",
        Shape.circle(0.2),
        known={"r": 0.0, "mu_c": 0.0},
        effects=("linear_drag", "constant_force"),
    )
    scene = Scene(time_step=0.1, bodies=(puck,))
    history = simulated_history(scene, TRUTH, seed=8, trajectories=3, intervals=10, noise=noise)
    return physics_model(scene, history, sigma="scalar")


@pytest.fixture(scope="module")
def model():
    return problem_of()


def truth(model) -> np.ndarray:
    return problem_in(model).layout.to_vector(TRUTH)


def test_gradient_of_the_log_density_is_its_difference_quotient(model) -> None:
    logp, gradient = model.compile_logp(), model.compile_dlogp()
    point = model.initial_point()
    point = {name: np.asarray(value, dtype=float) for name, value in point.items()}
    found = gradient(point)
    position = 0
    for name, value in point.items():
        for i in range(value.size):
            ends = []
            for h in (1e-5, -1e-5):
                moved = value.copy()
                moved.ravel()[i] += h
                ends.append(float(logp(point | {name: moved})))
            # rounding of the log-density over the step, and the step's square
            expected = pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5, abs=1e-3)
            assert found[position] == expected, (name, i)
            position += 1


def test_find_map_is_the_mode_and_recovers_the_truth(model) -> None:
    """The mode of least squares to 1 % of a sd, and the truth within 4 of it."""
    with model, warnings.catch_warnings():
        # PyMC 6 announces that it will return something else one day
        warnings.simplefilter("ignore", FutureWarning)
        found = pm.find_MAP(progressbar=False)
    mode = find_mode(problem_in(model), seed=1)
    deviation = np.sqrt(np.diag(mode.covariance))
    for block, at, sd in zip(problem_in(model).layout.blocks, mode.phi, deviation, strict=True):
        assert found[block.name] == pytest.approx(at, abs=0.01 * sd), block.name
        assert abs(at - TRUTH[block.name]) < 4 * sd, block.name


def test_least_squares_with_the_batched_jacobian(model) -> None:
    """To the truth itself on data without noise, from the prior's centre."""
    problem = problem_in(problem_of(noise=0.0))
    segments = problem.segments

    def jacobian(phi: np.ndarray) -> np.ndarray:
        found = problem.physics.simulator.jacobian(phi, segments.start, segments.actions)
        return -found.reshape(-1, problem.layout.size)

    begin = np.array([max(prior.centre, 0.1) for prior in problem.layout.priors])
    result = least_squares(lambda phi: problem.residual(phi).ravel(), begin, jac=jacobian)
    # the data were made with 40 substeps, the model has 10
    np.testing.assert_allclose(result.x, truth(model), rtol=1e-4)


@pytest.mark.long
def test_nuts_agrees_with_the_default_sampler() -> None:
    """Mass, drag and sigma: means and squares within 4 Monte Carlo errors; 0.04 % false alarms."""
    puck = Body("puck", Shape.circle(0.2), known={"r": 0.0, "mu_c": 0.0}, effects=("linear_drag",))
    scene = Scene(time_step=0.1, substeps=4, bodies=(puck,))
    some = {"trajectories": 2, "intervals": 6, "noise": 0.01}
    model = physics_model(scene, simulated_history(scene, TWO, seed=8, **some), sigma="scalar")
    mode = find_mode(problem_in(model), seed=1)
    options = {"chains": 2, "cores": 1}
    nuts = pm.sample(
        draws=150, tune=150, initvals=mode.problem.named(mode.phi, mode.sigma), random_seed=3,
        progressbar=False, compute_convergence_checks=False, model=model, **options,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # few draws, on purpose
        default = fit(model, draws=600, start=mode, seed=3, progress=False, **options)
    assert int(group(nuts, "sample_stats")["diverging"].sum()) == 0
    ours, theirs = group(default, "posterior"), group(nuts, "posterior")
    for name in ("mass", "linear_drag_coefficient", "sigma"):
        centre = ours[name].mean(("chain", "draw"))
        for power in (1, 2):
            moments = [(each[name] - centre) ** power for each in (ours, theirs)]
            errors = [float(az.mcse(each.to_dataset(name=name))[name].item()) for each in moments]
            gap = float(abs(moments[0].mean() - moments[1].mean()))
            assert gap < 4 * np.hypot(*errors), (name, power)
    for name, true in TWO.items():
        draws = theirs[name].values.ravel()
        assert abs(draws.mean() - true) < 4.5 * draws.std(), name
