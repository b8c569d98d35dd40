"""Stepwise selection of effects: refit with the leaders, cross-validate, prune."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pbrl_ppl.criticism.criteria import Criteria
from pbrl_ppl.criticism.cross_validation import (
    Change,
    few_trajectories,
    folds,
    forecast_squares,
    leave_out,
    relative_fall,
)
from pbrl_ppl.criticism.forecast import longest_forecast
from pbrl_ppl.criticism.outliers import outliers
from pbrl_ppl.criticism.resolution import with_enough_substeps
from pbrl_ppl.criticism.results import Candidate
from pbrl_ppl.criticism.score import Signature, inseparable, twins
from pbrl_ppl.criticism.structure_search import structure_mode
from pbrl_ppl.effects import Attached, Effect, Noise, Structure, candidates
from pbrl_ppl.modes import Mode, trajectory_evidence, trajectory_mode
from pbrl_ppl.parameters import inside, prior_residual, prior_slopes
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Candidates that are refitted in a round.
TRIED = 4
#: A candidate with less than this share of the leader's statistic waits until that has failed.
WORTH_A_REFIT = 0.5
#: A parameter whose posterior is narrower than this share of its prior has been fitted.
TOLD = 0.7
#: Likelihoods that differ by less do not choose between effects: the catalogue's order does.
TIE = 1.0


@dataclass(frozen=True, eq=False)
class Step:
    """One effect added: its signature, the new mode and what it gained."""

    signature: Signature
    not_separable_from: tuple[str, ...]
    after: Mode
    elpd_difference: float
    elpd_difference_se: float


@dataclass(frozen=True, eq=False)
class Selection:
    """The data and the catalogue that effects are chosen by, and what became of each effect.

    Parameters
    ----------
    scene : Scene
        The declared one.
    catalogue : tuple of Effect
        Effects to consider.
    criteria : Criteria
        When an effect is accepted.
    say : callable
        Told what takes long.
    why : dict of (str, str) to str
        Why an effect on a body was added or not, as the last round that it was tried in has it.
    small : list of Candidate
        Of the last round, the best that is certain and does not matter, if there is one.
    """

    scene: Scene
    catalogue: tuple[Effect, ...]
    criteria: Criteria
    say: Callable[[str], None]
    why: dict[tuple[str, str], str] = field(default_factory=dict, init=False)
    small: list[Candidate] = field(default_factory=list, init=False)

    def missing(self, mode: Mode) -> tuple[Attached, ...]:
        """Candidate effects for a model."""
        return candidates(self.scene, mode.problem.physics.effects, self.catalogue)

    def best_addition(
        self, mode: Mode, ranked: list[Signature], *, provisional: bool = False
    ) -> Step | None:
        """Refit with the leading candidates; the best that held-out data confirm, or None.

        If ``provisional``, one whose fit shows outliers is returned without being confirmed.
        """
        order = [attached.effect.name for attached in self.missing(mode)]
        self.small.clear()

        def rank(item: tuple[Signature, Mode]) -> float:
            signature, fitted = item
            fitting = _told(fitted, signature.attached)
            shown = fitted.problem.trajectory_noise.seen.any(axis=1).sum()
            penalty = 0.5 * fitting * np.log(shown)
            return float(_log_likelihood(fitted) - penalty)

        waiting = self._worth_a_refit(ranked, order)
        while waiting:
            # those far behind the first wait until it has failed
            enough = WORTH_A_REFIT * waiting[0].candidate.statistic
            leading = [
                signature for signature in waiting if signature.candidate.statistic >= enough
            ]
            waiting = [signature for signature in waiting if signature.candidate.statistic < enough]
            fits = [(signature, refitted(mode, signature)) for signature in leading]
            ranks = {item: rank(item) for item in fits}
            ranks = {item: value for item, value in ranks.items() if np.isfinite(value)}
            while ranks:
                best = max(ranks.values())
                tied = [item for item, value in ranks.items() if value > best - TIE]
                item = min(tied, key=lambda pair: order.index(pair[0].attached.effect.name))
                own = ranks.pop(item)
                if provisional and np.isfinite(outliers(item[1])).any():
                    return Step(item[0], (), item[1], np.nan, np.nan)
                step = self._confirm(mode, *item, ranked)
                if step is None:
                    continue
                for (other, _), value in ranks.items():
                    self._note(other, _behind(own - value, step.signature, other))
                for other in waiting:
                    self._note(other, f"too far behind {_named(item[0], other)} to be refitted")
                return step
        return None

    def _worth_a_refit(self, ranked: list[Signature], order: list[str]) -> list[Signature]:
        """Significant candidates, best first; of twins, the one that the catalogue names first.

        The noise's shape is scored and never added: misfit would pass for noise. A scene declares
        it.
        """
        kept: list[Signature] = []
        for signature in sorted(ranked, key=lambda entry: order.index(entry.attached.effect.name)):
            same = [earlier for earlier in kept if twins(signature, earlier)]
            if isinstance(signature.attached.effect.stage, Noise):
                self._note(signature, "the noise's shape is scored and never added: declare it")
            elif signature.candidate.p_value >= self.criteria.try_p:
                # of one that came close before, what it was is better known by that round
                if _key(signature) not in self.why:
                    chance = f"p = {signature.candidate.p_value:.2g}"
                    self._note(signature, f"not significant ({chance})")
            elif same:
                self._note(signature, f"the same as {_named(same[0], signature)} in these data")
            else:
                kept.append(signature)
        kept.sort(key=lambda entry: entry.log_p)
        for signature in kept[TRIED:]:
            self._note(signature, f"behind the {TRIED} that are refitted in a round")
        return kept[:TRIED]

    def _confirm(
        self, mode: Mode, signature: Signature, fitted: Mode, ranked: list[Signature]
    ) -> Step | None:
        """Accept an improvement that cross-validation is sure of and that is not negligible."""
        fitted = with_enough_substeps(fitted, self.say, self.criteria)
        if why := self._implausible(fitted, signature):
            self._note(signature, why)
            return None
        density, forecasts = gains = _gains(mode, fitted)
        if why := self._unsure(mode, fitted, *gains):
            self._note(signature, why)
            return None
        share, negligible = _share(mode, fitted), self.criteria.negligible
        if forecasts.certain(self.criteria.min_elpd_se):
            share = max(share, forecasts.total)
        if share < negligible:
            size = f"changes predictions by {100 * share:.2g} %"
            self._note(signature, f"{size}: less than {100 * negligible:g} % is negligible")
            if not self.small:  # of others it is not known whether they are there beside it
                self.small.append(signature.candidate)
            return None
        self._note(signature, "added")
        step = density.total, density.error
        return Step(signature, inseparable(signature, ranked), fitted, *step)

    def _implausible(self, mode: Mode, signature: Signature) -> str:
        """Why the fitted size of an effect is not accepted; empty if it is."""
        attached = signature.attached
        if not _told(mode, attached):
            return "the data do not inform its size"
        layout = mode.problem.layout
        places = [layout.labels.index(label) for label in attached.labels]
        away = np.abs(prior_residual(layout.priors, mode.phi)[places])
        worst = int(np.argmax(away))
        if away[worst] < self.criteria.far_out:
            return ""
        parameter = attached.effect.parameters[worst]
        size = f"{mode.phi[places[worst]]:.3g} {parameter.unit.removesuffix('1')}".rstrip()
        return (
            f"{parameter.name} = {size} lies {away[worst]:.0f} prior scales out; a wider prior of"
            " the effect would allow it"
        )

    def _unsure(self, before: Mode, after: Mode, density: Change, forecasts: Change) -> str:
        """Why a gain in density, and a fall of forecasts' errors, do not do; empty if they do.

        Runs of a few trajectories are too few and too much alike for a standard error: there the
        evidence decides.
        """
        criteria = self.criteria
        if -forecasts.total > max(criteria.negligible, forecasts.needed(criteria.min_elpd_se)):
            return f"errors of cross-validated forecasts rise by {-100 * forecasts.total:.2g} %"
        if few_trajectories(after):
            return self._without_evidence(before, after)
        needed = max(criteria.min_elpd, density.needed(criteria.min_elpd_se))
        either = any(each.certain(criteria.min_elpd_se) for each in (density, forecasts))
        if density.total >= criteria.min_elpd and either:
            return ""
        gained = f"{density.total:.1f} ± {density.error:.1f} nats"
        return f"cross-validation gains {gained}, {needed:.1f} are needed"

    def _without_evidence(self, before: Mode, after: Mode) -> str:
        """Why neither evidence nor likelihood says that an effect is there; empty if both do.

        The likelihood must rise, too: a declared prior that fits badly is no ground for a name.
        """
        likelihood = _log_likelihood(after) - _log_likelihood(before)
        more = len(after.phi) - len(before.phi)
        chance = float(chi2.sf(2 * max(likelihood, 0.0), max(more, 1)))
        if chance > self.criteria.try_p:
            return f"the likelihood rises by {likelihood:.1f} nats (p = {chance:.2g})"
        labels = before.problem.layout.labels
        added = [i for i, label in enumerate(after.problem.layout.labels) if label not in labels]
        told = [i for i in added if _left_of_prior(after)[i] < TOLD]
        gained = trajectory_evidence(after, told) - trajectory_evidence(before)
        if gained >= self.criteria.min_evidence:
            return ""
        return f"the evidence rises by {gained:.1f} nats, {self.criteria.min_evidence:g} are needed"

    def prune(self, mode: Mode, steps: list[Step]) -> tuple[Mode, list[Step]]:
        """Drop effects that later ones have made unnecessary; what gained most comes first."""
        for step in sorted(steps, key=lambda addition: addition.elpd_difference):
            without = self._without(mode, step.signature.attached)
            if why := self._unsure(without, mode, *_gains(without, mode)):
                self._note(step.signature, f"needless beside later ones: {why}")
                mode = without
                steps = [addition for addition in steps if addition is not step]
        return mode, sorted(steps, key=lambda addition: -addition.elpd_difference)

    def withdraw(self, steps: list[Step]) -> None:
        """Take back what was added: most of what was missing remains with it."""
        for step in steps:
            self._note(step.signature, "withdrawn: most of what is missing remains with it")
        self.small.clear()  # beside what is no longer there

    def explained(self, ranked: list[Signature]) -> tuple[Candidate, ...]:
        """Candidates that say what became of them."""
        return tuple(replace(own.candidate, why=self.why.get(_key(own), "")) for own in ranked)

    def _note(self, signature: Signature, why: str) -> None:
        self.why[_key(signature)] = why

    def _without(self, mode: Mode, effect: Attached) -> Mode:
        kept = tuple(attached for attached in mode.problem.physics.effects if attached != effect)
        problem = mode.problem.with_physics(effects=kept)
        phi = problem.layout.from_layout(mode.problem.layout, mode.phi)
        return trajectory_mode(problem, phi, mode.sigma)


def refitted(mode: Mode, signature: Signature) -> Mode:
    """Mode with the candidate in the model, under the same noise structure."""
    attached = signature.attached
    estimate = np.array(list(signature.candidate.estimate.values()))
    stage = attached.effect.stage
    if isinstance(stage, Structure) and stage.rod is None:  # something to run into
        return structure_mode(mode, attached, estimate)
    effects = (*mode.problem.physics.effects, attached)
    problem = mode.problem.with_physics(effects=effects)
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    phi[[layout.labels.index(label) for label in attached.labels]] = estimate
    return trajectory_mode(problem, inside(layout.priors, phi), mode.sigma)


def _key(signature: Signature) -> tuple[str, str]:
    return signature.candidate.effect, signature.candidate.body


def _named(signature: Signature, beside: Signature) -> str:
    """An effect in words, with its body where the other one's is another."""
    name, body = signature.attached.effect.name.replace("_", " "), signature.attached.body
    return name if body == beside.attached.body else f"{name} on {body}"


