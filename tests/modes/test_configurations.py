"""Which bodies a joint joins: configurations, their evidence, and draws mixed by it."""

import json
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from scipy import stats
from scipy.special import logsumexp

from pbrl_ppl.errors import FitError, PosteriorError, RefitWarning, UninformedWarning
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import Mode, find_mode, weigh
from pbrl_ppl.modes.configurations import (
    Configuration,
    Weighed,
    configurations,
    evidence_warning,
    number,
    stored,
)
from pbrl_ppl.modes.importance import Marginal, importance, laplace
from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import (
    convergence,
    draws,
    from_groups,
    group,
    identify,
    joint_probabilities,
    load_posterior,
    save_posterior,
    updated_scene,
)
from pbrl_ppl.sampling import fit, mixture, updating
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE, WRENCH
from tests.helpers.histories import simulated_history
from tests.helpers.joints import HINGED, reference_anchors, run_of, scene
from tests.helpers.worlds import G, body

pytestmark = [pytest.mark.one_stack, pytest.mark.first(2)]

# Python 3.12 and later warn of a fork in a process with threads; PyMC's chains start by fork
FORK = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
# so few draws do not converge, and are not meant to
SHORT = pytest.mark.filterwarnings("ignore:the chains have not converged")
QUICK = {"draws": 100, "tune": 100, "chains": 2, "cores": 1, "progress": False}
#: Boxes a and b end to end, so that they touch whether or not a hinge joins them.
LINED = ((0.0, 0.0, 0.0), (0.76, 0.0, 0.0), (2.5, -0.2, -0.3), (0.3, 2.0, 0.0))
#: Where each kind of joint holds what, by the bodies that it joins.
ANCHORS = {
    ("hinge", "a", "b"): ((0.38, 0.05), (-0.38, 0.05)),
    ("hinge", "c", WORLD): ((0.0, 0.0), (2.5, -0.2)),
    ("distance", "a", "d"): ((0.3, 0.1), (-0.2, 0.05)),
    ("distance", "d", WORLD): ((0.1, 0.2), (1.5, 1.0)),
}
HELD = ANCHORS["hinge", "a", "b"]
NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)


def recorded(kind: str, *joined: str) -> tuple[Scene, History]:
    """A scene that does not say what is joined, and ten transitions of what is."""
    joints = (Joint(kind, joined, *ANCHORS[kind, *joined]),) if joined else ()
    truth = scene(*joints, poses=LINED)
    history = simulated_history(
        truth, {}, seed=2, trajectories=5, intervals=2, noise=NOISE, poses=LINED, substeps=20
    )  # fmt: skip
    return scene(Joint(kind, known=False), poses=LINED).replace(substeps=5), history


def transitions(truth: Scene, start, actions, noise) -> History:
    """Transitions (n, body, 6) that begin exactly so, under wrenches (n, 1, body, 3)."""
    end = Simulator(Physics(truth))(np.zeros(0), start, actions)[:, 0]
    end += np.random.default_rng(6).standard_normal(end.shape) * noise
    cells = np.concatenate([start, actions[:, 0]], -1), np.pad(end, ((0, 0),) * 2 + ((0, 3),))
    rows = [
        {"trajectory": t, "time": truth.time_step * step, "body": one.name}
        | dict(zip((*STATE, *WRENCH), cells[step][t, i], strict=True))
        for t in range(len(start))
        for step in range(2)
        for i, one in enumerate(truth.bodies)
    ]
    frame = pd.DataFrame(rows)
    frame.loc[frame["time"] > 0, list(WRENCH)] = np.nan
    return History.from_dataframe(frame, truth)


def best_of(found) -> Configuration:
    return max(found, key=lambda each: each.probability).configuration


# -- configurations --------------------------------------------------------------------------------


def test_every_choice_has_its_prior_weight() -> None:
    """Four bodies and the world: ten pairs, each in both orders, and no joint in five ways."""
    two = scene(Joint("hinge", known=False, name="pin"), Joint("distance", known=False))
    for joints, count in ((1, 11), (2, 121)):
        every = configurations(two.replace(joints=two.joints[:joints]))
        assert len({each.pairs for each in every}) == len(every) == count
        assert np.exp([each.log_prior for each in every]).sum() == pytest.approx(1.0)
        assert every[0].empty
        assert np.exp(every[0].log_prior) == pytest.approx(0.2**joints)
    chosen = next(e for e in every if dict(e.pairs) == {"pin": ("a", "b"), "joint2": ("a", "c")})
    names = dict(chosen.pairs)
    left = chosen.scene(two)
    assert [(joint.name, joint.bodies) for joint in left.joints] == list(names.items())
    assert not every[0].scene(two).joints


