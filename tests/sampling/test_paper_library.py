"""`fit(method="metropolis")` of a model with a library: Table 2's row for the apartment."""

import json

import numpy as np
import pymc as pm
import pytest

from pbrl_ppl.model import physics_model
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import convergence, draws, group
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE

LIBRARY = ParameterLibrary(
    {"x": {"mass": 2.0}, "y": {"mass": 2.2}, "z": {"mass": 2.4}},
    {"a": {"x": 1, "y": 2, "z": 1}, "b": {"x": 1, "z": 1}},
)
pytestmark = [
    pytest.mark.filterwarnings("ignore:one chain alone"),
    pytest.mark.filterwarnings("ignore:the chains have not converged"),
    OBJECT_MODE,
]


def ambiguous(scalar: bool = True) -> pm.Model:
    """Two pucks whose masses little noise hides; b is never of the set y."""
    known = {"r": 0.2, "mu_c": 0.3}
    bodies = tuple(Body(name, Shape.circle(0.1), known=known) for name in "ab")
    scene = Scene(time_step=0.1, substeps=4, bodies=bodies)
    history = simulated_history(
        scene, {"mass": 2.2}, seed=2, trajectories=3, intervals=1, wrench_sd=(1.0, 1.0, 0.002),
        noise=(0.01, 0.01, 0.01, 0.04, 0.04, 0.1), substeps=4,
    )  # fmt: skip
    sigma = "scalar" if scalar else "per_dimension"
    return physics_model(scene, history, library=LIBRARY, sigma=sigma)


def shares(idata) -> np.ndarray:
    """Share of each set among the draws, shape (body, set)."""
    index = draws(idata)["library_index"]
    return np.array([np.bincount(own, minlength=3) for own in index.T]) / len(index)


def test_its_probabilities_are_those_of_the_exact_sum() -> None:
    """By default on Table 2's schedule: 5,000 iterations, 1,000 burnt in, each tenth kept.

    Within 4 standard errors: false alarm 6e-5 each of the five.
    """
    model = ambiguous()
    exact = fit(model, seed=1, progress=False)
    paper = fit(model, method="metropolis", seed=1, progress=False)
    posterior = group(paper, "posterior")
    assert (posterior.sizes["chain"], posterior.sizes["draw"]) == (1, 400)
    assert exact.attrs["method"] == "exact sum over the library"
    assert paper.attrs["method"] == "metropolis"
    p = shares(exact)
    sizes = [min(convergence(idata)[1].values()) for idata in (exact, paper)]
    error = np.sqrt(p * (1 - p) * sum(1 / size for size in sizes))
    assert (p > 0.05).sum() == 5  # nothing is certain, so that there is something to compare
    assert shares(paper)[1, 1] == 0.0  # what the prior excludes
    assert (abs(shares(paper) - p) <= 4 * error).all(), (shares(paper), p, error)
    # the parameters follow from the choices, and the file's mode is the most frequent choice
    masses = np.array([2.0, 2.2, 2.4])
    np.testing.assert_array_equal(draws(paper)["mass"], masses[draws(paper)["library_index"]])
    sets = json.loads(paper.attrs["mode"])["sets"]
    assert [LIBRARY.names.index(sets[body]) for body in "ab"] == shares(paper).argmax(1).tolist()


def test_several_chains_of_one_sigma_a_dimension() -> None:
    """Starts are drawn from the prior, and the same seed gives the same draws."""
    options = {"method": "metropolis", "seed": 3, "draws": 20, "tune": 50, "thin": 2, "chains": 2}
    first, second = (
        fit(ambiguous(scalar=False), cores=1, progress=False, **options) for _ in range(2)
    )
    assert group(first, "posterior")["sigma"].shape == (2, 20, 6)
    for name, values in draws(first).items():
        np.testing.assert_array_equal(values, draws(second)[name])


def test_bodies_of_one_class_have_one_choice() -> None:
    """By walk and by sum; the stored mode names the class."""
    known = {"r": 0.2, "mu_c": 0.3}
    bodies = tuple(Body(name, Shape.circle(0.1), known=known, object_class="puck") for name in "ab")
    scene = Scene(time_step=0.1, substeps=4, bodies=bodies)
    history = simulated_history(scene, {"mass": 2.2}, seed=2, trajectories=3, intervals=2)
    model = physics_model(scene, history, library=ParameterLibrary(dict(LIBRARY.sets)))
    for options in ({}, {"method": "metropolis", "draws": 20, "tune": 50, "thin": 2}):
        idata = fit(model, seed=1, progress=False, **options)
        assert group(idata, "posterior")["library_index"].sizes["owner"] == 1
        assert json.loads(idata.attrs["mode"])["sets"] == {"puck": "y"}
        assert Dynamics.of(idata).phi.tolist() == [[2.2]]
