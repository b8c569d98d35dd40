"""Pieces drawn from a long recording: which, how many, and what they keep."""

import numpy as np
import pytest

from pbrl_ppl.cli import options
from pbrl_ppl.history import MOST_TRANSITIONS, History, drawn_pieces, thinned
from pbrl_ppl.scene import Body, Scene, Shape, Wall

PUCK = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))


def recording(*rows: int, moving: slice = slice(None)) -> History:
    """Return trajectories of a puck that goes about where it moves, and lies still elsewhere."""
    rng, longest = np.random.default_rng(1), max(rows)
    states = np.full((len(rows), longest, 1, 6), np.nan)
    for states_of_one, n in zip(states, rows, strict=True):
        states_of_one[:n] = rng.normal(scale=1e-4, size=(n, 1, 6))
        states_of_one[:n][moving] += rng.normal(size=(n, 1, 6))[moving]
    times = np.where(np.isfinite(states[:, :, 0, 0]), 5.0 + 0.1 * np.arange(longest), np.nan)
    pushes = rng.normal(size=(len(rows), longest - 1, 1, 3))
    return History.of_arrays(states, PUCK, pushes, times)


def test_a_history_that_is_not_too_long_is_used_as_it_is() -> None:
    history = recording(30, 50)
    assert drawn_pieces(history, 78) == (history, ())


@pytest.mark.parametrize("rows", [(5000,), (400, 3000), (40,) * 60])
def test_pieces_are_of_the_recording_and_no_more_than_asked_for(rows: tuple[int, ...]) -> None:
    history = recording(*rows)
    drawn, said = drawn_pieces(history, 800, seed=3)
    assert 600 < drawn.n_transitions <= 800
    assert f"{drawn.n_transitions} of {history.n_transitions} transitions" in said[0]
    whole, part = history.dataset, drawn.dataset
    for i, n in enumerate(part["n_rows"].to_numpy()):
        assert n <= 101
        of, clock = int(part["number"][i]), part["clock"].to_numpy()[i, :n]
        first = int(np.nanargmin(np.abs(whole["clock"].to_numpy()[of] - clock[0])))
        for name, last in (("observed", n), ("start", n), ("action", n - 1)):
            expected = whole[name].to_numpy()[of, first : first + last]
            assert np.array_equal(part[name].to_numpy()[i, :last], expected, equal_nan=True)
        assert np.isnan(part["action"].to_numpy()[i, n - 1 :]).all()
        assert np.isnan(part["observed"].to_numpy()[i, n:]).all()
        held = whole["action"].to_numpy()[of, first - 1] if first else np.zeros((1, 3))
        assert np.array_equal(part["before"].to_numpy()[i], held)
        assert np.allclose(drawn.elapsed[i, 0], 0.1 * first)
    assert len(set(part["trajectory"].to_numpy())) == drawn.n_trajectories >= 8


def test_the_seed_draws_the_pieces() -> None:
    history = recording(9000)
    first, again, other = (drawn_pieces(history, 800, seed)[0] for seed in (1, 1, 2))
    assert first.data_sha256 == again.data_sha256 != other.data_sha256


def test_rests_are_left_out() -> None:
    drawn, _ = drawn_pieces(recording(9000, moving=slice(4000, 5600)), 800)
    x = drawn.dataset["observed"].to_numpy()[:, :, 0, 0]
    assert (np.nanmax(x, axis=1) - np.nanmin(x, axis=1) > 1.0).all()


def test_no_piece_begins_in_a_gap() -> None:
    history = recording(3000)
    data = history.dataset.copy(deep=True)
    data["start"][:, 600:1250] = np.nan
    drawn, _ = drawn_pieces(History(data), 2000)
    assert np.isfinite(drawn.dataset["start"].to_numpy()[:, 0]).all()
    data["start"][:] = np.nan
    never_whole = History(data)
    assert drawn_pieces(never_whole, 2000) == (never_whole, ())


def test_commands_use_as_many() -> None:
    assert options.MOST_TRANSITIONS == MOST_TRANSITIONS


def swings(*rows: int, step: float = 0.001, period: float = 1.0, noise: float = 1e-4) -> History:
    """Return a puck that goes to and fro, in a row a step, and is pushed by the row's number."""
    rng, longest = np.random.default_rng(0), max(rows)
    states = np.full((len(rows), longest, 1, 6), np.nan)
    pushes = np.zeros((len(rows), longest - 1, 1, 3))
    for states_of_one, n in zip(states, rows, strict=True):
        places = np.cos(2.0 * np.pi * step * np.arange(n) / period)
        states_of_one[:n, 0, 0] = places + rng.normal(scale=noise, size=n)
    pushes[..., 0, 0] = np.arange(longest - 1)
    times = np.where(np.isfinite(states[:, :, 0, 0]), step * np.arange(longest), np.nan)
    return History.of_arrays(states, PUCK.replace(time_step=step), pushes, times)


def test_a_recording_finer_than_its_motion_is_thinned() -> None:
    """Rows are kept, commands averaged, and no trajectory's rows are mixed with another's."""
    history = swings(6001, 3004)
    scene, (thin, other), said = thinned(PUCK.replace(time_step=0.001), history, history)
    step = round(scene.time_step / 0.001)
    assert 2 <= step <= 9 and f"one row in {step}" in said[0]
    assert thin.n_transitions > 990 and thin.dataset.attrs["time_step"] == scene.time_step
    assert thin.data_sha256 == other.data_sha256 != history.data_sha256
    np.testing.assert_array_equal(thin.dataset["n_rows"], [6000 // step + 1, 3003 // step + 1])
    for i, n in enumerate(thin.dataset["n_rows"].to_numpy()):
        for name in ("observed", "start", "clock"):
            kept = history.dataset[name].to_numpy()[i, ::step][:n]
            np.testing.assert_array_equal(thin.dataset[name].to_numpy()[i, :n], kept)
            assert np.isnan(thin.dataset[name].to_numpy()[i, n:]).all()
        pushes = thin.dataset["action"].to_numpy()[i, :, 0, 0]
        np.testing.assert_allclose(pushes[: n - 1], step * np.arange(n - 1) + (step - 1) / 2)
        assert np.isnan(pushes[n - 1 :]).all()


@pytest.mark.parametrize(
    "history",
    [swings(1500), swings(6000, step=0.1), swings(6000, noise=0.0, step=0.1)],
    ids=["short", "no finer than it moves", "exact"],
)
def test_a_recording_that_its_motion_needs_stays(history: History) -> None:
    scene = PUCK.replace(time_step=float(history.dataset.attrs["time_step"]))
    assert thinned(scene, history) == (scene, (history,), ())


def test_a_recording_with_collisions_stays() -> None:
    history = swings(6000)
    walled = PUCK.replace(time_step=0.001, walls=(Wall((-1.0, -1.0), (1.0, -1.0)),))
    assert thinned(walled, history)[2] == ()