def test_joints_of_one_kind_are_exchangeable() -> None:
    """Which of two hinges is called the first is no question that data could answer."""
    every = configurations(scene(*(Joint("hinge", known=False),) * 2))
    assert len(every) == 66
    assert np.exp([each.log_prior for each in every]).sum() == pytest.approx(1.0)
    weight = {each.pairs: np.exp(each.log_prior) for each in every}
    ab, cd = ("a", "b"), ("c", "d")
    assert weight[("joint1", ab), ("joint2", cd)] == pytest.approx(2 * 0.08**2)
    assert weight[("joint1", ab), ("joint2", ab)] == pytest.approx(0.08**2)
    assert (("joint1", cd), ("joint2", ab)) not in weight


def test_they_are_counted_without_being_made() -> None:
    """Eleven bodies and the world: 66 pairs and none, two of them at a time, 68 over 2."""
    room = tuple(Body(f"b{i}", Shape.circle(0.1), pose=(i, 0.0, 0.0)) for i in range(11))
    for kinds, count in (
        (("hinge",), 67),
        (("hinge", "hinge"), 2278),
        (("hinge", "distance"), 67**2),
    ):
        joints = tuple(Joint(kind, known=False) for kind in kinds)
        assert number(Scene(time_step=0.1, bodies=room, joints=joints)) == count
    two = scene(*(Joint("hinge", known=False),) * 2)
    assert number(two) == len(configurations(two))


def test_named_joints_keep_their_names_without_the_free_ones() -> None:
    """joint2 stays joint2, or its anchors' labels would change with the configuration."""
    held = Joint("hinge", ("a", "b"), known=False)
    left = configurations(scene(Joint("hinge", known=False), held))[0].scene(
        scene(Joint("hinge", known=False), held)
    )
    assert left.joint_names == ("joint2",)


# -- evidence --------------------------------------------------------------------------------------


def of_wheel(intervals: int) -> Problem:
    """A cart of which the wheel's angle and side friction are unknown, with one sigma."""
    wheel = {"mass": 8.0, "r": 0.2, "mu_c": 0.3, "w_x": -0.25, "w_y": 0.05, "mu_x": 0.04}
    known = {**wheel, "w_theta": 0.3, "mu_y": 0.4}
    cart = body("cart", Shape.box(0.9, 0.55), wheel=True, **known)
    truth = Scene(time_step=0.1, normal_gravity=G, bodies=(cart,), substeps=10)
    history = simulated_history(truth, {}, seed=3, trajectories=1, intervals=intervals, noise=0.05)
    free = truth.replace(bodies=(replace(cart, known=wheel),))
    return problem_in(physics_model(free, history, sigma="scalar"))


@pytest.mark.slow
def test_evidence_is_that_of_a_fine_grid() -> None:
    """The prior's density there is PyMC's, and no constant may be missing from ours."""
    problem = of_wheel(6)
    mode = find_mode(problem, seed=1)
    theta = mode.phi[0] + np.linspace(-np.pi / 2, np.pi / 2, 91)  # half a turn is the same wheel
    mu_y = np.linspace(1e-3, 1 - 1e-3, 81)
    log_sigma = np.log(mode.sigma[0]) + np.linspace(-1.0, 1.5, 41)
    grid = np.stack(np.meshgrid(theta, mu_y, indexing="ij"), axis=-1).reshape(-1, 2)
    residual = problem.residual(grid)
    prior = sum(
        pm.logp(law, values).eval()
        for law, values in (
            (pm.Uniform.dist(-np.pi, np.pi), grid[:, 0]),
            (pm.TruncatedNormal.dist(mu=0.5, sigma=1.0, lower=0.0, upper=1.0), grid[:, 1]),
        )
    )
    model = physics_model(problem.scene, problem.data.history, sigma="scalar")
    law = model["sigma"]
    sigma = np.exp(log_sigma)
    of_sigma = pm.logp(law, sigma).eval() + log_sigma  # d sigma = sigma d log sigma
    total = [
        prior + problem.log_density(residual, np.full((len(grid), 6), s)).sum(axis=1) + own
        for s, own in zip(sigma, of_sigma, strict=True)
    ]
    cell = np.log((theta[1] - theta[0]) * (mu_y[1] - mu_y[0]) * (log_sigma[1] - log_sigma[0]))
    expected = logsumexp(total) + cell
    found = importance(mode, np.random.default_rng(1))
    assert found.ess > 200
    # four standard errors, and the grid's own error
    assert found.log_z == pytest.approx(expected, abs=4 * found.error + 0.02)
    # these data are few; it only has to say what is hopeless, at 25 units
    assert laplace(mode).log_z == pytest.approx(expected, abs=3.0)


