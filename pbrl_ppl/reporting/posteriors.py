"""What a posterior's report shows: parameters, their diagnostics, predictions, and their plots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import rankdata

from pbrl_ppl.criticism import PriorCheck
from pbrl_ppl.effects import Effect
from pbrl_ppl.parameters import BODY_PARAMETERS, JOINT_ANCHORS
from pbrl_ppl.posterior import (
    DATATREE,
    HDI_PROB,
    SIZE,
    Idata,
    arviz,
    convergence,
    from_groups,
    group,
    loo_pit,
    scalars,
    stored_fields,
)
from pbrl_ppl.reporting import style
from pbrl_ppl.reporting.words import number, plain
from pbrl_ppl.state import Floats, acceleration_unit

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
    good_r_hat, good_ess : float
        R-hat up to which, and effective sample size from which on, chains are good.
    usable_r_hat, usable_ess : float
        Those that are enough for a verdict, and for the first digits of an interval.
    """

    posterior: Idata
    effects: tuple[Effect, ...]
    first: tuple[str, ...] = ()
    good_r_hat: float = 1.01
    good_ess: float = 400.0
    usable_r_hat: float = 1.05
    usable_ess: float = 100.0

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
            style.UNITS.get(place[:-1], "")
            if name == "sigma"
            else acceleration_unit(place[:-1])
            if name.endswith("_acceleration") and name in PARAMETERS
            else units.get(name, "").removesuffix("1")
            for name, _, place in names
        ]
        table["ess"] = ess = table[["ess_bulk", "ess_tail"]].min(axis=1)
        # written so that a value that is not a number counts as bad
        agree = table["r_hat"] <= (self.usable_r_hat if self.weighted else self.good_r_hat)
        enough = ess >= self.good_ess
        table["wrong"] = [
            [f"R-hat {number(r_hat, 4)}"] * (self.chains and not agrees)
            + [f"effective sample size {number(size)}"] * (self.chains and not suffices)
            for r_hat, agrees, size, suffices in zip(
                table["r_hat"], agree, ess, enough, strict=True
            )
        ]
        good = (table["r_hat"] <= self.usable_r_hat) & (ess >= self.usable_ess)
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


def coverage(posterior: Idata) -> dict[str, float]:
    """Return the share of measurements in the central 94 % of leave-one-out predictions.

    By state dimension; those that were not measured are left out.
    """
    pit = loo_pit(posterior)
    inside = (abs(pit - 0.5) < 0.47).astype(float).where(pit.notnull())
    shares = inside.mean([name for name in pit.dims if name != "state"]).dropna("state")
    return {str(name): float(shares.sel(state=name)) for name in shares["state"].values}


def plot_rank(posterior: Idata, parameters: Sequence[str] | None = None) -> Figure:
    """Plot how evenly the ranks of each chain's draws are spread.

    A curve is the share of a chain's draws below each rank, less what an even spread gives. The
    band follows from the effective sample sizes of the chains: chains that agree stay inside it 99
    times of 100.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.
    parameters : sequence of str, optional
        Labels such as ``mass[cart]``; by default those with the worst R-hat.
    """
    if parameters is None:
        parameters = most_interesting(summary(posterior))
    draws = scalars(posterior)[list(parameters)]
    # by chain: chains that differ have few effective draws together
    sizes = [
        convergence(from_groups({"posterior": draws.isel(chain=[i])}, {}))[1]
        for i in range(draws.sizes["chain"])
    ]
    count, even = len(draws.data_vars), np.linspace(0.0, 1.0, 201)
    figure, panels = style.blank_figure(1.7, count, min(count, 2), spare=0.6)
    for axes, (name, values) in zip(panels, draws.items(), strict=False):
        chains = values.to_numpy()
        ranks = np.sort(rankdata(chains).reshape(chains.shape) / chains.size)
        off = [np.searchsorted(each, even, side="right") / each.size - even for each in ranks]
        fewest = min(ess[str(name)] for ess in sizes)
        # Kolmogorov's distance times the root of the size, at 1 %
        edge = 1.63 / float(np.sqrt(max(fewest, 1.0) if np.isfinite(fewest) else 1.0))
        axes.axhspan(-edge, edge, color=style.BAND, zorder=0)
        axes.plot(even, np.transpose(off), linewidth=1.3)
        largest = float(np.abs(off).max())
        top = max(1.4 * edge, 1.1 * largest)
        title = f"{name}{': chains differ' * (largest > edge)}"
        axes.set(title=title, xlabel="rank among all draws", ylim=(-top, top))
    return figure


def plot_prior_check(check: PriorCheck) -> Figure:
    """Plot the measured changes of state over a segment beside those that the prior predicts."""
    bodies, states = check.dataset["body"].values, check.dataset["state"].values
    pairs = [(body, state) for body in bodies for state in states]
    figure, panels = style.blank_figure(1.3, len(pairs), 2, "x", spare=0.8)
    ends = ("whislo", "q1", "med", "q3", "whishi")
    for axes, (body, state) in zip(panels, pairs, strict=False):
        changes = check.dataset.sel(body=body, state=state)
        boxes = [
            {"label": label} | dict(zip(ends, changes[name].to_numpy(), strict=True))
            for label, name in (("prior", "predicted"), ("measured", "measured"))
        ]
        axes.bxp(boxes, orientation="horizontal", showfliers=False, widths=0.5)
        axes.yaxis.set_inverted(True)
        share = float(changes["share_inside"])
        x = f"change in {check.seconds:g} s ({style.UNITS[str(state)]})"
        axes.set(title=f"{state} of {body}: {100 * share:.0f} % as expected", xlabel=x)
    return figure
