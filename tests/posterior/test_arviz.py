"""What ArviZ wants of a posterior: prior, its density, predictions that belong to draws."""

import json
from functools import partial

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from pymc.stats import compute_log_prior

from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.parameters import wheels
from pbrl_ppl.posterior import by_number, from_groups, group, groups, loo_pit
from pbrl_ppl.posterior.completion import predictive_rows, prior_groups
from pbrl_ppl.posterior.cross_validation import predicted_rows
from pbrl_ppl.posterior.store import DATATREE, load_posterior, save_posterior
from pbrl_ppl.sampling import fit, sample, update
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.stacks import SCENE, fitted, history


@pytest.fixture(scope="module")
def idata(tmp_path_factory):
    """A puck's posterior, written and read; 500 draws of each of 2 chains."""
    path = tmp_path_factory.mktemp("arviz") / "puck.nc"
    save_posterior(fitted(), path)
    return load_posterior(path)


def aligned(idata):
    """Return draws that have predictions: of so few, a fifth is the tail whatever their ESS."""
    return idata.sel(draw=idata["posterior_predictive"]["draw"].values[:80])


@pytest.fixture(scope="module")
def of_vx(idata):
    """The draws that have predictions, and of these what concerns one state: see the notebooks."""
    return aligned(idata).sel(state="vx").isel(step=0, body=0)


# what failed before there were the groups, by the generation that has it
def prior_against_posterior(idata, of_vx):
    return az.plot_prior_posterior(idata, var_names=["mass"])


def bayes_factor(idata, of_vx):
    name = {"var_names": "mass"} if DATATREE else {"var_name": "mass"}
    return az.plot_bf(idata, ref_val=2.0, **name)


def power_scaling(idata, of_vx):
    table = az.psense_summary(idata)
    assert table.loc["mass[puck]", "prior"] < table.loc["mass[puck]", "likelihood"]
    return az.plot_psense_dist(idata, var_names=["mass"])


def pit(idata, of_vx):
    return az.plot_loo_pit(of_vx) if DATATREE else az.plot_loo_pit(of_vx, y="next_state")


def predictive_pit(idata, of_vx):
    return az.plot_ppc_pit(of_vx)


def predictive_interval(idata, of_vx):
    return az.plot_ppc_interval(of_vx)


def expectations(idata, of_vx):
    return az.loo_metrics(of_vx)


BOTH = (bayes_factor, pit)
NEWER = (
    prior_against_posterior,
    power_scaling,
    predictive_pit,
    predictive_interval,
    expectations,
)


@pytest.mark.parametrize("function", (*BOTH, *NEWER) if DATATREE else BOTH)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")  # ArviZ's own
def test_arviz_takes_it(function, idata, of_vx) -> None:
    assert function(idata, of_vx) is not None
    plt.close("all")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.filterwarnings("ignore::UserWarning")  # ArviZ's own
def test_predictive_check_has_a_panel_a_state_dimension(idata) -> None:
    """As the guide has it: metres beside radians per second, and not in one density with them."""
    names = list(group(idata, "observed_data")["state"].values)
    if DATATREE:
        panels = az.plot_ppc_dist(idata, cols=["state"]).viz["plot"].to_dataset()
        panels = [panels["plot"].sel(state=name).item() for name in names]
    else:
        flatten = ["transition", "step", "body"]
        panels = az.plot_ppc(idata, flatten=flatten, num_pp_samples=20, random_seed=1).ravel()
    measured = group(idata, "observed_data")["next_state"]
    for name, axes in zip(names, panels, strict=True):
        own = measured.sel(state=name)
        width = float(own.max() - own.min())
        # what it shows is about as wide as this dimension's values, not all dimensions'
        shown = np.ptp(np.concatenate([line.get_xdata() for line in axes.get_lines()]))
        assert 0.8 * width < shown < 3 * width, name
    plt.close("all")


def test_prior_is_pymc_s(idata) -> None:
    """Its density against PyMC's; its draws against their law, false alarm 1e-4 each."""
    model = physics_model(SCENE, history(1))
    theirs = compute_log_prior(idata, model=model, extend_inferencedata=False, progressbar=False)
    posterior, prior, density = (group(idata, g) for g in ("posterior", "prior", "log_prior"))
    for name in posterior.data_vars:
        np.testing.assert_allclose(density[name], theirs[name])
        assert density[name].dims == prior[name].dims == posterior[name].dims
        assert prior[name].attrs == posterior[name].attrs
    for each in (prior, density):
        assert each.sizes == posterior.sizes
    z = (np.log(prior["mass"].values.ravel()) - 1.0) / 1.5
    assert abs(z.mean()) < 4 / np.sqrt(1000)
    assert abs(z.std() - 1) < 4 / np.sqrt(2000)


