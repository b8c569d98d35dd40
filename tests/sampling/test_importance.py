"""Importance sampling: draws, weights, diagnostics, and particles where weights do not suffice."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import ks_2samp, kstest, kstwobign, norm

from pbrl_ppl.effects import Effect, EffectParameter
from pbrl_ppl.errors import ConvergenceWarning, FitError, RefitWarning
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import Space, adaptive_importance, find_mode, trajectory_mode
from pbrl_ppl.modes.space import constrain, unconstrain
from pbrl_ppl.parameters import Prior
from pbrl_ppl.posterior import (
    MAX_PARETO_K,
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
from pbrl_ppl.sampling import fit, update
from pbrl_ppl.sampling.importance import Reference, draw_proposals, resample
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

# Python 3.12 and later warn of a fork in a process with threads; PyMC's chains start by fork
pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")

FREE = {"r": 0.0, "mu_c": 0.0}
QUICK = {"draws": 250, "chains": 4, "cores": 1, "progress": False}


def pucks(names="a", known=FREE, **options) -> Scene:
    """Discs that slide with drag, 4 m apart in simulated histories."""
    bodies = (
        Body(name, Shape.circle(0.1), known=known, effects=("linear_drag",)) for name in names
    )
    return Scene(time_step=0.1, substeps=4, bodies=tuple(bodies), **options)


TRUTH = {"mass": 2.0, "linear_drag_coefficient": 1.0, "r": 0.2, "mu_c": 0.3}


def pushed(scene, seed=3, trajectories=30, **options):
    options = {"intervals": 1, "substeps": 4} | options
    return simulated_history(scene, TRUTH, seed=seed, trajectories=trajectories, **options)


def quiet(function, *arguments, **options):
    """Few draws, on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return function(*arguments, **options)


def no_weights(*arguments, **options):
    """Adaptive importance sampling without success."""
    points, last = adaptive_importance(*arguments, **(options | {"most_batches": 2}))
    return points._replace(good=False), last


@pytest.fixture
def without_weights(monkeypatch) -> None:
    monkeypatch.setattr("pbrl_ppl.sampling.importance.adaptive_importance", no_weights)


@pytest.fixture(scope="module")
def model():
    scene = pucks()
    return physics_model(scene, pushed(scene))


@pytest.fixture(scope="module")
def mode(model):
    return find_mode(problem_in(model), seed=1)


@pytest.fixture(scope="module")
def fitted(model, mode):
    return fit(model, seed=1, start=mode, **QUICK)


# -- the draws -------------------------------------------------------------------------------------


def grid_moments(problem, mode) -> tuple[np.ndarray, np.ndarray, float]:
    """Return means and sds of a posterior of one parameter and one sigma, and its log-evidence.

    The density is summed over a grid of 8 Laplace standard deviations to each side.
    """
    prior, space = problem.layout.priors[0], Space.of(mode)
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
    cell = (first[1] - first[0]) * (second[1] - second[0])
    weight = np.exp(density - logsumexp(density))
    assert weight[[0, -1]].sum() + weight[:, [0, -1]].sum() < 1e-6  # nothing beyond the grid
    mean = np.einsum("ij,ijk->k", weight, q)
    spread = np.sqrt(np.einsum("ij,ijk->k", weight, (q - mean) ** 2))
    return mean, spread, float(logsumexp(density) + np.log(cell))


@pytest.fixture(scope="module")
def simple():
    """One parameter and one sigma: the mode, and the moments and log-evidence by a grid."""
    scene = pucks(known=FREE | {"mass": 2.0})
    problem = problem_in(physics_model(scene, pushed(scene), sigma="scalar"))
    mode = find_mode(problem, seed=1)
    return mode, *grid_moments(problem, mode)


def test_draws_have_the_moments_of_the_posterior(simple) -> None:
    """Drag and a scalar sigma against a grid, over 10 seeds.

    The sum of 10 squared standardised errors is chi-squared with 10 degrees of freedom: below 35.6
    but for 1e-4. The mean sd of 10 times about 500 draws has a standard error of 1 %. So has the
    log-evidence, whose mean is within 5 standard errors of ten: 1e-3 by Student's t.
    """
    mode, mean, sd, log_evidence = simple
    problem, errors, widths, evidences = mode.problem, [], [], []
    reference = Reference.about(Space.of(mode), mode, Space.of(mode))
    for seed in range(10):
        pool, _ = draw_proposals(reference, 750, [seed], print)
        chosen, k, size = resample(pool.log_weight, 500, np.random.default_rng(seed))
        assert k < MAX_PARETO_K
        phi, sigma = reference.space.split(pool.q[chosen])
        first = unconstrain(problem.layout.priors[0], phi[:, 0])[0]
        q = np.stack([first, np.log(sigma[:, 0])], axis=1)
        errors.append((q.mean(axis=0) - mean) / sd * np.sqrt(size))
        widths.append(q.std(axis=0) / sd)
        evidences.append(pool.log_z)
    assert (np.square(errors).sum(axis=0) < 35.6).all(), errors
    np.testing.assert_allclose(np.mean(widths, axis=0), 1.0, atol=0.05)
    error = np.std(evidences, ddof=1) / np.sqrt(10)
    assert error < 0.05
    assert abs(np.mean(evidences) - log_evidence) < 5 * error + 1e-3


