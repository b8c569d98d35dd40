"""Best subsets of laws by one regression, and the table of models, on discs in closed form."""

from dataclasses import replace

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism.score import Library
from pbrl_ppl.criticism.subsets import best_subsets, worth
from pbrl_ppl.criticism.table import Table, refit, share, sizes_of
from pbrl_ppl.effects import candidates
from pbrl_ppl.errors import EffectError
from pbrl_ppl.likelihood import in_pieces
from pbrl_ppl.modes import Mode, filtered_mode, fit_pieces
from tests.helpers.free_puck import BOX, DISC, MASS, Disc, box2d, fitted

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
    regression = best_subsets(Library(mode), candidates(DISC, (), OFFERED))
    first = regression.subsets[0]
    assert {law.effect.name for law in first.laws} == {"linear_drag", "constant_force"}
    sizes = {law.effect.name: size for law, size in first.sizes.items()}
    # to first order: the noise and the curvature leave a few hundredths
    np.testing.assert_allclose(sizes["linear_drag"], 0.8, rtol=0.1)
    np.testing.assert_allclose(sizes["constant_force"], (1.5, -0.6), rtol=0.1)
    alone = [one for one in regression.subsets if len(one.laws) == 1]
    assert alone[0].share < first.share
    assert first.nats > alone[0].nats


def test_no_subset_breaks_a_sign(dragged_and_pulled) -> None:
    """A drag is never negative, however much that would explain."""
    mode = dragged_and_pulled
    for subset in best_subsets(Library(mode), candidates(DISC, (), OFFERED)).subsets:
        for law, size in subset.sizes.items():
            if law.effect.name.endswith("drag"):
                assert size[0] >= 0.0


def test_prior_odds_are_part_of_the_price(dragged_and_pulled) -> None:
    mode, rare = dragged_and_pulled, -5.0
    (drag,) = (effect for effect in OFFERED if effect.name == "linear_drag")
    worth = [
        best_subsets(Library(mode), candidates(DISC, (), (replace(drag, log_odds=odds),)))
        .subsets[0]
        .nats
        for odds in (0.0, rare)
    ]
    assert worth[1] - worth[0] == pytest.approx(rare)
    with pytest.raises(EffectError, match="log_odds is 1"):
        replace(drag, log_odds=1.0)


@pytest.fixture(scope="module")
def table(dragged_and_pulled) -> Table:
    """Models with each of some sets of laws."""
    table = Table((), tried=6, modes={frozenset(): dragged_and_pulled})
    laws = {law.effect.name: law for law in candidates(DISC, (), OFFERED)}
    drag, force = laws["linear_drag"], laws["constant_force"]
    begin = dict(zip((*drag.labels, *force.labels), (0.8, 1.5, -0.6), strict=True))
    table.fitted(dragged_and_pulled, (drag, force), begin)
    return table


def test_each_set_of_laws_is_fitted_once(table) -> None:
    (mode,) = (table.modes[key] for key in table.modes if len(key) == 2)
    first, second = table.laws(mode)
    assert table.fitted(mode, (second, first)) is mode
    assert table.without(mode, first) is table.without(mode, first)
    assert table.laws(table.without(mode, first)) == (second,)


def test_a_model_does_not_depend_on_the_order_of_its_laws(dragged_and_pulled) -> None:
    """That of a set differs from run to run, for it hashes functions by their addresses."""
    laws = [law for law in candidates(DISC, (), OFFERED) if "drag" in law.effect.name]
    models = [Table((), 6).fitted(dragged_and_pulled, given) for given in (laws, laws[::-1])]
    assert models[0].problem.layout.labels == models[1].problem.layout.labels
    np.testing.assert_array_equal(models[0].phi, models[1].phi)