def rods() -> Scene:
    """Two boxes of which all but a rod is known."""
    shapes = (body("a", Shape.box(0.8, 0.5)), body("b", Shape.box(0.6, 0.6), mass=2.0))
    places = ((0.0, 0.0, 0.0), (1.3, 0.2, 0.3))
    bodies = tuple(replace(each, pose=pose) for each, pose in zip(shapes, places, strict=True))
    return Scene(time_step=0.1, bodies=bodies, joints=(Joint("distance", known=False),), substeps=6)


@pytest.mark.slow
@pytest.mark.parametrize("joined", [True, False])
def test_probabilities_are_those_of_weighted_prior_draws(joined) -> None:
    """Data so noisy that draws from the whole prior, indices and all, hit the posterior."""
    free = rods()
    rod = (Joint("distance", ("a", "b"), (0.2, 0.1), (-0.1, 0.1)),) if joined else ()
    start = np.zeros((3, 2, 6))
    start[..., :3] = [each.pose for each in free.bodies]
    actions = np.random.default_rng(4).normal(0.0, (8.0, 8.0, 1.0), (3, 1, 2, 3))
    history = transitions(free.replace(joints=rod), start, actions, np.full(6, 0.5))
    problem = problem_in(physics_model(free, history, sigma="scalar"))
    rng = np.random.default_rng(1)
    n = 80_000
    index = rng.integers(0, 3, (n, 2))
    layout = problem.layout
    phi = np.empty((n, layout.size))
    phi[:, :2] = index
    for block in layout.blocks[2:]:
        own = index[:, 0 if block.name[0] == "a" else 1]
        for i, prior in enumerate(block.conditional[0]):
            here = own == i
            phi[here, layout.index(block.name, "joint1")] = prior.sample(rng, int(here.sum()))
    model = physics_model(free, history, sigma="scalar")
    sigma = pm.draw(model["sigma"], n, random_seed=1)[:, None] * np.ones(6)
    log_weight = problem.log_density(problem.residual(phi), sigma).sum(axis=1)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    names = (*"ab", WORLD)
    found = {each.configuration.pairs[0][1]: each.probability for each in weigh(problem, seed=1)}
    low = np.minimum(*index.T)
    high = np.maximum(*index.T)
    assert 1.0 / (weight**2).sum() > 400
    for pair, probability in found.items():
        here = low == high
        if pair is not None:
            here = (low == names.index(pair[0])) & (high == names.index(pair[1]))
        share = weight[here].sum()
        error = np.sqrt((weight**2 * (here - share) ** 2).sum())
        assert probability == pytest.approx(share, abs=4 * error + 0.02), pair


# -- finding ---------------------------------------------------------------------------------------


#: Fixtures of configurations that other tests take too.
SHARED = {("hinge", "a", "b"): "found", ("hinge",): "found_loose"}


@pytest.mark.slow
@pytest.mark.parametrize("joined", [*ANCHORS, ("hinge",), ("distance",)], ids="-".join)
def test_what_is_joined_is_found(joined, request) -> None:
    """Ten transitions with the noise of motion capture."""
    if joined in SHARED:
        found = request.getfixturevalue(SHARED[joined])
    else:
        found = weigh(problem_in(physics_model(*recorded(*joined))), seed=1)
    best = max(found, key=lambda each: each.probability)
    assert best.configuration.pairs == (("joint1", joined[1:] or None),)
    assert best.probability > 0.999
    assert sum(each.probability for each in found) == pytest.approx(1.0)
    if joined[1:]:
        anchors = best.mode.phi
        expected = np.ravel(ANCHORS[joined])
        if joined[0] == "hinge":
            np.testing.assert_allclose(anchors, expected, atol=5e-3)