def agree(weighted, particles) -> None:
    """Means of two fits within 4 Monte Carlo errors, sds within 4 of theirs."""
    sizes = [convergence(each)[1] for each in (weighted, particles)]
    flat = [scalars(each) for each in (weighted, particles)]
    for name in flat[0].data_vars:
        # logarithms where a parameter is positive: ``r`` and the noises have long tails
        a, b = (each[name].to_numpy().ravel() for each in flat)
        if (a > 0).all() and (b > 0).all():
            a, b = np.log(a), np.log(b)
        error = np.sqrt(sum(1.0 / each[name] for each in sizes))
        assert abs(a.mean() - b.mean()) < 4 * error * b.std(), (name, a.mean(), b.mean(), error)
        assert abs(np.log(a.std() / b.std())) < 4 * error, (name, a.std(), b.std())


def test_a_cart_s_posterior_is_that_of_particles() -> None:
    """Means of 12 parameters within 4 Monte Carlo errors, sds within 4 of theirs: false alarm 2e-3.

    Nothing touches the cart: the data do not inform ``r``, whose draws follow the prior.
    """
    known = {name: CART[name] for name in ("w_y", "mu_c")}
    scene = cart_scene(known=known).replace(substeps=4)
    history = simulated_history(scene, CART, seed=7, trajectories=4, intervals=10, substeps=4)
    model = physics_model(scene, history)
    start = find_mode(problem_in(model), seed=1)
    quick = QUICK | {"start": start, "chains": 2}
    weighted = quiet(fit, model, seed=1, **(quick | {"draws": 1000}))
    particles = quiet(fit, model, seed=2, method="smc", **(quick | {"draws": 400}))
    assert weighted.attrs["method"] == "importance"
    assert weighted.attrs[PARETO_K] < MAX_PARETO_K
    agree(weighted, particles)
    # of two estimates, whose errors are below 0.1
    assert abs(weighted.attrs["log_evidence"] - particles.attrs["log_evidence"]) < 0.5


# -- several parts, several modes ------------------------------------------------------------------


@pytest.mark.one_stack
def test_independent_parts_share_the_noise_alone() -> None:
    """Two pucks with drag and masses, as by particles: 10 numbers, false alarm 2e-3."""
    scene = pucks("ab")
    model = physics_model(scene, pushed(scene, trajectories=20))
    assert len(problem_in(model).physics.simulator.parts) == 2
    start = find_mode(problem_in(model), seed=1)
    weighted = quiet(fit, model, seed=1, start=start, **QUICK)
    assert weighted.attrs["method"] == "importance"
    assert weighted.attrs[PARETO_K] < MAX_PARETO_K
    assert weighted.attrs[SIZE] > 400
    agree(weighted, quiet(fit, model, seed=2, start=start, method="smc", **QUICK))
    # given the noise, which the data inform well, they are independent
    a, b = (draws(weighted)["mass"][:, i] for i in (0, 1))
    assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(weighted.attrs[SIZE])


def squared(state, command, parameters, wrench):
    """A force whose sign its parameter does not have."""
    wrench[0] += parameters[0] ** 2


BREEZE = Effect(
    "breeze", (EffectParameter("root", "N^0.5", Prior("normal", mu=0.3, sigma=1.0)),), "a breeze",
    "ours", force=squared,
)  # fmt: skip


@pytest.fixture(scope="module")
def twofold():
    """A model with modes at a root of the force and at its negative, and the mode with the other.

    The likelihood is even, so that the shares are those of the prior.
    """
    body = Body("a", Shape.circle(0.1), known=FREE | {"mass": 2.0})
    scene = Scene(time_step=0.1, substeps=4, bodies=(body,))
    history = simulated_history(
        scene, {"breeze_root": 1.0}, seed=3, trajectories=20, intervals=1, effects=[BREEZE],
        substeps=4,
    )  # fmt: skip
    model = physics_model(scene, history, [BREEZE])
    one, other = (find_mode(problem_in(model), initial=np.array([x])) for x in (1.0, -1.0))
    return model, replace(one, others=(other,))


