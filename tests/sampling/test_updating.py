"""update: the posterior of all data, from the posterior of some and the transitions that follow."""

import json
import warnings

import arviz as az
import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.cli import main
from pbrl_ppl.effects import Effect, EffectParameter, catalogue
from pbrl_ppl.errors import (
    BoundWarning,
    ConvergenceWarning,
    EffectError,
    HistoryError,
    PosteriorError,
    RefitWarning,
)
from pbrl_ppl.history import History
from pbrl_ppl.model import build_model, physics_model
from pbrl_ppl.parameters import Prior
from pbrl_ppl.posterior import (
    convergence,
    draws,
    from_groups,
    group,
    groups,
    load_posterior,
    loo_pit,
    problem_of,
    save_posterior,
    scalars,
    scene_of,
    smoothed,
)
from pbrl_ppl.sampling import fit, update
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history
from tests.helpers.samplers import shorten

pytestmark = pytest.mark.first(3)

KNOWN = {"r": 0.2, "mu_c": 0.3}
PUCKS = {"mass": [2.0, 3.0], "linear_drag_coefficient": [0.5, 1.0]}
QUICK = {"draws": 1000, "chains": 2, "cores": 1, "progress": False}


def pucks(names="ab") -> Scene:
    """Discs that slide with drag, 4 m apart."""
    shape = Shape.circle(0.1)
    bodies = (Body(name, shape, known=KNOWN, effects=("linear_drag",)) for name in names)
    return Scene(time_step=0.1, substeps=4, bodies=tuple(bodies))


def quiet(function, *arguments, **options):
    """Few draws, on purpose; and whatever else a hasty fit says of itself."""
    with warnings.catch_warnings():
        for kind in (ConvergenceWarning, BoundWarning):
            warnings.simplefilter("ignore", kind)
        return function(*arguments, **options)


def log(idata) -> list[dict]:
    return json.loads(idata.attrs["updates"])


def did(idata) -> list[str]:
    return [each["did"] for each in log(idata)]


def agree(one, other, sigmas: float = 4.0) -> None:
    """Means and standard deviations within so many Monte Carlo standard errors.

    With 14 moments and 4 standard errors, a right update fails with probability 1e-3 over seeds.
    """
    ess = [convergence(each)[1] for each in (one, other)]
    flat = [scalars(each) for each in (one, other)]
    for name in flat[0].data_vars:
        a, b = (each[name].to_numpy().ravel() for each in flat)
        n = np.array([each[name] for each in ess])
        sd = b.std()
        error = np.hypot(*(sd / np.sqrt(n)))
        assert abs(a.mean() - b.mean()) < sigmas * error, (name, a.mean(), b.mean(), error)
        # of a standard deviation, for tails no heavier than twice a Gaussian's variance of squares
        assert abs(np.log(a.std() / sd)) < sigmas * error / sd, (name, a.std(), sd)


@pytest.fixture(scope="module")
def parts():
    """A scene, 60 transitions, 10 that follow, and all of them."""
    scene = pucks()
    whole = simulated_history(scene, PUCKS, seed=3, trajectories=70, intervals=1, substeps=8)
    return scene, whole.select(range(60)), whole.select(range(60, 70)), whole


@pytest.fixture(scope="module")
def first(parts):
    scene, a, _, _ = parts
    return quiet(fit, physics_model(scene, a), seed=1, **QUICK | {"draws": 3000})


@pytest.fixture(scope="module")
def whole(parts):
    """The fit to all data, under the prior of the first data's fit."""
    scene, _, _, both = parts
    return quiet(fit, physics_model(scene, both), seed=2, **QUICK)


@pytest.fixture(scope="module")
def one(parts, first):
    """Two transitions more."""
    return quiet(update, first, parts[2].select([0, 1]), seed=5)


