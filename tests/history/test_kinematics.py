"""Kinematic bodies in histories: their path is the action, and nothing has to explain it."""

import numpy as np
import pytest

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, from_segments
from tests.helpers.pushes import SCENE, WRENCH, pushed, rows

pytestmark = pytest.mark.one_stack


def test_its_path_is_the_action_and_is_not_observed() -> None:
    segments = pushed()[1].segments(5)
    assert segments.step.tolist() == [0, 0]
    step = np.arange(5)
    expected = np.stack([0.1 * (2 * step + 1), 2.0 + 0 * step, 2.0 + 0 * step], axis=-1)
    np.testing.assert_allclose(segments.actions[1, :, 1], expected)
    np.testing.assert_allclose(segments.actions[0, :3, 1], expected[:3])
    np.testing.assert_array_equal(segments.actions[0, 3:], 0.0)
    assert np.isnan(segments.observed[:, :, 1]).all()
    seen = np.isfinite(segments.observed[:, :, 0]).all(axis=-1)
    assert seen.tolist() == [[False, False, True, False, False], [False] * 4 + [True]]


def test_its_velocity_is_the_difference_of_its_positions_unless_given() -> None:
    start = pushed()[1].dataset["start"].to_numpy()
    np.testing.assert_allclose(start[1, :, 1, 3], 0.1 * np.array([1, 3, 5, 7, 9, 9]))
    np.testing.assert_allclose(start[0, :4, 1, 3], 0.1 * np.array([1, 3, 5, 5]))
    assert np.isnan(start[0, 4:]).all()
    table = rows()
    table.loc[table["body"] == "finger", "vx"] = 7.0
    given = History.from_dataframe(table, SCENE)
    assert (given.dataset["start"].to_numpy()[1, :, 1, 3] == 7.0).all()
    np.testing.assert_array_equal(given.segments(5).actions, pushed()[1].segments(5).actions)


def test_an_angle_goes_the_shorter_way_round() -> None:
    table = rows()
    turning = table["body"] == "finger"
    wrapped = np.mod(table.loc[turning, "theta"] + np.pi, 2 * np.pi) - np.pi
    table.loc[turning, "theta"] = wrapped
    actions = History.from_dataframe(table, SCENE).segments(5).actions
    np.testing.assert_allclose(actions[1, :, 1, 2], 2.0)


@pytest.mark.parametrize("column", ["x", "y", "theta"])
def test_a_gap_in_its_path_is_refused(column) -> None:
    table = rows()
    table.loc[11, column] = np.nan
    message = rf'history row 13: {column} of body "finger" is empty in trajectory 1; .* kinematic'
    with pytest.raises(HistoryError, match=message):
        History.from_dataframe(table, SCENE)


def test_it_must_be_recorded() -> None:
    table = rows()
    with pytest.raises(HistoryError, match='"finger" of the scene has no rows'):
        History.from_dataframe(table[table["body"] == "block"], SCENE)
    with pytest.raises(HistoryError, match=r'"finger" has no row at time 0\.2 s in trajectory 0'):
        History.from_dataframe(table.drop(5), SCENE)


def test_segments_make_the_same_history_again() -> None:
    segments = pushed()[1].segments(5)
    given = segments.start, segments.actions, segments.observed
    same = from_segments(SCENE, *given)
    again = same.segments(5)
    for name in ("start", "actions", "observed"):
        np.testing.assert_allclose(getattr(again, name), getattr(segments, name), atol=1e-12)
    # a path is no wrench: nobody is to read it as newtons
    table = same.to_dataframe()
    assert table.loc[table["body"] == "finger", WRENCH].isna().all(axis=None)


@pytest.mark.parametrize("suffix", ["csv", "parquet", "nc"])
def test_files_keep_it(tmp_path, suffix) -> None:
    history = pushed()[1]
    history.save(tmp_path / f"pushes.{suffix}")
    loaded = History.load(tmp_path / f"pushes.{suffix}", SCENE)
    assert loaded.data_sha256 == history.data_sha256
    np.testing.assert_array_equal(loaded.segments(5).actions, history.segments(5).actions)
    assert history.select([1]).segments(5).n == 1
