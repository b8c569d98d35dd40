"""Importance sampling: density, draws, weights, diagnostics, and the fallback to chains."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import kstest, norm

from pbrl_ppl.background import background
from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import ConvergenceWarning, RefitWarning
from pbrl_ppl.likelihood import single_transitions
from pbrl_ppl.model import build_model
from pbrl_ppl.modes import find_mode, trajectory_mode
from pbrl_ppl.posterior import (
    PARETO_K,
    SIZE,
    PosteriorRecord,
    convergence,
    draws,
    from_groups,
    group,
    groups,
    load_posterior,
    save_posterior,
    scalars,
    smoothed,
)
from pbrl_ppl.sampling import fit, physics_model, update, updating
from pbrl_ppl.sampling.importance import (
    MAX_PARETO_K,
    Space,
    draw_pool,
    resample,
    silent,
    unsuited,
)
from pbrl_ppl.sampling.starts import constrain, evened_logp, unconstrain
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

# Python 3.12 and later warn of a fork in a process with threads; PyMC's chains start by fork
pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")

DRAG = [effect for effect in catalogue if effect.name == "linear_drag"]
FREE = {"r": 0.0, "mu_c": 0.0}
QUICK = {"draws": 250, "chains": 4, "cores": 1, "progress": False}


def pucks(names="a", known=FREE, **options) -> Scene:
    """Discs that slide with drag, 4 m apart in simulated histories."""
    bodies = (
        Body(name, Shape.circle(0.1), known=known, effects=("linear_drag",)) for name in names
    )
    return Scene(time_step=0.1, substeps=4, bodies=tuple(bodies), **options)


def pushed(scene, seed=3, trajectories=30, **options):
    truth = {"mass": 2.0, "linear_drag_coefficient": 1.0, "r": 0.2, "mu_c": 0.3}
    options = {"intervals": 1, "substeps": 4} | options
    return simulated_history(scene, truth, seed=seed, trajectories=trajectories, **options)


def quiet(function, *arguments, **options):
    """Few draws, on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return function(*arguments, **options)


@pytest.fixture(scope="module")
def model():
    scene = pucks()
    return physics_model(scene, pushed(scene))


@pytest.fixture(scope="module")
def mode(model):
    return find_mode(model.problem, seed=1)


@pytest.fixture(scope="module")
def fitted(model, mode):
    return fit(model, seed=1, start=mode, **QUICK)


# -- the density -----------------------------------------------------------------------------------


@pytest.mark.parametrize("likelihood", ["sigma per dimension", "scalar sigma", "trajectories"])
def test_the_density_is_pymc_s(likelihood) -> None:
    """Prior, transforms and likelihood, with a prior that distinguishes a wheel's descriptions."""
    scene = cart_scene(prior={"w_theta": {"mu": 0.6, "kappa": 0.7}, "mu_x": {"mu": 0.2}})
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=4)
    whole = likelihood == "trajectories"
    sigma = "scalar" if likelihood == "scalar sigma" else "per_dimension"
    model = physics_model(scene, history, trajectories=whole, **({} if whole else {"sigma": sigma}))
    problem = model.problem
    mode = find_mode(single_transitions(problem) if whole else problem, seed=1, rounds=1)
    if whole:
        mode = trajectory_mode(problem, mode.phi)
        problem = mode.problem
        model = build_model(problem)
    layout, space = problem.layout, Space(problem)
    centre = [unconstrain(p, x)[0] for p, x in zip(layout.priors, mode.phi, strict=True)]
    noise = problem.likelihood.free(np.log(np.maximum(mode.sigma, 1e-3)))
    rng = np.random.default_rng(4)
    logs = np.concatenate([centre, noise])
    logs = logs + 0.3 * rng.standard_normal((5, len(logs)))
    noise = space.noise(logs[:, layout.size :])
    q = np.concatenate([logs[:, : layout.size], noise], axis=1)
    phi, sigma = space.split(q)
    # the density of a cube root is 3 / root times that of the logarithm
    roots = np.log(3.0 / noise[:, space.roots]).sum(axis=-1)
    ours = (
        -roots
        + space.log_prior(q)
        + problem.log_density(problem.residual(phi), sigma, phi).sum(axis=-1)
    )
    density = model.logp() + evened_logp(model, problem)
    function, theirs = model.compile_fn(density, inputs=model.value_vars), []
    for point, x, noise in zip(q, phi, sigma, strict=True):
        named = layout.to_dict(point[: layout.size])
        named |= {
            name: np.log(values)
            for name, values in problem.named(x, noise).items()
            if name in problem.noise_variables
        }
        values = {model.rvs_to_values[model[name]].name: v for name, v in named.items()}
        theirs.append(float(function(values)))
    # PyMC's constant of a truncated normal distribution has nine digits
    assert np.ptp(ours - theirs) < 1e-8
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


