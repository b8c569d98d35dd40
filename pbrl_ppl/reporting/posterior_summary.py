"""What a posterior's report shows: parameters, their diagnostics, dependence and predictions."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr

from pbrl_ppl.effects import Effect
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.posterior import (
    DATATREE,
    HDI_PROB,
    SIZE,
    Idata,
    arviz,
    from_groups,
    group,
    groups,
    left_out,
    loo_pit,
    scalars,
    separate,
    stored_fields,
)
from pbrl_ppl.reporting.style import UNITS
from pbrl_ppl.reporting.words import number, plain
from pbrl_ppl.state import Floats, acceleration_unit

#: Chains are good up to this R-hat and from this effective sample size on.
GOOD_R_HAT, GOOD_ESS = 1.01, 400.0
#: Up to these they are good enough for a verdict, and for the first digits of an interval.
USABLE_R_HAT, USABLE_ESS = 1.05, 100.0

#: Of parameters, by the variable's name.
PARAMETERS = {
    "mass": "mass",
    "r": "elasticity in contacts: 0 keeps no speed, 1 all of it",
    "mu_c": "friction where it touches others",
    "w_x": "place of the wheel along the body",
    "w_y": "place of the wheel across the body",
    "w_theta": "direction in which the wheel rolls",
    "mu_x": "friction of the wheel along that direction",
    "mu_y": "friction of the wheel across it",
    "i_a": "number of the first body that a joint joins",
    "i_b": "number of the second; the same one means no joint",
    "a_x": "anchor of a joint on its first body, along it",
    "a_y": "anchor of a joint on its first body, across it",
    "b_x": "anchor of a joint on its second body, along it",
    "b_y": "anchor of a joint on its second body, across it",
    "sigma": "typical error of measuring it (standard deviation)",
    "unexplained_acceleration": "typical acceleration that nothing in the model explains",
    "contact_acceleration": "the same, on top, where bodies touch",
}


@dataclass(frozen=True, eq=False)
class Parameters:
    """Summary of a posterior's parameters and of the chains that it comes from.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.
    effects : tuple of Effect
        Where the names of its effects are looked up.
    first : tuple of str
        Labels of parameters to show first.
    """

    posterior: Idata
    effects: tuple[Effect, ...]
    first: tuple[str, ...] = ()

    @cached_property
    def sampler(self) -> dict[str, object]:
        """What the posterior's record says of its draws: method, weights and proposals."""
        return stored_fields(self.posterior, ("method", "pareto_k", "importance_ess", "proposals"))

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Summary by parameter, with ``unit``, ``meaning``, ``ess``, ``wrong`` and ``failed``.

        ``wrong`` is what is wrong with its draws, in words.
        """
        table = summary(self.posterior)
        units, meanings = {**BODY_PARAMETERS, **JOINT_ANCHORS}, dict(PARAMETERS)
        for effect in self.effects:
            for one in effect.parameters:
                name = effect.variable(one)
                units[name] = one.unit
                meanings.setdefault(name, f"{plain(one.name)} of the effect {plain(effect.name)}")
        names = [label.partition("[") for label in table.index]
        table["meaning"] = [meanings.get(name, "") for name, _, _ in names]
        table["unit"] = [
            UNITS.get(place[:-1], "")
            if name == "sigma"
            else acceleration_unit(place[:-1])
            if name.endswith("_acceleration") and name in PARAMETERS
            else units.get(name, "").removesuffix("1")
            for name, _, place in names
        ]
        table["ess"] = ess = table[["ess_bulk", "ess_tail"]].min(axis=1)
        # written so that a value that is not a number counts as bad
        agree = table["r_hat"] <= (USABLE_R_HAT if self.weighted else GOOD_R_HAT)
        table["wrong"] = [
            [f"R-hat {number(r_hat, 4)}"] * (self.chains and not fine)
            + [f"effective sample size {number(size)}"] * (self.chains and not size >= GOOD_ESS)
            for r_hat, fine, size in zip(table["r_hat"], agree, ess, strict=True)
        ]
        good = (table["r_hat"] <= USABLE_R_HAT) & (ess >= USABLE_ESS)
        table["failed"] = ~good & self.chains
        return table

    @property
    def chains(self) -> bool:
        """Whether there are chains to compare: draws of Laplace's approximation are independent."""
        return self.sampler.get("method") != "laplace"

    @property
    def weighted(self) -> bool:
        """Whether the draws are of importance sampling: R-hat of few of them is often too large."""
        return "importance_ess" in self.sampler

    @property
    def failed(self) -> pd.DataFrame:
        """The parameters that did not converge."""
        return self.summary[self.summary["failed"]]

    @property
    def verdict(self) -> str:
        """Whether the sampler worked, in a word or two."""
        if not self.chains:
            return "No chains."
        if len(self.failed):
            return "Not converged."
        return "Well enough." if self.summary["wrong"].astype(bool).any() else "Yes."


