"""Locally weighted regression (Eqs. 3 to 5), and one regression per condition."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from pbrl_ppl.state import Bools, Floats, Ints

#: Predicates of a condition, one flag each.
Key = tuple[bool, ...]

#: Share of the largest eigenvalue of X' W X below which eigenvalues are rounding errors.
_SINGULAR = 1e-13


class Regression:
    """Weighted least squares about each query: ``beta = (X' W X)^-1 X' W y`` (Eqs. 4 and 5).

    The kernel is ``exp(-d^2 / bandwidth)`` of the distance d in units of each column's scale. As in
    the paper, there is no constant term: the prediction at zero is zero.

    A ridge determines beta where the weighted data do not, as far from the data or where they are
    few. It shrinks beta to the unweighted fit of all data, not to zero: that would stop bodies that
    move faster than any in the data. A linear system is reproduced with any ridge.

    Parameters
    ----------
    x : ndarray
        Training inputs, shape (n, p).
    y : ndarray
        Training outputs, shape (n, q).
    neighbours : int
        Number of nearest inputs used, k.
    bandwidth : float
        Lambda, squared units of distance.
    ridge : float
        Share of the trace of ``X' W X``; 0 is Eq. 4. Where ``X' W X`` is then singular (an
        eigenvalue below 1e-13 of the largest), beta is the least-norm solution, with columns in
        units of ``scale``: directions in which the weighted data do not vary predict zero.
    scale : ndarray, optional
        Unit of distance of each column, shape (p,); 1 by default.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(size=(50, 2))
    >>> regression = Regression(x, x @ [[2.0], [-1.0]])
    >>> regression(np.array([[1.0, 1.0]])).round(9)
    array([[1.]])
    """

    def __init__(
        self,
        x: Floats,
        y: Floats,
        *,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        scale: Floats | None = None,
    ) -> None:
        self.scale = np.ones(x.shape[1]) if scale is None else scale
        self.neighbours, self.bandwidth, self.ridge = neighbours, bandwidth, ridge
        self._x = x / self.scale
        self._tree = cKDTree(self._x) if len(x) > neighbours else None
        # a ridge is added to the squares of the singular values
        self._everywhere = np.linalg.lstsq(self._x, y, rcond=max(ridge, _SINGULAR) ** 0.5)[0]
        # X' W X and X' W y are weighted sums of these rows, one per training input
        columns = np.concatenate([self._x, y], axis=1)
        self._products = np.einsum("ni,nj->nij", self._x, columns).reshape(len(x), -1)

    def __call__(self, queries: Floats, *, weights: int = 4_000_000) -> Floats:
        """Return predictions, shape (m, q), at queries of shape (m, p).

        ``weights``: weights computed at a time, to limit memory.
        """
        size = max(1, weights // len(self._x))
        parts = np.array_split(queries / self.scale, max(1, -(-len(queries) // size)))
        return np.concatenate([self._predict(part) for part in parts])

    def _predict(self, at: Floats) -> Floats:
        n, p = at.shape
        products = (self._weights(at) @ self._products).reshape(n, p, self._products.shape[1] // p)
        square, cross = products[..., :p], products[..., p:]
        if not self.ridge:
            beta = np.linalg.pinv(square, rcond=_SINGULAR, hermitian=True) @ cross
            return np.asarray(np.einsum("mp,mpq->mq", at, beta))
        size = np.trace(square, axis1=1, axis2=2) + np.finfo(float).tiny ** 0.5
        added = self.ridge * size[:, None, None]
        beta = np.linalg.solve(square + added * np.eye(p), cross + added * self._everywhere)
        return np.asarray(np.einsum("mp,mpq->mq", at, beta))

    def _weights(self, at: Floats) -> Floats | csr_array:
        """Return weights of the training inputs relative to the nearest's, shape (m, n).

        The factor cancels; without it all weights vanish for a query far from the data.
        """
        if self._tree is None:
            square = cdist(at, self._x, "sqeuclidean")
            nearest = square.min(axis=1, keepdims=True)
            return np.asarray(np.exp(-(square - nearest) / self.bandwidth))
        distance, which = self._tree.query(at, k=np.arange(1, self.neighbours + 1))
        weights = np.exp(-(distance**2 - distance[:, :1] ** 2) / self.bandwidth)
        ends = self.neighbours * np.arange(len(at) + 1)
        return csr_array((weights.ravel(), which.ravel(), ends), shape=(len(at), len(self._x)))


class Experience:
    """Observed transitions of a body or a class, with one regression per condition.

    See section 3.1.3 of the paper. Inputs are triples of two planar components and an angular one,
    the last of them the wrench.

    Parameters
    ----------
    reach : float
        Bounding radius of the body (m).
    standardise : bool
        Whether distances are in units of each input's standard deviation over all conditions;
        otherwise in SI units.
    regression : callable
        :class:`Regression` with its options.
    """

    def __init__(
        self, reach: float, *, standardise: bool, regression: Callable[..., Regression]
    ) -> None:
        self._reach, self._standardise, self._regression = reach, standardise, regression
        self._x: list[Floats] = []
        self._y: list[Floats] = []
        self._rows: dict[Key, list[int]] = {}
        self._count = 0
        self._models: dict[Key, Regression] = {}

    def add(self, x: Floats, y: Floats, flags: Bools) -> None:
        """Add inputs (n, p), outputs (n, q) and predicates (n, ...)."""
        for key, rows in grouped(flags).items():
            self._rows.setdefault(key, []).extend((rows + self._count).tolist())
        self._x.append(x)
        self._y.append(y)
        self._count += len(x)
        self._models.clear()

    @property
    def counts(self) -> dict[Key, int]:
        """Return the number of transitions in each observed condition."""
        return {key: len(rows) for key, rows in self._rows.items()}

    def predict(self, x: Floats, flags: Bools) -> Floats:
        """Return predictions (n, q) at inputs (n, p), predicates (n, ...); NaN if unobserved."""
        out = np.full((len(x), self._y[0].shape[1]), np.nan)
        for key, rows in grouped(flags).items():
            if key in self._rows:
                out[rows] = self._model(key)(x[rows])
        return out

    def gains(self) -> Floats:
        """Return the linear fit of outputs by inputs in the commonest condition, shape (p, q)."""
        x, y = self._joined()
        most = max(self._rows.values(), key=len)
        size = self._sizes(x[most])
        return np.asarray(np.linalg.lstsq(x[most] / size, y[most])[0] / size[:, None])

    def _model(self, key: Key) -> Regression:
        if key not in self._models:
            x, y = self._joined()
            scale = np.ones(x.shape[1])
            if self._standardise:  # a column that is constant, up to rounding errors, by its size
                scale, size = x.std(axis=0), self._sizes(x)
                scale = np.where(scale > 1e-9 * size, scale, size)
            rows = self._rows[key]
            self._models[key] = self._regression(x[rows], y[rows], scale=scale)
        return self._models[key]

    def _sizes(self, x: Floats) -> Floats:
        """Return the largest size of the triple that each column is of, in the column's unit."""
        largest = abs(x).max(axis=0).reshape(-1, 3)
        lever = np.full(len(largest), self._reach)
        lever[-1] = 1 / self._reach  # a torque is a force at the rim
        size = np.maximum(largest[:, :2].max(axis=1), lever * largest[:, 2])
        size = np.where(size > 0, size, 1.0)
        return np.stack([size, size, size / lever], axis=1).ravel()

    def _joined(self) -> tuple[Floats, Floats]:
        self._x, self._y = [np.concatenate(self._x)], [np.concatenate(self._y)]
        return self._x[0], self._y[0]


def grouped(flags: Bools) -> dict[Key, Ints]:
    """Return the rows of predicates (n, ...) that agree, by their flags.

    Examples
    --------
    >>> list(grouped(np.array([[True], [False], [True]])).values())
    [array([0, 2]), array([1])]
    """
    groups: dict[Key, list[int]] = defaultdict(list)
    rows = flags.reshape(len(flags), math.prod(flags.shape[1:])).tolist()
    for i, row in enumerate(rows):
        groups[tuple(row)].append(i)
    return {key: np.array(rows) for key, rows in groups.items()}
