"""Stepwise selection of effects: refit with the leaders, cross-validate, prune."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from pbrl_ppl.criticism.criteria import Criteria
from pbrl_ppl.criticism.cross_validation import (
    Change,
    LeftOut,
    folds,
    forecast_squares,
    leave_out,
    relative_fall,
)
from pbrl_ppl.criticism.forecast import forecast_change, longest_forecast
from pbrl_ppl.criticism.refinement import structure_mode, with_effects, with_enough_substeps
from pbrl_ppl.criticism.results import Candidate
from pbrl_ppl.criticism.score import Signature, inseparable, rank_candidates, twins
from pbrl_ppl.criticism.simulated import Law, Simulated, sizes_of, worth_of
from pbrl_ppl.effects import Attached, Effect, Noise, Structure, candidates
from pbrl_ppl.modes import Mode, fit_pieces, nearby_mode, trajectory_mode
from pbrl_ppl.parameters import prior_residual, prior_slopes
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats
from pbrl_ppl.threads import in_parallel


@dataclass(frozen=True, eq=False)
class Step:
    """An added effect: its signature, the new mode and the gain in log predictive density.

    ``simulated`` is what the simulation error of whole trajectories says of it, if that named it.
    """

    signature: Signature
    not_separable_from: tuple[str, ...]
    after: Mode
    elpd_difference: float
    elpd_difference_se: float
    simulated: Law | None = None


@dataclass(eq=False)
class Selection:
    """Stepwise selection of effects, which records its decision on each candidate.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    catalogue : tuple of Effect
        Effects to consider.
    criteria : Criteria
        Thresholds of the decisions.
    say : callable
        Called with the name of what takes long.

    Attributes
    ----------
    simulated : Mode or None
        The model so far, fitted to whole trajectories that are simulated without process noise.
    tried : dict of (str, str) to (float, float)
        Net evidence (nats) of an effect on a body by simulation, and its share of the error.
    why : dict of (str, str) to str
        Why an effect on a body was added or not, from the last round that tried it.
    small : list of Candidate
        The best candidate of the last round that is significant and negligible, if there is one.
    """

    scene: Scene
    catalogue: tuple[Effect, ...]
    criteria: Criteria
    say: Callable[[str], None]
    simulated: Mode | None = field(default=None, init=False)
    tried: Mapping[tuple[str, str], tuple[float, float]] = field(default_factory=dict, init=False)
    why: dict[tuple[str, str], str] = field(default_factory=dict, init=False)
    small: list[Candidate] = field(default_factory=list, init=False)

    def missing(self, mode: Mode) -> tuple[Attached, ...]:
        """Return the candidate effects for a model."""
        return candidates(self.scene, mode.problem.physics.effects, self.catalogue)

    def rank(self, mode: Mode) -> list[Signature]:
        """Return the scores of a model's candidates."""
        return rank_candidates(mode, self.missing(mode), self.criteria)

    def adopted(
        self, mode: Mode, simulated: Simulated | None, ranked: list[Signature]
    ) -> tuple[Mode, list[Step]]:
        """Return the mode with the laws that simulations name, and a step for each of them.

        Parameters
        ----------
        mode : Mode
            Of the declared model, fitted to whole trajectories.
        simulated : Simulated or None
            The laws, and the parameters that were found with them; None where nothing can be
            simulated.
        ranked : list of Signature
            Scores of the declared model's candidates.
        """
        if simulated is None:
            return mode, []
        self.simulated = simulated.after
        scored = {signature.attached: signature for signature in ranked}
        self.tried = {_key(scored[known]): worth for known, worth in simulated.tried.items()}
        for attached, (nats, share) in simulated.tried.items():
            sentence = (
                f"takes {100 * share:.2g} % off the error of whole trajectories ({nats:.0f} nats)"
            )
            self._note(scored[attached], sentence)
        if not simulated.laws:
            return mode, []
        problem = mode.problem.with_physics(effects=simulated.after.problem.physics.effects)
        phi = problem.layout.from_layout(simulated.after.problem.layout, simulated.after.phi)
        after = with_enough_substeps(trajectory_mode(problem, phi), self.say, self.criteria)
        lacking = [mode]
        if len(simulated.laws) > 1:
            named = [law.attached for law in simulated.laws]
            lacking = in_parallel(partial(self._without, after), named)
        steps = []
        for law, described, without in zip(
            simulated.laws, simulated.described(), lacking, strict=True
        ):
            signature = scored[law.attached]
            gained, _ = _gains(without, after, self.criteria)
            self._note(signature, "added")
            steps.append(
                Step(
                    signature, law.confounded_names, after, gained.total, gained.error, described
                )
            )  # fmt: skip
        return after, steps

    @staticmethod
    def _without(mode: Mode, attached: Attached) -> Mode:
        """Return the mode of the model without an effect."""
        kept = tuple(other for other in mode.problem.physics.effects if other != attached)
        return nearby_mode(*with_effects(mode, kept), mode.sigma)

    def best_addition(self, mode: Mode, ranked: list[Signature]) -> Step | None:
        """Refit with the leading candidates and return the best that is confirmed, or None."""
        order = [attached.effect.name for attached in self.missing(mode)]
        limits = self.criteria.selection
        self.small.clear()

        def score(signature: Signature, fitted: Mode) -> float:
            shown = fitted.problem.trajectory_noise.seen.any(axis=1).sum()
            penalty = 0.5 * _informed(fitted, signature.attached, limits.informed) * np.log(shown)
            return float(_log_likelihood(fitted) - penalty)

        waiting = self._worth_a_refit(ranked, order)
        while waiting:
            # those far behind the first are tried only once it has failed
            enough = limits.worth_a_refit * waiting[0].candidate.statistic
            leading = [addition for addition in waiting if addition.candidate.statistic >= enough]
            waiting = [addition for addition in waiting if addition.candidate.statistic < enough]
            self.say(f"refitting with each of {len(leading)} candidates")
            fits = dict(zip(leading, in_parallel(partial(refitted, mode), leading), strict=True))
            scores = {signature: score(signature, fitted) for signature, fitted in fits.items()}
            scores = {signature: value for signature, value in scores.items() if np.isfinite(value)}
            while scores:
                best = max(scores.values())
                tied = [addition for addition, value in scores.items() if value > best - limits.tie]
                signature = min(
                    tied, key=lambda addition: order.index(addition.attached.effect.name)
                )
                height, fitted = scores.pop(signature), fits[signature]
                step = self._confirm(mode, signature, fitted, ranked)
                if step is None:
                    continue
                for other, value in scores.items():
                    self._note(other, _behind(height - value, limits.tie, signature, other))
                for other in waiting:
                    self._note(other, f"too far behind {_named(signature, other)} to be refitted")
                return step
        return None

    def _worth_a_refit(self, ranked: list[Signature], order: list[str]) -> list[Signature]:
        """Return the candidates that could be added, best first; of twins, the earlier one.

        The noise's shape is scored and never added, for it would take up any misfit.
        """
        kept: list[Signature] = []
        for signature in sorted(ranked, key=lambda entry: order.index(entry.attached.effect.name)):
            same = [earlier for earlier in kept if twins(signature, earlier, self.criteria)]
            if isinstance(signature.attached.effect.stage, Noise):
                self._note(signature, "the noise's shape is scored and never added: declare it")
            elif signature.candidate.p_value >= self.criteria.try_p:
                # an earlier round that tried it says more
                if _key(signature) not in self.why:
                    self._note(
                        signature, f"not significant (p = {signature.candidate.p_value:.2g})"
                    )
            elif same:
                self._note(signature, f"the same as {_named(same[0], signature)} in these data")
            else:
                kept.append(signature)
        kept.sort(key=lambda entry: entry.log_p)
        most = self.criteria.selection.refits
        for signature in kept[most:]:
            self._note(signature, f"behind the {most} that are refitted in a round")
        return kept[:most]

    def _is_supported(self, mode: Mode, signature: Signature) -> bool:
        """Return whether a candidate takes anything off the simulation error of trajectories.

        Innovations alone take what is no law of motion for one: an error of the sensor that lasts.
        """
        if self.simulated is None:
            return True
        effects = mode.problem.physics.effects
        if self.simulated.problem.physics.effects != effects:
            begin = {effect: sizes_of(mode, effect) for effect in effects}
            self.simulated = fit_pieces(*with_effects(self.simulated, effects, begin))
        sizes = np.array(list(signature.candidate.estimate.values()))
        enough = self.criteria.simulation.least_nats
        worth = worth_of(self.simulated, signature.attached, sizes, enough)
        if worth < enough:
            self._note(signature, f"takes too little off simulation errors ({worth:.1f} nats)")
            return False
        return True

    def _confirm(
        self, mode: Mode, signature: Signature, fitted: Mode, ranked: list[Signature]
    ) -> Step | None:
        """Return the step if its gain is significant in cross-validation and not negligible."""
        if not self._is_supported(mode, signature):
            return None
        fitted = with_enough_substeps(fitted, self.say, self.criteria)
        if why := self._implausible(fitted, signature):
            self._note(signature, why)
            return None
        density, forecasts = _gains(mode, fitted, self.criteria)
        if why := self._uncertain(mode, fitted, density, forecasts):
            self._note(signature, why)
            return None
        share = _share(mode, fitted)
        if forecasts.certain(self.criteria.min_elpd_se):
            share = max(share, min(forecasts.total, forecast_change(mode, fitted)))
        if share < self.criteria.negligible:
            self._negligible(signature, share)
            return None
        self._note(signature, "added")
        others = inseparable(signature, ranked, self.criteria)
        return Step(signature, others, fitted, density.total, density.error)

    def _negligible(self, signature: Signature, share: float) -> None:
        """Record that a candidate changes predictions by a negligible share."""
        limit = f"less than {100 * self.criteria.negligible:g} % is negligible"
        self._note(signature, f"changes predictions by {100 * share:.2g} %: {limit}")
        if not self.small:  # others may be significant only without it
            self.small.append(signature.candidate)

    def _implausible(self, mode: Mode, signature: Signature) -> str:
        """Return why the fitted size of an effect is not accepted; empty if it is."""
        attached = signature.attached
        if not _informed(mode, attached, self.criteria.selection.informed):
            return "the data do not inform its size"
        layout = mode.problem.layout
        places = layout.places(attached.labels)
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

    def _uncertain(self, before: Mode, after: Mode, density: Change, forecasts: Change) -> str:
        """Return why gains in density and forecasts are not enough; empty if they are."""
        criteria = self.criteria
        if -forecasts.total > max(criteria.negligible, forecasts.needed(criteria.min_elpd_se)):
            return f"errors of cross-validated forecasts rise by {-100 * forecasts.total:.2g} %"
        needed = max(criteria.min_elpd, density.needed(criteria.min_elpd_se))
        either = any(gain.certain(criteria.min_elpd_se) for gain in (density, forecasts))
        if density.total >= criteria.min_elpd and either:
            return ""
        gained = f"{density.total:.1f} ± {density.error:.1f} nats"
        return f"cross-validation gains {gained}, {needed:.1f} are needed"

    def prune(self, mode: Mode, steps: list[Step]) -> tuple[Mode, list[Step]]:
        """Drop effects that later ones have made unnecessary; sort the rest by their gain."""
        for step in sorted(steps, key=lambda addition: addition.elpd_difference):
            least = self.criteria.simulation.least_share
            if step.simulated is not None and step.simulated.share >= least:
                continue  # innovations have no veto on a large law
            without = self._without(mode, step.signature.attached)
            gains = _gains(without, mode, self.criteria)
            if why := self._uncertain(without, mode, *gains):
                self._note(step.signature, f"needless beside later ones: {why}")
                mode = without
                steps = [addition for addition in steps if addition is not step]
        return mode, sorted(steps, key=lambda addition: -addition.elpd_difference)

    def explained(self, ranked: list[Signature]) -> tuple[Candidate, ...]:
        """Return candidates with the decision on each, and what simulations say of it."""
        return tuple(
            replace(
                one.candidate,
                why=self.why.get(_key(one), ""),
                simulated_nats=self.tried.get(_key(one), (None, None))[0],
                simulated_share=self.tried.get(_key(one), (None, None))[1],
            )
            for one in ranked
        )

    def _note(self, signature: Signature, why: str) -> None:
        """Record the decision on a candidate."""
        self.why[_key(signature)] = why


