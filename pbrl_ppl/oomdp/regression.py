"""Locally weighted regression, Eqs. 3 to 5."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]

#: Weights that are made at a time, to spare memory.
_WEIGHTS = 4_000_000
#: Eigenvalue of X' W X, as a share of the largest, below which it is rounding.
_SINGULAR = 1e-13


class Regression:
    """Weighted least squares about each query: ``beta = (X' W X)^-1 X' W y`` (Eqs. 4 and 5).

    The kernel is ``exp(-d^2 / bandwidth)``, of the distance d in units of each column's scale.
    There is no constant term, as in the paper: where nothing acts, nothing is predicted.

    A ridge settles what the weighted data leave open, as far from the data or where they are few.
    It draws beta to the unweighted fit of all the data, for to draw it to nought would stop what
    moves faster than anything seen; a linear system is reproduced with any ridge.

    Parameters
    ----------
    x : ndarray
        Training inputs, shape (n, p).
    y : ndarray
        What they led to, shape (n, q).
    neighbours : int
        Nearest inputs that count, k.
    bandwidth : float
        Lambda, squared units of distance.
    ridge : float
        As a share of the trace of ``X' W X``; 0 is Eq. 4 as it stands. Where ``X' W X`` is singular
        (an eigenvalue below 1e-13 of the largest), that is its least-norm solution, of beta by
        columns in units of ``scale``: directions in which the weighted data do not vary predict
        nothing.
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
        x: Array,
        y: Array,
        *,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        scale: Array | None = None,
    ) -> None:
        self.scale = np.ones(x.shape[1]) if scale is None else scale
        self.neighbours, self.bandwidth, self.ridge = neighbours, bandwidth, ridge
        self._x = x / self.scale
        self._tree = cKDTree(self._x) if len(x) > neighbours else None
        # the squares of singular values are what a ridge is added to
        self._everywhere = np.linalg.lstsq(self._x, y, rcond=max(ridge, _SINGULAR) ** 0.5)[0]
        # X' W X and X' W y are weighted sums of these, one row a training input
        columns = np.concatenate([self._x, y], axis=1)
        self._products = np.einsum("ni,nj->nij", self._x, columns).reshape(len(x), -1)

    def __call__(self, queries: Array) -> Array:
        """Predictions, shape (m, q), at queries of shape (m, p)."""
        size = max(1, _WEIGHTS // len(self._x))
        parts = np.array_split(queries / self.scale, max(1, -(-len(queries) // size)))
        return np.concatenate([self._predict(part) for part in parts])

    def _predict(self, at: Array) -> Array:
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

    def _weights(self, at: Array) -> Array | csr_array:
        """Weights of the training inputs, shape (m, n); relative to the nearest's, which cancels.

        Otherwise all would vanish for a query far from the data.
        """
        if self._tree is None:
            square = cdist(at, self._x, "sqeuclidean")
            nearest = square.min(axis=1, keepdims=True)
            return np.asarray(np.exp(-(square - nearest) / self.bandwidth))
        distance, which = self._tree.query(at, k=np.arange(1, self.neighbours + 1))
        weights = np.exp(-(distance**2 - distance[:, :1] ** 2) / self.bandwidth)
        ends = self.neighbours * np.arange(len(at) + 1)
        return csr_array((weights.ravel(), which.ravel(), ends), shape=(len(at), len(self._x)))
