"""`fit(method="metropolis")`: the schedule of the paper's Table 2."""

import numpy as np
import pymc as pm
import pytest

from pbrl_ppl.errors import ConvergenceWarning
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.posterior import group
from pbrl_ppl.sampling import fit
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

#: Table 2: iterations (the burn-in among them), burn-in, thinning, chains.
CART_ROW, APARTMENT_ROW = (20_000, 1_000, 10, 30), (5_000, 1_000, 10, 1)


class AskedFor(Exception):
    """What PyMC was asked to sample."""


@pytest.fixture(scope="module")
def puck():
    """Its mass is all there is to learn of the cart."""
    scene = cart_scene(known={name: CART[name] for name in CART if name != "mass"})
    history = simulated_history(scene, CART, seed=9, trajectories=2, intervals=4)
    return physics_model(scene, history, substeps=4)


@pytest.fixture(scope="module")
def mode(puck):
    return find_mode(problem_in(puck), seed=1)


@pytest.mark.parametrize(
    ("options", "row"),
    [({}, CART_ROW), ({"draws": 400, "chains": 1}, APARTMENT_ROW)],
    ids=["cart, the default", "apartment, as documented"],
)
def test_it_is_table_2(puck, mode, monkeypatch, options, row) -> None:
    def record(**asked):
        raise AskedFor(asked)

    monkeypatch.setattr(pm, "sample", record)
    with pytest.raises(AskedFor) as caught:
        fit(puck, method="metropolis", start=mode, progress=False, **options)
    (asked,) = caught.value.args
    iterations, burn_in, thin, chains = row
    assert asked["draws"] + asked["tune"] == iterations
    assert (asked["tune"], asked["chains"], len(asked["initvals"])) == (burn_in, chains, chains)
    assert asked["draws"] == (iterations - burn_in) // thin * thin
    assert all(type(step) is pm.Metropolis for step in asked["step"])


@pytest.mark.parametrize("chains", [1, 3])
def test_each_thin_th_draw_is_kept(puck, mode, chains) -> None:
    """Tiny, and so not converged; of one chain alone that cannot be said at all."""
    options = {"draws": 12, "tune": 20, "thin": 3, "chains": chains, "cores": 1}
    said = "one chain alone cannot show" if chains == 1 else "chains have not converged"
    with pytest.warns(ConvergenceWarning, match=said):
        idata = fit(puck, method="metropolis", seed=2, start=mode, progress=False, **options)
    mass = group(idata, "posterior")["mass"]
    assert mass.shape == (chains, 12, 1)
    assert idata.attrs["method"] == "metropolis"
    assert np.isfinite(mass.values).all()
    assert np.isfinite(idata.attrs["min_ess"])
    assert np.isfinite(idata.attrs["max_rhat"]) == (chains > 1)
