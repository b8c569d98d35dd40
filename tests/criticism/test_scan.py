"""Effects with a place, a threshold or a time are tried at many values, and pay for each.

That they are found is tested in test_criticism, with all other effects.
"""

from collections.abc import Iterator
from typing import Any
from weakref import WeakSet

import numpy as np
import pytest
from scipy.stats import binom, chi2, norm

from pbrl_ppl.criticism import score
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.score import (
    GridPoint,
    detection_limits,
    each_grid_point,
    is_upper_limit,
    rank_candidates,
)
from pbrl_ppl.effects import candidates, catalogue
from pbrl_ppl.state import STATE
from tests.helpers.free_puck import BOX, DISC, Disc, box2d, fitted
from tests.helpers.histories import NOISE

pytestmark = pytest.mark.one_stack

EFFECTS = {effect.name: effect for effect in catalogue}


@pytest.fixture(scope="module")
def mode(make_history):
    return fitted(BOX, box2d(make_history, 3, force_cutoff=2.0)[0])


def test_grid_points_are_paid_for(mode) -> None:
    found = {one.candidate.effect: one for one in rank_candidates(mode, candidates(BOX, ()))}
    assert found["linear_drag"].candidate.n_grid_points == 1
    scanned = found["force_cutoff"]
    n = scanned.candidate.n_grid_points
    assert n > 10
    # a whole change has one sign: half of a chi-squared, times the grid points
    single = chi2.logsf(scanned.candidate.statistic, 1) + np.log(0.5)
    assert scanned.log_p == pytest.approx(min(0.0, single + np.log(n)))


def test_what_is_not_scanned_is_differentiated(mode) -> None:
    tried = list(each_grid_point(mode, EFFECTS["mass_change"].on("puck")))
    assert {look.columns for look in tried} == {(0,)}  # the factor
    assert {look.values[0] for look in tried} == {1.0}
    moments = {(look.values[1], look.values[2]) for look in tried}
    assert (0.5, 0.0) in moments  # from the second trajectory on
    assert any(time > 0 for _, time in moments)
    whole = list(each_grid_point(mode, EFFECTS["force_cutoff"].on("puck")))
    assert {look.columns for look in whole} == {()}


def test_a_signature_is_what_the_effect_does(mode) -> None:
    """The change that a look at the truth predicts is what brings the residual down."""
    thresholds = list(each_grid_point(mode, EFFECTS["force_cutoff"].on("puck")))
    residual = mode.whitened_residual.ravel()

    def left(look) -> float:
        return float(((residual - look.signature[:, 0]) ** 2).sum())

    best = min(thresholds, key=left)
    assert left(best) < 0.9 * (residual**2).sum()
    assert best.values[0] == pytest.approx(2.0, rel=0.3)  # the nearest of those looked at


def test_the_smallest_size_is_of_the_look_that_shows_it_best() -> None:
    needed = norm.isf(0.005 / (2 * 2)) + norm.isf(0.1)  # two candidates, two grid points
    signature = np.zeros((3, 1))
    free = [GridPoint(np.array([1.0, begin, 0.0]), signature, (0,)) for begin in (0.5, 1.5)]
    units = [np.array([2.0]), np.array([5.0])]
    sizes = detection_limits(EFFECTS["mass_change"], free, units, 2, DEFAULT.residual)
    assert sizes == {"factor": pytest.approx(needed / 5.0)}
    whole = [GridPoint(np.array([value]), signature, ()) for value in (1.0, 2.0, 3.0)]
    units = [np.array([change]) for change in (1.0, 9.0, 12.0)]
    assert detection_limits(EFFECTS["force_cutoff"], whole, units, 2, DEFAULT.residual) == {
        "threshold": 2.0
    }
    assert detection_limits(EFFECTS["saturation"], whole, units, 2, DEFAULT.residual) == {
        "limit": 3.0
    }
    none = detection_limits(EFFECTS["force_cutoff"], whole[:1], units[:1], 2, DEFAULT.residual)
    assert none == {"threshold": np.inf}
    there = [GridPoint(np.zeros(3), signature, ())]
    assert (
        detection_limits(EFFECTS["hidden_obstacle"], there, units[1:2], 2, DEFAULT.residual) == {}
    )
    assert is_upper_limit(EFFECTS["saturation"], whole)
    assert not is_upper_limit(EFFECTS["force_cutoff"], whole)
    assert not is_upper_limit(EFFECTS["mass_change"], free)


def test_sizes_of_what_is_scanned_are_seen(make_history) -> None:
    """Twice the smallest stiffness that shows anywhere is found where the spring really is."""
    clean = fitted(BOX, box2d(make_history, 3)[0])
    (found,) = rank_candidates(clean, [EFFECTS["spring"].on("puck")])
    size = found.candidate.detectable["stiffness"]
    assert 0 < size < 0.1
    pulled = fitted(BOX, box2d(make_history, 3, spring=(2 * size, 1.0, -0.5))[0])
    (found,) = rank_candidates(pulled, [EFFECTS["spring"].on("puck")])
    assert found.candidate.p_value < 0.01


@pytest.mark.long
def test_p_values_of_scans_are_no_smaller_than_chance_makes_them() -> None:
    """Looks are paid for by a union bound, and an obstacle's are where the data bounced most."""
    disc = Disc(scene=DISC.replace(substeps=40, noise=dict(zip(STATE, NOISE, strict=True))))
    names = ("mass_change", "force_cutoff", "saturation", "spring", "hidden_obstacle")
    tried = [EFFECTS[name].on("puck") for name in names]
    rng = np.random.default_rng(12)
    found = {name: [] for name in names}
    for _ in range(100):
        for one in rank_candidates(disc.mode(rng), tried):
            found[one.candidate.effect].append(np.exp(one.log_p))
    for name, p in found.items():
        # more come by chance in one of a thousand
        assert (np.array(p) < 0.05).sum() <= binom.isf(0.001, 100, 0.05), name


def test_an_effect_without_a_scan_has_no_grid_points(mode) -> None:
    assert list(each_grid_point(mode, EFFECTS["linear_drag"].on("puck"))) == []


def test_a_ranking_does_not_hold_every_signature(mode, monkeypatch) -> None:
    """Of many rows, all candidates at all their grid points do not go into memory."""
    made, most, each = 0, 0, score.each_grid_point

    def noted(*arguments: Any) -> Iterator[GridPoint]:
        nonlocal made, most
        alive: WeakSet[GridPoint] = WeakSet()
        for point in each(*arguments):
            alive.add(point)
            made, most = made + 1, max(most, len(alive))
            yield point
            del point

    monkeypatch.setattr(score, "each_grid_point", noted)
    tried = [EFFECTS[name].on("puck") for name in ("linear_drag", "force_cutoff", "mass_change")]
    ranked = rank_candidates(mode, tried)
    assert made > 30 and most < 10
    for one in ranked:
        assert not one.basis.size and not one.linear


def test_grid_points_of_long_recordings_are_simulated_one_by_one(mode) -> None:
    """To the last digit as eight at a time."""
    tried = EFFECTS["mass_change"].on("puck")
    at_once = list(each_grid_point(mode, tried))
    in_turn = list(each_grid_point(mode, tried, most_values=1))
    for one, other in zip(at_once, in_turn, strict=True):
        np.testing.assert_array_equal(one.signature, other.signature)
