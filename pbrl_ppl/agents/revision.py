"""Criticism during an episode: stepwise selection of effects from few transitions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

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
    with_effects,
)
from pbrl_ppl.effects import Attached, Effect, Noise, Structure, candidates
from pbrl_ppl.modes import Mode, find_mode
from pbrl_ppl.parameters import prior_slopes
from pbrl_ppl.state import Floats

#: Returns the mode of a model with these effects.
Search = Callable[[tuple[Attached, ...]], Mode]

#: Largest number of added effects: an episode is short.
_MOST_ADDED = 3
#: Log-likelihoods of few transitions that differ by less do not decide between effects; the
#: catalogue's order does, simpler effects first (nats; a score of 10, as in `inseparable`).
_TIE = 5.0
#: Up to this many transitions all candidates are refitted, whatever their scores, because the
#: declared model may fit badly; a refit counts if it explains this share of the squared residuals.
_FEW, _DECISIVE = 16, 0.99
#: Precision of a uniform angle, as if it were normal (1/rad^2).
_CIRCLE = 3.0 / np.pi**2


@dataclass(frozen=True)
class Revision:
    """Effect that an agent added to its model during an episode.

    Parameters
    ----------
    attached : Attached
        The effect, and the body that it acts on.
    transitions : int
        Number of transitions observed when it was first added.
    p_value : float
        p-value of the score test, or of the share of the misfit that a refit explains, corrected
        for the candidates and for their grid points.
    elpd_difference, elpd_difference_se : float
        Gain in cross-validated log predictive density, and its standard error (nats).
    not_separable_from : tuple of str
        Effects that the data cannot separate from it.
    """

    attached: Attached
    transitions: int
    p_value: float
    elpd_difference: float
    elpd_difference_se: float
    not_separable_from: tuple[str, ...]

    @property
    def effect(self) -> str:
        """Return the name of the effect."""
        return self.attached.effect.name

    @property
    def body(self) -> str:
        """Return the name of the body."""
        return self.attached.body


def select_effects(
    search: Search,
    declared: tuple[Attached, ...],
    added: tuple[Revision, ...],
    catalogue: Iterable[Effect],
    *,
    level: float,
    floor: Floats,
) -> tuple[tuple[Revision, ...], Mode]:
    """Return the effects that a declared model lacks, and the mode with them.

    Stepwise selection starts from the effects added before. Each of these is tested again with the
    later data, and is dropped or replaced if they say so.

    Parameters
    ----------
    search : callable
        Fits a model with these effects to single transitions, whose starts are exact (Eq. 11).
    declared : tuple of Attached
        Effects of the declared model.
    added : tuple of Revision
        Effects added before.
    catalogue : iterable of Effect
        Candidates. Effects of the structure stage, whose search takes too long, and of the noise
        stage, which would take misfit for noise, are not tried.
    level : float
        Significance level, corrected for the candidates.
    floor : ndarray
        Errors up to this are the engine's, and carry no information, shape (body, 6), SI units.

    Returns
    -------
    tuple of Revision
        In the order in which they were added.
    Mode
        Mode of the model with them.
    """
    tried = tuple(each for each in catalogue if not isinstance(each.stage, Structure | Noise))
    step = _Step(search, tried, level, floor)
    mode, found = search((*declared, *(each.attached for each in added))), added
    for each in added:
        others = tuple(other for other in found if other is not each)
        kept = tuple(one for one in mode.problem.physics.effects if one != each.attached)
        problem, phi = with_effects(mode, kept)
        lacking = find_mode(problem, initial=phi)
        better = step.addition(lacking, {each.attached: mode})
        if better is not None and better.revision.attached != each.attached:
            found, mode = (*others, better.revision), better.mode
        elif not _is_worth_adding(step.gain(mode, lacking)):
            found, mode = others, search((*declared, *(other.attached for other in others)))
    while len(found) < _MOST_ADDED and not _is_exact(mode, floor):
        more = step.addition(mode, {})
        if more is None:
            break
        found, mode = (*found, more.revision), more.mode
    return found, mode


def _is_exact(mode: Mode, floor: Floats) -> bool:
    """Return whether a model predicts its data up to the engine's error."""
    columns = list(mode.problem.observations.columns)
    residual = mode.problem.residual(mode.phi)[..., columns]
    return bool((np.nan_to_num(abs(residual), nan=np.inf) <= floor[:, columns]).all())


