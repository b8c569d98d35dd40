"""Partial pooling: hyper-parameters that robots of one kind share, from their single posteriors.

Each single posterior, its prior divided out, is a normal likelihood of that robot's parameter on
the scale on which the prior is normal. The robots' parameters are normal about a mean, with a
spread; both are integrated over, so that few robots give wide answers and not a spread of zero, as
its maximum of likelihood would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import chi2, norm

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.parameters import Layout, Prior, nearest, prior_draws, wheels
from pbrl_ppl.posterior import (
    HDI_PROB,
    Idata,
    labelled_draws,
    layout_of,
    moment_matched,
    scene_of,
    with_priors,
)
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Bools, Floats, wrapped

#: Least precision of a robot's data, as a share of the prior's, that informs the population; less
#: is within the error of a posterior's width.
_INFORMS = 0.2
#: Quantiles: the middle, and the ends of the usual interval.
_MIDDLE, _ENDS = 0.5, ((1 - HDI_PROB) / 2, (1 + HDI_PROB) / 2)
#: Standard deviation of a uniform angle (rad).
_ANY_ANGLE = np.pi / np.sqrt(3)
#: The scales on which priors are normal, by their family.
_SCALES = {"log_normal": "logarithm", "von_mises": "angle"}


@dataclass(frozen=True, eq=False)
class Population:
    """A parameter over robots of one kind, on the scale on which its prior is normal.

    Parameters
    ----------
    weights : ndarray
        Posterior of the spread on its grid, shape (grid,).
    spread : ndarray
        The grid: standard deviations between robots.
    centre, centre_sd : ndarray
        Mean and standard deviation of the kind's mean at each spread, shape (grid,).
    value, value_sd : ndarray
        The same of each robot's parameter, shape (robot, grid).
    p_same : float
        Probability of robots that differ so much if they were the same (Cochran's Q); NaN with
        fewer than two that inform. Called different below 0.05, robots that are the same are in 5 %
        of cases.
    informed : ndarray of bool
        Whose data say something of it, shape (robot,).
    """

    weights: Floats
    spread: Floats
    centre: Floats
    centre_sd: Floats
    value: Floats
    value_sd: Floats
    p_same: float
    informed: Bools

    def mean(self, q: float) -> float:
        """Return a quantile of the kind's mean."""
        return _quantile(self.weights, self.centre, self.centre_sd, q)

    def deviation(self, q: float) -> float:
        """Return a quantile of the spread between robots."""
        return float(np.interp(q, np.cumsum(self.weights), self.spread))

    def robot(self, number: int, q: float) -> float:
        """Return a quantile of a robot's parameter, given all robots' data."""
        return _quantile(self.weights, self.value[number], self.value_sd[number], q)

    def next(self, q: float) -> float:
        """Return a quantile of the parameter of a robot without data."""
        return _quantile(self.weights, self.centre, np.hypot(self.centre_sd, self.spread), q)


def population(
    estimate: Floats,
    sd: Floats,
    *,
    centre: float,
    width: float,
    spread: float,
    least: float = 1e-6,
    most: float = 6.0,
    points: int = 800,
) -> Population:
    """Pool normal likelihoods partially, integrated over mean and spread.

    Parameters
    ----------
    estimate, sd : ndarray
        Of each robot's likelihood, shape (robot,); an infinite ``sd`` says nothing.
    centre, width : float
        Of the kind's mean, normal a priori.
    spread : float
        Scale of the half-normal prior of the standard deviation between robots.
    least : float
        Least spread of the grid, in units of its prior's scale.
    most : float
        The largest.
    points : int
        Points of the grid.

    Examples
    --------
    >>> found = population(np.array([1.0, 1.2, 0.9, 1.1]), np.full(4, 0.02), centre=0.0, width=5.0,
    ...                    spread=1.0)
    >>> round(found.mean(0.5), 2), found.p_same < 1e-6
    (1.05, True)
    """
    informed = np.isfinite(sd)
    tau = spread * np.geomspace(least, most, points)
    estimates = np.where(informed, estimate, 0.0)[:, None]
    precision = 1 / (sd[:, None] ** 2 + tau**2)  # zero of those that say nothing
    total = precision.sum(axis=0) + width**-2
    middle = ((precision * estimates).sum(axis=0) + centre * width**-2) / total
    log_weight = 0.5 * np.log(precision[informed]).sum(axis=0) - 0.5 * np.log(total)
    log_weight -= 0.5 * (precision * (estimates - middle) ** 2).sum(axis=0)
    log_weight -= 0.5 * ((middle - centre) / width) ** 2 + 0.5 * (tau / spread) ** 2
    log_weight += np.log(tau)  # the grid is even in the logarithm
    weights = np.exp(log_weight - log_weight.max())
    # each robot's mean given the spread lies between its estimate and the population's mean
    share = tau**2 * precision
    value = share * estimates + (1 - share) * middle
    variance = (1 - share) * tau**2 + (1 - share) ** 2 / total
    p_same = np.nan
    if informed.sum() > 1:
        inverse = sd[informed] ** -2.0
        common = (inverse * estimate[informed]).sum() / inverse.sum()
        q = (inverse * (estimate[informed] - common) ** 2).sum()
        p_same = float(chi2.sf(q, informed.sum() - 1))
    weights /= weights.sum()
    deviation = np.sqrt(variance)
    return Population(weights, tau, middle, total**-0.5, value, deviation, p_same, informed)


def _quantile(
    weights: Floats, mean: Floats, sd: Floats, q: float, *, nothing: float = 1e-9
) -> float:
    """Return a quantile of a mixture of normals.

    ``nothing``: a point of the grid that is less probable changes no quantile.
    """
    some = weights > nothing
    weights, mean, sd = weights[some] / weights[some].sum(), mean[some], sd[some]
    low, high = float((mean - 9 * sd).min()), float((mean + 9 * sd).max())

    def excess(x: float) -> float:
        return float(weights @ ndtr((x - mean) / sd)) - q

    return float(brentq(excess, low, high, xtol=1e-9 * (high - low)))


def _interval(quantile: Callable[[float], float], labels: tuple[str, str, str]) -> dict[str, float]:
    """Return the median and the ends of the 94 % interval under these labels."""
    return {label: quantile(q) for label, q in zip(labels, (_MIDDLE, *_ENDS), strict=True)}


@dataclass(frozen=True, eq=False)
class Pooled:
    """Robots of one kind: what they share, each one given the others, and the next.

    Parameters
    ----------
    names : tuple of str
        The robots.
    scene : Scene
        For the next robot of the kind: the effects that all of these have, and in ``prior`` what is
        known of the kind.
    populations : mapping of str to Population
        By parameter, such as ``mass[cart]``.
    left_out : tuple of str
        Parameters of effects that some robots have and some lack. Those that lack it had too little
        to be found, so the mean of the others would be too large.
    """

    names: tuple[str, ...]
    scene: Scene
    populations: Mapping[str, Population]
    left_out: tuple[str, ...]
    _families: Mapping[str, tuple[str, float]]
    _single: Mapping[str, Floats]

    def table(self) -> pd.DataFrame:
        """Return one row a parameter, in its unit; the spread is on ``scale`` (logarithms: shares).

        ``mean`` is the median of the kind's mean, ``next`` that of a further robot; with 94 %
        intervals. ``p_same`` as of :class:`Population`, ``informed`` how many robots inform.
        """
        rows = [
            {"parameter": name, "scale": self._families[name][0]}
            | self._natural(name, pooled.mean, ("mean", "mean_low", "mean_high"))
            | _interval(pooled.deviation, ("spread", "spread_low", "spread_high"))
            | self._natural(name, pooled.next, ("next_median", "next_low", "next_high"))
            | {"informed": int(pooled.informed.sum()), "p_same": pooled.p_same}
            for name, pooled in self.populations.items()
        ]
        return pd.DataFrame(rows)

    def robots(self) -> pd.DataFrame:
        """Return one row a robot and parameter: its single posterior, and that given all robots."""
        rows = [
            {
                "robot": robot,
                "parameter": name,
                "single_mean": self._single[name][number, 0],
                "single_sd": self._single[name][number, 1],
                "informed": bool(pooled.informed[number]),
                **self._natural(name, partial(pooled.robot, number), ("median", "low", "high")),
            }
            for name, pooled in self.populations.items()
            for number, robot in enumerate(self.names)
        ]
        return pd.DataFrame(rows)

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON; not a number is None."""
        table = self.table().astype(object)
        return {
            "robots": list(self.names),
            "parameters": table.where(table.notna(), None).to_dict("records"),
            "left_out": list(self.left_out),
        }

    def _natural(
        self, name: str, quantile: Callable[[float], float], labels: tuple[str, str, str]
    ) -> dict[str, float]:
        """Return an interval from the scale of the prior, in the parameter's unit and support."""
        scale, reference = self._families[name]
        found = _interval(quantile, labels)
        if scale == "logarithm":
            return {label: float(np.exp(value)) for label, value in found.items()}
        if scale == "angle":
            return {label: float(wrapped(value + reference)) for label, value in found.items()}
        return found


def pool(
    posteriors: Mapping[str, Idata],
    *,
    spread: float = 0.5,
    effects: Iterable[Effect] = catalogue,
) -> Pooled:
    """Estimate what robots of one kind share from their single posteriors.

    Parameters
    ----------
    posteriors : mapping of str to InferenceData or DataTree
        By robot, two at least, each of the same scene but for priors and effects.
    spread : float
        How different robots of a kind may be: the scale of the half-normal prior of their standard
        deviation, as a share of that of the scene's prior. With few robots it matters.
    effects : iterable of Effect
        Where the names of the models' effects are looked up; add your own to the package's.

    Returns
    -------
    Pooled
        Dependence between parameters is not kept. Truncation is neglected in the population, which
        matters where robots lie within a standard deviation of a bound.

    Raises
    ------
    PosteriorError
        If there are fewer than two posteriors, their scenes differ in bodies or unknowns, or a
        posterior's draws do not vary.
    ValueError
        If ``spread`` is not above 0.

    Examples
    --------
    ::

        robots = {name: pp.load_posterior(f"out/{name}/after.nc") for name in ("cart1", "cart2")}
        pooled = pp.pool(robots)
        pooled.table()
        pp.physics_model(pooled.scene, history_of_cart3)
    """
    if not spread > 0:
        raise ValueError(f"spread is {spread}, expected more than 0")
    if len(posteriors) < 2:
        raise PosteriorError(f"pool: {len(posteriors)} posterior(s), expected at least 2 robots")
    effects = tuple(effects)
    names = tuple(posteriors)
    scenes = [scene_of(idata) for idata in posteriors.values()]
    layouts = [layout_of(idata, effects) for idata in posteriors.values()]
    for name, layout in zip(names, layouts, strict=True):
        if _table1(layout) != _table1(layouts[0]):
            raise PosteriorError(
                f"pool: {name} has the unknowns {', '.join(_table1(layout))}, {names[0]} has"
                f" {', '.join(_table1(layouts[0]))}; expected the same scene"
            )
    drawn = _drawn(names, list(posteriors.values()), layouts)
    shared = [label for label in drawn[0] if all(label in robot for robot in drawn)]
    every = dict.fromkeys(label for robot in drawn for label in robot)
    populations, families, single, priors = {}, {}, {}, {}
    by_layout = {layout: _priors(layout) for layout in layouts}  # most are the same
    every_prior = [by_layout[layout] for layout in layouts]
    for label in shared:
        prior_of = [robot[label] for robot in every_prior]
        draws = [robot[label] for robot in drawn]
        family = layouts[0].priors[layouts[0].labels.index(label)]
        pooled, reference = _pooled(prior_of, draws, spread, family.uniform)
        populations[label] = pooled
        families[label] = (_SCALES.get(prior_of[0].family, "itself"), reference)
        single[label] = np.array(list(map(_moments, prior_of, draws)))
        if pooled.informed.any():
            priors[label] = _next_prior(family, pooled, reference)
    left_out = tuple(label for label in every if label not in shared)
    scene = _scene(scenes, priors, left_out)
    return Pooled(names, scene, populations, left_out, families, single)


def _table1(layout: Layout) -> list[str]:
    """Return the labels of the parameters that are no effect's."""
    return [f"{b.name}[{owner}]" for b in layout.blocks if b.effect is None for owner in b.owners]


def _drawn(
    names: tuple[str, ...], posteriors: list[Idata], layouts: list[Layout]
) -> list[dict[str, Floats]]:
    """Return each robot's draws of its bodies' parameters; equal wheels are described alike."""
    result: list[dict[str, Floats]] = []
    first: Floats | None = None
    for name, idata, layout in zip(names, posteriors, layouts, strict=True):
        posterior = labelled_draws(idata)
        if lacking := [label for label in layout.labels if label not in posterior]:
            raise PosteriorError(f"pool: {name} has no {lacking[0]}, which its scene asks for")
        phi = nearest(layout, layout.columns(posterior))
        first = phi if first is None else first
        phi = nearest(layout, phi, first)  # Table 1 comes first in all
        values = dict(zip(layout.labels, phi.T, strict=True))
        of_bodies = [f"{b.name}[{o}]" for b in layout.blocks if b.of == "body" for o in b.owners]
        for label in of_bodies:
            if not np.ptp(values[label]) > 0:
                raise PosteriorError(f"pool: the draws of {label} of {name} do not vary")
        result.append({label: values[label] for label in of_bodies})
    return result


def _priors(layout: Layout, *, n_draws: int = 4000) -> dict[str, Prior]:
    """Return priors by label; those of a wheel are of the chosen one of its equal descriptions.

    ``n_draws``: draws for the moments of a wheel's prior, folded to one of its equal descriptions.
    """
    priors = dict(zip(layout.labels, layout.priors, strict=True))
    for wheel in wheels(layout):
        if wheel.period < 4:
            drawn = prior_draws(wheel.priors, np.random.default_rng(0), n_draws)
            columns = layout.columns(dict(zip(wheel.labels, drawn.T, strict=True)))
            folded = nearest(layout, columns)[:, list(wheel.places)].T
            for label, x in zip(wheel.labels, folded, strict=True):
                priors[label] = moment_matched(priors[label], x)
    return priors


def _moments(prior: Prior, draws: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of draws, of an angle about its mean direction."""
    if prior.family != "von_mises":
        return float(draws.mean()), float(draws.std())
    mean = float(np.angle(np.exp(1j * draws).mean()))
    return mean, float(wrapped(draws - mean).std())


def _pooled(
    priors: list[Prior], draws: list[Floats], spread: float, free: bool
) -> tuple[Population, float]:
    """Return the population of a parameter, and the angle that its scale is about.

    Natural parameters of a product of normals add up: the data's are differences. Angles are normal
    about their mean direction, as they are where the data inform. A ``free`` angle is uniform a
    priori: what its prior has of concentration is from the choice among a wheel's equal
    descriptions, and about the angle itself.
    """
    matched = [moment_matched(prior, x) for prior, x in zip(priors, draws, strict=True)]
    towards, about = (np.array([one.mu for one in of]) for of in (matched, priors))
    if priors[0].family == "von_mises":
        before, after = (np.array([one.kappa for one in of]) for of in (priors, matched))
        about = towards if free else about
        said = after * np.exp(1j * towards) - before * np.exp(1j * about)
        precision = np.abs(said)
        informed = precision > np.maximum(1.0, _INFORMS * np.abs(before))
        reference = float(np.angle((said * informed).sum())) if informed.any() else 0.0
        estimate = wrapped(np.angle(said) - reference)
        least = priors[int(np.abs(before).argmin())]
        width = _ANY_ANGLE if free else min(_ANY_ANGLE, max(least.kappa, 1e-9) ** -0.5)
        centre = 0.0 if free else float(wrapped(least.mu - reference))
    else:
        before, after = (np.array([one.sigma**-2.0 for one in of]) for of in (priors, matched))
        precision = after - before
        informed, reference = precision > _INFORMS * before, 0.0
        estimate = (towards * after - about * before) / np.where(informed, precision, 1.0)
        least = priors[int(before.argmin())]
        centre, width = least.mu, least.sigma
    sd = np.where(informed, np.where(informed, precision, 1.0) ** -0.5, np.inf)
    pooled = population(estimate, sd, centre=centre, width=width, spread=spread * width)
    return pooled, reference


def _next_prior(
    prior: Prior, pooled: Population, reference: float, *, sharpest: float = 1e6
) -> dict[str, float]:
    """Return hyper-parameters with the median and 94 % interval of a robot without data.

    ``sharpest``: the largest concentration of a von Mises.
    """
    middle, low, high = (pooled.next(q) for q in (_MIDDLE, *_ENDS))
    sigma = (high - low) / float(np.diff(norm.ppf(_ENDS))[0])
    if prior.family == "von_mises":
        return {"mu": float(wrapped(middle + reference)), "kappa": min(sigma**-2, sharpest)}
    lower, upper = (-np.inf, np.inf) if prior.family == "log_normal" else prior.support
    return {"mu": float(np.clip(middle, lower - 5 * sigma, upper + 5 * sigma)), "sigma": sigma}


def _scene(
    scenes: list[Scene], priors: Mapping[str, dict[str, float]], left_out: tuple[str, ...]
) -> Scene:
    """Return the first scene with the effects that all have, and these priors."""
    dropped = {tuple(label.rstrip("]").split("[")) for label in left_out}
    bodies = []
    for body in scenes[0].bodies:
        owners = (body.owner, body.name)  # of Table 1's parameters, and of its effects'
        others = [set(scene.body(body.name).effects) for scene in scenes]
        kept = tuple(name for name in body.effects if all(name in effects for effects in others))
        gone = {name for name, owner in dropped if owner in owners}
        prior = tuple((name, hyper) for name, hyper in body.prior if name not in gone)
        bodies.append(with_priors(replace(body, effects=kept, prior=prior), priors))
    return scenes[0].replace(bodies=tuple(bodies))
