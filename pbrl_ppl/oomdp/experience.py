"""Transitions of one body, or of a class, by condition, and a regression for each condition."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.oomdp.regression import Regression

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Experience:
    """Observed transitions of a body or a class, assigned to effect models by condition.

    See section 3.1.3 of the paper.

    Distances are in units of each input's standard deviation over all conditions, so that one with
    few transitions measures them as the others do.

    Parameters
    ----------
    standardise : bool
        Whether they are; otherwise in SI units.
    options : mapping
        Of :class:`Regression`.
    """

    def __init__(self, *, standardise: bool, options: Mapping[str, Any]) -> None:
        self._standardise, self._options = standardise, options
        self._x: list[Array] = []
        self._y: list[Array] = []
        self._rows: dict[bytes, list[int]] = {}
        self._count = 0
        self._models: dict[bytes, Regression] = {}

    def __len__(self) -> int:
        return self._count

    def add(self, x: Array, y: Array, flags: Flags) -> None:
        """Add inputs (n, p), what they led to (n, q), and the predicates then (n, ...)."""
        for key, rows in grouped(flags).items():
            self._rows.setdefault(key, []).extend((rows + self._count).tolist())
        self._x.append(x)
        self._y.append(y)
        self._count += len(x)
        self._models.clear()

    @property
    def counts(self) -> dict[bytes, int]:
        """Transitions in each condition that was observed."""
        return {key: len(rows) for key, rows in self._rows.items()}

    def predict(self, x: Array, flags: Flags) -> Array:
        """Predictions (n, q) at inputs (n, p) under predicates (n, ...); NaN without a model."""
        out = np.full((len(x), self._y[0].shape[1]), np.nan)
        for key, rows in grouped(flags).items():
            if key in self._rows:
                out[rows] = self._model(key)(x[rows])
        return out

    def gains(self) -> Array:
        """Linear effect of inputs in the commonest condition, shape (p, q), by least squares."""
        x, y = self._joined()
        most = max(self._rows.values(), key=len)
        return np.asarray(np.linalg.lstsq(x[most], y[most])[0])

    def _model(self, key: bytes) -> Regression:
        if key not in self._models:
            x, y = self._joined()
            scale = x.std(axis=0) if self._standardise else np.ones(x.shape[1])
            # a constant column says nothing of distances; one of rounding errors is constant, too
            scale = np.where(scale > 1e-9 * abs(x).max(), scale, 1.0)
            rows = self._rows[key]
            self._models[key] = Regression(x[rows], y[rows], scale=scale, **self._options)
        return self._models[key]

    def _joined(self) -> tuple[Array, Array]:
        self._x, self._y = [np.concatenate(self._x)], [np.concatenate(self._y)]
        return self._x[0], self._y[0]


def grouped(flags: Flags) -> dict[bytes, NDArray[np.intp]]:
    """Rows of predicates (n, ...) that agree, by their bits.

    Examples
    --------
    >>> list(grouped(np.array([[True], [False], [True]])).values())
    [array([0, 2]), array([1])]
    """
    found: dict[bytes, list[int]] = {}
    flat = flags.reshape(len(flags), math.prod(flags.shape[1:]))
    for i, bits in enumerate(np.packbits(flat, axis=1)):
        found.setdefault(bits.tobytes(), []).append(i)
    return {key: np.array(rows) for key, rows in found.items()}


def ungrouped(key: bytes, size: int) -> Flags:
    """Predicates (size,) of a key of :func:`grouped`."""
    return np.unpackbits(np.frombuffer(key, dtype=np.uint8), count=size).astype(bool)