def shares(root, size, at=0.3) -> tuple[float, float, float]:
    """Return the share of draws above zero, what it is to be, and its standard error."""
    log_odds = 2.0 * at * np.abs(root)  # of the prior at x over that at -x, whose sd is one
    expected = float((1.0 / (1.0 + np.exp(-log_odds))).mean())
    return float((root > 0).mean()), expected, float(np.sqrt(expected * (1 - expected) / size))


def test_two_modes_have_their_shares(twofold) -> None:
    """Over four seeds, each within 4 standard errors of the prior's share: false alarm 3e-4."""
    model, mode = twofold
    for seed in range(4):
        idata = quiet(fit, model, seed=seed, start=mode, **QUICK)
        assert idata.attrs["method"] == "importance"
        assert idata.attrs[PARETO_K] < MAX_PARETO_K
        assert idata.attrs[SIZE] > 200
        root = draws(idata)["breeze_root"].ravel()
        assert (np.abs(root) > 0.3).all()  # nothing is between them
        found, expected, error = shares(root, idata.attrs[SIZE])
        assert abs(found - expected) < 4 * error, (seed, found, expected, error)
        # each mode is the other's mirror image
        high, low = root[root > 0], -root[root < 0]
        worth = idata.attrs[SIZE] / root.size * high.size * low.size / root.size
        distance = ks_2samp(high, low).statistic
        assert kstwobign.sf(distance * np.sqrt(worth)) > 1e-5


@pytest.mark.usefixtures("without_weights")
def test_particles_after_weights_see_both_modes(twofold) -> None:
    """Within 4 standard errors of the prior's share: false alarm 6e-5; and they are told of."""
    model, mode = twofold
    idata = quiet(fit, model, seed=1, start=mode, **QUICK)
    assert idata.attrs["method"] == "importance"
    assert idata.attrs["proposals"].startswith("none: smc, for weights do not suffice")
    assert not {SIZE, PARETO_K} & set(idata.attrs)
    assert idata.attrs["max_rhat"] < 1.05
    root = draws(idata)["breeze_root"].ravel()
    found, expected, error = shares(root, convergence(idata)[1]["breeze_root[a]"])
    assert abs(found - expected) < 4 * error, (found, expected, error)
    whole = quiet(fit, model, seed=2, resume=idata, **QUICK)
    assert group(whole, "posterior").sizes["draw"] == 500


@pytest.mark.usefixtures("without_weights")
def test_particles_after_weights_along_trajectories(monkeypatch) -> None:
    """They have the moments of weighted draws, with two noises."""
    scene = pucks()
    model = physics_model(
        scene, pushed(scene, trajectories=3, intervals=8), substeps=4, likelihood="trajectories"
    )
    mode = trajectory_mode(problem_in(model), problem_in(model).layout.to_vector(TRUTH))
    particles = quiet(fit, model, seed=1, start=mode, **QUICK)
    assert "smc" in particles.attrs["proposals"]
    monkeypatch.setattr("pbrl_ppl.sampling.importance.adaptive_importance", adaptive_importance)
    weighted = quiet(fit, model, seed=2, start=mode, **QUICK)
    assert weighted.attrs[PARETO_K] < MAX_PARETO_K
    agree(weighted, particles)


def test_proposals_without_density_are_an_error(model, mode, monkeypatch) -> None:
    def nothing(*arguments, **options):
        points, last = no_weights(*arguments, **options)
        return points._replace(log_weight=np.full(len(points.q), -np.inf)), last

    monkeypatch.setattr("pbrl_ppl.sampling.importance.adaptive_importance", nothing)
    with pytest.raises(FitError, match=r"the model gives none of .* start from another mode"):
        fit(model, seed=1, start=mode, **QUICK)


def test_more_draws_keep_both_modes(twofold) -> None:
    """Two fits resumed, each within 4 standard errors of the prior's share: false alarm 1e-4."""
    model, mode = twofold
    for seed in range(2):
        first = quiet(fit, model, seed=seed, start=mode, **QUICK)
        whole = quiet(fit, model, seed=seed, resume=first, **QUICK)
        new = group(whole, "posterior")["breeze_root"].values[:, 250:].ravel()
        assert (np.abs(new) > 0.3).all()
        found, expected, error = shares(new, whole.attrs[SIZE] - first.attrs[SIZE])
        assert abs(found - expected) < 4 * error, (seed, found, expected, error)


