"""The mode (MAP) in a posterior's attributes, and what uses it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.likelihood import log_posterior
from pbrl_ppl.model import physics_model
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.planning import Dynamics, plan, predicted_path
from pbrl_ppl.posterior import (
    from_groups,
    groups,
    load_posterior,
    parameter_draws,
    problem_of,
    save_posterior,
    stored_mode,
)
from pbrl_ppl.posterior.record import ParameterPoint, packed_mode
from pbrl_ppl.sampling import fit, update
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)
ROOM = cart_scene()
pytestmark = [
    pytest.mark.filterwarnings("ignore:the chains have not converged"),  # few draws, on purpose
    pytest.mark.filterwarnings("ignore:the data say nothing about"),
]


def recorded(seed: int, trajectories: int):
    return simulated_history(
        ROOM, CART, seed=seed, trajectories=trajectories, intervals=5, noise=NOISE
    )


@pytest.fixture(scope="module")
def idata():
    return quick(physics_model(ROOM, recorded(3, 8)))


def quick(model, **options):
    given = {"method": "laplace", "seed": 1, "draws": 200, "chains": 2, "progress": False}
    return fit(model, **(given | options))


def test_the_mode_is_above_all_draws_and_described_as_they_are(idata) -> None:
    """The cart's wheel has four equal descriptions, of which the draws have one."""
    problem = problem_of(idata)
    mode = stored_mode(problem, idata)
    phi, sigma = parameter_draws(problem, idata)
    height = log_posterior(problem, mode.phi, mode.sigma)
    assert json.loads(idata.attrs["mode"])["log_posterior"] == pytest.approx(height, abs=1e-9)
    assert height > log_posterior(problem, phi, sigma).max()
    for label in ("w_theta[cart]", "mu_x[cart]", "mu_y[cart]"):
        own = phi[:, problem.layout.labels.index(label)]
        off = mode.phi[problem.layout.labels.index(label)] - own.mean()
        assert abs(off) < 4 * own.std(), label  # another description is dozens away


def test_a_mode_that_a_draw_is_above_is_climbed_to_again(idata) -> None:
    """As where the search ended at a lower mode than the chains found."""
    problem = problem_of(idata)
    phi, sigma = parameter_draws(problem, idata)
    likelihood = problem.log_density(problem.residual(phi), sigma, phi).sum(axis=-1)
    low = ParameterPoint(phi[0] + 0.1 * np.eye(len(phi[0]))[0], sigma[0])
    found = packed_mode(problem, low, phi, sigma, likelihood)
    held = json.loads(idata.attrs["mode"])
    # friction makes the top rough by about a nat: a climb from elsewhere ends beside the highest
    assert found.log_posterior == pytest.approx(held["log_posterior"], abs=0.3)


def test_a_script_plans_with_exactly_the_mode_of_the_file(idata, tmp_path: Path) -> None:
    save_posterior(idata, tmp_path / "cart.nc")
    script = tmp_path / "plans.py"
    script.write_text(
        "import sys\n"
        "import pbrl_ppl as pp\n"
        "idata = pp.load_posterior(sys.argv[1])\n"
        "plan = pp.plan(idata, {'cart': (0, 0, 0)}, {'cart': (0.6, 0.0, None)}, seed=1)\n"
        "plan.save(sys.argv[2])\n"
    )
    files = [str(script), str(tmp_path / "cart.nc"), str(tmp_path / "plan.csv")]
    subprocess.run([sys.executable, *files], check=True, capture_output=True)
    problem, loaded = problem_of(idata), load_posterior(tmp_path / "cart.nc")
    assert loaded.attrs["mode"] == idata.attrs["mode"]
    mode = stored_mode(problem, idata)
    np.testing.assert_array_equal(Dynamics.of(loaded).phi, mode.phi[None])
    named = json.loads(idata.attrs["mode"])["parameters"]
    assert dict(zip(problem.layout.labels, mode.phi.tolist(), strict=True)) == named
    values = problem.layout.to_dict(mode.phi)
    known = Dynamics.known(ROOM, values, substeps=problem.physics.substeps)
    goal = {"cart": (0.6, 0.0, None)}
    with_mode = plan(loaded, {"cart": (0, 0, 0)}, goal, seed=1)
    with_mode.save(tmp_path / "here.csv")
    assert (tmp_path / "here.csv").read_bytes() == (tmp_path / "plan.csv").read_bytes()
    there = predicted_path(known, np.zeros((1, 6)), with_mode.wrenches)
    predicted = with_mode.predicted["predicted"].isel(draw=0).to_numpy()
    np.testing.assert_allclose(predicted, there[0], atol=1e-12)


def test_a_mode_that_is_missing_or_incomplete_is_named(idata) -> None:
    attrs = {name: value for name, value in idata.attrs.items() if name != "mode"}
    with pytest.raises(PosteriorError, match="holds no mode; ask for draws"):
        Dynamics.of(from_groups(groups(idata), attrs))
    empty = '{"parameters": {}, "noise": {}, "log_posterior": 0.0}'
    broken = from_groups(groups(idata), attrs | {"mode": empty})
    with pytest.raises(PosteriorError, match=r"its mode has no mass\[cart\]"):
        Dynamics.of(broken)


def test_an_update_climbs_to_the_mode_of_all_data(monkeypatch) -> None:
    """Of which the log-posterior is no lower than at the old mode."""
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 30)
    before = quick(physics_model(ROOM, recorded(3, 8)), draws=2000)
    more = update(before, recorded(5, 1), progress=False)
    assert json.loads(more.attrs["updates"])[-1]["did"] == "reweighted"
    problem = problem_of(more)
    old, new = stored_mode(problem, before), stored_mode(problem, more)
    heights = [float(log_posterior(problem, each.phi, each.sigma)) for each in (old, new)]
    assert heights[1] > heights[0]
    assert json.loads(more.attrs["mode"])["log_posterior"] == pytest.approx(heights[1], abs=1e-9)


def test_with_a_library_it_is_the_most_probable_choice() -> None:
    sets = {"light": CART | {"mass": 5.0}, "like it": CART, "heavy": CART | {"mass": 9.0}}
    model = physics_model(ROOM, recorded(3, 2), library=ParameterLibrary(sets))
    found = fit(model, seed=1, draws=100, chains=2, progress=False)
    mode = json.loads(found.attrs["mode"])
    assert mode["sets"] == {"cart": "like it"}
    assert mode["parameters"] == {f"{name}[cart]": value for name, value in CART.items()}
    # the noise is the most probable one there: no draw of it is better
    problem = problem_of(found)
    held = stored_mode(problem, found)
    np.testing.assert_array_equal(held.choice, [1])
    _, sigma = parameter_draws(problem, found)
    choice = np.ones((len(sigma), 1), dtype=np.intp)
    draws = log_posterior(problem, np.tile(held.phi, (len(sigma), 1)), sigma, choice)
    assert log_posterior(problem, held.phi, held.sigma, held.choice) > draws.max()
    np.testing.assert_array_equal(Dynamics.of(found).phi[0], held.phi)