@pytest.mark.slow
def test_two_joints_are_found() -> None:
    """A hinge and a rod at once, each of unknown bodies: sixteen configurations."""
    rod = Joint("distance", ("b", WORLD), (0.1, 0.2), (1.5, 1.0))
    given = Joint("hinge", ("a", "b"), *ANCHORS["hinge", "a", "b"]), rod
    truth = scene(*given, poses=LINED).subset("ab")
    history = simulated_history(
        truth, {}, seed=2, trajectories=5, intervals=2, noise=NOISE, poses=LINED[:2], substeps=20
    )
    unknown = Joint("hinge", known=False, name="pin"), Joint("distance", known=False, name="rod")
    free = scene(*unknown, poses=LINED).subset("ab").replace(substeps=5)
    problem = problem_in(physics_model(free, history))
    best = max(weigh(problem, seed=1), key=lambda each: each.probability)
    assert dict(best.configuration.pairs) == {"pin": ("a", "b"), "rod": ("b", WORLD)}
    assert best.probability > 0.999


@pytest.mark.long
def test_bodies_that_lie_in_each_other_are_no_proof_of_a_joint() -> None:
    """Shapes are approximate: what says which bodies are joined is how they move.

    Boxes a and b begin deep inside each other. A scene that joins others by name would be refused.
    """
    anchors = np.reshape(reference_anchors(0, 1), (2, 2))
    for pair in (("a", "b"), ("b", "d")):
        held = [tuple(each) for each in anchors] if pair == ("a", "b") else [(0.1, 0.2), (0.0, 0.1)]
        kind = "hinge" if pair == ("a", "b") else "distance"
        truth = scene(Joint(kind, pair, *held), poses=HINGED)
        start = np.zeros((20, 4, 6))
        start[..., :3] = HINGED
        rng = np.random.default_rng(5)
        actions = rng.normal(0.0, (8.0, 8.0, 1.0), (20, 1, 4, 3))
        history = transitions(truth, start, actions, np.array(NOISE))
        free = scene(Joint(kind, known=False), poses=HINGED)
        found = weigh(problem_in(physics_model(free, history)), seed=1)
        assert best_of(found).pairs[0][1] == pair


# -- mixing ----------------------------------------------------------------------------------------

WEIGHTS = {("a", "b"): 0.6, ("c", WORLD): 0.2501, None: 0.1495, ("a", "c"): 0.0004}


@pytest.fixture(scope="module")
def model() -> pm.Model:
    """Boxes a and b with a hinge, of which the scene knows nothing."""
    return physics_model(*recorded("hinge", "a", "b"))


@pytest.fixture(scope="module")
def found(model) -> list[Weighed]:
    """Its configurations, weighed."""
    return weigh(problem_in(model), seed=1)


@pytest.fixture(scope="module")
def loose() -> pm.Model:
    """Boxes without a joint, of which the scene says that there may be a hinge."""
    return physics_model(*recorded("hinge"))


@pytest.fixture(scope="module")
def found_loose(loose) -> list[Weighed]:
    """Its configurations, weighed."""
    return weigh(problem_in(loose), seed=1)


@pytest.fixture
def known_weights(found, monkeypatch) -> None:
    """A fit of that model with that seed does not weigh them again."""
    monkeypatch.setattr("pbrl_ppl.sampling.fitting.weigh", lambda problem, **options: found)


@pytest.fixture(scope="module")
def rod() -> pm.Model:
    """A rod of which the scene knows nothing."""
    return physics_model(*recorded("distance", "a", "d"))


def weighed(model: pm.Model) -> list[Weighed]:
    """Configurations of known weights."""
    found = []
    for each in configurations(problem_in(model).scene):
        own = each.problem(problem_in(model))
        phi = np.array([prior.centre for prior in own.layout.priors])
        nothing = np.zeros((0, 0))
        mode = Mode(own, phi, np.full(6, 0.1), nothing, nothing, 0.0)
        probability = WEIGHTS.get(each.pairs[0][1], 0.0)
        found.append(Weighed(each, mode, Marginal(0.0), probability))
    return found