@pytest.mark.parametrize("method", ["importance", "smc"])
def test_an_angle_that_the_data_hardly_inform(method) -> None:
    """Its Gaussian reaches where there is no density, which makes no NaN and no warning."""
    known = {name: CART[name] for name in CART if name not in ("w_theta", "mu_x", "mu_y")}
    scene = cart_scene(known=known).replace(substeps=4)
    history = simulated_history(
        scene, CART, seed=7, trajectories=2, intervals=3, substeps=4, noise=0.3
    )
    idata = quiet(fit, physics_model(scene, history), seed=1, method=method, **QUICK)
    angle = draws(idata)["w_theta"].ravel()
    assert np.isfinite(angle).all()
    assert np.ptp(angle) > 1.0


def test_a_wheel_half_a_turn_on_is_another_mode() -> None:
    """Of a wheel of known frictions, the angle's prior alone tells half a turn: false alarm 1e-4.

    Half a turn is where a circle is cut.
    """
    known = {name: CART[name] for name in CART if name != "w_theta"}
    scene = cart_scene(known=known, prior={"w_theta": {"mu": 0.6, "kappa": 0.7}})
    scene = scene.replace(substeps=4)
    history = simulated_history(scene, CART, seed=7, trajectories=3, intervals=8, substeps=4)
    model = physics_model(scene, history)
    mode = find_mode(problem_in(model), seed=1)
    (other,) = mode.others
    assert abs(np.cos(mode.phi[0] - other.phi[0]) + 1) < 1e-3
    idata = quiet(fit, model, seed=1, start=mode, **QUICK)
    angle = draws(idata)["w_theta"].ravel()
    # of half turns, the one with the higher prior
    log_odds = 2 * 0.7 * np.abs(np.cos(angle - 0.6))
    expected = (1.0 / (1.0 + np.exp(-log_odds))).mean()
    found = (np.cos(angle - 0.6) > 0).mean()
    error = np.sqrt(expected * (1 - expected) / idata.attrs[SIZE])
    assert abs(found - expected) < 4 * error, (found, expected, error)


# -- parameters that the data do not inform --------------------------------------------------------


def test_an_uninformed_parameter_s_draws_follow_the_prior() -> None:
    """Kolmogorov's statistic of independent draws exceeds 1.95 / sqrt(n) in 0.1 % of cases.

    Of the resampled draws as many count as they are worth.
    """
    scene = pucks(known={"mu_c": 0.3, "mass": 2.0}, walls=(Wall((50.0, -1.0), (50.0, 1.0)),))
    model = physics_model(scene, pushed(scene))
    start = find_mode(problem_in(model), seed=1)
    labels = list(problem_in(model).layout.labels)
    place = labels.index("r[a]")
    assert list(np.flatnonzero(Space.of(start).uninformed)) == [place]
    with pytest.warns(UserWarning, match=r"nothing about r\[a\]"):
        idata = fit(model, seed=5, start=start, **QUICK)
    assert idata.attrs["method"] == "importance"
    prior = problem_in(model).layout.priors[place]
    assert prior.family == "log_normal"
    found = kstest(np.log(draws(idata)["r"].ravel()), norm(prior.mu, prior.sigma).cdf).statistic
    assert found * np.sqrt(idata.attrs[SIZE]) < 1.95


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


def test_a_resumed_fit_may_go_on_by_particles(model, fitted) -> None:
    options = QUICK | {"draws": 100, "method": "smc"}
    whole = quiet(fit, model, seed=1, resume=fitted, **options)
    assert whole.attrs["method"] == "smc"
    stats = group(whole, "sample_stats")
    assert stats.sizes["draw"] == group(whole, "posterior").sizes["draw"] == 350
    assert np.isfinite(stats["log_weight"][:, :250]).all()
    assert np.isnan(stats["log_weight"][:, 250:]).all()
    assert np.isfinite(stats["accept"][:, 250:]).all()
    assert fitted.attrs[SIZE] < whole.attrs[SIZE] < fitted.attrs[SIZE] + 4 * 100 * 2


def test_particles_in_one_process_or_two(model, mode) -> None:
    """The same seed gives the same draws, and other ones go on from these."""
    options = QUICK | {"draws": 100, "chains": 2, "method": "smc"}
    first = quiet(fit, model, seed=1, start=mode, **options)
    again = quiet(fit, model, seed=1, start=mode, **(options | {"cores": 2}))
    np.testing.assert_array_equal(draws(again)["mass"], draws(first)["mass"])
    whole = quiet(fit, model, seed=1, resume=first, **options)
    assert "accept" in group(whole, "sample_stats")
    assert not {SIZE, PARETO_K, "proposals"} & set(whole.attrs)
    assert len(np.unique(draws(whole)["mass"])) > 300


