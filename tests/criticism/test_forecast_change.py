"""How far an effect changes long forecasts."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.forecast import forecast_change
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


def test_a_drag_changes_forecasts_by_what_it_takes_of_a_speed(dragged) -> None:
    """A drag of 0.1 kg/s on 2 kg takes 14 % of a speed in 3 s: forecasts change by some percent."""
    _, signature = scored(dragged)
    after = refitted(dragged, signature)
    assert 0.03 < forecast_change(dragged, after) < 0.3
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