# -- the draws -------------------------------------------------------------------------------------


def grid_moments(problem, mode) -> tuple[np.ndarray, np.ndarray]:
    """Return means and sds of the sampler's entries of a posterior of one parameter and one sigma.

    The density is summed over a grid of 8 Laplace standard deviations to each side.
    """
    prior, space = problem.layout.priors[0], Space(problem)
    sd = np.sqrt(mode.covariance[0, 0]) * unconstrain(prior, mode.phi[0])[1]
    cells = problem.observations.measured.sum()
    steps = np.linspace(-8.0, 8.0, 161)
    first = unconstrain(prior, mode.phi[0])[0] + sd * steps
    second = np.log(mode.sigma[0]) + steps / np.sqrt(2.0 * cells)
    residual = problem.residual(constrain(prior, first)[:, None])
    q = np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1)
    density = space.log_prior(q)
    for i, row in enumerate(residual):
        phi, sigma = space.split(q[i])
        density[i] += problem.log_density(np.repeat(row[None], 161, axis=0), sigma, phi).sum(-1)
    weight = np.exp(density - logsumexp(density))
    assert weight[[0, -1]].sum() + weight[:, [0, -1]].sum() < 1e-6  # nothing beyond the grid
    mean = np.einsum("ij,ijk->k", weight, q)
    return mean, np.sqrt(np.einsum("ij,ijk->k", weight, (q - mean) ** 2))


def test_draws_have_the_moments_of_the_posterior() -> None:
    """Drag and a scalar sigma against a grid, over 10 seeds.

    The proposals of a seed share their first walkers; if they were not independent, means would
    scatter more than their number allows. The sum of 10 squared standardised errors is chi-squared
    with 10 degrees of freedom: below 35.6 but for 1e-4. The mean sd of 10 times about 500 draws has
    a standard error of 1 %.
    """
    scene = pucks(known=FREE | {"mass": 2.0})
    problem = physics_model(scene, pushed(scene), sigma="scalar").problem
    mode = find_mode(problem, seed=1)
    mean, sd = grid_moments(problem, mode)
    errors, widths = [], []
    for seed in range(10):
        pool, why = draw_pool(mode, 750, [seed], 1)
        assert why == ""
        chosen, k, size = resample(pool.log_weight, 500, np.random.default_rng(seed))
        assert k < MAX_PARETO_K
        prior = problem.layout.priors[0]
        first = unconstrain(prior, pool.phi[chosen, 0])[0]
        q = np.stack([first, np.log(pool.sigma[chosen, 0])], axis=1)
        errors.append((q.mean(axis=0) - mean) / sd * np.sqrt(size))
        widths.append(q.std(axis=0) / sd)
    assert (np.square(errors).sum(axis=0) < 35.6).all(), errors
    np.testing.assert_allclose(np.mean(widths, axis=0), 1.0, atol=0.05)


