"""Single bad frames are left out of both histories, named, and stay so in posterior files."""

import numpy as np

from pbrl_ppl.criticism.attribution import criticise
from pbrl_ppl.criticism.refinement import checked_histories
from pbrl_ppl.effects import catalogue
from pbrl_ppl.history import History, without_bad_frames
from pbrl_ppl.posterior import recorded, recording
from pbrl_ppl.reporting import in_brief, render
from tests.helpers.free_puck import DISC, Disc, fitted, searched
from tests.helpers.histories import simulated_history
from tests.helpers.made_up import changed, made_up
from tests.helpers.places import MODELS, load


def puck(seed: int, row: int) -> History:
    """Five pushed discs, the x of the second 0.3 m off at a row; no row is, at -1."""
    history = simulated_history(
        DISC, {"mass": [2.0]}, seed=seed, trajectories=5, intervals=20, wrench_sd=(1.0, 1.0, 0.01)
    )
    observed = history.dataset["observed"].to_numpy().copy()
    if row >= 0:
        observed[1, row, 0, 0] += 0.3
    return History(history.dataset.assign(observed=history.dataset["observed"].copy(data=observed)))


def test_both_histories_are_without_them_and_each_is_named_once() -> None:
    train, test = puck(1, 8), puck(2, 11)
    kept, held_out, unused, said = checked_histories(DISC, train, test)
    assert not unused
    for history, row in ((kept, 8), (held_out, 11)):
        missing = np.argwhere(~np.isfinite(history.dataset["observed"].to_numpy()))
        assert missing.tolist() == [[1, row, 0, 0]]
    assert len(said) == 2
    assert said[0].startswith("x of puck at t = 0.8 s of trajectory 1 is off by 0.")
    assert said[0].endswith(" m and left out (1 of 105 rows)")
    assert said[1].startswith("held out: x of puck at t = 1.1 s")
    assert len(checked_histories(DISC, train, train)[3]) == 1


def test_a_measured_velocity_is_not_called_computed_for_a_bad_frame() -> None:
    scene, train, test = load(MODELS / "shopping_cart", MODELS / "shopping_cart" / "recorded")
    observed = train.dataset["observed"].to_numpy().copy()
    observed[1, 19, 0, 0] += 0.4
    data = train.dataset.assign(observed=train.dataset["observed"].copy(data=observed))
    _, _, unused, said = checked_histories(scene, History(data), test)
    assert not unused
    assert len(said) == 1


def test_a_file_holds_them_as_missing() -> None:
    clean, _ = without_bad_frames(puck(1, 8))
    mode = fitted(DISC, clean)
    again = recorded(DISC, recording(mode.problem), clean.data_sha256)
    for name in ("observed", "start"):
        assert np.array_equal(
            again.dataset[name].to_numpy(), clean.dataset[name].to_numpy(), equal_nan=True
        )


def test_one_bad_frame_changes_no_mode() -> None:
    """The mass with the row missing is within a standard error of that without a bad frame."""
    whole, left_out = fitted(DISC, puck(1, -1)), fitted(DISC, without_bad_frames(puck(1, 8))[0])
    spread = np.sqrt(np.diagonal(whole.covariance))
    assert (np.abs(left_out.phi - whole.phi) < spread).all()


def test_laws_are_refitted_by_simulations_without_the_frames() -> None:
    """A frame less changes a law within its standard error, and not the likelihood."""
    rng = np.random.default_rng(4)
    train = History.from_dataframe(Disc(trajectories=6, intervals=12, drag=0.8).frame(rng), DISC)
    found = searched(fitted(DISC, train), [one for one in catalogue if one.name == "linear_drag"])
    assert len(found.laws) == 1
    observed = train.dataset["observed"].copy()
    observed[1, 5, 0, 0] = np.nan
    again = found.on(fitted(DISC, History(train.dataset.assign(observed=observed))))
    for mode in (again.declared, again.after):
        assert mode.problem.likelihood.name == "simulation"
    seen = [each.problem.observations.measured.sum() for each in (found.after, again.after)]
    assert seen[0] == seen[1] + 1
    off = again.after.phi - found.after.phi
    assert (np.abs(off) < np.sqrt(np.diagonal(found.after.covariance))).all()


def test_criticise_says_which() -> None:
    said: list[str] = []
    drag = [effect for effect in catalogue if effect.name == "linear_drag"]
    criticise(DISC, puck(1, 8), catalogue=drag, progress=said.append)
    assert any("trajectory 1 is off by" in line for line in said)


def test_the_report_says_which() -> None:
    sentence = "x of puck at t = 0.8 s of trajectory 1 is off by 0.3 m and left out (1 of 105 rows)"
    findings = changed(made_up(), bad_frames=(sentence,) * 9)
    assert sentence in render(findings)
    assert f"Left out: {sentence}" in "\n".join(in_brief(findings, "out"))
    assert findings.to_dict()["bad_frames"] == [sentence] * 9
    assert "Left out" not in render(made_up())