def test_prior_of_a_wheel_is_described_like_the_posterior() -> None:
    """Its angle is within an eighth of a turn of the posterior's, where every one is equal."""
    scene = cart_scene(known={"r": 0.2, "mu_c": 0.3})
    problem = problem_in(physics_model(scene, simulated_history(scene, CART, seed=1)))
    draws = 400
    phi = np.tile(problem.layout.to_vector(CART), (draws, 1))
    sigma = np.full((draws, 6), 0.01)
    named = problem.named(phi, sigma)
    posterior = xr.Dataset({n: (("chain", "draw", f"{n}_of"), v[None]) for n, v in named.items()})
    made = prior_groups(problem, posterior, phi, sigma, seed=1)
    angle, x, y = (made["prior"][name].values.ravel() for name in ("w_theta", "mu_x", "mu_y"))
    (wheel,) = wheels(problem.layout)
    assert wheel.period == 1
    assert (np.cos(angle - CART["w_theta"]) > 0).all()
    assert (x > y).mean() == pytest.approx(0.5, abs=0.25)  # frictions as they come
    # descriptions are equally probable, so that the density at the draws is the declared one
    np.testing.assert_allclose(
        made["log_prior"]["mu_x"].values.ravel(), problem.layout.log_prior(phi)[:, 4]
    )


#: Of the puck's 3 trajectories of 4 intervals.
TRAJECTORY, TIME = np.repeat([0, 1, 2], 4), np.tile([0.0, 0.1, 0.2, 0.3], 3)


def test_transitions_say_of_which_trajectory_and_when(idata) -> None:
    """In every group that has them, for whom a sum over trajectories is one line."""
    of = [name for name, data in groups(idata).items() if "transition" in data.dims]
    assert len(of) == 4
    for name in of:
        coords = group(idata, name).coords
        assert coords["trajectory"].dims == coords["time"].dims == ("transition",)
        np.testing.assert_array_equal(coords["trajectory"], TRAJECTORY)
        np.testing.assert_allclose(coords["time"], TIME)
        assert coords["time"].attrs["units"] == "s"
    likelihood = group(idata, "log_likelihood")["next_state"]
    by_trajectory = likelihood.groupby("trajectory").sum()
    np.testing.assert_allclose(
        by_trajectory.sel(trajectory=1), likelihood.sel(transition=slice(4, 7)).sum("transition")
    )


@pytest.mark.filterwarnings(
    "ignore::UserWarning", "ignore::FutureWarning", "ignore::DeprecationWarning"
)
def test_arviz_keeps_trajectory_and_time(idata) -> None:
    k = az.loo(idata, pointwise=True).pareto_k
    np.testing.assert_array_equal(k["trajectory"], TRAJECTORY)
    pairs = az.compare({"one": idata, "other": idata})
    assert list(pairs["rank"]) == [0, 1]


def test_a_selection_of_trajectories_keeps_their_numbers() -> None:
    model = physics_model(SCENE, history(1).select([2, 0]))
    few = fit(model, method="map", seed=1, progress=False)
    np.testing.assert_array_equal(few["observed_data"]["trajectory"], [2] * 4 + [0] * 4)


@pytest.mark.parametrize("way", ["reweighted", "refitted"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_update_numbers_trajectories_on(idata, way, monkeypatch) -> None:
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 0 if way == "reweighted" else np.inf)
    monkeypatch.setattr("pbrl_ppl.posterior.MAX_PARETO_K", np.inf)
    quick = partial(sample, method="laplace")
    monkeypatch.setattr("pbrl_ppl.sampling.updating.sample", quick)
    new = update(idata, history(2, trajectories=1), seed=1)
    new = update(new, history(3, trajectories=1), seed=1)
    assert [each["did"] for each in json.loads(new.attrs["updates"])] == [way, way]
    for name, data in groups(new).items():
        if "transition" in data.dims:
            assert data.sizes["transition"] == 20, name
            np.testing.assert_array_equal(data["trajectory"], [*TRAJECTORY, *[3] * 4, *[4] * 4])
            np.testing.assert_allclose(data["time"], [*TIME, *TIME[:4], *TIME[:4]])


def test_predictions_belong_to_draws(idata) -> None:
    """As many of each chain, at the draws that their labels name: residuals are of that noise."""
    posterior, predictive = group(idata, "posterior"), group(idata, "posterior_predictive")
    assert dict(predictive.sizes) | {"chain": 2, "draw": 100} == dict(predictive.sizes)
    rows = predicted_rows(posterior, predictive)
    sigma = posterior["sigma"].values.reshape(1000, -1)
    np.testing.assert_array_equal(
        posterior["sigma"].sel(draw=predictive["draw"]).values.reshape(200, -1), sigma[rows]
    )
    problem = problem_in(physics_model(SCENE, history(1)))
    phi = posterior["mass"].values.reshape(1000, 1)[rows]
    predicted = predictive["next_state"].values.reshape(200, *problem.measured.shape)
    z = (predicted - problem.predict(phi)) / sigma[rows][:, None, None, None]
    assert (z**2).mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / z.size))