@pytest.mark.one_stack
def test_few_transitions_are_a_matter_of_weights(parts, first, one) -> None:
    assert pp.update is update
    (entry,) = log(one)
    assert entry["did"] == "reweighted"
    assert entry["transitions"] == 2
    assert 0.5 < entry["share"] < 1.0
    assert entry["data_sha256"] == parts[2].select([0, 1]).data_sha256
    assert {**one.attrs, "updates": 0, "warnings": 0}.keys() >= first.attrs.keys()
    assert one.attrs["data_sha256"] != first.attrs["data_sha256"]
    for name in ("posterior", "log_likelihood"):
        before, after = group(first, name), group(one, name)
        sizes = dict(before.sizes) | ({"transition": 62} if name == "log_likelihood" else {})
        assert dict(after.sizes) == sizes
        assert {v: after[v].dims for v in after} == {v: before[v].dims for v in before}
        assert set(after.coords) == set(before.coords)
    # every draw is one of the fit's, of the same chain, in the same order
    ancestor = group(one, "sample_stats")["ancestor"].values
    assert (np.diff(ancestor, axis=1) >= 0).all()
    mass = group(first, "posterior")["mass"]
    np.testing.assert_array_equal(
        group(one, "posterior")["mass"].values[1], mass.values[1][ancestor[1]]
    )
    assert group(one, "posterior")["mass"].attrs == mass.attrs


def test_stored_likelihoods_and_data_are_those_of_all_data(parts, one) -> None:
    """Old columns went with their draws, new ones were added; and the file's own problem agrees."""
    problem = problem_of(one)
    assert problem.segments.n == 62
    phi = problem.layout.to_vectors(draws(one), 6000)[::1200]
    sigma = draws(one)["sigma"][::1200]
    stored = group(one, "log_likelihood")["next_state"].values.reshape(6000, -1)[::1200]
    np.testing.assert_allclose(problem.log_density(problem.residual(phi), sigma), stored)
    _, a, b, _ = parts
    observed = np.concatenate([a.segments().observed, b.segments().observed[:2]])
    np.testing.assert_array_equal(group(one, "observed_data")["next_state"].values, observed)
    predicted = group(one, "posterior_predictive")["next_state"]
    assert predicted.shape == (2, 100, *observed.shape)
    z = (observed - predicted.values.mean(axis=(0, 1))) / predicted.values.std(axis=(0, 1))
    # 124 cells a dimension, 200 draws for each sd: chi-squared / 124 has sd 0.13; 5 of it
    assert (np.abs((z**2).mean(axis=(0, 1, 2)) - 1) < 0.65).all()


def test_arviz_takes_it(one) -> None:
    assert "mass[a]" in az.summary(one).index
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Estimated shape parameter")
        az.loo(one)


def test_prior_groups_follow_the_draws(first, one) -> None:
    """And predictions are of the draws that their labels name, which LOO-PIT needs."""
    ancestor = group(one, "sample_stats")["ancestor"].values
    was, now = (group(idata, "log_prior")["mass"].values for idata in (first, one))
    for chain, chosen in enumerate(ancestor):
        np.testing.assert_allclose(now[chain], was[chain][chosen])
    prior = group(one, "prior")["mass"].values
    assert prior.shape == group(one, "posterior")["mass"].shape
    # log-normal: 5 standard errors of the mean of 4000 numbers
    prior_of = problem_of(one).layout.priors[0]
    assert abs(np.log(prior).mean() - prior_of.mu) < 5 * prior_of.sigma / np.sqrt(prior.size)
    pit = loo_pit(one).values
    # 62 transitions, correlated within one: the mean of uniform numbers, 5 standard errors
    assert abs(np.nanmean(pit) - 0.5) < 5 * np.sqrt(1 / 12 / 62)


@pytest.mark.slow
def test_update_is_the_full_fit(parts, first, whole) -> None:
    """A sixth more data, by weights."""
    new = quiet(update, first, parts[2], seed=6)
    assert did(new) == ["reweighted"]
    agree(new, whole)


@pytest.mark.slow
def test_a_refit_is_the_full_fit(parts, first, whole, monkeypatch) -> None:
    """Where fewer effective draws are left than are wanted, all data are fitted."""
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 6000)
    with pytest.warns(RefitWarning, match="fewer than 6000 effective draws are left of 6000"):
        new = quiet(update, first, parts[2], seed=6, progress=False)
    assert did(new) == ["refitted"]
    assert group(new, "log_likelihood").sizes["transition"] == 70
    agree(new, whole)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.RefitWarning")
