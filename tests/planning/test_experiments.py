"""Suggested experiments: what a first recording cannot separate, the second one does."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from pbrl_ppl.cli import main
from pbrl_ppl.criticism.closing import keep_groups
from pbrl_ppl.criticism.results import Law
from pbrl_ppl.errors import EffectError, GoalError, PosteriorError
from pbrl_ppl.planning import predicted_path
from pbrl_ppl.planning.experiments import (
    Rival,
    Separation,
    fit_rivals,
    kept_groups,
    named_effects,
)
from pbrl_ppl.posterior.record import scene_of
from tests.helpers.free_puck import BOX, fitted, searched
from tests.helpers.one_speed import SIZE, at_one_speed, record
from tests.helpers.stacks import file

DRAGS = ("linear_drag", "quadratic_drag")
#: What is looked for: both, and others that either might be taken for.
LOOKED = [e for e in pp.catalogue if e.name in (*DRAGS, "constant_force", "magnus_force")]
BOUNDS = {"puck": {"force_x": (-6.0, 6.0), "force_y": (-6.0, 6.0)}}
REST = {"puck": (0.0, 0.0, 0.0)}
# few draws are enough to compare models by, and say that they are few
pytestmark = [
    pytest.mark.one_stack,
    pytest.mark.first(4),
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
]


def selected(frame: pd.DataFrame) -> Law:
    """What the loop adds to the model of a box without drag."""
    (law,) = searched(fitted(BOX, frame), tuple(LOOKED)).laws.values()
    return law


def posterior_of(frame: pd.DataFrame, effect: str):
    """A posterior as the loop leaves it where it added this drag."""
    drag = [one for one in pp.catalogue if one.name == effect]
    model = pp.physics_model(
        BOX, pp.History.from_dataframe(frame, BOX), drag, likelihood="trajectories"
    )
    idata = pp.fit(model, method="laplace", draws=50, seed=1, progress=False)
    others = tuple(name for name in DRAGS if name != effect)
    keep_groups(idata, [Law(effect, "puck", not_separable_from=others)])
    return idata


@pytest.fixture(scope="module")
def posterior(make_history):
    """Of the drag that the catalogue names first; the other is true."""
    return posterior_of(at_one_speed(make_history, 1, quadratic_drag=SIZE), "linear_drag")


@pytest.fixture(scope="module")
def suggestion(posterior) -> pp.Suggestion:
    return pp.suggest_actions(posterior, REST, BOUNDS, steps=12, seed=1)


@pytest.mark.one_stack
@pytest.mark.parametrize(
    "truth", [pytest.param("linear_drag", marks=pytest.mark.slow), "quadratic_drag"]
)
def test_the_suggested_experiment_separates_what_a_first_recording_cannot(
    make_history, truth, suggestion
) -> None:
    """The truth is Box2D's; the suggestion is made where the other drag is taken for it."""
    first = at_one_speed(make_history, 1, **{truth: SIZE})
    law = selected(first)
    assert {law.effect, *law.not_separable_from} == {*DRAGS}
    if truth == "linear_drag":
        known = posterior_of(first, "quadratic_drag")
        suggestion = pp.suggest_actions(known, REST, BOUNDS, steps=12, seed=1)
    wrenches = suggestion.wrenches.sel(body="puck").to_numpy()
    assert (np.abs(wrenches) <= (6.0, 6.0, 0.0)).all()
    second = record(make_history, suggestion.start[0], wrenches, 6, 1, **{truth: SIZE})
    law = selected(pd.concat([first, second], ignore_index=True))
    assert law.effect == truth
    assert law.not_separable_from == ()


@pytest.mark.one_stack
def test_a_random_sequence_separates_less(posterior, suggestion) -> None:
    assert suggestion.decisive
    assert suggestion.expected > 2 * suggestion.at_random
    assert {*suggestion.separation["true"].values} == {f"{name} on puck" for name in DRAGS}
    # evaluated again, with draws and sequences that the search has not seen
    rivals = fit_rivals(
        posterior, named_effects(DRAGS, scene_of(posterior), pp.catalogue), pp.catalogue, 8, 99
    )
    judge = Separation(rivals, suggestion.start)
    rng = np.random.default_rng(99)
    held = np.repeat(rng.uniform(-6, 6, (30, 6, 1, 2)), 2, axis=1)
    others = np.concatenate([held, np.zeros((30, 12, 1, 1))], axis=-1)
    found, _ = judge(np.concatenate([suggestion.wrenches.to_numpy()[None], others]), 8)
    weakest = np.minimum(found[0, 1], found[1, 0])
    assert weakest[0] > weakest[1:].max()


