"""Effects of every stage are found in data of another engine; truth made with Box2D.

A candidate's p-value is corrected for the number of candidates and for its looks: on clean data one
below 0.01 is a false alarm in 1 % of the recordings.
"""

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism.scan import looks
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.effects import attach, candidates, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import find_mode
from tests.helpers.places import MODELS

EFFECTS = {effect.name: effect for effect in catalogue}
TRUTH = {
    "actuator_delay": (0.3, {"share": 0.3}),
    "dead_zone": (6.0, {"threshold": 6.0}),
    "mass_change": ((1.3, 6, 0.0), {"factor": 1.3, "trajectory": 5.5}),
    "sensor_bias": ((0, 0, 0, 0.05, 0, 0.05), {"vx": 0.05, "omega": 0.05}),
    "hidden_obstacle": ((1.0, 1.0, 0.4), {}),
    "heavy_tails": (0.4, {}),
}


@pytest.fixture(scope="module")
def scene() -> pp.Scene:
    return pp.Scene.load(MODELS / "shopping_cart" / "scene.toml")


@pytest.fixture(scope="module")
def ranked(scene, make_history):
    """Candidates at the declared model's mode, by what is missing from it; each once."""
    kept = {}

    def rank(name):
        if name not in kept:
            missing = {} if name is None else {name: TRUTH[name][0]}
            train, _ = make_history.simulate(3, **missing)
            problem = Problem.of(scene, History.from_dataframe(train, scene), attach(scene))
            mode = find_mode(problem)
            kept[name] = mode, rank_candidates(mode, candidates(scene, ()))
        return kept[name]

    return rank


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUTH)
def test_each_stage_is_found_in_box2ds_data(ranked, name) -> None:
    _, found = ranked(name)
    physical = [one for one in found if one.candidate.effect != "heavy_tails"]
    leader = (found if name == "heavy_tails" else physical)[0].candidate
    assert leader.effect == name
    assert leader.p_value < 1e-6
    for parameter, value in TRUTH[name][1].items():
        assert leader.estimate[parameter] == pytest.approx(value, rel=0.15, abs=0.006)


@pytest.mark.slow
def test_nothing_is_found_in_clean_data(ranked) -> None:
    _, found = ranked(None)
    assert min(one.candidate.p_value for one in found) > 0.01


def test_looks_are_paid_for(ranked) -> None:
    _, found = ranked(None)
    looked = {one.candidate.effect: one.candidate.looks for one in found}
    assert looked["linear_drag"] == 1
    assert looked["dead_zone"] > 10
    scanned = next(one for one in found if one.candidate.effect == "dead_zone")
    from scipy.stats import chi2

    single = chi2.logsf(scanned.candidate.statistic, 1) + np.log(0.5)
    assert scanned.log_p == pytest.approx(min(0.0, single + np.log(looked["dead_zone"])))


def test_what_is_not_scanned_is_differentiated(ranked) -> None:
    mode, _ = ranked(None)
    tried = looks(mode, EFFECTS["mass_change"].on("cart"))
    assert {look.columns for look in tried} == {(0,)}  # the factor
    assert {look.values[0] for look in tried} == {1.0}
    moments = {(look.values[1], look.values[2]) for look in tried}
    assert (0.5, 0.0) in moments  # from the second trajectory on
    assert any(trajectory == 0.0 and time > 0 for trajectory, time in moments)
    whole = looks(mode, EFFECTS["dead_zone"].on("cart"))
    assert {look.columns for look in whole} == {()}