class _Addition(NamedTuple):
    """An effect added, and the mode with it."""

    revision: Revision
    mode: Mode


class _Refit(NamedTuple):
    """A mode with a candidate, and the p-value of the share of the misfit that it explains."""

    mode: Mode
    p_value: float


@dataclass(frozen=True)
class _Step:
    """Step of the selection; fields as the arguments of :func:`select_effects`."""

    search: Search
    catalogue: tuple[Effect, ...]
    level: float
    floor: Floats

    def addition(self, mode: Mode, known: Mapping[Attached, Mode]) -> _Addition | None:
        """Return the best candidate that cross-validation confirms, or None.

        ``known`` has modes with a candidate from earlier searches.
        """
        missing = candidates(mode.problem.scene, mode.problem.physics.effects, self.catalogue)
        ranked = rank_candidates(mode, missing)
        order = {each: missing.index(each.attached) for each in ranked}
        by_name = sorted(ranked, key=order.__getitem__)
        p_values = {each: _p_value(mode, each) for each in ranked}
        significant: list[Signature] = []  # the first of a tie in the catalogue
        for each in by_name:
            p_value = p_values[each] * len(ranked)
            if p_value < self.level and not any(twins(each, other) for other in significant):
                significant.append(each)
        leading = sorted(significant, key=ranked.index)[:TRIED]
        fits = {each: known.get(each.attached) or _fit_with(mode, each) for each in leading}
        if mode.problem.segments.n <= _FEW:  # scores far from the mode are unreliable
            for each, refit in self._decisive_refits(mode, by_name).items():
                p_values[each] = min(p_values[each], refit.p_value)
                fits[each] = _higher(fits.get(each, refit.mode), refit.mode)
            leading = sorted(fits, key=lambda each: -fits[each].log_posterior)[:TRIED]
        if not leading:
            return None
        searched = {each for each in leading if each.attached in known}

        def search(signature: Signature) -> None:
            """Search for a higher mode than the one found from the score's estimate."""
            if signature not in searched:
                searched.add(signature)
                whole = self.search((*mode.problem.physics.effects, signature.attached))
                fits[signature] = _higher(fits[signature], whole)

        # a local mode must not decide against the best score, or the simplest effect that the data
        # cannot separate from it
        alike = {leading[0].attached.effect.name, *inseparable(leading[0], leading)}
        search(leading[0])
        search(min((x for x in leading if x.attached.effect.name in alike), key=order.__getitem__))
        scores = {each: _score(fits[each], each, self.floor) for each in leading}
        while scores:
            top = max(scores.values())
            tied = [each for each, score in scores.items() if score > top - _TIE]
            best = min(tied, key=order.__getitem__)
            del scores[best]
            gained = self.gain(fits[best], mode)
            if _is_worth_adding(gained):
                revision = Revision(
                    best.attached,
                    mode.problem.segments.n,
                    min(1.0, p_values[best] * len(missing)),
                    gained.total,
                    gained.error,
                    inseparable(best, ranked),
                )
                search(best)
                return _Addition(revision, fits[best])
        return None

    def _decisive_refits(self, mode: Mode, by_name: list[Signature]) -> dict[Signature, _Refit]:
        """Return significant refits that explain nearly all of the misfit, without duplicates."""
        before = float((mode.whitened_residual**2).sum())
        found: dict[Signature, _Refit] = {}
        for signature in by_name:
            if not any(twins(signature, earlier) for earlier in found):
                refit = _fit_with(mode, signature, estimate=False)
                after = float((refit.problem.whitened(refit.phi, mode.sigma) ** 2).sum())
                share = 1.0 - after / before
                p_value = _p_value_of_share(mode, signature, share)
                if share > _DECISIVE and p_value * len(by_name) < self.level:
                    found[signature] = _Refit(refit, p_value)
        return found

    def gain(self, mode: Mode, without: Mode) -> Change:
        """Return the gain in cross-validated log predictive density."""
        return gain(_floored(without, self.floor), _floored(mode, self.floor))