def test_the_same_seed_suggests_the_same(posterior, suggestion) -> None:
    again = pp.suggest_actions(posterior, REST, BOUNDS, steps=12, seed=1)
    np.testing.assert_array_equal(again.wrenches, suggestion.wrenches)
    np.testing.assert_array_equal(again.separation, suggestion.separation)


@pytest.mark.one_stack
def test_nothing_separates_a_model_from_itself(posterior) -> None:
    """Nor do actions at rest, where no drag acts; what parameters absorb is taken off."""
    (one, _) = fit_rivals(
        posterior, named_effects(DRAGS, scene_of(posterior), pp.catalogue), pp.catalogue, 8, 1
    )
    copy = Rival(one.mode, one.mode.draws(np.random.default_rng(2), 8), one.sigma)
    pushes = np.zeros((2, 12, 1, 3))
    pushes[1, :, 0, 0] = 5.0
    found, meeting = Separation((one, copy), np.zeros((1, 6)))(pushes, 8)
    assert not meeting.any()
    # what draws of one posterior differ by, its own width absorbs: 0 but for their number
    assert (np.abs(found) < 1.5).all()
    assert np.allclose(found[:, :, 0], 0.0, atol=1e-3)


@pytest.mark.one_stack
def test_expected_is_what_bayes_factors_are_in_the_mean(posterior) -> None:
    """Against log densities of simulated recordings, where both models are nearly linear."""
    rivals = fit_rivals(
        posterior, named_effects(DRAGS, scene_of(posterior), pp.catalogue), pp.catalogue, 16, 3
    )
    # so little is known of each that it must show in both
    start = np.array([[0.0, 0.0, 0.0, 1.3, 0.0, 0.0]])
    pushes = np.zeros((1, 6, 1, 3))
    judge = Separation(rivals, start)
    expected = judge(pushes, 16)[0][:, :, 0]
    assert (expected[~np.eye(2, dtype=bool)] > 0).all()
    rng, noise = np.random.default_rng(4), _noise(judge, 6)
    factor = np.linalg.cholesky(noise)
    moments = [_moments(judge, i, pushes) for i in range(2)]
    for i, j in ((0, 1), (1, 0)):
        gains = []
        for path in predicted_path(judge.dynamics[i].at(rivals[i].draws), start, pushes)[:, 0, 1:]:
            for _ in range(50):
                data = path.ravel() + factor @ rng.standard_normal(len(factor))
                ours, theirs = (_density(data, mean, noise + cov) for mean, cov in moments)
                gains.append((ours if i == 0 else theirs) - (theirs if i == 0 else ours))
        error = np.std(gains) / np.sqrt(len(rivals[i].draws))
        assert abs(np.mean(gains) - expected[i, j]) < 3 * error + 0.05 * expected[i, j]