def test_a_cart_s_posterior_is_that_of_chains() -> None:
    """Means of 12 parameters within 4 Monte Carlo errors, sds within 4 of theirs: false alarm 2e-3.

    Nothing touches the cart: the data do not inform ``r``, whose draws follow the prior.
    """
    known = {name: CART[name] for name in ("w_y", "mu_c")}
    scene = cart_scene(known=known).replace(substeps=4)
    history = simulated_history(scene, CART, seed=7, trajectories=4, intervals=10, substeps=4)
    model = physics_model(scene, history)
    start = find_mode(model.problem, seed=1)
    quick = QUICK | {"start": start, "chains": 2}
    weighted = quiet(fit, model, seed=1, **(quick | {"draws": 1000}))
    chains = quiet(fit, model, seed=2, method="metropolis", tune=300, **(quick | {"draws": 700}))
    assert weighted.attrs["method"] == "importance"
    assert weighted.attrs[PARETO_K] < MAX_PARETO_K
    sizes = [convergence(each)[1] for each in (weighted, chains)]
    flat = [scalars(each) for each in (weighted, chains)]
    for name in flat[0].data_vars:
        # logarithms where a parameter is positive: ``r`` and the noises have long tails
        a, b = (each[name].to_numpy().ravel() for each in flat)
        if (a > 0).all() and (b > 0).all():
            a, b = np.log(a), np.log(b)
        error = np.sqrt(sum(1.0 / each[name] for each in sizes))
        assert abs(a.mean() - b.mean()) < 4 * error * b.std(), (name, a.mean(), b.mean(), error)
        assert abs(np.log(a.std() / b.std())) < 4 * error, (name, a.std(), b.std())


# -- parameters that the data do not inform --------------------------------------------------------


def test_an_uninformed_parameter_s_draws_follow_the_prior() -> None:
    """Kolmogorov's statistic of independent draws exceeds 1.95 / sqrt(n) in 0.1 % of cases.

    Of the resampled draws as many count as they are worth.
    """
    scene = pucks(known={"mu_c": 0.3, "mass": 2.0})
    model = physics_model(scene, pushed(scene))
    start = find_mode(model.problem, seed=1)
    labels = list(model.problem.layout.labels)
    place = labels.index("r[a]")
    assert list(np.flatnonzero(silent(start))) == [place]
    with pytest.warns(UserWarning, match=r"nothing about r\[a\]"):
        idata = fit(model, seed=5, start=start, **QUICK)
    assert idata.attrs["method"] == "importance"
    prior = model.problem.layout.priors[place]
    assert prior.family == "log_normal"
    found = kstest(np.log(draws(idata)["r"].ravel()), norm(prior.mu, prior.sigma).cdf).statistic
    assert found * np.sqrt(idata.attrs[SIZE]) < 1.95


def test_whether_a_parameter_is_informed_does_not_depend_on_its_unit(mode) -> None:
    """The derivative by a mass of 1e6 kg is small, and times the mass it is not."""
    place = list(mode.problem.layout.labels).index("mass[a]")
    assert not silent(mode).any()
    phi, jacobian = mode.phi.copy(), mode.jacobian.copy()
    phi[place] *= 1e6
    jacobian[:, place] /= 1e6
    assert not silent(replace(mode, phi=phi, jacobian=jacobian)).any()


# -- seeds, and going on ---------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_draws(model, mode, fitted) -> None:
    """Whatever the number of threads."""
    again = fit(model, seed=1, start=mode, **(QUICK | {"cores": 2}))
    other = fit(model, seed=2, start=mode, **QUICK)
    for name, before in groups(fitted).items():
        for variable in before.data_vars:
            after = group(again, name)[variable].values
            np.testing.assert_array_equal(after, before[variable].values, err_msg=variable)
    assert again.attrs[SIZE] == fitted.attrs[SIZE]
    assert not np.isin(draws(other)["mass"], draws(fitted)["mass"]).any()


def test_a_resumed_fit_adds_new_draws(model, fitted) -> None:
    """With the seed of the first fit, too; what the draws are worth adds up."""
    whole = fit(model, seed=1, resume=fitted, **QUICK)
    assert whole.attrs["method"] == "importance"
    mass = group(whole, "posterior")["mass"].values
    assert mass.shape == (4, 500, 1)
    np.testing.assert_array_equal(mass[:, :250], group(fitted, "posterior")["mass"].values)
    assert not np.isin(mass[:, 250:], mass[:, :250]).any()
    assert fitted.attrs[SIZE] + 300 < whole.attrs[SIZE] <= 2000
    assert fitted.attrs[PARETO_K] <= whole.attrs[PARETO_K] < MAX_PARETO_K