@pytest.mark.parametrize(
    ("chains", "draws", "cells", "expected"),
    [(4, 800, 2160, 50), (1, 800, 2160, 200), (30, 1900, 2160, 7), (4, 800, 66_000, 13),
     (4, 20, 100, 20), (1, 1, 100, 1)],
)  # fmt: skip
def test_how_many_predictions(chains, draws, cells, expected) -> None:
    rows = predictive_rows(chains, draws, cells)
    assert rows.shape == (chains, expected)
    assert (np.diff(rows, axis=1) > 0).all()
    assert (rows[:, -1] == draws * np.arange(1, chains + 1) - 1).all()


def test_loo_pit_is_arviz_s(idata, of_vx) -> None:
    """Of one state, from the same draws."""
    ours = loo_pit(aligned(idata))
    if DATATREE:
        theirs = az.loo_pit(of_vx)["next_state"].values
    else:
        theirs = az.loo_pit(of_vx, y="next_state")
    assert ours.dims == ("transition", "step", "body", "state")
    np.testing.assert_allclose(ours.sel(state="vx").values.ravel(), theirs, atol=1e-6)


def test_loo_pit_where_a_draw_without_predictions_has_all_weight(idata) -> None:
    """A draw under which a transition is impossible, nearly: the others' weights underflow."""
    data = groups(idata)
    data["posterior_predictive"] = data["posterior_predictive"].isel(draw=slice(1, None))
    values = data["log_likelihood"]["next_state"].copy(deep=True)
    values[{"chain": 0, "draw": 0, "transition": 3}] = -1e14
    data["log_likelihood"] = values.to_dataset(name="next_state")
    seen = loo_pit(from_groups(data, idata.attrs)).sel(state="vx").to_numpy()
    assert ((seen >= 0.0) & (seen <= 1.0)).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")  # ArviZ's own
def test_arviz_s_loo_pit_of_every_number(idata) -> None:
    """All states at once, one number missing, an angle a turn on; from the same draws."""
    data = groups(idata)
    values = data["observed_data"]["next_state"].copy(deep=True)
    values.loc[{"state": "theta"}] += 2 * np.pi
    values.loc[{"state": "x", "transition": 3}] = np.nan
    data["observed_data"] = values.to_dataset(name="next_state")
    whole = from_groups(data, idata.attrs)
    each = by_number(whole)
    named = {} if DATATREE else {"y": "next_state"}
    theirs = az.loo_pit(by_number(aligned(whole)), **named)
    theirs = theirs["next_state"].values if DATATREE else theirs
    ours = loo_pit(aligned(whole)).values.ravel()
    assert theirs.shape == (71,)
    np.testing.assert_allclose(theirs, ours[np.isfinite(ours)], atol=1e-6)
    assert az.plot_loo_pit(each, **named) is not None
    if DATATREE:
        assert az.plot_ppc_pit(each) is not None
    plt.close("all")
    kept = group(each, "posterior")["mass"].values
    place = group(idata, "posterior_predictive")["draw"]
    np.testing.assert_array_equal(kept, group(idata, "posterior")["mass"].sel(draw=place).values)
    state = group(each, "observed_data")["state"].values
    assert list(state[:6]) == ["x", "y", "theta", "vx", "vy", "omega"]


def test_loo_pit_of_angles_and_gaps(idata) -> None:
    """A turn more is the same angle; what was not measured has no place among predictions."""
    data = groups(idata)
    values = data["observed_data"]["next_state"].copy(deep=True)
    values.loc[{"state": "theta"}] += 2 * np.pi
    values.loc[{"state": "x", "transition": 3}] = np.nan
    data["observed_data"] = values.to_dataset(name="next_state")
    before, after = loo_pit(idata), loo_pit(from_groups(data, idata.attrs))
    np.testing.assert_allclose(after.sel(state="theta"), before.sel(state="theta"))
    assert np.isnan(after.sel(state="x", transition=3)).all()
    assert int(np.isnan(after).sum()) == 1


def test_prior_of_one_sigma_for_all() -> None:
    """As the paper has it: a single number, whose median is the geometric mean."""
    model = physics_model(SCENE, history(1), sigma="scalar")
    problem = problem_in(model)
    phi, sigma = np.full((300, 1), 2.0), np.full((300, 6), 0.05)
    named = {"mass": phi, "sigma": sigma[:, 0]}
    dims = {"mass": ("chain", "draw", "body"), "sigma": ("chain", "draw")}
    posterior = xr.Dataset({name: (dims[name], named[name][None]) for name in named})
    made = prior_groups(problem, posterior, phi, sigma, seed=1)
    assert made["prior"]["sigma"].shape == (1, 300)
    theirs = compute_log_prior(
        from_groups({"posterior": posterior}, {}), model=model, extend_inferencedata=False,
        progressbar=False,
    )  # fmt: skip
    np.testing.assert_allclose(made["log_prior"]["sigma"], theirs["sigma"])
