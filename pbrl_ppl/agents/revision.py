"""Criticism in the middle of an episode: which effects a model of few transitions lacks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import beta

from pbrl_ppl.criticism import (
    DEFAULT,
    TRIED,
    Change,
    Signature,
    gain,
    inseparable,
    rank_candidates,
    twins,
)
from pbrl_ppl.effects import Attached, Effect, Noise, Structure, candidates
from pbrl_ppl.modes import Mode, find_mode
from pbrl_ppl.parameters import inside, prior_slopes

#: Finds the mode of a model with these effects.
Search = Callable[[tuple[Attached, ...]], Mode]

#: Effects added at most: an episode is short.
MOST_ADDED = 3
#: Log-likelihoods of few transitions that differ by less choose between no effects: the catalogue's
#: order does, in which the simpler goes first (nats; a score of 10, as in `inseparable`).
_TIE = 5.0
#: Up to so many transitions all candidates are refitted, whatever their scores; a refit counts
#: where it explains so much of the squared residuals, for the declared model's own fit may be poor.
_FEW, _DECISIVE = 16, 0.99
#: Precision of an angle of which nothing is known, as if it were normal (1/rad^2).
_CIRCLE = 3.0 / np.pi**2


@dataclass(frozen=True)
class Revision:
    """An effect that an agent added to its model in the middle of an episode.

    Parameters
    ----------
    attached : Attached
        The effect, and the body that it acts on.
    transitions : int
        How many the agent had observed when it first added it.
    p_value : float
        Of the score test, or of the share of the misfit that a refit explains, corrected for the
        candidates and for the looks at each.
    elpd_difference, elpd_difference_se : float
        Gain in cross-validated log predictive density, and its standard error (nats).
    not_separable_from : tuple of str
        Effects that the data could not tell from it.
    """

    attached: Attached
    transitions: int
    p_value: float
    elpd_difference: float
    elpd_difference_se: float
    not_separable_from: tuple[str, ...]

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.attached.effect.name

    @property
    def body(self) -> str:
        """Name of the body."""
        return self.attached.body


def select_effects(
    search: Search,
    declared: tuple[Attached, ...],
    added: tuple[Revision, ...],
    catalogue: Iterable[Effect],
    *,
    level: float,
    floor: float,
) -> tuple[tuple[Revision, ...], Mode]:
    """Effects that a declared model lacks, stepwise from those added before, and the mode.

    Each of those added before has to be earned again: it goes, or another takes its place, when
    later data speak for that.

    Parameters
    ----------
    search : callable
        Fits a model with these effects to single transitions, whose starts are exact (Eq. 11).
    declared : tuple of Attached
        Effects of the declared model.
    added : tuple of Revision
        Effects added before.
    catalogue : iterable of Effect
        Candidates. What adds to the scene takes too long a search, and the noise's shape would let
        misfit pass for noise: neither is tried.
    level : float
        Chance of trying a candidate where nothing is missing.
    floor : float
        Errors up to this are of the engine, and say nothing (SI units).

    Returns
    -------
    tuple of Revision
        In the order in which they were added.
    Mode
        Of the model with them.
    """
    step = _Step(
        search,
        tuple(each for each in catalogue if not isinstance(each.stage, Structure | Noise)),
        level,
        floor,
    )
    mode, found = search((*declared, *(each.attached for each in added))), added
    for each in added:
        others = tuple(other for other in found if other is not each)
        lacking = _without(mode, each.attached)
        better = step.addition(lacking, {each.attached: mode})
        if better is not None and better[0].attached != each.attached:
            found, mode = (*others, better[0]), better[1]
        elif not _worth_it(step.gain(mode, lacking)):
            found = others
            mode = search((*declared, *(other.attached for other in others)))
    while len(found) < MOST_ADDED and not _foretold(mode, floor):
        more = step.addition(mode, {})
        if more is None:
            break
        found, mode = (*found, more[0]), more[1]
    return found, mode


def _foretold(mode: Mode, floor: float) -> bool:
    """Whether a model predicts what it was fitted to up to the engine's own error."""
    residual = mode.problem.residual(mode.phi)[..., list(mode.problem.observations.columns)]
    return bool((np.nan_to_num(abs(residual), nan=np.inf) <= floor).all())


@dataclass(frozen=True)
class _Step:
    """A step of the selection; arguments as of :func:`select_effects`."""

    search: Search
    catalogue: tuple[Effect, ...]
    level: float
    floor: float

    def addition(self, mode: Mode, known: Mapping[Attached, Mode]) -> tuple[Revision, Mode] | None:
        """The best of the leading candidates that cross-validation confirms, and the mode with it.

        ``known`` are modes with a candidate that were found before.
        """
        missing = candidates(mode.problem.scene, mode.problem.physics.effects, self.catalogue)
        ranked = rank_candidates(mode, missing)
        leading = _significant(mode, ranked, missing, self.level)[:TRIED]
        fits = {each: known.get(each.attached) or _climbed(mode, each) for each in leading}
        chances = {each: _p_value(mode, each) for each in ranked}
        if mode.problem.segments.n <= _FEW:  # a score far from the truth says little of so few
            for each, (refit, chance) in _refitted(mode, ranked, missing, self.level).items():
                chances[each] = min(chances[each], chance)
                fits[each] = max(fits.get(each, refit), refit, key=lambda one: one.log_posterior)
            leading = sorted(fits, key=lambda each: -fits[each].log_posterior)[:TRIED]
            fits = {each: fits[each] for each in leading}
        if not leading:
            return None

        def rank(signature: Signature) -> int:
            return missing.index(signature.attached)

        sure = {each for each in leading if each.attached in known}

        def search(signature: Signature) -> None:
            """Look for the top elsewhere than where the climb led."""
            if signature not in sure:
                sure.add(signature)
                whole = self.search((*mode.problem.physics.effects, signature.attached))
                fits[signature] = max(fits[signature], whole, key=lambda each: each.log_posterior)

        # a climb that ends short of the top must not choose another name than the score's, nor
        # than the simplest of those that the data cannot tell from that
        alike = {leading[0].attached.effect.name, *inseparable(leading[0], leading)}
        search(leading[0])
        search(min((each for each in leading if each.attached.effect.name in alike), key=rank))
        heights = {each: _height(fits[each], each, self.floor) for each in leading}
        while heights:
            top = max(heights.values())
            tied = [each for each, height in heights.items() if height > top - _TIE]
            best = min(tied, key=rank)
            del heights[best]
            gained = self.gain(fits[best], mode)
            if _worth_it(gained):
                revision = Revision(
                    best.attached,
                    mode.problem.segments.n,
                    min(1.0, chances[best] * len(missing)),
                    gained.total,
                    gained.error,
                    inseparable(best, ranked),
                )
                search(best)
                return revision, fits[best]
        return None

    def gain(self, mode: Mode, without: Mode) -> Change:
        """Gain in cross-validated log predictive density."""
        return gain(_floored(without, self.floor), _floored(mode, self.floor))


