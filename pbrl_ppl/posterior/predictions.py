"""Which draws the predictions in a posterior file were made with."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Ints = NDArray[np.intp]

#: Predictions are stored for so many draws: of many cells for fewer, or they would fill the file.
_MOST, _LEAST, _NUMBERS = 200, 50, 2_000_000


def predictive_rows(chains: int, draws: int, cells: int) -> Ints:
    """Draws to predict with: equally many of each chain, evenly spread, the last among them.

    Parameters
    ----------
    chains, draws : int
        Of the posterior; draws of each chain.
    cells : int
        Numbers that one prediction has.

    Returns
    -------
    ndarray
        Shape (chain, draw): indices of the draws, chains joined.
    """
    wanted = int(np.clip(_NUMBERS // max(cells, 1), _LEAST, _MOST))
    each = min(draws, -(-wanted // chains))
    own = np.linspace(draws - 1, 0, each).astype(int)[::-1]
    return np.asarray(draws * np.arange(chains)[:, None] + own)


def predicted_rows(posterior: xr.Dataset, predictive: xr.Dataset) -> Ints:
    """Draws that stored predictions were made with.

    Parameters
    ----------
    posterior, predictive : Dataset
        The two groups of a fit.

    Returns
    -------
    ndarray
        Indices of the draws, chains joined: one a prediction, chains of these joined too.
    """
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    own, label = predictive.indexes["draw"], posterior.indexes["draw"]
    if predictive.sizes["chain"] == chains and own[-1] == label[-1]:
        places = label.get_indexer(own)
        return np.asarray((draws * np.arange(chains)[:, None] + places).ravel())
    # files of older versions number the predictions of all chains through
    return np.linspace(0, chains * draws - 1, len(own)).astype(int)