def test_a_resumed_fit_may_need_chains(model, fitted, monkeypatch) -> None:
    monkeypatch.setattr("pbrl_ppl.sampling.methods.MAX_PARETO_K", -10.0)
    whole = quiet(fit, model, seed=1, resume=fitted, tune=20, **(QUICK | {"draws": 40}))
    assert whole.attrs["method"] == "metropolis"
    assert "Pareto k" in whole.attrs["fallback"]
    stats = group(whole, "sample_stats")
    assert stats.sizes["draw"] == group(whole, "posterior").sizes["draw"] == 290
    assert np.isfinite(stats["log_weight"][:, :250]).all()
    assert np.isnan(stats["log_weight"][:, 250:]).all()
    assert np.isfinite(stats["accept"][:, 250:]).all()
    assert fitted.attrs[SIZE] < whole.attrs[SIZE] < fitted.attrs[SIZE] + 4 * 40 * 2
    # chains go on as chains, for the same reason
    monkeypatch.undo()
    more = quiet(fit, model, seed=1, resume=whole, tune=20, **(QUICK | {"draws": 10}))
    assert more.attrs["method"] == "metropolis"
    assert more.attrs["fallback"] == whole.attrs["fallback"]


def test_chains_go_on_as_chains(model, mode) -> None:
    options = QUICK | {"draws": 20, "tune": 20, "chains": 2}
    first = quiet(fit, model, seed=1, start=mode, method="metropolis", **options)
    whole = quiet(fit, model, seed=1, resume=first, **options)
    assert whole.attrs["method"] == "metropolis"
    assert "accept" in group(whole, "sample_stats")
    assert not {SIZE, PARETO_K, "fallback"} & set(whole.attrs)


# -- weights ---------------------------------------------------------------------------------------


@pytest.mark.one_stack
def test_resampling_is_unbiased() -> None:
    """Each proposal is drawn as often as its smoothed weight says, on average.

    A count has a standard deviation of at most 0.5, the mean of 400 counts 0.025; none of 200 is
    off by 5 of these, but for 1e-4.
    """
    log_weight = 0.7 * np.random.default_rng(1).standard_normal(200)
    log_weight[3] = -np.inf
    there = np.isfinite(log_weight)
    weight = np.zeros(200)
    weight[there], k = smoothed(log_weight[there])
    counts = np.zeros(200)
    for seed in range(400):
        chosen, found, size = resample(log_weight, 150, np.random.default_rng(seed))
        assert chosen.shape == (150,)
        assert found == k
        assert size <= min(1.0 / (weight**2).sum(), 150.0)
        counts += np.bincount(chosen, minlength=200) / 400
    assert counts[3] == 0.0
    assert np.abs(counts - 150 * weight).max() < 5 * 0.025


@pytest.mark.one_stack
def test_draws_come_in_random_order() -> None:
    """Chains are slices of the draws: sorted ones would disagree."""
    chosen, *_ = resample(np.linspace(-1.0, 0.0, 400), 400, np.random.default_rng(0))
    assert abs(np.corrcoef(chosen, np.arange(400))[0, 1]) < 0.2  # 4 standard errors


@pytest.mark.one_stack
@pytest.mark.parametrize(
    "log_weight",
    [np.r_[np.zeros(99), np.inf], np.r_[0.0, np.full(99, -np.inf)], np.full(9, np.nan)],
)
def test_weights_that_are_not_to_be_relied_on(log_weight) -> None:
    """Proposals that the emulator excludes, and proposals that the engine excludes."""
    _, k, size = resample(log_weight, 50, np.random.default_rng(0))
    assert (k, size) == (np.inf, 0.0)


# -- the fallback ----------------------------------------------------------------------------------


@pytest.mark.one_stack
def test_where_proposals_do_not_suit(mode) -> None:
    assert unsuited(mode) == ""
    assert unsuited(replace(mode, others=(mode,))) == "the posterior has several modes"
    near = [[0.0, 0.0, 0.0], [0.21, 0.0, 0.0]]
    scene = pucks("ab")
    history = pushed(scene, trajectories=3, intervals=6, poses=near)
    problem = physics_model(scene, history, trajectories=True).problem
    assert unsuited(SimpleNamespace(problem=problem, others=())) == "bodies touch"


