"""Criticism during an episode: stepwise selection of effects from few transitions.

The selection of :mod:`pbrl_ppl.criticism` needs whole trajectories: it filters, smooths and
forecasts along them, and knows the noise from hundreds of transitions. An agent has three to some
tens of separate ones, at first without noise, so that here the noise is unknown in each test, the
engine's error bounds it, and candidates are refitted where scores are far from the mode.
"""

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
    with_effects,
)
from pbrl_ppl.effects import Attached, Effect, Noise, Structure, candidates
from pbrl_ppl.modes import Mode, find_mode, laplace_covariance
from pbrl_ppl.parameters import prior_slopes
from pbrl_ppl.state import Floats

#: Returns the mode of a model with these effects.
Search = Callable[[tuple[Attached, ...]], Mode]


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
    most_added: int = 3,
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
    most_added : int
        Largest number of added effects: an episode is short.

    Returns
    -------
    tuple of Revision
        In the order in which they were added.
    Mode
        Mode of the model with them.
    """
    tried = tuple(effect for effect in catalogue if not isinstance(effect.stage, Structure | Noise))
    selection = _Selection(search, tried, level, floor)
    mode, chosen = search((*declared, *(revision.attached for revision in added))), added
    for revision in added:
        others = tuple(other for other in chosen if other is not revision)
        kept = (one for one in mode.problem.physics.effects if one != revision.attached)
        problem, phi = with_effects(mode, tuple(kept))
        without = find_mode(problem, initial=phi)
        better = selection.addition(without, {revision.attached: mode})
        if better is not None and better[0].attached != revision.attached:
            chosen, mode = (*others, better[0]), better[1]
        elif not _is_worth_adding(selection.gain(mode, without)):
            chosen, mode = others, search((*declared, *(other.attached for other in others)))
    while len(chosen) < most_added and not selection.is_exact(mode):
        more = selection.addition(mode, {})
        if more is None:
            break
        chosen, mode = (*chosen, more[0]), more[1]
    return chosen, mode


@dataclass(frozen=True)
class _Selection:
    """Selection of effects from few transitions; fields as arguments of :func:`select_effects`.

    Parameters
    ----------
    tie : float
        Log-likelihoods of few transitions that differ by less do not decide between effects; the
        catalogue's order does, simpler effects first (nats; a score of 10, as in `inseparable`).
    few : int
        Up to this many transitions all candidates are refitted, whatever their scores, because the
        declared model may fit badly.
    decisive : float
        Such a refit counts if it explains this share of the squared residuals.
    """

    search: Search
    catalogue: tuple[Effect, ...]
    level: float
    floor: Floats
    tie: float = 5.0
    few: int = 16
    decisive: float = 0.99

    def addition(self, mode: Mode, known: Mapping[Attached, Mode]) -> tuple[Revision, Mode] | None:
        """Return the best candidate that cross-validation confirms, and the mode with it.

        ``known`` has modes with a candidate from earlier searches.
        """
        missing = candidates(mode.problem.scene, mode.problem.physics.effects, self.catalogue)
        ranked = rank_candidates(mode, missing)
        order = {signature: missing.index(signature.attached) for signature in ranked}
        by_name = sorted(ranked, key=order.__getitem__)
        p_values = {signature: _p_value(mode, signature) for signature in ranked}
        significant: list[Signature] = []  # the first of indistinguishable ones in the catalogue
        for signature in by_name:
            p_value = p_values[signature] * len(ranked)
            if p_value < self.level and not any(twins(signature, one) for one in significant):
                significant.append(signature)
        leading = sorted(significant, key=ranked.index)[:TRIED]
        fits = {one: known.get(one.attached) or _fit_with(mode, one) for one in leading}
        if mode.problem.segments.n <= self.few:  # scores far from the mode are unreliable
            for signature, (refit, p_value) in self._decisive_refits(mode, by_name).items():
                p_values[signature] = min(p_values[signature], p_value)
                fits[signature] = _higher(fits.get(signature, refit), refit)
            leading = sorted(fits, key=lambda one: -fits[one].log_posterior)[:TRIED]
        if not leading:
            return None
        searched = {signature for signature in leading if signature.attached in known}

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
        scores = {signature: self._score(fits[signature], signature) for signature in leading}
        while scores:
            top = max(scores.values())
            tied = [signature for signature, score in scores.items() if score > top - self.tie]
            best = min(tied, key=order.__getitem__)
            del scores[best]
            gained = self.gain(fits[best], mode)
            if _is_worth_adding(gained):
                p_value = min(1.0, p_values[best] * len(missing))
                revision = Revision(
                    best.attached, mode.problem.segments.n, p_value, gained.total, gained.error,
                    inseparable(best, ranked),
                )  # fmt: skip
                search(best)
                return revision, fits[best]
        return None

    def gain(self, mode: Mode, without: Mode) -> Change:
        """Return the gain in cross-validated log predictive density."""
        return gain(self._floored(without), self._floored(mode))

    def is_exact(self, mode: Mode) -> bool:
        """Return whether a model predicts its data up to the engine's error."""
        columns = list(mode.problem.observations.columns)
        residual = mode.problem.residual(mode.phi)[..., columns]
        return bool((np.nan_to_num(abs(residual), nan=np.inf) <= self.floor[:, columns]).all())

    def _decisive_refits(
        self, mode: Mode, by_name: list[Signature]
    ) -> dict[Signature, tuple[Mode, float]]:
        """Return significant refits that explain nearly all of the misfit, with their p-values."""
        before = float((mode.whitened_residual**2).sum())
        refits: dict[Signature, tuple[Mode, float]] = {}
        for signature in by_name:
            if not any(twins(signature, earlier) for earlier in refits):
                refit = _fit_with(mode, signature, estimate=False)
                after = float((refit.problem.whitened(refit.phi, mode.sigma) ** 2).sum())
                p_value = _p_value(mode, signature, share := 1.0 - after / before)
                if share > self.decisive and p_value * len(by_name) < self.level:
                    refits[signature] = refit, p_value
        return refits

    def _score(self, mode: Mode, signature: Signature) -> float:
        """Return the log-likelihood less half the log number of transitions per parameter (BIC)."""
        problem = mode.problem
        residual, sigma = problem.residual(mode.phi), self._noise(mode)
        likelihood = problem.log_density(residual, sigma, mode.phi).sum()
        return float(likelihood - 0.5 * signature.candidate.dof * np.log(problem.segments.n))

    def _noise(self, mode: Mode) -> Floats:
        """Return the noise of each measured dimension, at least the engine's error of any body."""
        columns = list(mode.problem.observations.columns)
        return np.asarray(np.maximum(mode.sigma, self.floor.min(axis=0)[columns]))

    def _floored(self, mode: Mode) -> Mode:
        """Return a mode whose noise is at least the engine's error, which bounds its certainty."""
        sigma = self._noise(mode)
        if (sigma == mode.sigma).all():
            return mode
        scaled = mode.jacobian.reshape(-1, len(sigma), len(mode.phi))
        jacobian = (scaled * (mode.sigma / sigma)[:, None]).reshape(mode.jacobian.shape)
        priors = mode.problem.layout.priors
        precision = jacobian.T @ jacobian + np.diag(prior_slopes(priors, mode.phi) ** 2)
        covariance = laplace_covariance(priors, precision)
        return replace(mode, sigma=sigma, jacobian=jacobian, covariance=covariance)


def _higher(first: Mode, second: Mode) -> Mode:
    """Return the mode with the higher log-posterior, the first of a tie."""
    return max(first, second, key=lambda mode: mode.log_posterior)


def _p_value(mode: Mode, signature: Signature, share: float | None = None) -> float:
    """Return the p-value of an explained share of squares (beta distribution: noise is unknown).

    The share of the score statistic by default.
    """
    if share is None:
        total = float((mode.whitened_residual**2).sum())
        share = min(signature.candidate.statistic / total, 1.0)
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


def _is_worth_adding(gained: Change) -> bool:
    return gained.total >= DEFAULT.min_elpd and gained.certain(DEFAULT.min_elpd_se)