def numbered(mode: Mode, chains: int = 2, n: int = 5000):
    """A trace whose noise says where each draw was: its chain and number."""
    place = np.arange(chains)[:, None] * n + np.arange(n)
    named = mode.problem.named(mode.phi, mode.sigma)
    values = {k: np.broadcast_to(v, (chains, n, *v.shape)).copy() for k, v in named.items()}
    values["sigma"] = np.repeat(place[..., None], 6, axis=-1).astype(float)
    posterior = mixture.posterior_dataset(mode.problem, values)
    of = posterior[["chain", "draw"]]
    stats_of = of.assign(lp=(("chain", "draw"), place * 1.0), odd=("steps", np.zeros(3)))
    data = {"posterior": posterior, "sample_stats": stats_of}
    return from_groups(data | {"observed_data": stats_of, "constant_data": stats_of}, {})


def mixed(rod: pm.Model, seed: int = 1):
    found = weighed(rod)
    return mixture.mix(run_of(problem_in(rod), 5000, seed), found, numbered)


def test_draws_are_shared_out_by_weight(rod) -> None:
    named = draws(mixed(rod))
    pairs = np.column_stack([named["i_a"][:, 0], named["i_b"][:, 0]])
    assert ((pairs == (0, 1)).all(axis=1)).sum() == 6000 + 2  # the negligible one's share too
    assert ((pairs == (2, 4)).all(axis=1)).sum() == 2502
    assert (pairs[:, 0] == pairs[:, 1]).sum() == 1496
    assert (pairs[:, 0] <= pairs[:, 1]).all()


def test_a_draw_stays_where_it_was_in_its_chain(rod) -> None:
    """Or R-hat and effective sample sizes would be of another order of draws."""
    trace = mixed(rod)
    sigma = group(trace, "posterior")["sigma"].to_numpy()
    expected = np.arange(2)[:, None] * 5000 + np.arange(5000)
    np.testing.assert_array_equal(sigma, np.repeat(expected[..., None], 6, axis=-1))
    np.testing.assert_array_equal(group(trace, "sample_stats")["lp"], expected)
    assert "odd" not in group(trace, "sample_stats")
    # each chain and each half has its share: one false alarm in a million
    first = group(trace, "posterior")["i_a"].to_numpy()[..., 0] == 0
    shares = first.reshape(4, 2500).mean(axis=1)
    assert np.ptp(shares) < 5 * np.sqrt(2 * 0.65 * 0.35 / 2500)


def test_no_joint_is_any_equal_pair_with_anchors_from_the_prior(rod) -> None:
    """One false alarm in 10 000 for each of nine tests."""
    named = draws(mixed(rod))
    none = named["i_a"][:, 0] == named["i_b"][:, 0]
    held = named["i_a"][none, 0]
    assert stats.chisquare(np.bincount(held, minlength=5)).pvalue > 1e-4
    for block in problem_in(rod).layout.blocks[2:]:
        x = named[block.name][none, 0]
        for i in (0, 4):
            prior = block.conditional[0][i]
            own = x[held == i]
            ends = (np.array(prior.support) - prior.mu) / prior.sigma
            law = stats.truncnorm(*ends, prior.mu, prior.sigma)
            assert stats.kstest(own, law.cdf).pvalue > 1e-4
    # the others' are their configuration's
    assert (named["a_x"][~none] == named["a_x"][~none][0]).all()


def test_probabilities_are_finer_than_the_draws(rod) -> None:
    """Where nothing is drawn of a pair, its weight is there all the same."""
    held = {"configurations": json.dumps(mixed(rod).attrs["configurations"])}
    table = joint_probabilities(SimpleNamespace(attrs=held))
    expected = {"a-b": 0.6, "c-world": 0.2501, "none": 0.1495, "a-c": 0.0004}
    assert list(table) == ["joint1"]
    assert {k: v for k, v in table["joint1"].items() if v} == pytest.approx(expected)
    assert list(table["joint1"])[:4] == list(expected)  # the most probable first
    assert len(table["joint1"]) == 11