def test_a_refit_begins_without_sizes_that_are_no_numbers(table) -> None:
    """A regression has none where the engine diverges; the refit finds the same model."""
    (mode,) = (table.modes[key] for key in table.modes if len(key) == 2)
    effects, bare = mode.problem.physics.effects, table.modes[frozenset()]
    lost = dict.fromkeys(mode.problem.layout.labels, np.nan)
    np.testing.assert_allclose(refit(bare, effects, lost).sigma, mode.sigma, rtol=0.01)


def test_the_value_is_the_log_evidence_with_the_odds_of_the_laws(table) -> None:
    """The logarithm of the errors' ratio, less half a log n a parameter, the prior, the choice."""
    (mode,) = (table.modes[key] for key in table.modes if len(key) == 2)
    bare, weight = table.fitted(mode, ()), table.weight
    gain = float((weight * np.log(bare.sigma / mode.sigma)).sum())
    laws = table.laws(mode)
    paid = 0.5 * 3 * np.log(weight.sum()) + 2 * np.log(6)
    paid -= sum(law.effect.log_odds for law in laws)
    value = table.value(mode) - table.value(bare)
    assert value == pytest.approx(gain - paid, abs=3.0)  # of the priors, which are wide
    assert value < gain - paid + 1.0
    louder = replace(mode, sigma=2.0 * mode.sigma)
    assert table.value(mode) - table.value(louder) == pytest.approx(weight.sum() * np.log(2.0))
    assert share(louder, mode, weight) == pytest.approx(0.5)


def test_shares_of_laws_that_replace_each_other_add_up(table) -> None:
    """A drag and a force are apart: each share is that by which the error rises without it."""
    (mode,) = (table.modes[key] for key in table.modes if len(key) == 2)
    for law, part in table.shares(mode, 0.2):
        alone = share(table.without(mode, law), mode, table.weight)
        assert part == pytest.approx(alone, abs=1e-9)
    parts = [part for _, part in table.shares(mode, 0.2)]
    assert parts == sorted(parts)


def test_two_laws_that_replace_each_other_share_what_both_take_off(table) -> None:
    """A force and the same force of two laws: without one the other does as well."""
    (mode,) = (table.modes[key] for key in table.modes if len(key) == 2)
    drag, force = table.laws(mode)
    without = {law: table.without(mode, law) for law in (drag, force)}
    small = {law: replace(mode, sigma=1.05 * mode.sigma) for law in without}
    copy = Table((), 6, modes=dict(table.modes))
    copy.modes[frozenset({force})], copy.modes[frozenset({drag})] = small[drag], small[force]
    together = share(table.fitted(mode, ()), mode, copy.weight)
    half = 1.0 - np.sqrt(1.0 - together)  # of a fall in the logarithm
    assert [part for _, part in copy.shares(mode, 0.2)] == pytest.approx([half, half])


def test_rivals_are_models_within_some_nats_that_differ_by_one_law(table) -> None:
    (mode,) = (table.modes[key] for key in table.modes if len(key) == 2)
    laws = {law.effect.name: law for law in candidates(DISC, (), OFFERED)}
    drag, force, other = laws["linear_drag"], laws["constant_force"], laws["quadratic_drag"]
    at = [*sizes_of(mode, drag), *sizes_of(mode, force)]
    begin = dict(zip((*other.labels, *force.labels), at, strict=True))
    worse = table.value(mode) - table.value(table.fitted(mode, (force, other), begin))
    assert table.rivals(mode, drag, worse + 1.0) == (other,)
    assert table.rivals(mode, drag, worse - 1.0) == ()
    assert table.rivals(mode, force, worse + 1.0) == ()


def test_filtered_at_a_modes_parameters_is_that_mode() -> None:
    """Noise and states are those of the fit itself."""
    mode = fitted(DISC, Disc(6, 15).frame(np.random.default_rng(3)))
    again = filtered_mode(mode, mode)
    assert again.log_posterior == pytest.approx(mode.log_posterior, abs=0.5)
    np.testing.assert_array_equal(again.phi, mode.phi)


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