def test_one_at_a_time_is_all_at_once(parts, first, whole, monkeypatch) -> None:
    """Ten updates; each resamples the draws of the one before, until too few are left."""
    shorten(monkeypatch, draws=1000)
    idata = first
    for i in range(10):
        idata = quiet(update, idata, parts[2].select([i]), seed=20 + i, progress=False)
    assert set(did(idata)) == {"reweighted", "refitted"}
    assert [each["transitions"] for each in log(idata)] == [1] * 10
    assert group(idata, "log_likelihood").sizes["transition"] == 70
    agree(idata, whole)


def test_reproducible_and_the_same_from_a_file(parts, first, one, tmp_path) -> None:
    save_posterior(one, tmp_path / "one.nc")
    new = parts[2].select([2])
    a, b, other = (
        quiet(update, idata, new, seed=seed)
        for idata, seed in ((one, 7), (load_posterior(tmp_path / "one.nc"), 7), (one, 8))
    )
    assert dict(a.attrs) == dict(b.attrs)
    for name, data in groups(a).items():
        for variable in data.data_vars:
            np.testing.assert_array_equal(group(b, name)[variable].values, data[variable].values)
    assert not np.array_equal(draws(a)["mass"], draws(other)["mass"])
    # and what went in is as it was
    assert len(log(one)) == 1
    assert group(first, "log_likelihood").sizes["transition"] == 60


@pytest.mark.long
def test_other_data_are_refitted(parts, first, monkeypatch) -> None:
    """The masses are others now: nearly no draw is left, and the answer is the refit's."""
    shorten(monkeypatch, draws=500)
    scene, _, _, _ = parts
    heavy = PUCKS | {"mass": [4.0, 6.0]}
    new = simulated_history(scene, heavy, seed=4, trajectories=40, intervals=1, substeps=8)
    with pytest.warns(RefitWarning, match="refitted, .*; look whether") as caught:
        idata = quiet(update, first, new, seed=9, progress=False)
    assert [each.filename for each in caught if each.category is RefitWarning] == [__file__]
    assert did(idata) == ["refitted"]
    problem = problem_of(first).with_data(history=problem_of(idata).data.history)
    assert problem.segments.n == 100
    agree(idata, quiet(fit, build_model(problem), seed=10, **QUICK | {"draws": 500}))


@pytest.mark.parametrize("mass", [2.0, 20.0])
def test_a_refit_asks_whether_the_bodies_are_the_same(mass, monkeypatch) -> None:
    """Twenty times the data leave few draws of the same body too."""
    scene = pucks("a")
    truth = {"mass": 2.0, "linear_drag_coefficient": 0.5}
    few = simulated_history(scene, truth, seed=1, trajectories=10, intervals=6, substeps=8)
    model = physics_model(scene, few)
    start = quiet(fit, model, method="laplace", seed=1, draws=100, progress=False)
    more = simulated_history(
        scene, truth | {"mass": mass}, seed=2, trajectories=40, intervals=30, substeps=8
    )

    def long_work(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("pbrl_ppl.sampling.updating.sample", long_work)
    with pytest.warns(RefitWarning, match="look whether"), pytest.raises(KeyboardInterrupt):
        update(start, more, seed=3, progress=False)


@pytest.mark.parametrize(
    "sigma",
    [
        pytest.param("scalar", marks=pytest.mark.slow),
        pytest.param("per_dimension", marks=pytest.mark.long),
    ],
)
def test_a_cart(sigma, few_suffice) -> None:
    """Friction's kinks, a wheel, Student-t noise and a horizon: against the fit to all data.

    The grain that friction gives the posterior makes the effective numbers optimistic: 5 errors.
    """
    scene = cart_scene(known=KNOWN).replace(substeps=4)
    both = simulated_history(scene, CART, seed=9, trajectories=12, intervals=10)
    options = {"horizon": 2} if sigma == "scalar" else {"nu": 4.0}
    short = QUICK | {"draws": 1500}
    first, whole = (
        quiet(fit, physics_model(scene, h, sigma=sigma, **options), seed=1, **short)
        for h in (both.select(range(11)), both)
    )
    idata = quiet(update, first, both.select([11]), seed=11, progress=False)
    assert "refitted" not in did(idata)
    agree(idata, whole, sigmas=5.0)


@pytest.mark.one_stack
def test_missing_cells_and_dimensions(parts, first) -> None:
    """What was not measured takes no part; a dimension of which no noise is known cannot."""
    rows = parts[2].select([0]).to_dataframe()
    rows.loc[rows["step"] == 1, ["x", "y", "theta", "omega"]] = np.nan
    new = History.from_dataframe(rows, parts[0])
    idata = quiet(update, first, new)
    stored = group(idata, "observed_data")["next_state"].values[-1]
    assert np.isfinite(stored).sum() == 4  # vx and vy of both
    without = rows.copy()
    with_all = parts[1].to_dataframe()
    with_all.loc[with_all["step"] == 1, "omega"] = np.nan
    no_omega = quiet(
        fit, physics_model(parts[0], History.from_dataframe(with_all, parts[0])), seed=1,
        **(QUICK | {"draws": 500}),
    )  # fmt: skip
    quiet(update, no_omega, History.from_dataframe(without, parts[0]))
    with pytest.raises(HistoryError, match=r"measures omega, of which .* leave those columns"):
        update(no_omega, parts[2])


@pytest.fixture
def few_suffice(monkeypatch) -> None:
    """No refit for the number of effective draws."""
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 30)


