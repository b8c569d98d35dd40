"""Effects with a place, a threshold or a time are tried at many values, and pay for each.

That they are found is tested in test_criticism, with all other effects.
"""

import numpy as np
import pytest
from scipy.stats import chi2

from pbrl_ppl.criticism.scan import looks
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.effects import candidates, catalogue
from tests.helpers.free_puck import BOX, box2d, fitted

EFFECTS = {effect.name: effect for effect in catalogue}


@pytest.fixture(scope="module")
def mode(make_history):
    return fitted(BOX, box2d(make_history, 3, dead_zone=2.0)[0])


def test_looks_are_paid_for(mode) -> None:
    found = {one.candidate.effect: one for one in rank_candidates(mode, candidates(BOX, ()))}
    assert found["linear_drag"].candidate.looks == 1
    scanned = found["dead_zone"]
    n = scanned.candidate.looks
    assert n > 10
    # a whole change has one sign: half of a chi-squared, times the looks
    single = chi2.logsf(scanned.candidate.statistic, 1) + np.log(0.5)
    assert scanned.log_p == pytest.approx(min(0.0, single + np.log(n)))


def test_what_is_not_scanned_is_differentiated(mode) -> None:
    tried = looks(mode, EFFECTS["mass_change"].on("puck"))
    assert {look.columns for look in tried} == {(0,)}  # the factor
    assert {look.values[0] for look in tried} == {1.0}
    moments = {(look.values[1], look.values[2]) for look in tried}
    assert (0.5, 0.0) in moments  # from the second trajectory on
    assert any(time > 0 for _, time in moments)
    whole = looks(mode, EFFECTS["dead_zone"].on("puck"))
    assert {look.columns for look in whole} == {()}


def test_a_signature_is_what_the_effect_does(mode) -> None:
    """The change that a look at the truth predicts is what brings the residual down."""
    thresholds = looks(mode, EFFECTS["dead_zone"].on("puck"))
    residual = mode.whitened_residual().ravel()

    def left(look) -> float:
        return float(((residual - look.signature[:, 0]) ** 2).sum())

    best = min(thresholds, key=left)
    assert left(best) < 0.9 * (residual**2).sum()
    assert best.values[0] == pytest.approx(2.0, rel=0.3)  # the nearest of those looked at


def test_an_effect_without_a_scan_has_no_looks(mode) -> None:
    assert looks(mode, EFFECTS["linear_drag"].on("puck")) == []