def refitted(mode: Mode, signature: Signature) -> Mode:
    """Return the mode with a candidate in the model, under the same noise structure."""
    attached = signature.attached
    estimate = np.array(list(signature.candidate.estimate.values()))
    stage = attached.effect.stage
    if isinstance(stage, Structure) and stage.rod is None:  # bodies collide with it
        return structure_mode(mode, attached, estimate)
    effects = (*mode.problem.physics.effects, attached)
    return trajectory_mode(*with_effects(mode, effects, {attached: estimate}), mode.sigma)


def _key(signature: Signature) -> tuple[str, str]:
    """Return effect and body."""
    return signature.candidate.effect, signature.candidate.body


def _named(signature: Signature, beside: Signature) -> str:
    """Return an effect's name, with its body if the other effect acts on another."""
    name, body = signature.attached.effect.name.replace("_", " "), signature.attached.body
    return name if body == beside.attached.body else f"{name} on {body}"


def _behind(nats: float, tie: float, best: Signature, other: Signature) -> str:
    """Return why a refitted candidate was not taken but another that fits better."""
    if nats < tie:
        return f"fits no better than {_named(best, other)}, which is simpler"
    return f"fits less well than {_named(best, other)}, by {nats:.1f} nats"


def _gains(before: Mode, after: Mode, criteria: Criteria) -> tuple[Change, Change]:
    """Return the gain in cross-validated density, and the fall of forecast errors.

    The forecasts are as long as the recording allows; the fall is a mean over observed coordinates,
    each in units of the errors before.
    """
    (worse, low), (better, high) = (_left_out(mode, criteria) for mode in (before, after))
    return Change.of(high.density - low.density), relative_fall(worse, better)