@pytest.mark.one_stack
def test_an_effect_of_one_s_own(parts, few_suffice) -> None:
    def force(state, command, parameters, wrench):
        wrench[0] += parameters[0]

    own = Effect(
        "breeze", (EffectParameter("force", "N", Prior("normal", sigma=1.0)),), "a breeze", "ours",
        force=force,
    )  # fmt: skip
    scene = pucks("a")
    history = simulated_history(
        scene, {"mass": 2.0, "linear_drag_coefficient": 0.5, "breeze_force": 0.3}, seed=1,
        trajectories=12, intervals=1, effects=[own], substeps=8,
    )  # fmt: skip
    idata = quiet(
        fit, physics_model(scene, history.select(range(10)), [own]), seed=1,
        **(QUICK | {"draws": 500}),
    )  # fmt: skip
    new = history.select([10])
    with pytest.raises(EffectError, match="breeze"):
        update(idata, new)
    updated = quiet(update, idata, new, effects=(*catalogue, own))
    assert did(updated) == ["reweighted"]


@pytest.mark.one_stack
@pytest.mark.parametrize("known", ["b", "ab"])
def test_bodies_of_which_all_is_known(known, few_suffice) -> None:
    """Nothing is unknown of them but the noise."""
    free, given = {"known": KNOWN}, {"known": KNOWN | {"mass": 3.0}}
    shape = Shape.circle(0.1)
    bodies = tuple(Body(n, shape, **(given if n in known else free)) for n in "ab")
    scene = Scene(time_step=0.1, substeps=4, bodies=bodies)
    truth = {} if known == "ab" else {"mass": 2.0}
    history = simulated_history(scene, truth, seed=1, trajectories=31, intervals=1, substeps=8)
    idata = quiet(fit, physics_model(scene, history.select(range(30))), seed=1,
                  **(QUICK | {"draws": 500}))  # fmt: skip
    assert did(quiet(update, idata, history.select([30]))) == ["reweighted"]


def test_refused_histories(parts, first) -> None:
    scene, _, b, _ = parts
    others = pucks("xy")
    elsewhere = simulated_history(others, PUCKS, seed=1, trajectories=1, intervals=1, substeps=8)
    with pytest.raises(HistoryError, match=r"history is of x, y, the posterior of a, b; load it"):
        update(first, elsewhere)
    slow = scene.replace(time_step=0.2)
    with pytest.raises(HistoryError, match=r"each 0\.2 s, the posterior's each 0\.1 s"):
        update(first, simulated_history(slow, PUCKS, seed=1, trajectories=1, intervals=1))
    once = quiet(update, first, b.select([0]))
    for data in (parts[1], b.select([0])):
        with pytest.raises(PosteriorError, match=r"in the posterior already.*pass only"):
            update(once, data)


