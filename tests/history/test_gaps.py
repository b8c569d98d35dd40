"""Rows in which bodies were not seen."""

import numpy as np
import pytest

from pbrl_ppl.history import History, longest_gap, unseen
from tests.helpers.pushes import SCENE, pushed, rows

pytestmark = pytest.mark.one_stack


def test_a_block_that_was_seen_before_and_after_a_push() -> None:
    _, history = pushed(steps=(4, 6))
    hidden = np.zeros((2, 6, 2), dtype=bool)
    hidden[0, 1:3, 0] = hidden[1, 1:5, 0] = True  # the block; the finger's path is given
    np.testing.assert_array_equal(unseen(history), hidden)
    assert longest_gap(history) == 5


def test_rows_that_are_lost_now_and_then_do_not_make_a_recording_sparse() -> None:
    table = rows(steps=(30,))
    state = ["x", "y", "theta", "vx", "vy", "omega"]
    seen = (table["body"] == "finger") | ~table["step"].between(10, 16)
    finger = table.loc[table["body"] == "finger", state].to_numpy()
    table.loc[table["body"] == "block", state] = np.nan_to_num(finger)
    table.loc[~seen, state] = np.nan
    history = History.from_dataframe(table, SCENE)
    assert unseen(history).sum() == 7
    assert longest_gap(history) == 1