def _significant(
    mode: Mode, ranked: list[Signature], missing: tuple[Attached, ...], level: float
) -> list[Signature]:
    """Significant candidates, best first; of twins, the earlier in the catalogue."""
    kept: list[Signature] = []
    for signature in sorted(ranked, key=lambda each: missing.index(each.attached)):
        chance = _p_value(mode, signature) * len(ranked)
        if chance < level and not any(twins(signature, earlier) for earlier in kept):
            kept.append(signature)
    return sorted(kept, key=ranked.index)


def _refitted(
    mode: Mode, ranked: list[Signature], missing: tuple[Attached, ...], level: float
) -> dict[Signature, tuple[Mode, float]]:
    """Refits that explain nearly all of the misfit, and the chance of that; of twins, the first."""
    before = float((mode.whitened_residual**2).sum())
    found: dict[Signature, tuple[Mode, float]] = {}
    for signature in sorted(ranked, key=lambda each: missing.index(each.attached)):
        if not any(twins(signature, earlier) for earlier in found):
            refit = _climbed(mode, signature, estimate=False)
            after = float((refit.problem.whitened(refit.phi, mode.sigma) ** 2).sum())
            share = 1.0 - after / before
            chance = _chance(mode, signature, share)
            if share > _DECISIVE and chance * len(ranked) < level:
                found[signature] = refit, chance
    return found


def _p_value(mode: Mode, signature: Signature) -> float:
    """Chance of a score statistic where nothing is missing."""
    total = float((mode.whitened_residual**2).sum())
    return _chance(mode, signature, min(signature.candidate.statistic / total, 1.0))


def _chance(mode: Mode, signature: Signature, share: float) -> float:
    """Chance of explaining a share of the squares, by the beta law: few residuals tell no noise."""
    q = signature.basis.shape[1]
    free = np.count_nonzero(mode.whitened_residual) - np.linalg.matrix_rank(mode.jacobian) - q
    if q == 0 or free < 1 or share <= 0.0:
        return 1.0
    return float(min(1.0, signature.candidate.looks * beta.sf(share, q / 2, free / 2)))


def _climbed(mode: Mode, signature: Signature, *, estimate: bool = True) -> Mode:
    """Mode with the candidate, climbed to from the score's estimate or from its prior's centre."""
    attached, old = signature.attached, mode.problem
    problem = old.with_physics(effects=(*old.physics.effects, attached))
    phi = problem.layout.from_layout(old.layout, mode.phi)
    if estimate:
        places = [problem.layout.labels.index(label) for label in attached.labels]
        phi[places] = list(signature.candidate.estimate.values())
    return find_mode(problem, initial=inside(problem.layout.priors, phi))


def _without(mode: Mode, attached: Attached) -> Mode:
    """Mode of the model that lacks an effect, climbed to from the one that has it."""
    kept = tuple(each for each in mode.problem.physics.effects if each != attached)
    problem = mode.problem.with_physics(effects=kept)
    return find_mode(problem, initial=problem.layout.from_layout(mode.problem.layout, mode.phi))


def _height(mode: Mode, signature: Signature, floor: float) -> float:
    """Log-likelihood, less half the logarithm of the number of transitions a parameter."""
    problem, sigma = mode.problem, np.maximum(mode.sigma, floor)
    likelihood = problem.log_density(problem.residual(mode.phi), sigma, mode.phi).sum()
    return float(likelihood - 0.5 * signature.candidate.dof * np.log(problem.segments.n))


def _worth_it(gained: Change) -> bool:
    return gained.total >= DEFAULT.min_elpd and gained.certain(DEFAULT.min_elpd_se)


def _floored(mode: Mode, floor: float) -> Mode:
    """A mode with no less noise than the engine's own: without any it would be certain of all."""
    sigma = np.maximum(mode.sigma, floor)
    if (sigma == mode.sigma).all():
        return mode
    priors, p = mode.problem.layout.priors, len(mode.phi)
    jacobian = mode.jacobian.reshape(-1, len(sigma), p) * (mode.sigma / sigma)[:, None]
    jacobian = jacobian.reshape(-1, p)
    precision = jacobian.T @ jacobian + np.diag(prior_slopes(priors, mode.phi) ** 2)
    angles = [i for i, prior in enumerate(priors) if prior.family == "von_mises"]
    precision[angles, angles] += _CIRCLE
    covariance = np.asarray(np.linalg.pinv(precision, hermitian=True), dtype=float)
    return replace(mode, sigma=sigma, jacobian=jacobian, covariance=covariance)
