"""Selection says what became of each candidate, and which is there without mattering."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism import selection as module
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.cross_validation import Change
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.criticism.selection import Selection
from pbrl_ppl.effects import catalogue
from tests.helpers.free_puck import DISC, Disc, fitted

pytestmark = pytest.mark.one_stack

FINE = DISC.replace(substeps=40)
TRIED = ("linear_drag", "quadratic_drag", "torque_gain", "inertia_scale", "constant_torque",
         "heavy_tails")  # fmt: skip


def selection(*names: str, criteria: Criteria = DEFAULT) -> Selection:
    chosen = tuple(effect for effect in catalogue if effect.name in names)
    return Selection(FINE, chosen, criteria, lambda stage: None)


@pytest.fixture(scope="module")
def weak():
    """A disc with drag, and four fifths of the torque that was asked for."""
    frame = Disc(6, 12, FINE, drag=0.3).frame(np.random.default_rng(1))
    return fitted(FINE, frame.assign(torque=0.8 * frame["torque"]))


def test_each_candidate_says_what_became_of_it(weak) -> None:
    chosen = selection(*TRIED)
    first = ranked = rank_candidates(weak, chosen.missing(weak))
    mode, steps = weak, []
    while (step := chosen.best_addition(mode, ranked)) is not None:
        steps.append(step)
        mode = step.after
        ranked = rank_candidates(mode, chosen.missing(mode))
    why = {one.effect: one.why for one in chosen.explained(first)}
    assert {name for name, said in why.items() if said == "added"} == {
        "inertia_scale",
        "linear_drag",
    }
    assert why["quadratic_drag"].startswith("fits less well than linear drag, by ")
    assert why["torque_gain"] == "the same as inertia scale in these data"
    assert why["constant_torque"].startswith("not significant (p = ")
    assert why["heavy_tails"] == "the noise's shape is scored and never added: declare it"


def test_a_gain_that_is_not_sure_is_told(weak, monkeypatch) -> None:
    few = replace(DEFAULT, selection=replace(DEFAULT.selection, least_trajectories=1))
    chosen = selection("linear_drag", criteria=few)
    ranked = rank_candidates(weak, chosen.missing(weak))
    gains = Change(3.1, 2.4, 100_000), Change(0.0, np.inf, 0)
    monkeypatch.setattr(module, "_gains", lambda before, after, criteria: gains)
    assert chosen.best_addition(weak, ranked) is None
    (only,) = chosen.explained(ranked)
    assert only.why == "cross-validation gains 3.1 ± 2.4 nats, 4.8 are needed"


def test_what_is_certain_and_does_not_matter_is_told_once() -> None:
    """A drag of 0.0015 kg/s in 600 transitions, which a quadratic one explains nearly as well."""
    mode = Disc(20, 30, FINE, drag=0.0015).mode(np.random.default_rng(1))
    chosen = selection("linear_drag", "quadratic_drag")
    ranked = rank_candidates(mode, chosen.missing(mode))
    for _ in range(2):  # as often as it is looked at
        assert chosen.best_addition(mode, ranked) is None
        assert [one.effect for one in chosen.small] == ["linear_drag"]
    said = chosen.explained(ranked)[0].why
    assert said.startswith("changes predictions by 0.") and said.endswith("1 % is negligible")
    # where the model has another that explains it, nothing is there any more
    leader = next(one for one in ranked if one.candidate.effect == "quadratic_drag")
    drags = module.refitted(mode, leader)
    assert chosen.best_addition(drags, rank_candidates(drags, chosen.missing(drags))) is None
    assert chosen.small == []
