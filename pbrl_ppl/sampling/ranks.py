"""Simulation-based calibration: ranks of true values among posterior draws, and their tests."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from scipy.stats import binom, chisquare

from pbrl_ppl.files import write_atomically
from pbrl_ppl.state import Floats

#: Draws among which a true value is ranked, so that there are 100 ranks.
MOST_DRAWS = 99
#: Central intervals whose coverage is counted.
LEVELS = (0.5, 0.9)
#: How often a right sampler fails the uniformity tests of one calibration; its coverages likewise.
FALSE_ALARM = 0.01


def rank(draws: Floats, truth: float, effective: float) -> tuple[int, int]:
    """Return the rank of a true value among draws, thinned to about independent ones.

    Parameters
    ----------
    draws : ndarray
        Posterior draws of one parameter, shape (draw,), chains joined.
    truth : float
        Value that the data were simulated with.
    effective : float
        Effective sample size of the draws.

    Returns
    -------
    rank, size : int
        How many of the kept draws are below the truth, and how many were kept: at most 99.

    Examples
    --------
    >>> rank(np.arange(1000.0), 250.0, 800.0)
    (25, 99)
    >>> rank(np.arange(1000.0), 250.0, 9.7)
    (2, 9)
    """
    size = int(np.clip(effective, 1, min(MOST_DRAWS, len(draws))))
    # the middles of equal parts
    kept = draws[((np.arange(size) + 0.5) * len(draws) / size).astype(int)]
    return int((kept < truth).sum()), size


def uniformity(position: Floats) -> float:
    """Return the chi-squared p-value that positions are uniform on (0, 1).

    Parameters
    ----------
    position : ndarray
        Places of true values among their draws, shape (replication,).

    Examples
    --------
    >>> even = (np.arange(200) + 0.5) / 200
    >>> round(uniformity(even), 3), uniformity(even**2) < 1e-6
    (1.0, True)
    """
    return float(chisquare(np.histogram(position, bins(len(position)), (0.0, 1.0))[0]).pvalue)


def bins(n: int, *, bins: tuple[int, ...] = (20, 10, 5, 4, 2), a_bin: int = 5) -> int:
    """Return the number of bins for n positions: a divisor of 100, with 5 or more in each.

    ``bins``: numbers of bins, the most first.
    ``a_bin``: ranks a bin, at least.
    """
    return next((b for b in bins if n >= a_bin * b), bins[-1])


def holm(p_values: Floats) -> Floats:
    """Return p-values corrected for their number by Holm's step-down method, shape (m,).

    Examples
    --------
    >>> holm(np.array([0.01, 0.04, 0.5]))
    array([0.03, 0.08, 0.5 ])
    """
    m = len(p_values)
    order = np.argsort(p_values)
    corrected = np.empty(m)
    corrected[order] = np.maximum.accumulate((m - np.arange(m)) * p_values[order])
    return np.minimum(corrected, 1.0)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Ranks of true parameters among the draws of their posteriors, over many replications.

    Parameters
    ----------
    dataset : xarray.Dataset
        Over ``replication`` and ``parameter``: ``rank``, ``size`` (draws ranked among),
        ``position`` (the rank as a place in (0, 1), ties broken at random), ``truth``, ``ess``,
        ``r_hat``; and ``covered``, also over ``level``: whether a central interval holds the truth.
        Over ``parameter``: ``judged``, whether it counts for `passed`. A parameter's unit is that
        of the model; ``log_likelihood`` is the data's. ``attrs`` say what was calibrated.
    failures : tuple of str
        Replications that ended in an error, and which.

    Examples
    --------
    >>> right = Calibration.of(np.arange(200)[:, None] % 100, np.full((200, 1), 99), ["mass[puck]"])
    >>> right.passed, float(right.table()["coverage_90"].iloc[0])
    (True, 0.9)
    """

    dataset: xr.Dataset
    failures: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        rank: Floats,
        size: Floats,
        parameters: list[str],
        *,
        judged: Collection[str] | None = None,
        replication: Floats | None = None,
        failures: tuple[str, ...] = (),
        attrs: dict[str, object] | None = None,
        **others: Floats,
    ) -> Calibration:
        """Return a calibration of ranks and numbers of draws, shape (replication, parameter) each.

        Parameters
        ----------
        rank, size : ndarray
            As from :func:`rank`.
        parameters : list of str
            Their names.
        judged : collection of str, optional
            Those that count for `passed`; all by default.
        replication : ndarray, optional
            Their numbers.
        failures : tuple of str
            Replications that are not among these.
        attrs : dict, optional
            What was calibrated.
        **others : ndarray
            Further variables, same shape.
        """
        numbers = np.arange(len(rank)) if replication is None else replication
        # ranks among fewer draws than 99 are spread over (0, 1) evenly; a generator for each
        # replication, so that the order and number of the others do not matter
        spread = [np.random.default_rng(int(i)).random(len(parameters)) for i in numbers]
        position = (rank + np.reshape(spread, np.shape(rank))) / (size + 1)
        off = np.abs(position - 0.5)[:, :, None]
        dims = ("replication", "parameter")
        variables = {"rank": rank, "size": size, "position": position, **others}
        dataset = xr.Dataset(
            {name: (dims, value) for name, value in variables.items()}
            | {"covered": ((*dims, "level"), off < np.array(LEVELS) / 2)}
            | {"judged": ("parameter", [judged is None or name in judged for name in parameters])},
            {"replication": numbers, "parameter": parameters, "level": list(LEVELS)},
            attrs or {},
        )
        return cls(dataset, failures)

    def table(self) -> pd.DataFrame:
        """Return one row a parameter: tests of uniform ranks, coverage and its limits, convergence.

        Returns
        -------
        pandas.DataFrame
            ``p_value`` and, corrected for the number of parameters, ``p_holm``; ``coverage_50``,
            ``coverage_90`` and their binomial limits ``low_``, ``high_``, which hold all coverages
            of the table together in 99 % of calibrations of a right sampler; the smallest ``ess``
            and largest ``r_hat`` of a replication, where known; ``passed``, and ``judged``, whether
            it counts for :attr:`passed`.
        """
        data = self.dataset
        names = [str(name) for name in data["parameter"].values]
        p_values = np.array([uniformity(column) for column in data["position"].values.T])
        table = pd.DataFrame({"p_value": p_values, "p_holm": holm(p_values)}, index=names)
        table.index.name = "parameter"
        passed = table["p_holm"] >= FALSE_ALARM
        n = data.sizes["replication"]
        share = 1.0 - FALSE_ALARM / (len(names) * len(LEVELS))
        for i, level in enumerate(LEVELS):
            low, high = np.array(binom.interval(share, n, level)) / n
            covered = data["covered"].values[:, :, i].mean(axis=0)
            percent = f"{100 * level:.0f}"
            table[f"coverage_{percent}"] = covered
            table[f"low_{percent}"], table[f"high_{percent}"] = low, high
            passed &= (covered >= low) & (covered <= high)
        if "ess" in data:
            table["ess"] = data["ess"].values.min(axis=0)
            table["r_hat"] = data["r_hat"].values.max(axis=0)
        table["passed"] = passed
        table["judged"] = data["judged"].values
        return table

    @property
    def passed(self) -> bool:
        """Whether every judged parameter passed and no replication failed.

        A right sampler passes in at least 98 % of calibrations: 1 % of false alarms for uniform
        ranks and 1 % for coverage, whatever the number of parameters.
        """
        table = self.table()
        return not self.failures and bool(table.loc[table["judged"], "passed"].all())

    def save(self, path: str | Path) -> None:
        """Write the dataset to a NetCDF file, whole or not at all.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        data = self.dataset.assign_attrs(failures="\n".join(self.failures))
        write_atomically(Path(path), lambda to: data.to_netcdf(to, engine="h5netcdf"))