def test_an_interrupt_with_others_to_come_ends_the_fit(rod) -> None:
    """PyMC ends quietly with the draws so far; what has none cannot be mixed in."""

    def interrupted(mode):
        return numbered(mode, n=100)

    with pytest.raises(KeyboardInterrupt):
        mixture.mix(run_of(problem_in(rod), 5000), weighed(rod), interrupted)


@pytest.mark.parametrize(
    ("error", "ess", "uncertain"), [(0.2, 500.0, True), (0.01, 900.0, False), (0.01, 9.0, True)]
)
def test_uncertain_evidence_is_said(rod, error, ess, uncertain) -> None:
    """A standard error of 0.2 moves a probability of 0.6 by a tenth; one of 0.01 by nothing."""
    found = [replace(each, evidence=Marginal(0.0, error, ess)) for each in weighed(rod)]
    said = evidence_warning(stored(found))
    assert (said is not None) == uncertain
    if uncertain:
        assert "the probability 0.6 of joint1: a-b may be off by" in said
    assert evidence_warning(()) is None


# -- fitting ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(model):
    """From the weighing on; it is not given what was found before."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the chains have not converged")
        warnings.filterwarnings("ignore", ".*fork.*", DeprecationWarning)
        return fit(model, seed=1, **QUICK)


def test_fit_finds_the_hinge(fitted) -> None:
    posterior = group(fitted, "posterior")
    assert posterior["i_a"].dims == posterior["i_b"].dims == ("chain", "draw", "free_joint")
    assert posterior["i_a"].dtype.kind == "i"
    assert (posterior["i_a"] == 0).all()
    assert (posterior["i_b"] == 1).all()
    assert joint_probabilities(fitted)["joint1"]["a-b"] > 0.999
    for name, value in zip(("a_x", "a_y", "b_x", "b_y"), np.ravel(HELD), strict=True):
        assert abs(float(posterior[name].mean()) - value) < 5e-3
        assert 1e-6 < float(posterior[name].std()) < 5e-3
    assert "i_a" in {str(each) for each in posterior.data_vars}
    r_hat, ess = convergence(fitted)
    assert r_hat["i_a[joint1]"] == 1.0  # the same in all draws: certain, not broken
    assert ess["i_b[joint1]"] == 200
    assert np.isfinite(list(r_hat.values())).all()


def test_an_anchor_s_bounds_are_its_body_s(model) -> None:
    """Pressed against a bound is what lies on the edge of the body that holds it."""
    layout = problem_in(model).layout
    phi = np.zeros((2, layout.size))
    phi[:, layout.index("i_b", "joint1")] = 1, 4  # b, which is 0.5 m wide, and the world
    lower, upper = (each[:, layout.index("b_y", "joint1")] for each in layout.supports(phi))
    assert (lower[0], upper[0]) == (-0.25, 0.25)
    assert (lower[1], upper[1]) == problem_in(model).scene.extent[2:]


def test_the_record_is_of_the_whole_model(model, fitted) -> None:
    """Likelihoods and predictions come from the problem that takes the indices."""
    problem = problem_in(model)
    named = draws(fitted)
    phi = problem.layout.to_vectors({k: v.astype(float) for k, v in named.items()}, 200)
    expected = problem.log_density(problem.residual(phi[:5]), named["sigma"][:5])
    likelihood = group(fitted, "log_likelihood")["next_state"]
    np.testing.assert_allclose(likelihood.stack(s=("chain", "draw")).T[:5], expected)
    assert set(group(fitted, "posterior_predictive")["next_state"].dims) >= {"body", "transition"}
    assert "joint1" not in json.loads(fitted.attrs["warnings"])


def test_the_file_holds_all_of_it(fitted, tmp_path) -> None:
    save_posterior(fitted, tmp_path / "joints.nc")
    loaded = load_posterior(tmp_path / "joints.nc")
    assert joint_probabilities(loaded) == joint_probabilities(fitted)
    for name in ("i_a", "b_x"):
        np.testing.assert_array_equal(
            group(loaded, "posterior")[name], group(fitted, "posterior")[name]
        )
    said = identify(loaded)
    assert said.parameters == ()  # all but the joint is known, and a free joint takes no part
    assert updated_scene(loaded).joints[0].bodies is None


def test_an_update_refits_over_all_configurations(fitted, monkeypatch) -> None:
    truth = scene(Joint("hinge", ("a", "b"), *HELD), poses=LINED)
    more = simulated_history(
        truth, {}, seed=9, trajectories=1, intervals=2, noise=NOISE, poses=LINED, substeps=20
    )
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", np.inf)  # no weights are good enough
    asked = []

    def refit(problem, **options):
        asked.append(problem.layout.discrete.any())
        raise InterruptedError

    monkeypatch.setattr(updating, "sample", refit)
    with warnings.catch_warnings(), pytest.raises(InterruptedError):
        warnings.simplefilter("ignore", RefitWarning)
        updating.update(fitted, more)
    assert asked == [True]


def test_probabilities_need_a_joint_of_unknown_bodies() -> None:
    with pytest.raises(PosteriorError, match="bodies of all its joints were named"):
        joint_probabilities(SimpleNamespace(attrs={}))


@pytest.mark.slow
@FORK
@SHORT
@pytest.mark.usefixtures("known_weights")
def test_the_same_seed_gives_the_same_posterior(model, fitted) -> None:
    """Both parts run twice: `fitted` weighs the configurations itself, this fit takes `found`."""
    again = draws(fit(model, seed=1, **QUICK))
    for name, values in draws(fitted).items():
        np.testing.assert_array_equal(again[name], values)


@pytest.mark.usefixtures("known_weights")
def test_map_is_the_best_configuration_s_mode(model) -> None:
    idata = fit(model, seed=1, method="map", progress=False)
    named = draws(idata)
    assert (named["i_a"].item(), named["i_b"].item()) == (0, 1)
    anchors = [named[name].item() for name in ("a_x", "a_y", "b_x", "b_y")]
    np.testing.assert_allclose(anchors, np.ravel(HELD), atol=5e-3)
    assert joint_probabilities(idata)["joint1"]["a-b"] > 0.999
    # and it is what the file holds as the mode
    np.testing.assert_allclose(Dynamics.of(idata).phi[0], [0, 1, *anchors], rtol=1e-12)


def test_no_joint_is_found_where_there_is_none(loose, found_loose, monkeypatch) -> None:
    """The anchors' draws are then the prior's, and no warning of an uninformed one is due."""
    monkeypatch.setattr("pbrl_ppl.sampling.fitting.weigh", lambda problem, **options: found_loose)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UninformedWarning)
        idata = fit(loose, seed=1, method="map", progress=False)
    named = draws(idata)
    assert named["i_a"].item() == named["i_b"].item()
    assert next(iter(joint_probabilities(idata)["joint1"])) == "none"
    i_a, i_b, *anchors = Dynamics.of(idata).phi[0]  # of the stored mode
    assert i_a == i_b
    assert np.isfinite(anchors).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", [pytest.param("metropolis", marks=pytest.mark.long), "smc"])
@FORK
@SHORT
@pytest.mark.usefixtures("known_weights")
def test_other_samplers_go_by_the_same_way(model, method) -> None:
    short = QUICK | {"draws": 20, "tune": 20, "thin": 1}
    posterior = group(fit(model, seed=1, method=method, **short), "posterior")
    assert posterior.sizes["draw"] == 20
    assert (posterior["i_b"] == 1).all()


def test_what_cannot_be_done_is_refused(model, fitted) -> None:
    with pytest.raises(FitError, match=r"resume was given and which bodies.*leave resume out"):
        fit(model, resume=fitted)
    with pytest.raises(FitError, match=r"a mode is one of continuous.*pbrl_ppl.fit finds them"):
        find_mode(problem_in(model))


def test_constants_have_converged_and_disagreeing_chains_have_not() -> None:
    """A variable that is constant in each chain, and not the same in all, is no certain index."""
    rng = np.random.default_rng(1)
    varied = rng.normal(size=(2, 400))
    values = {
        "same": np.ones((2, 400)), "stuck": np.repeat([[0.0], [1.0]], 400, axis=1), "mass": varied
    }  # fmt: skip
    posterior = xr.Dataset({name: (("chain", "draw"), each) for name, each in values.items()})
    r_hat, ess = convergence(from_groups({"posterior": posterior}, {}))
    assert r_hat["same"] == 1.0
    assert ess["same"] == 800
    assert not r_hat["stuck"] <= 1.01
    assert r_hat["mass"] < 1.05