def test_independent_parts_are_sampled_by_chains() -> None:
    scene = pucks("ab", known=FREE | {"mass": 2.0})
    model = physics_model(scene, pushed(scene))
    idata = quiet(fit, model, seed=1, tune=20, **(QUICK | {"draws": 20, "chains": 2}))
    assert idata.attrs["method"] == "metropolis"
    assert idata.attrs["fallback"] == "the scene has several independent parts"
    assert "accept" in group(idata, "sample_stats")
    assert not {SIZE, PARETO_K} & set(idata.attrs)


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("methods.MAX_PARETO_K", -10.0, "Pareto k of the proposals is .*, above -10.0"),
        ("methods._WORTH", 2.0, "weights leave [0-9]+ of 40 draws"),
        ("importance._ENOUGH", 0.0, "the emulator's log-likelihood is off by .* nats"),
        ("importance._DRIFT", 0.0, "the proposals still drift"),
    ],
)
def test_proposals_that_fail_give_way_to_chains(model, mode, monkeypatch, name, value, why) -> None:
    monkeypatch.setattr(f"pbrl_ppl.sampling.{name}", value)
    options = QUICK | {"draws": 20, "chains": 2}
    with pytest.warns(ConvergenceWarning, match="the chains have not converged.*thin="):
        idata = fit(model, seed=1, start=mode, tune=20, **options)
    assert idata.attrs["method"] == "metropolis"
    assert PosteriorRecord.of(idata).fallback == idata.attrs["fallback"]
    assert re.fullmatch(why, idata.attrs["fallback"])


# -- diagnostics in the attributes -----------------------------------------------------------------


def test_diagnostics(model, mode, fitted, tmp_path) -> None:
    attrs = fitted.attrs
    assert attrs["method"] == "importance"
    assert "fallback" not in attrs
    assert attrs[PARETO_K] < MAX_PARETO_K
    assert attrs["min_ess"] <= attrs[SIZE] <= 1000
    assert "log_likelihood" not in attrs
    theirs = model.problem.log_density(
        model.problem.residual(model.problem.layout.to_vectors(draws(fitted), 1000)),
        draws(fitted)["sigma"],
        model.problem.layout.to_vectors(draws(fitted), 1000),
    )
    ours = group(fitted, "log_likelihood")["next_state"].values.reshape(1000, -1)
    np.testing.assert_allclose(ours, theirs)
    save_posterior(fitted, tmp_path / "puck.nc")
    loaded = load_posterior(tmp_path / "puck.nc")
    assert dict(loaded.attrs) == dict(attrs)
    record = PosteriorRecord.of(loaded)
    assert (record.pareto_k, record.importance_ess) == (attrs[PARETO_K], attrs[SIZE])


def test_no_parameter_is_worth_more_than_the_weights(fitted) -> None:
    """Resampled draws look independent to ArviZ."""
    capped = from_groups(groups(fitted), {**fitted.attrs, SIZE: 17.0})
    assert set(convergence(capped)[1].values()) == {17.0}


def test_too_few_draws(model, mode) -> None:
    cure = r"the draws are too few: .*effective.*; raise draws=, or go on with resume="
    with pytest.warns(ConvergenceWarning, match=cure) as caught:
        few = fit(model, seed=1, start=mode, **(QUICK | {"draws": 40}))
    assert few.attrs["max_rhat"] > 1.01  # as that of a few independent draws is
    assert "R-hat" not in "".join(str(each.message) for each in caught)