@lru_cache(maxsize=2)  # candidates of a round are compared with the same mode
def _left_out(mode: Mode, criteria: Criteria) -> tuple[Floats, LeftOut]:
    """Return squared errors of the longest forecasts of each fold, and the fits without it."""
    fold = folds(mode, criteria)
    left_out = leave_out(mode, fold)
    return forecast_squares(mode, fold, left_out, longest_forecast(mode.problem)), left_out


def _share(before: Mode, after: Mode) -> float:
    """Return the share by which a model's innovations exceed another's, in the latter's noise."""
    physics = before.problem.physics
    model = after.problem.with_physics(effects=physics.effects, substeps=physics.substeps)
    worse, better = model.whitened(before.phi, after.sigma), after.whitened_residual
    return 1.0 - float(np.sqrt((better**2).sum() / (worse**2).sum()))


def _informed(mode: Mode, attached: Attached, informed: float) -> int:
    """Return the number of an effect's parameters that the data inform.

    Where the derivative vanishes, as at a threshold, the posterior's width says nothing: scanned
    parameters always count.
    """
    problem = mode.problem
    places = problem.layout.places(attached.labels)
    narrow = _width_over_prior(mode)[places] < informed
    if attached.effect.scan is not None:
        body = problem.scene.body(attached.body)
        points = np.nan_to_num(attached.effect.scan(problem.scene, problem.data.history, body))
        narrow |= np.ptp(points, axis=0) > 0
    return int(narrow.sum())


def _width_over_prior(mode: Mode) -> Floats:
    """Return posterior standard deviations in units of the prior's, shape (p,)."""
    slopes = prior_slopes(mode.problem.layout.priors, mode.phi)
    return np.asarray(np.sqrt(np.diag(mode.covariance)) * np.abs(slopes))


def _log_likelihood(mode: Mode) -> float:
    """Return the log-likelihood of the mode."""
    problem = mode.problem
    residual = problem.residual(mode.phi)
    return float(problem.log_density(residual, mode.sigma, mode.phi).sum())