def _behind(nats: float, best: Signature, own: Signature) -> str:
    """Why one that was refitted was not taken, but another that fits so much better."""
    if nats < TIE:
        return f"fits no better than {_named(best, own)}, which is simpler"
    return f"fits less well than {_named(best, own)}, by {nats:.1f} nats"


def _gains(before: Mode, after: Mode) -> tuple[Change, Change]:
    """Gain in cross-validated log predictive density, and relative fall of forecasts' errors.

    The forecasts are as long as the recording lets them be; the mean is taken over what was
    measured, each in units of the errors before.
    """
    fold = folds(after)
    models = [leave_out(mode, fold) for mode in (before, after)]
    intervals = longest_forecast(after.problem)
    worse, better = (
        forecast_squares(mode, fold, left_out, intervals)
        for mode, left_out in zip((before, after), models, strict=True)
    )
    return Change.of(models[1].density - models[0].density), relative_fall(worse, better)


def _share(before: Mode, after: Mode) -> float:
    """Share by which one model's innovations exceed another's, in units of the latter's noise."""
    physics = before.problem.physics
    model = after.problem.with_physics(effects=physics.effects, substeps=physics.substeps)
    worse, better = model.whitened(before.phi, after.sigma), after.whitened_residual
    return 1.0 - float(np.sqrt((better**2).sum() / (worse**2).sum()))


def _told(mode: Mode, attached: Attached) -> int:
    """How many of an effect's parameters the data say something of: others fit nothing.

    Where the derivative vanishes, as at a threshold, the posterior cannot tell: what is scanned
    counts.
    """
    problem = mode.problem
    labels = problem.layout.labels
    places = [labels.index(label) for label in attached.labels]
    told = _left_of_prior(mode)[places] < TOLD
    if attached.effect.scan is not None:
        body = problem.scene.body(attached.body)
        looks = np.nan_to_num(attached.effect.scan(problem.scene, problem.data.history, body))
        told |= np.ptp(looks, axis=0) > 0
    return int(told.sum())


def _left_of_prior(mode: Mode) -> Array:
    """Posterior standard deviations in units of the prior's, shape (p,)."""
    slopes = prior_slopes(mode.problem.layout.priors, mode.phi)
    return np.asarray(np.sqrt(np.diag(mode.covariance)) * np.abs(slopes))


def _log_likelihood(mode: Mode) -> float:
    problem = mode.problem
    residual = problem.residual(mode.phi)
    return float(problem.log_density(residual, mode.sigma, mode.phi).sum())