def _higher(first: Mode, second: Mode) -> Mode:
    """Return the mode with the higher log-posterior, the first of a tie."""
    return max(first, second, key=lambda mode: mode.log_posterior)


def _p_value(mode: Mode, signature: Signature) -> float:
    """Return the p-value of a score statistic."""
    total = float((mode.whitened_residual**2).sum())
    return _p_value_of_share(mode, signature, min(signature.candidate.statistic / total, 1.0))


def _p_value_of_share(mode: Mode, signature: Signature, share: float) -> float:
    """Return the p-value of an explained share of squares (beta distribution: noise is unknown)."""
    q = signature.basis.shape[1]
    size = np.linalg.norm(mode.jacobian, axis=0)  # by a parameter's unit
    rank = np.linalg.matrix_rank(mode.jacobian / np.where(size > 0, size, 1.0))
    free = np.count_nonzero(mode.whitened_residual) - rank - q
    if q == 0 or free < 1 or share <= 0.0:
        return 1.0
    return float(min(1.0, signature.candidate.looks * beta.sf(share, q / 2, free / 2)))


def _fit_with(mode: Mode, signature: Signature, *, estimate: bool = True) -> Mode:
    """Return the mode with the candidate, from the score's estimate or its prior's centre."""
    attached = signature.attached
    sizes = {attached: np.array(list(signature.candidate.estimate.values()))} if estimate else {}
    problem, phi = with_effects(mode, (*mode.problem.physics.effects, attached), sizes)
    return find_mode(problem, initial=phi)


def _score(mode: Mode, signature: Signature, floor: Floats) -> float:
    """Return the log-likelihood minus half the log number of transitions per parameter (BIC)."""
    problem, sigma = mode.problem, _floored_noise(mode, floor)
    likelihood = problem.log_density(problem.residual(mode.phi), sigma, mode.phi).sum()
    return float(likelihood - 0.5 * signature.candidate.dof * np.log(problem.segments.n))


def _is_worth_adding(gained: Change) -> bool:
    return gained.total >= DEFAULT.min_elpd and gained.certain(DEFAULT.min_elpd_se)


def _floored_noise(mode: Mode, floor: Floats) -> Floats:
    """Return the noise of each measured dimension, at least the engine's error of any body."""
    columns = list(mode.problem.observations.columns)
    return np.asarray(np.maximum(mode.sigma, floor.min(axis=0)[columns]))


def _floored(mode: Mode, floor: Floats) -> Mode:
    """Return a mode whose noise is at least the engine's error, which bounds its certainty."""
    sigma = _floored_noise(mode, floor)
    if (sigma == mode.sigma).all():
        return mode
    priors, p = mode.problem.layout.priors, len(mode.phi)
    jacobian = mode.jacobian.reshape(-1, len(sigma), p) * (mode.sigma / sigma)[:, None]
    jacobian = jacobian.reshape(-1, p)
    precision = jacobian.T @ jacobian + np.diag(prior_slopes(priors, mode.phi) ** 2)
    angles = [i for i, prior in enumerate(priors) if prior.family == "von_mises"]
    precision[angles, angles] += _CIRCLE
    size = np.sqrt(np.diag(precision))
    size = np.where(size > 0, size, 1.0)  # by a parameter's unit
    scaled = precision / np.outer(size, size)
    covariance = np.linalg.pinv(scaled, hermitian=True) / np.outer(size, size)
    return replace(mode, sigma=sigma, jacobian=jacobian, covariance=covariance)
