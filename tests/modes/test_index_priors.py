"""Prior probabilities of what a joint of unknown bodies joins."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.errors import PosteriorError, SceneError
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import Mode, Weighed
from pbrl_ppl.modes.configurations import (
    configurations,
    index_law,
    nothing,
    number,
    one_more,
    stored,
)
from pbrl_ppl.modes.importance import Marginal
from pbrl_ppl.physics import build_layout, index_priors
from pbrl_ppl.posterior import draws, from_groups, group, updated_scene
from pbrl_ppl.sampling import mixture
from pbrl_ppl.scene import WORLD, Joint, Scene
from tests.helpers.histories import simulated_history
from tests.helpers.joints import run_of, scene
from tests.helpers.marks import OBJECT_MODE

NAMES = (*"abcd", WORLD)
#: The trailer's hook is on a or on c; what it holds is anything but d.
PRIOR = {"i_a": {"a": 3.0, "c": 1.0}, "i_b": {"a": 1, "b": 4, "c": 2, WORLD: 3}}
P_A = np.array([0.75, 0.0, 0.25, 0.0, 0.0])
P_B = np.array([0.1, 0.4, 0.2, 0.0, 0.3])


def hooked(prior=PRIOR, joints: int = 1) -> Scene:
    return scene(*(Joint("hinge", known=False, prior=prior) for _ in range(joints)))


def test_the_scene_file_says_it() -> None:
    text = hooked().to_toml()
    assert "prior = { i_a = { a = 3.0, c = 1.0 }, i_b = { a = 1.0" in text
    assert Scene.from_toml(text) == hooked()
    one, other = index_priors(hooked(), hooked().joints[0])
    np.testing.assert_allclose(one.probabilities, P_A)
    np.testing.assert_allclose(other.probabilities, P_B)
    half = hooked({"i_b": {"b": 1.0}})
    one, other = index_priors(half, half.joints[0])
    np.testing.assert_allclose(one.probabilities, 0.2)
    np.testing.assert_allclose(other.probabilities, np.eye(5)[1])


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"i_c": {"a": 1.0}}, 'unknown index "i_c" in prior of joint; did you mean "i_[ab]"?'),
        (
            {"i_a": {"e": 1.0}},
            'number 1: prior i_a names what is no moving body or the world, "e"; did you',
        ),
        ({"i_a": {"wolrd": 1.0}}, 'did you mean "world"?'),
        ({"i_a": {"a": -0.1}}, "i_a a is -0.1, expected 0 or more"),
        ({"i_a": {"a": 0.0}}, "i_a has no name of a probability above 0"),
        ({"i_a": {}}, "i_a has no name"),
        ({"i_a": 0.5}, "i_a is 0.5, expected a table"),
    ],
)
def test_what_makes_no_prior_is_refused(prior, message) -> None:
    with pytest.raises(SceneError, match=message):
        hooked(prior)


def test_named_bodies_have_no_prior() -> None:
    with pytest.raises(SceneError, match="it has bodies and a prior of them; drop one"):
        Joint("hinge", ("a", "b"), known=False, prior=PRIOR)


def test_configurations_have_the_declared_probabilities() -> None:
    """What the indices say of each pair in both orders, and of none; nothing impossible."""
    every = configurations(hooked())
    weight = {each.pairs[0][1]: np.exp(each.log_prior) for each in every}
    both = np.outer(P_A, P_B)
    expected = {None: np.trace(both)}
    for i, j in ((0, 1), (0, 2), (0, 4), (1, 2), (2, 4)):
        expected[NAMES[i], NAMES[j]] = both[i, j] + both[j, i]
    assert weight == pytest.approx(expected)
    assert sum(expected.values()) == pytest.approx(1.0)
    # two of them are alike and may be exchanged; one with another prior may not
    two = configurations(hooked(joints=2))
    assert len(two) == number(hooked(joints=2)) == 6 * 7 / 2
    assert np.exp([each.log_prior for each in two]).sum() == pytest.approx(1.0)
    other = scene(*hooked().joints, Joint("hinge", known=False))
    assert number(other) == 6 * 11
    assert np.exp([e.log_prior for e in configurations(other)]).sum() == pytest.approx(1.0)


def test_a_joint_that_there_must_be() -> None:
    """No joint at all is kept to begin with, and is impossible."""
    sure = hooked({"i_a": {"a": 1.0}, "i_b": {"b": 0.5, "c": 0.5}})
    first, *others = configurations(sure)
    assert first.empty
    assert first.log_prior == -np.inf
    assert [each.pairs[0][1] for each in others] == [("a", "b"), ("a", "c")]


def test_the_model_has_them() -> None:
    layout = build_layout(hooked())
    drawn = layout.priors[0].sample(np.random.default_rng(1), 4000)
    np.testing.assert_allclose(np.bincount(drawn.astype(int), minlength=5) / 4000, P_A, atol=0.03)
    model = physics_model(
        hooked(), simulated_history(scene(), {}, seed=1, trajectories=1, intervals=2)
    )
    p = model["i_b"].owner.inputs[-1].eval()
    np.testing.assert_allclose(np.squeeze(p), P_B)


def test_one_more_joint() -> None:
    """In the order of `configurations`, so that each is the same object whoever makes it."""
    two = scene(*(Joint("hinge", known=False),) * 2, Joint("distance", known=False))
    every = set(configurations(two))
    empty = nothing(two)
    assert empty in every
    singles = one_more(two, empty)
    assert len(singles) == 20
    assert set(singles) <= every
    for single in singles:
        grown = one_more(two, single)
        assert set(grown) <= every
        joined = {pair for _, pair in single.pairs} - {None}
        assert all(joined <= {pair for _, pair in each.pairs} for each in grown)
    full = next(each for each in every if None not in dict(each.pairs).values())
    assert one_more(two, full) == ()


@pytest.mark.parametrize("pair", [("a", "c"), ("a", "b"), ("c", WORLD), None])
def test_the_order_of_a_pair(pair) -> None:
    free = hooked()
    law = index_law(pair, free, P_A, P_B)
    both = np.outer(P_A, P_B)
    assert law.sum() == pytest.approx(1.0)
    held = [(i, i) for i in range(5)]
    if pair is not None:
        i, j = (NAMES.index(name) for name in pair)
        held = [(i, j), (j, i)]
    expected = np.array([both[each] for each in held])
    np.testing.assert_allclose([law[each] for each in held], expected / expected.sum())
    # one prior for both: an order means nothing
    even = index_law(pair, free, P_B, P_B)
    assert (np.tril(even, -1) == 0.0).all()


@OBJECT_MODE
def test_draws_have_each_order_s_share() -> None:
    """A pair of which either may be the first: its anchors change sides with it.

    Binomial: 5 standard errors of 10,000 draws, false alarm 6e-7 each.
    """
    history = simulated_history(scene(), {}, seed=1, trajectories=1, intervals=2)
    model = physics_model(hooked(), history)
    probability = {("a", "c"): 0.6, None: 0.4}
    found = []
    for each in configurations(hooked()):
        own = each.problem(problem_in(model))
        phi = np.array([0.1, 0.2, -0.1, -0.2])[: own.layout.size]
        mode = Mode(own, phi, np.full(6, 0.1), np.zeros((0, 0)), np.zeros((0, 0)), 0.0)
        weight = probability.get(each.pairs[0][1], 0.0)
        found.append(Weighed(each, mode, Marginal(0.0), weight))

    def constant(mode):
        named = mode.problem.named(mode.phi, mode.sigma)
        values = {k: np.broadcast_to(v, (2, 5000, *v.shape)).copy() for k, v in named.items()}
        posterior = mixture.posterior_dataset(mode.problem, values)
        rest = dict.fromkeys(("sample_stats", "observed_data", "constant_data"), posterior)
        return from_groups({"posterior": posterior, **rest}, {})

    trace = mixture.mix(run_of(problem_in(model), 5000), found, constant)
    named = {k: v[:, 0] for k, v in draws(trace).items()}
    joined = named["i_a"] != named["i_b"]
    assert joined.sum() == 6000
    turned = joined & (named["i_a"] == 2)
    assert (named["i_b"][turned] == 0).all()
    both = np.outer(P_A, P_B)
    share = both[2, 0] / (both[2, 0] + both[0, 2])
    assert turned.sum() == pytest.approx(6000 * share, abs=5 * np.sqrt(6000 * share * (1 - share)))
    np.testing.assert_allclose(named["a_x"][joined], np.where(turned, -0.1, 0.1)[joined])
    np.testing.assert_allclose(named["b_y"][joined], np.where(turned, 0.2, -0.2)[joined])
    none = ~joined
    share = both[0, 0] / np.trace(both)
    assert (named["i_a"][none] == 0).sum() == pytest.approx(
        4000 * share, abs=5 * np.sqrt(4000 * share * (1 - share))
    )
    # and they are the next prior
    attrs = {"scene": hooked().to_toml(), "configurations": json.dumps(stored(found))}
    posterior = group(trace, "posterior")
    new = updated_scene(from_groups({"posterior": posterior}, attrs))
    one, other = index_priors(new, new.joints[0])
    of_draws = [np.bincount(named[i], minlength=5) / 10_000 for i in ("i_a", "i_b")]
    np.testing.assert_allclose(one.probabilities, of_draws[0], atol=0.025)
    np.testing.assert_allclose(other.probabilities, of_draws[1], atol=0.025)
    assert Scene.from_toml(new.to_toml()) == new


def test_the_next_prior_needs_the_probabilities() -> None:
    made = from_groups({"posterior": group(_blank(), "posterior")}, {"scene": hooked().to_toml()})
    with pytest.raises(PosteriorError, match="does not say what joint1 may join"):
        updated_scene(made)


def _blank():
    free = hooked()
    names = build_layout(free).to_dict(np.zeros(build_layout(free).size))
    import xarray as xr

    data = {k: (("chain", "draw", f"{k}_dim"), v[None, None]) for k, v in names.items()}
    return from_groups({"posterior": xr.Dataset(data)}, {})


def test_certain_indices_stay_certain() -> None:
    """Of what has been found for sure the next fit tries nothing else."""
    free = scene(Joint("hinge", known=False))
    rows = [
        {"joints": {"joint1": pair}, "probability": p}
        for pair, p in ((["c", WORLD], 1.0), (None, 0.0))
    ]
    attrs = {"scene": free.to_toml(), "configurations": json.dumps(rows)}
    new = updated_scene(from_groups({"posterior": group(_blank(), "posterior")}, attrs))
    assert new.joints == (replace(free.joints[0], prior={"i_a": {"c": 1.0}, "i_b": {WORLD: 1.0}}),)
    assert [each.pairs[0][1] for each in configurations(new)] == [None, ("c", WORLD)]
