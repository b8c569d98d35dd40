"""Noise of its own where bodies touch: how they part hangs on more than any engine knows."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_data import simulated_trajectories, with_measurements

from pbrl_ppl.likelihood import (
    Problem,
    along_trajectories,
    smoothed,
)
from pbrl_ppl.likelihood.smoothing import linearised
from pbrl_ppl.model import build_model
from pbrl_ppl.modes import profile_sigma
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

pytestmark = pytest.mark.one_stack

KNOWN = {"mass": 1.0, "r": 0.5, "mu_c": 0.2}
PUCKS = Scene(
    time_step=0.1,
    substeps=4,
    bodies=tuple(Body(name, Shape.circle(0.3), known=KNOWN) for name in ("one", "two")),
)
#: Errors of measuring, unexplained accelerations, and what comes on top where bodies touch.
NOISE = np.array([1e-3, 1e-3, 2e-3, 5e-3, 5e-3, 1e-2, 0.02, 0.02, 0.05, 2.0, 1.0, 4.0])
PHI = np.zeros(0)


@pytest.fixture(scope="module")
def pucks() -> Problem:
    """Two pucks that lie side by side and are pushed about."""
    history = simulated_history(
        PUCKS, {}, seed=2, trajectories=60, intervals=12, wrench_sd=(1.5, 1.5, 0.1),
        poses=[(0.0, 0.0, 0.0), (0.61, 0.0, 0.0)], substeps=8,
    )  # fmt: skip
    return along_trajectories(Problem.of(Physics.declare(PUCKS), history), PHI)


def test_its_score_is_that_of_differences(pucks) -> None:
    noise, residual = pucks.likelihood.noise, pucks.residual(PHI)
    assert 0.1 < noise.touching.mean() < 0.9
    at = np.log(NOISE)
    slope = noise.score(residual, NOISE)[1]
    steps = 1e-5 * np.eye(len(at))
    ends = [
        [pucks.log_density(residual, np.exp(at + sign * h)).sum() for sign in (1, -1)]
        for h in steps
    ]
    by_differences = [(ahead - behind) / 2e-5 for ahead, behind in ends]
    np.testing.assert_allclose(slope, by_differences, rtol=1e-5, atol=1e-5 * np.abs(slope).max())


def test_both_kinds_of_noise_are_told_apart(pucks) -> None:
    """That of contacts comes out, to 4 standard errors; little of it is taken for the others.

    Bodies that parted by chance may seem not to have touched, and that shows in the others.
    """
    rng = np.random.default_rng(3)
    made = with_measurements(pucks, simulated_trajectories(pucks, PHI, NOISE, rng))
    for _ in range(2):  # which ones touch is seen at smoothed states
        sigma = profile_sigma(made, made.residual(PHI), PHI)
        made = smoothed(made, PHI, sigma)
    sigma = profile_sigma(made, made.residual(PHI), PHI)
    measurements = 2 * made.likelihood.noise.touching.sum()  # at each of two bodies
    assert measurements > 100
    assert (np.abs(np.log(sigma / NOISE)[9:]) < 4 / np.sqrt(2 * measurements)).all()
    assert (np.abs(np.log(sigma / NOISE)[:6]) < 0.4).all()
    assert (sigma[6:9] < 0.2 * NOISE[9:]).all()


def test_a_measured_contact_counts_where_smoothing_takes_it_away(pucks) -> None:
    """Blaming a start's measurement, smoothed states may pass by: the contact stays one."""
    noise = pucks.likelihood.noise
    apart = pucks.data.smoothed_states + np.array([[0.0] * 6, [5.0] + [0.0] * 5])
    moved = replace(pucks, data=replace(pucks.data, states=apart))
    again = linearised(moved, noise.coordinates, noise.slope, noise.sigma)
    assert again.touching.mean() > 0.1


def test_the_model_names_it_where_bodies_touch_and_there_alone(pucks) -> None:
    model = build_model(pucks)
    assert "contact_acceleration" in model.named_vars
    assert tuple(model.named_vars_to_dims["contact_acceleration"]) == ("velocity",)
    density = pucks.log_density(pucks.residual(PHI), NOISE).sum()
    values = {"sigma": NOISE[:6], "unexplained_acceleration": NOISE[6:9]}
    values["contact_acceleration"] = NOISE[9:]
    got = model.compile_logp(vars=model.observed_RVs)(
        {model.rvs_to_values[v].name: np.log(values[v.name]) for v in model.free_RVs}
    )
    assert got == pytest.approx(density, rel=1e-10)
    apart = simulated_history(PUCKS, {}, seed=1, trajectories=2, intervals=4, substeps=4)
    alone = along_trajectories(Problem.of(Physics.declare(PUCKS), apart), PHI)
    assert "contact_acceleration" not in alone.noise_variables