def summary(posterior: Idata) -> pd.DataFrame:
    """Return ArviZ's summary of every scalar parameter, with the same columns on every ArviZ.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.

    Returns
    -------
    pandas.DataFrame
        Columns mean, sd, lower, upper (94 % highest density), ess_bulk, ess_tail, r_hat. The ESS
        of resampled draws is limited by their weights, see `convergence`.
    """
    # the same interval has other names before and after ArviZ 1.0
    options = {"ci_prob": HDI_PROB, "ci_kind": "hdi"} if DATATREE else {"hdi_prob": HDI_PROB}
    with np.errstate(all="ignore"):  # a parameter that never moved has no R-hat
        table = arviz().summary(scalars(posterior), round_to="none", **options)
    names = {table.columns[2]: "lower", table.columns[3]: "upper"}
    columns = ["mean", "sd", "lower", "upper", "ess_bulk", "ess_tail", "r_hat"]
    result: pd.DataFrame = table.rename(columns=names)[columns]
    sizes, most = ["ess_bulk", "ess_tail"], float(posterior.attrs.get(SIZE, np.inf))
    result[sizes] = result[sizes].clip(upper=most)
    return result


def most_interesting(table: pd.DataFrame, added: Iterable[str] = (), most: int = 6) -> list[str]:
    """Return the parameters to look at first: those of added effects, then the worst by R-hat.

    Parameters
    ----------
    table : pandas.DataFrame
        The posterior's :func:`summary`.
    added : iterable of str
        Labels of the added effects' parameters.
    most : int
        As many parameters, at most.
    """
    worst = table["r_hat"].fillna(np.inf).sort_values(ascending=False, kind="stable").index
    first = [name for name in added if name in table.index]
    return list(dict.fromkeys([*first, *worst]))[:most]


def recorded_poses(posterior: Idata) -> Floats | None:
    """Return the recorded poses that a posterior holds, shape (trajectory, time, body, 3).

    None if it holds none, or no positions were measured.
    """
    if "scene" not in posterior.attrs:
        return None
    constants = group(posterior, "constant_data")
    if "recorded_start" in constants:
        poses = constants["recorded_start"].to_numpy()[..., :3]
    else:  # single transitions: the start of each, in order
        poses = constants["start"].to_numpy()[None, ..., :3]
    return np.asarray(poses) if np.isfinite(poses[..., :2]).any() else None


def prior_draws(posterior: Idata) -> xr.Dataset:
    """Return one variable per scalar parameter of the prior; none if there are no prior draws."""
    if "prior" not in groups(posterior):
        return xr.Dataset()
    return scalars(from_groups({"posterior": group(posterior, "prior")}, {}))


def moving(posterior: Idata) -> list[str]:
    """Return the parameters whose draws differ."""
    return [str(name) for name, v in scalars(posterior).items() if float(v.max() - v.min()) > 0]


def most_dependent(posterior: Idata, most: int = 4) -> list[str]:
    """Return the parameters whose draws depend most on each other, by rank correlation."""
    draws, names = scalars(posterior), moving(posterior)
    if len(names) < 2:
        return []
    strength = np.abs(np.nan_to_num(rank_correlations(draws, names)))
    np.fill_diagonal(strength, 0.0)
    chosen = list(divmod(int(strength.argmax()), len(names)))
    while len(chosen) < min(most, len(names)):
        rest = [i for i in range(len(names)) if i not in chosen]
        chosen.append(max(rest, key=lambda i: float(strength[i, chosen].max())))
    return [names[i] for i in chosen]


def rank_correlations(draws: xr.Dataset, names: Sequence[str]) -> Floats:
    """Return rank correlations, shape (parameter, parameter)."""
    table = pd.DataFrame({name: draws[name].to_numpy().ravel() for name in names})
    return np.asarray(table.corr("spearman"))


def pit_values(posterior: Idata) -> dict[str, Floats]:
    """Return where measurements lie in leave-one-out predictions (0 to 1), by state dimension."""
    pit = loo_pit(posterior)
    every = {str(name): pit.sel(state=name).to_numpy().ravel() for name in pit["state"].values}
    seen = {name: values[np.isfinite(values)] for name, values in every.items()}
    return {name: values for name, values in seen.items() if values.size}


def coverage(posterior: Idata) -> dict[str, tuple[float, float, int]]:
    """Return how leave-one-out predictions cover the measurements, by state dimension.

    Shares of measurements in the central 50 % and 94 % of predictions, and their number.
    """
    off = {name: np.abs(values - 0.5) for name, values in pit_values(posterior).items()}
    return {
        name: (float((each < 0.25).mean()), float((each < 0.47).mean()), each.size)
        for name, each in off.items()
    }


def pareto_k(posterior: Idata) -> tuple[Floats, float, str]:
    """Return Pareto k, the threshold above which it is bad, and the unit left out at a time.

    Raises
    ------
    PosteriorError
        If ArviZ cannot compute it.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # ArviZ warns of a high k, which the result shows
        try:
            loo = arviz().loo(separate(posterior), pointwise=True)
        except (TypeError, ValueError, KeyError, IndexError) as error:  # no finite likelihood
            raise PosteriorError(f"leave-one-out cross-validation: {error}") from error
    return np.asarray(loo.pareto_k, dtype=float).ravel(), float(loo.good_k), left_out(posterior)
