"""Best subsets of laws by one regression, against discs in closed form."""

from dataclasses import replace

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism import search
from pbrl_ppl.criticism.search import Evidence, Search, refit
from pbrl_ppl.criticism.subsets import best_subsets, worth
from pbrl_ppl.effects import candidates
from pbrl_ppl.errors import EffectError
from pbrl_ppl.likelihood import in_pieces
from pbrl_ppl.modes import Mode, filtered_mode, fit_pieces
from tests.helpers.free_puck import BOX, DISC, MASS, Disc, box2d, fitted, searched

pytestmark = pytest.mark.one_stack
NAMES = [
    "linear_drag",
    "quadratic_drag",
    "constant_force",
    "constant_torque",
    "force_gain",
    "spring",
]
OFFERED = tuple(effect for effect in pp.catalogue if effect.name in NAMES)


def short_pieces(mode: Mode) -> Mode:
    """The model on pieces of four rows."""
    problem = in_pieces(mode.problem, 4, mode.problem.data.smoothed_states)
    return fit_pieces(problem, mode.phi)


@pytest.fixture(scope="module")
def dragged_and_pulled() -> Mode:
    """A disc with a drag of 0.8 kg/s and a force of (1.5, -0.6) N that the model lacks."""
    disc = Disc(8, 20, drag=0.8)
    push = np.broadcast_to((1.5 / MASS, -0.6 / MASS, 0.0), disc.pushes.shape)
    return short_pieces(fitted(DISC, disc.frame(np.random.default_rng(1), pushed=push)))


def test_two_laws_are_proposed_together_with_their_joint_sizes(dragged_and_pulled) -> None:
    mode = dragged_and_pulled
    regression = best_subsets(mode, candidates(DISC, (), OFFERED))
    first = regression.subsets[0]
    assert {law.effect.name for law in first.laws} == {"linear_drag", "constant_force"}
    sizes = {law.effect.name: size for law, size in first.sizes.items()}
    # to first order: the noise and the curvature leave a few hundredths
    np.testing.assert_allclose(sizes["linear_drag"], 0.8, rtol=0.1)
    np.testing.assert_allclose(sizes["constant_force"], (1.5, -0.6), rtol=0.1)
    alone = [one for one in regression.path if len(one.laws) == 1]
    assert alone[0].share < first.share
    assert first.nats > alone[0].nats


def test_no_subset_breaks_a_sign(dragged_and_pulled) -> None:
    """A drag is never negative, however much that would explain."""
    mode = dragged_and_pulled
    for subset in best_subsets(mode, candidates(DISC, (), OFFERED)).subsets:
        for law, size in subset.sizes.items():
            if law.effect.name.endswith("drag"):
                assert size[0] >= 0.0


def test_prior_odds_are_part_of_the_price(dragged_and_pulled) -> None:
    mode, rare = dragged_and_pulled, -5.0
    (drag,) = (effect for effect in OFFERED if effect.name == "linear_drag")
    worth = [
        best_subsets(mode, candidates(DISC, (), (replace(drag, log_odds=odds),))).subsets[0].nats
        for odds in (0.0, rare)
    ]
    assert worth[1] - worth[0] == pytest.approx(rare)
    with pytest.raises(EffectError, match="log_odds is 1"):
        replace(drag, log_odds=1.0)


def test_evidence_is_the_logarithm_of_the_errors_ratio(dragged_and_pulled) -> None:
    """Of n measurements, less half a log n for each parameter that the data inform."""
    before = dragged_and_pulled
    after = searched(fitted_again(before), OFFERED).after
    assert Evidence.of(after, after).nats == 0.0
    assert Evidence.of(after, after).share == 0.0
    larger = replace(after, sigma=2.0 * after.sigma)
    evidence = Evidence.of(larger, after)
    n = after.problem.likelihood.counts(after.problem.observations).sum()
    assert evidence.nats == pytest.approx(n * np.log(2.0))
    assert evidence.share == pytest.approx(0.5)


def fitted_again(mode: Mode) -> Mode:
    """The same recording along whole trajectories."""
    return fitted(DISC, mode.problem.data.history)


def test_filtered_at_a_modes_parameters_is_that_mode() -> None:
    """Noise and states are those of the fit itself."""
    mode = fitted(DISC, Disc(6, 15).frame(np.random.default_rng(3)))
    again = filtered_mode(mode, mode)
    assert again.log_posterior == pytest.approx(mode.log_posterior, abs=0.5)
    np.testing.assert_array_equal(again.phi, mode.phi)


@pytest.mark.parametrize("net", [3.1, 2.9, -2.9, -3.1])
def test_the_other_of_two_laws_that_are_nearly_as_good_is_reported(
    dragged_and_pulled, monkeypatch, net
) -> None:
    """Which of them is named is decided by 3 nats, and near that by the data's last digits."""
    first, second = (one for one in candidates(DISC, (), OFFERED) if "drag" in one.effect.name)
    bare = dragged_and_pulled
    model = search._Model(refit(bare, (first,), {}), {first: 0.0})
    monkeypatch.setattr(search, "_net", lambda *_: {second: net})
    monkeypatch.setattr(search, "_gained", lambda *_: 9.0 * np.sign(net))
    named, other = (second, first) if net > 3.0 else (first, second)
    found = Search(lambda _: ())._exchanged(model, first, bare, {second: np.array([0.3])})
    assert ([*found.earlier], [*found.rivals[named]]) == ([named], [other])
    # on the longest pieces, where the first is named and the second among its rivals
    kept = replace(model, rivals={first: {second: np.array([0.3])}}).fitted(whole=True)
    again, confounded = Search(lambda _: ())._confounded(kept, set())
    assert ([*again.earlier], confounded) == ([named], {named: (other,)})


@pytest.mark.slow
def test_single_transitions_are_searched_as_they_are(make_history) -> None:
    """Two rows each: no simulation can be judged, and the drag is named all the same."""
    train, test = box2d(make_history, 6, trajectories=60, intervals=1, linear_drag=0.8)
    histories = (pp.History.from_dataframe(frame, BOX) for frame in (train, test))
    found = pp.close_loop(BOX, *histories, catalogue=OFFERED, seed=1, method="laplace")
    assert [one.effect for one in found.added] == ["linear_drag"]
    estimate = found.added[0].parameters["coefficient"]
    assert abs(estimate.mean - 0.8) < 4 * estimate.sd  # a false alarm in 1e-4


def test_a_law_that_leaves_nothing_of_exact_data_has_finite_evidence() -> None:
    with np.errstate(all="raise"):
        assert 500.0 < worth(1.0, 1, 40.0) < np.inf
