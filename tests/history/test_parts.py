"""Pieces drawn from a long recording: which, how many, and what they keep."""

import numpy as np
import pytest

from pbrl_ppl.cli import options
from pbrl_ppl.history import MOST_TRANSITIONS, History, drawn_pieces
from pbrl_ppl.scene import Body, Scene, Shape

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