def test_one_run_of_particles(model, mode) -> None:
    idata = quiet(fit, model, seed=1, start=mode, **(QUICK | {"chains": 1, "method": "smc"}))
    assert group(idata, "posterior").sizes["chain"] == 1
    assert np.isfinite(idata.attrs["log_evidence"])


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
    """Proposals that their own density excludes, and proposals that the engine excludes."""
    _, k, size = resample(log_weight, 50, np.random.default_rng(0))
    assert (k, size) == (np.inf, 0.0)


# -- diagnostics in the attributes -----------------------------------------------------------------


def test_diagnostics(model, mode, fitted, tmp_path) -> None:
    attrs = fitted.attrs
    assert attrs["method"] == "importance"
    assert attrs[PARETO_K] < MAX_PARETO_K
    assert attrs["proposals"] == "Gaussians at the modes"
    assert np.isfinite(attrs["log_evidence"])
    assert attrs["min_ess"] <= attrs[SIZE] <= 1000
    assert "log_likelihood" not in attrs
    problem = problem_in(model)
    phi = problem.layout.to_vectors(draws(fitted), 1000)
    theirs = problem.log_density(problem.residual(phi), draws(fitted)["sigma"], phi)
    ours = group(fitted, "log_likelihood")["next_state"].values.reshape(1000, -1)
    np.testing.assert_allclose(ours, theirs)
    save_posterior(fitted, tmp_path / "puck.nc")
    loaded = load_posterior(tmp_path / "puck.nc")
    assert dict(loaded.attrs) == dict(attrs)
    record = PosteriorRecord.of(loaded)
    assert (record.pareto_k, record.importance_ess) == (attrs[PARETO_K], attrs[SIZE])
    assert record.proposals == attrs["proposals"]
    assert record.log_evidence == attrs["log_evidence"]


def test_no_parameter_is_worth_more_than_the_weights(fitted) -> None:
    """Resampled draws look independent to ArviZ."""
    capped = from_groups(groups(fitted), {**fitted.attrs, SIZE: 17.0})
    assert set(convergence(capped)[1].values()) == {17.0}


def test_weights_with_a_heavy_tail_are_warned_of(model, mode, monkeypatch) -> None:
    monkeypatch.setattr("pbrl_ppl.posterior.completion.MAX_PARETO_K", -10.0)
    says = r"Pareto k of the proposals' weights is .* \(want <= -10.0\): .*'smc'"
    with pytest.warns(ConvergenceWarning, match=says):
        idata = fit(model, seed=1, start=mode, **QUICK)
    assert any("Pareto k" in each for each in json.loads(idata.attrs["warnings"]))


def test_weights_of_which_one_is_all_have_an_infinite_tail() -> None:
    """The fit of their tail divides by zero; there is no warning, and no NaN."""
    weights, k = smoothed(np.random.default_rng(1).normal(-4e4, 8e3, 84))
    assert k == np.inf
    assert np.isfinite(weights).all() and weights.max() == pytest.approx(1.0)


def test_too_few_draws(model, mode) -> None:
    cure = r"the draws are too few: .*effective.*; raise draws, or resume this posterior"
    with pytest.warns(ConvergenceWarning, match=cure) as caught:
        few = fit(model, seed=1, start=mode, **(QUICK | {"draws": 40}))
    assert few.attrs["max_rhat"] > 1.01  # as that of a few independent draws is
    assert "R-hat" not in "".join(str(each.message) for each in caught)


def test_updates_keep_count_of_what_draws_are_worth(model, mode) -> None:
    """Reweighted draws are worth less with each update; those of a new fit start again."""
    last = fit(model, seed=1, start=mode, **(QUICK | {"draws": 500}))
    since = pushed(pucks(), seed=8, trajectories=4)
    for i in (0, 2):
        new = quiet(update, last, since.select([i]), seed=2)
        entry = json.loads(new.attrs["updates"])[-1]
        assert entry["did"] == "reweighted"
        assert new.attrs[SIZE] == pytest.approx(entry["share"] * last.attrs[SIZE])
        assert new.attrs["min_ess"] <= new.attrs[SIZE]
        last = new
    rest = since.select([1, 3])
    with pytest.MonkeyPatch.context() as patch, pytest.warns(RefitWarning):
        patch.setattr("pbrl_ppl.posterior.MIN_ESS", 1001)
        new = quiet(update, last, rest, seed=2, progress=False)
    assert json.loads(new.attrs["updates"])[-1]["did"] == "refitted"
    assert 400 < new.attrs[SIZE] <= 1000  # a fit's own draws
