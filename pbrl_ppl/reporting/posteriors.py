"""What a posterior's report shows: parameters, their diagnostics, predictions, and their plots."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from scipy.stats import rankdata

from pbrl_ppl.criticism import PriorCheck
from pbrl_ppl.effects import Effect
from pbrl_ppl.errors import PosteriorError
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
    groups,
    left_out,
    loo_pit,
    scalars,
    separate,
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


def plot_rank(
    posterior: Idata, parameters: Sequence[str] | None = None, width: float = style.WIDE
) -> Figure:
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
    width : float
        Width of the figure (inches).
    """
    if parameters is None:
        parameters = most_interesting(summary(posterior))
    draws = scalars(posterior)[list(parameters)]
    # by chain: chains that differ have few effective draws together
    sizes = [
        convergence(from_groups({"posterior": draws.isel(chain=[i])}, {}))[1]
        for i in range(draws.sizes["chain"])
    ]
    count = len(draws.data_vars)
    figure, panels = style.blank_figure(width, 1.7, count, min(count, 2), spare=0.6)
    for axes, (name, values) in zip(panels, draws.items(), strict=False):
        chains = values.to_numpy()
        ranks = rankdata(chains).reshape(chains.shape) / chains.size
        fewest = min(ess[str(name)] for ess in sizes)
        size = fewest if np.isfinite(fewest) else 1.0
        edge, largest = style.shares_below(
            axes, {str(i): chain for i, chain in enumerate(ranks)}, size
        )
        top = max(1.4 * edge, 1.1 * largest)
        title = f"{name}{': chains differ' * (largest > edge)}"
        axes.set(title=title, xlabel="rank among all draws", ylim=(-top, top))
    return figure


def plot_prior(posterior: Idata, parameters: Sequence[str], width: float = style.WIDE) -> Figure:
    """Plot posterior densities over those of the prior.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``prior``.
    parameters : sequence of str
        Labels such as ``mass[cart]``.
    width : float
        Width of the figure (inches).
    """
    after, before = scalars(posterior), prior_draws(posterior)
    count = len(parameters)
    columns = min(3, count) if width > style.NARROW else 2
    figure, panels = style.blank_figure(width, 1.5, count, columns, None, spare=0.6, stack=False)
    for axes, name in zip(panels, parameters, strict=False):
        drawn = {
            colour: draws[name].to_numpy().ravel()
            for colour, draws in ((style.PLAIN, before), (style.AFTER, after))
            if name in draws
        }
        low, high = np.quantile(next(iter(drawn.values())), [0.01, 0.99])
        ends = min(low, drawn[style.AFTER].min()), max(high, drawn[style.AFTER].max())
        for colour, values in drawn.items():
            style.density(axes, values, colour, ends, ends)
        axes.set(title=name, yticks=[], ylim=(0.0, None))
    style.legend(figure, style.patches({"prior": style.PLAIN, "posterior": style.AFTER}))
    return figure


def plot_pairs(
    posterior: Idata, parameters: Sequence[str], width: float = style.WIDE, points: int = 800
) -> Figure:
    """Plot some draws of each pair of parameters, with the rank correlation of all."""
    draws = scalars(posterior)
    correlation = rank_correlations(draws, parameters)
    pairs = list(combinations(range(len(parameters)), 2))
    columns = min(3, len(pairs)) if width > style.NARROW else 2
    figure, panels = style.blank_figure(width, 2.0, len(pairs), columns, None, stack=False)
    for axes, (i, k) in zip(panels, pairs, strict=False):
        x, y = (draws[parameters[place]].to_numpy().ravel() for place in (i, k))
        some = slice(None, None, max(1, len(x) // points))
        axes.plot(x[some], y[some], ".", color=style.AFTER, markersize=2, alpha=0.4)
        axes.locator_params(nbins=3)
        axes.tick_params(labelsize=7)
        title = f"{correlation[i, k]:+.2f}".replace("-", "−")
        axes.set(title=title, xlabel=parameters[i], ylabel=parameters[k])
    return figure


def plot_predictions(posterior: Idata, width: float = style.WIDE) -> Figure:
    """Plot the calibration of leave-one-out predictions, one curve a state dimension.

    A curve is the share of measurements below each quantile, less what calibrated predictions give;
    those of independent measurements stay in the band 99 times of 100.
    """
    seen = pit_values(posterior)
    figure, (axes,) = style.blank_figure(width, 3.4)
    axes.set_prop_cycle(style.LINES)
    style.shares_below(axes, seen, min((len(values) for values in seen.values()), default=1))
    x = "position in the prediction: 0 below all draws, 1 above"
    axes.set(xlabel=x, ylabel="share below, less expected")
    if seen:
        style.legend(figure, axes.lines)
    return figure


def plot_pareto(k: Floats, good: float, unit: str, width: float = style.WIDE) -> Figure:
    """Plot Pareto k of every unit left out, and the threshold above which LOO is unreliable."""
    figure, (axes,) = style.blank_figure(width, 2.8)
    high = ~(k <= good)
    axes.axhline(good, color=style.BEFORE, linewidth=1.2, linestyle="--")
    axes.plot(np.flatnonzero(~high), k[~high], ".", color=style.AFTER, markersize=4)
    axes.plot(np.flatnonzero(high), np.nan_to_num(k[high], posinf=2.0), "x", color=style.BEFORE)
    axes.set(xlabel=unit, ylabel="Pareto k")
    return figure


def plot_prior_check(check: PriorCheck) -> Figure:
    """Plot the measured changes of state over a segment beside those that the prior predicts."""
    bodies, states = check.dataset["body"].values, check.dataset["state"].values
    pairs = [(body, state) for body in bodies for state in states]
    figure, panels = style.blank_figure(8.0, 1.3, len(pairs), 2, "x", spare=0.8)
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