def _moments(judge: Separation, rival: int, pushes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a rival's predictions, by many draws."""
    draws = judge.rivals[rival].mode.draws(np.random.default_rng(0), 400)
    dynamics = judge.dynamics[rival]
    cloud = predicted_path(dynamics.at(draws), judge.start, pushes)[:, 0, 1:].reshape(
        len(draws), -1
    )
    return predicted_path(dynamics, judge.start, pushes)[0, 0, 1:].ravel(), np.cov(cloud.T)


def _density(data: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> float:
    off = data - mean
    return float(-0.5 * (off @ np.linalg.solve(cov, off) + np.linalg.slogdet(cov)[1]))


def _noise(judge: Separation, steps: int) -> np.ndarray:
    """Covariance of what is measured of a free body: errors of the start and of steps run on."""
    one = judge.rivals[0]
    coordinates = one.mode.problem.likelihood.noise.coordinates
    errors, step = np.diag(coordinates.errors(one.sigma) ** 2), coordinates.steps(one.sigma)[0]
    flow = np.eye(6)
    flow[:3, 3:] = judge.scene.time_step * np.eye(3)
    state, cov = errors, np.zeros((steps, 6, steps, 6))
    for a in range(steps):
        state = flow @ state @ flow.T + step
        later = state
        for b in range(a, steps):
            cov[b, :, a], cov[a, :, b] = later, later.T
            later = flow @ later
        cov[a, :, a] += errors
    return cov.reshape(6 * steps, 6 * steps)


def test_a_list_of_wrenches_is_kept_to(posterior) -> None:
    """In the body's frame, in whole durations; the same seed plans the same."""
    allowed = pp.ActionSet.box("puck", forces=(0.0, 5.0), torques=(-0.2, 0.2), durations=(0.2, 0.4))
    said = pp.suggest_actions(posterior, REST, allowed, steps=6, seed=2, draws=2)
    wrenches = said.wrenches.sel(body="puck").to_numpy()
    sizes = np.hypot(wrenches[:, 0], wrenches[:, 1])
    assert (np.isclose(sizes, 0.0) | np.isclose(sizes, 5.0)).all()
    assert set(np.abs(wrenches[:, 2])) == {0.2}
    changes = np.flatnonzero(np.diff(wrenches[:, 2])) + 1
    assert (changes % 2 == 0).all()
    # the force turns with the body
    pushed = wrenches[sizes > 1]
    assert np.ptp(np.arctan2(pushed[:, 1], pushed[:, 0])) > 0.01


def test_the_table_is_what_a_history_is_made_of(suggestion, tmp_path) -> None:
    suggestion.to_csv(tmp_path / "next.csv")
    table = pd.read_csv(tmp_path / "next.csv")
    assert len(table) == 13
    np.testing.assert_allclose(
        table["force_x"][:12], suggestion.wrenches.sel(wrench="force_x")[:, 0]
    )
    assert table["x"][1:].isna().all()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("linear_drag",), "two or more"),
        (("linear_drag", "quadratc_drag"), 'did you mean "quadratic_drag"'),
        (("linear_drag", "heavy_tails"), "of the noise"),
        (("linear_drag", "quadratic_drag on cart"), "does not apply to body 'cart'"),
    ],
)
def test_effects_that_cannot_be_are_refused(posterior, names, message) -> None:
    with pytest.raises(EffectError, match=message):
        pp.suggest_actions(posterior, REST, BOUNDS, effects=names)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({"cart": {"force_x": (-1, 1)}}, "no moving body"),
        ({"puck": {"force_z": (-1, 1)}}, "force_z"),
        ({"puck": {"force_x": (1, -1)}}, "lowest and the highest"),
        ({"puck": {"force_x": (2, 2)}}, "nothing may vary"),
    ],
)
def test_bounds_that_cannot_be_are_refused(posterior, bounds, message) -> None:
    with pytest.raises(GoalError, match=message):
        pp.suggest_actions(posterior, REST, bounds)


def test_posteriors_that_do_not_tell_are_refused(posterior) -> None:
    with pytest.raises(PosteriorError, match="single transitions"):
        pp.suggest_actions(pp.load_posterior(file("5")), REST, BOUNDS, effects=DRAGS)
    with pytest.raises(EffectError, match="name two or more"):
        pp.suggest_actions(pp.load_posterior(file("5")), REST, BOUNDS)
    assert kept_groups(posterior) == [("linear_drag on puck", "quadratic_drag on puck")]


def test_the_command_writes_what_the_function_suggests(posterior, tmp_path, capsys) -> None:
    pp.save_posterior(posterior, tmp_path / "after.nc")
    out = tmp_path / "next.csv"
    command = ["suggest", str(tmp_path / "after.nc"), "--start", "0,0,0", "--steps", "8", "-q"]
    command += ["--draws", "2", "--bounds", "force_x=-6,6", "-o", str(out)]
    assert main([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["decisive"]
    assert said["written"] == [str(out)]
    here = pp.suggest_actions(
        pp.load_posterior(tmp_path / "after.nc"), REST, {"puck": {"force_x": (-6, 6)}},
        steps=8, draws=2, seed=1,
    )  # fmt: skip
    assert said["expected_log_bayes_factor"] == here.expected
    there = pd.read_csv(out)
    pd.testing.assert_frame_equal(there, here.to_dataframe(), check_dtype=False, rtol=1e-14)
    assert main(command) == 2  # it exists
    capsys.readouterr()
    # too little to tell them apart: written all the same
    weak = [*command[:-3], "force_x=-0.001,0.001", "-o", str(out), "--overwrite"]
    assert main(weak) == 1
    assert "names one effect alone, which is not to be expected" in capsys.readouterr().out
    assert main([*command[:-3], "force_x=strong", "-o", str(tmp_path / "no.csv")]) == 2
    assert "expected BODY.NAME=LOW,HIGH" in capsys.readouterr().err
    assert not (tmp_path / "no.csv").exists()


def test_words_say_where_nothing_is_to_be_expected(suggestion) -> None:
    weak = replace(suggestion, separation=suggestion.separation * 0 + 1.0)
    assert not weak.decisive
    assert "repeat it 5 times" in weak.sentences[-1]
