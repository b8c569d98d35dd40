"""Histories of arrays: the same as those of a table with the same numbers, and the same checks."""

import numpy as np
import pytest

from pbrl_ppl.errors import HistoryError, ResamplingWarning
from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.pushes import SCENE, pushed

pytestmark = pytest.mark.one_stack

DT = 0.1
PUCKS = Scene(time_step=DT, bodies=tuple(Body(name, Shape.circle(0.1)) for name in "ab"))


def states(n: int = 3, rows: int = 12) -> np.ndarray:
    """Two pucks that slide, shape (trajectory, row, body, 6)."""
    rng = np.random.default_rng(0)
    speed = rng.normal(size=(n, 1, 2, 3))
    time = DT * np.arange(rows)[:, None, None]
    return np.concatenate([speed * time, np.broadcast_to(speed, (n, rows, 2, 3))], axis=-1)


def test_arrays_and_a_table_make_the_same_history() -> None:
    """Of trajectories of different lengths, with a kinematic body, with gaps and labels."""
    given = pushed()[1]
    data = given.dataset
    labels = data["trajectory"].to_numpy().tolist()
    again = History.of_arrays(data["observed"], SCENE, data["action"], data["clock"], labels=labels)
    assert again.dataset.identical(data)


def test_without_actions_and_times_nothing_pushes_every_time_step() -> None:
    history = History.of_arrays(states(), PUCKS)
    table = history.to_dataframe()
    assert (table["time"] == DT * table["step"]).all()
    assert (history.dataset["action"][:, :-1] == 0.0).all()
    assert History.from_dataframe(table, PUCKS).dataset.identical(history.dataset)
    pushes = np.ones((3, 11, 2, 3))
    shorter = History.of_arrays(states(), PUCKS, pushes).dataset["action"]
    np.testing.assert_array_equal(shorter[:, :-1], pushes)


def test_arrays_are_not_changed_and_velocities_may_be_estimated() -> None:
    given = states()
    given[..., 3:] = np.nan
    before = given.copy()
    history = History.of_arrays(given, PUCKS, estimate_velocities=True)
    np.testing.assert_array_equal(given, before)
    assert not history.dataset["assumed"].any()
    assert History.of_arrays(given, PUCKS).dataset["assumed"][:, 3:].all()
    np.testing.assert_allclose(history.dataset["start"][..., 3:], states()[..., 3:], atol=1e-9)


def test_uneven_times_are_resampled_if_asked() -> None:
    """Uniform motion is interpolated exactly; a trajectory may end before the others."""
    given, times = states(), np.tile(0.8 * DT * np.arange(12), (3, 1))
    given[..., :3] *= 0.8
    given[..., 3:] = np.nan
    times[1, 8:] = np.nan
    with pytest.raises(HistoryError, match=r"history at 0.08 s: 0.08 s since .* expected 0.1 s"):
        History.of_arrays(given, PUCKS, times=times)
    with pytest.warns(ResamplingWarning, match="64 rows were resampled to 48"):
        history = History.of_arrays(given, PUCKS, times=times, resample=True)
    assert history.dataset["n_rows"].to_numpy().tolist() == [9, 6, 9]
    expected = states(rows=9)
    expected[1, 6:], expected[..., 3:] = np.nan, np.nan
    np.testing.assert_allclose(history.dataset["observed"], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": states()[0]}, r"states have shape \(12, 2, 6\), expected .*states\[None\]"),
        ({"actions": np.zeros((3, 5, 2, 3))}, r"actions have shape .* or \(3, 11, 2, 3\)"),
        ({"actions": np.full((3, 12, 2, 3), np.nan)}, 'history at 0 s: force_x of body "a" is emp'),
        ({"times": np.zeros(3)}, r"times have shape \(3,\), expected \(3, 12\) or \(12,\)"),
        ({"times": -DT * np.arange(12)}, "time goes back by 0.1 s in trajectory 0"),
        ({"times": np.full((3, 12), np.nan)}, "trajectory 0 has no times"),
        ({"labels": ["a", "a", "b"]}, "expected 3 different ones"),
        ({"states": np.full((3, 12, 2, 6), np.inf)}, "expected a finite number"),
        ({"states": states(rows=1)}, "trajectory 0 has 1 step; expected at least 2"),
    ],
)
def test_wrong_arrays_are_refused(changes, message) -> None:
    given = {"states": states(), "scene": PUCKS} | changes
    with pytest.raises(HistoryError, match=message):
        History.of_arrays(**given)