def test_updates_keep_count_of_what_draws_are_worth(model, mode) -> None:
    """Reweighted draws are worth less; moved draws and those of a new fit have no earlier weights.

    A second update weights the fit's draws by all that was recorded since.
    """
    fitted = last = fit(model, seed=1, start=mode, **(QUICK | {"draws": 500}))
    since = pushed(pucks(), seed=8, trajectories=4)
    for i in (0, 2):
        new = quiet(update, last, since.select([i]), seed=2)
        entry = json.loads(new.attrs["updates"])[-1]
        assert entry["did"] == "reweighted"
        assert new.attrs[SIZE] == min(last.attrs[SIZE], entry["share"] * fitted.attrs[SIZE])
        assert new.attrs["min_ess"] <= new.attrs[SIZE]
        last = new
    rest = since.select([1, 3])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(updating, "_MOVE", 1.1)
        moved = quiet(update, last, rest, seed=2)
    assert json.loads(moved.attrs["updates"])[-1]["did"] == "moved"
    assert not {SIZE, PARETO_K} & set(moved.attrs)
    with pytest.MonkeyPatch.context() as patch, pytest.warns(RefitWarning):
        patch.setattr(updating, "_MOVE", 1.1)
        patch.setattr(updating, "_REFIT", 1.1)
        new = quiet(update, last, rest, seed=2, progress=False)
    assert json.loads(new.attrs["updates"])[-1]["did"] == "refitted"
    assert updating.BASE not in groups(new)
    assert 900 < new.attrs[SIZE] <= 1000  # a fit's own draws


# -- a function beside the caller ------------------------------------------------------------------


@pytest.fixture
def two_processors(monkeypatch):
    monkeypatch.setattr("multiprocessing.cpu_count", lambda: 2)


@pytest.mark.one_stack
@pytest.mark.usefixtures("two_processors")
def test_background_runs_in_another_process() -> None:
    with background(lambda: (os.getpid(), 42)) as answer:
        process, value = answer()
    assert process != os.getpid()
    assert value == 42


@pytest.mark.usefixtures("two_processors")
def test_background_returns_a_posterior(fitted) -> None:
    with background(lambda: fitted) as answer:
        found = answer()
    assert found is not fitted  # it came from the other process
    assert dict(found.attrs) == dict(fitted.attrs)
    np.testing.assert_array_equal(draws(found)["mass"], draws(fitted)["mass"])


@pytest.mark.one_stack
@pytest.mark.usefixtures("two_processors")
def test_background_raises_what_the_function_raised() -> None:
    def fail() -> None:
        raise ValueError("no such mode")

    with background(fail) as answer, pytest.raises(ValueError, match="no such mode"):
        answer()


@pytest.mark.one_stack
@pytest.mark.usefixtures("two_processors")
def test_background_of_a_killed_process_is_evaluated_here() -> None:
    here = os.getpid()

    def killed() -> int:
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    with background(killed) as answer:
        assert answer() == here


@pytest.mark.one_stack
@pytest.mark.usefixtures("two_processors")
def test_background_ends_with_its_context() -> None:
    begin = time.monotonic()
    with pytest.raises(KeyError), background(lambda: time.sleep(60.0)):
        raise KeyError
    assert time.monotonic() - begin < 30.0


#: Prints the number of the process in the background, which computes or has a result to send.
KILLED = """
import multiprocessing, os, time
from pbrl_ppl.background import background
multiprocessing.cpu_count = lambda: 2
def work():
    print(os.getpid(), flush=True)
    return {work}
with background(work):
    time.sleep(120.0)
"""


@pytest.mark.one_stack
@pytest.mark.parametrize("work", ["time.sleep(60.0)", "bytes(10**7)"])
def test_background_ends_with_a_killed_parent(work) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", KILLED.format(work=work)], stdout=subprocess.PIPE
    )
    child = int(parent.stdout.readline())
    parent.kill()
    try:
        parent.communicate(timeout=20.0)  # the output ends once both have ended
    except subprocess.TimeoutExpired:
        os.kill(child, signal.SIGKILL)
        raise


@pytest.mark.one_stack
@pytest.mark.parametrize(
    ("name", "value"), [("get_all_start_methods", lambda: ["spawn"]), ("cpu_count", lambda: 1)]
)
def test_background_without_forks_or_processors_runs_here(monkeypatch, name, value) -> None:
    monkeypatch.setattr(f"multiprocessing.{name}", value)
    with background(os.getpid) as answer:
        assert answer() == os.getpid()
