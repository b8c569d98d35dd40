"""Leave-one-out cross-validation of two posteriors, against the exact one of a normal mean."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.posterior import (
    by_number,
    by_trajectory,
    compare,
    from_groups,
    group,
    groups,
    load_posterior,
)
from tests.helpers.stacks import file

N = 60
DATA = np.random.default_rng(1).normal(size=N)


def fitted(spread: float, seed: int = 2):
    """The mean of normal data of known spread, under a flat prior: 2 x 2000 exact draws."""
    rng = np.random.default_rng(seed)
    mean = rng.normal(DATA.mean(), spread / np.sqrt(N), (2, 2000))
    likelihood = stats.norm(mean[..., None], spread).logpdf(DATA)
    dims = ("chain", "draw", "transition")
    return from_groups(
        {
            "posterior": xr.Dataset({"mean": (dims[:2], mean)}),
            "log_likelihood": xr.Dataset({"next_state": (dims, likelihood)}),
        },
        {},
    )


def exact(spread: float) -> np.ndarray:
    """Predictive density of each datum given the others, in closed form."""
    others = (DATA.sum() - DATA) / (N - 1)
    return stats.norm(others, spread * np.sqrt(1 + 1 / (N - 1))).logpdf(DATA)


def test_two_models_of_known_elpd() -> None:
    """Monte Carlo errors of the sums are below 0.02 nats: five of them."""
    found = compare(fitted(2.0), fitted(1.0))
    gain = exact(1.0) - exact(2.0)
    assert found.count == N
    assert found.before.elpd_loo == pytest.approx(exact(2.0).sum(), abs=0.1)
    assert found.after.elpd_loo == pytest.approx(exact(1.0).sum(), abs=0.1)
    assert found.elpd_difference == pytest.approx(gain.sum(), abs=0.1)
    assert found.elpd_difference_se == pytest.approx(np.sqrt(N * gain.var()), rel=0.05)
    assert found.elpd_difference > 0
    assert (found.before.high_pareto_k, found.after.high_pareto_k) == (0, 0)
    assert found.after.p_loo == pytest.approx(1.0, abs=0.3)  # one parameter, of 60 data
    worse = compare(fitted(1.0), fitted(2.0))
    assert worse.elpd_difference == pytest.approx(-found.elpd_difference)


def test_one_model_twice_gains_nothing() -> None:
    idata = fitted(1.0)
    found = compare(idata, idata)
    assert (found.elpd_difference, found.elpd_difference_se) == (0.0, 0.0)
    assert found.before == found.after


def test_transitions_with_heavy_weights_are_counted() -> None:
    idata = fitted(1.0)
    noisy = group(idata, "log_likelihood")["next_state"].copy(deep=True)
    noisy[..., [3, 5]] = 5.0 * np.random.default_rng(3).normal(size=(2, 2000, 2))
    data = {"posterior": group(idata, "posterior"), "log_likelihood": noisy.to_dataset()}
    found = compare(idata, from_groups(data, {}))
    assert (found.before.high_pareto_k, found.after.high_pareto_k) == (0, 2)


@pytest.mark.parametrize("draws", [1, 2000])
def test_none_where_it_cannot_be_computed(draws) -> None:
    """One draw of one chain; and likelihoods of a world that was lost."""
    idata = fitted(1.0)
    data = {
        name: group(idata, name).isel(draw=slice(draws)) for name in ("posterior", "log_likelihood")
    }
    if draws > 1:
        data["log_likelihood"] = data["log_likelihood"] * np.nan
    assert compare(from_groups(data, {}), idata) is None


def test_posteriors_of_both_generations() -> None:
    """The same data and model, twice fitted: nothing gained."""
    found = compare(*(load_posterior(file(generation)) for generation in ("5", "6")))
    assert found.count == 12
    assert abs(found.elpd_difference) < 0.5


def grouped(spread: float, size: int = 6):
    """The same posterior, its data in trajectories of six whose terms depend on each other."""
    idata = fitted(spread)
    data = groups(idata)
    places = {"trajectory": ("transition", np.arange(N) // size)}
    data["log_likelihood"] = data["log_likelihood"].assign_coords(places)
    data["constant_data"] = xr.Dataset({"smoothed": 0.0})
    return from_groups(data, {})


def test_one_trajectory_is_left_out_at_a_time() -> None:
    """Against the closed form of six normal data given the others; Monte Carlo error below 0.05."""
    size = 6
    exact = 0.0
    for i in range(0, N, size):
        others = np.delete(DATA, slice(i, i + size))
        covariance = np.eye(size) + 1 / len(others)
        law = stats.multivariate_normal(np.full(size, others.mean()), covariance)
        exact += law.logpdf(DATA[i : i + size])
    found = compare(grouped(1.0), grouped(1.0))
    assert (found.count, found.left_out) == (N // size, "trajectory")
    assert (
        found.method
        == "Leave-one-trajectory-out cross-validation on the 10 trajectories of the fit"
    )
    assert found.before.elpd_loo == pytest.approx(exact, abs=0.25)
    assert abs(found.before.elpd_loo - compare(fitted(1.0), fitted(1.0)).before.elpd_loo) < 5
    summed = group(by_trajectory(grouped(1.0)), "log_likelihood")["next_state"]
    assert summed.dims == ("chain", "draw", "trajectory")


def test_no_number_is_left_out_of_a_trajectory() -> None:
    with pytest.raises(PosteriorError, match="later transitions have seen the one left out"):
        by_number(grouped(1.0))


def test_different_things_left_out_are_not_compared() -> None:
    with pytest.raises(PosteriorError, match="leaves out one transition at a time"):
        compare(fitted(1.0), grouped(1.0))
