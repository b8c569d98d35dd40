"""What a candidate's score promises, and how far long forecasts change, without a refit."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism import selection as module
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.promise import forecast_change, promised_share
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.criticism.selection import Selection, refitted
from pbrl_ppl.effects import catalogue
from tests.helpers.free_puck import DISC, Disc

pytestmark = pytest.mark.one_stack

FINE = DISC.replace(substeps=40)
LINEAR_DRAG = tuple(effect for effect in catalogue if effect.name == "linear_drag")


def mode_of(drag: float):
    return Disc(8, 30, FINE, drag=drag).mode(np.random.default_rng(1))


def scored(mode):
    chosen = Selection(FINE, LINEAR_DRAG, DEFAULT, lambda stage: None)
    (signature,) = rank_candidates(mode, chosen.missing(mode))
    return chosen, signature


@pytest.fixture(scope="module")
def dragged():
    return mode_of(0.1)


def test_a_score_promises_what_a_refit_brings(dragged) -> None:
    """A drag of 0.1 kg/s on 2 kg takes 14 % of a speed in 3 s: forecasts change by some percent."""
    _, signature = scored(dragged)
    after = refitted(dragged, signature)
    promised, change = promised_share(dragged, signature), forecast_change(dragged, after)
    assert change > DEFAULT.negligible
    assert promised > DEFAULT.negligible
    # the linear model's optimum is near that of the refit
    own = after.problem.layout.index("linear_drag_coefficient", "puck")
    estimate = signature.candidate.estimate["coefficient"]
    sd = np.sqrt(after.covariance[own, own])
    assert after.phi[own] == pytest.approx(estimate, abs=max(3 * sd, 0.05 * estimate))


def test_forecasts_of_one_model_do_not_change(dragged) -> None:
    assert forecast_change(dragged, dragged) == 0.0


def test_a_change_is_relative_to_the_motion(dragged) -> None:
    """A mass larger by a tenth moves under a known force by up to a tenth less, and no more."""
    heavier = replace(dragged, phi=1.1 * dragged.phi)
    assert 0.001 < forecast_change(dragged, heavier) < 0.15


def test_what_promises_little_is_not_refitted(monkeypatch) -> None:
    """A drag of 0.0015 kg/s is significant in 600 transitions, and changes nothing by 0.75 %."""
    mode = Disc(20, 30, FINE, drag=0.0015).mode(np.random.default_rng(1))
    chosen, signature = scored(mode)
    assert signature.candidate.p_value < DEFAULT.try_p
    least = DEFAULT.selection.promise * DEFAULT.negligible
    assert promised_share(mode, signature) < least

    def refuse(mode, signature):
        raise AssertionError("it was refitted")

    monkeypatch.setattr(module, "refitted", refuse)
    assert chosen.best_addition(mode, [signature]) is None
    assert chosen.why[("linear_drag", "puck")].startswith("changes predictions by 0.")
    assert [one.effect for one in chosen.small] == ["linear_drag"]