@pytest.mark.one_stack
def test_a_shorter_trajectory_than_the_horizon_counts_as_far_as_it_goes(few_suffice) -> None:
    scene = pucks("a")
    truth = {"mass": 2.0, "linear_drag_coefficient": 0.5}
    history = simulated_history(scene, truth, seed=1, trajectories=31, intervals=2, substeps=8)
    model = physics_model(scene, history.select(range(30)), horizon=2)
    idata = quiet(fit, model, seed=1, **(QUICK | {"draws": 500}))
    assert did(quiet(update, idata, history.select([30]))) == ["reweighted"]
    rows = history.select([30]).to_dataframe()
    short = History.from_dataframe(rows[rows["step"] < 2].assign(
        **{w: rows[w].where(rows["step"] == 0) for w in ("force_x", "force_y", "torque")}
    ), scene)  # fmt: skip
    assert did(quiet(update, idata, short)) == ["reweighted"]


def test_refused_posteriors(parts, first) -> None:
    _, _, b, _ = parts
    new = b.select([0])
    held = groups(first)
    for name in ("posterior_predictive", "constant_data"):
        less = {key: data for key, data in held.items() if key != name}
        with pytest.raises(PosteriorError, match=f"no group '{name}'"):
            update(from_groups(less, first.attrs), new)
    unknown = {k: v for k, v in first.attrs.items() if k != "data_sha256"}
    with pytest.raises(PosteriorError, match="does not say its data_sha256"):
        update(from_groups(held, unknown), new)
    other = scene_of(first).replace(gravity=(0.0, -9.81))
    with pytest.raises(PosteriorError, match=r"not what this engine gives.*refit all data"):
        update(from_groups(held, dict(first.attrs) | {"scene": other.to_toml()}), new)


def test_few_draws_are_refitted(parts, first, monkeypatch) -> None:
    def long_work(*args, **options):
        raise KeyboardInterrupt

    few = {
        key: data.isel(draw=slice(20)) if key in ("posterior", "log_likelihood") else data
        for key, data in groups(first).items()
    }
    monkeypatch.setattr("pbrl_ppl.sampling.updating.sample", long_work)
    says = "fewer than 400 effective draws are left of 40"
    with pytest.warns(RefitWarning, match=says), pytest.raises(KeyboardInterrupt):
        update(from_groups(few, first.attrs), parts[2].select([0]))


def test_other_likelihoods_are_refused(parts, first) -> None:
    """Of noise that is no more, or of another version: its numbers say so."""
    held = groups(first)
    likelihood = held["log_likelihood"] + 0.1
    with pytest.raises(PosteriorError, match=r"not what this engine gives .* off by 0\.1 or more"):
        update(
            from_groups(held | {"log_likelihood": likelihood}, first.attrs),
            parts[2].select([0]),
        )


def test_weights_are_smoothed_alike_on_both_stacks() -> None:
    x = np.random.default_rng(1).normal(size=1000)
    weights, k = smoothed(x)
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() > 0
    assert -0.1 < k < 0.4  # log-normal weights; and as from ArviZ 0.23
    equal, unknown = smoothed(np.zeros(50))
    np.testing.assert_allclose(equal, 0.02)
    assert unknown == np.inf
    order = np.argsort(x)
    assert (np.diff(weights[order]) >= 0).all()
    _, heavy = smoothed(5.0 * x)
    assert heavy > 0.7


def test_the_command(parts, first, tmp_path, capsys) -> None:
    save_posterior(first, tmp_path / "first.nc")
    parts[2].select([0, 1]).save(tmp_path / "new.csv")
    files = [str(tmp_path / name) for name in ("first.nc", "new.csv", "second.nc")]
    command = ["update", *files[:2], "-o", files[2], "--seed", "5"]
    assert quiet(main, command) == 0
    assert capsys.readouterr().out.splitlines()[0].startswith("reweighted: 2 transitions")
    assert did(load_posterior(files[2])) == ["reweighted"]
    assert main(command) == 2
    assert "exists" in capsys.readouterr().err
    command[2] = str(tmp_path / "nowhere.csv")
    assert main([*command, "--overwrite"]) == 2
    assert "error: history" in capsys.readouterr().err
