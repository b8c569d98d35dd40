"""Gaps of a recording: rows in which bodies were not seen."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pbrl_ppl.history.history import History

Bools = npt.NDArray[np.bool_]


def unseen(history: History) -> Bools:
    """Which bodies were not seen in a row, shape (trajectory, time, body).

    A trajectory's first row has a state, and a body that follows a path is where that says.
    """
    dataset = history.dataset
    hidden = ~np.isfinite(dataset["observed"].to_numpy()).any(axis=-1)
    hidden[:, 0] = False
    hidden[..., dataset["kinematic"].to_numpy()] = False
    rows = np.arange(hidden.shape[1]) < dataset["n_rows"].to_numpy()[:, None]
    return np.asarray(hidden & rows[..., None])


def longest_gap(history: History) -> int:
    """Intervals between rows that show all bodies, in a sparse recording the most; 1 otherwise.

    A recording is sparse if more than half of the steps from one such row to the next skip rows: a
    block that is seen before and after a push, say.
    """
    shown = np.asarray(~unseen(history).any(axis=-1))
    rows = history.dataset["n_rows"].to_numpy()
    gaps = [np.diff(np.flatnonzero(own[:n])) for own, n in zip(shown, rows, strict=True)]
    each = np.concatenate(gaps)
    return int(each.max()) if len(each) and np.median(each) > 1 else 1
