"""Search for missing laws by simulation error, from short pieces to whole trajectories.

Without process noise, which would follow whatever is smooth, a missing law piles up along a
trajectory. On short pieces that error is nearly linear in all laws, so that one regression proposes
which of them are missing together; a few proposals are refitted there, and longer pieces are
simulated with the laws found so far (output error: L. Ljung, System Identification, 1999).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from scipy.stats import norm

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import Law, LawsOfSize, SearchLength
from pbrl_ppl.criticism.score import named_beside, rank_candidates
from pbrl_ppl.criticism.subsets import Regression, Subset, best_subsets, fall, worth
from pbrl_ppl.effects import Attached, Noise, Structure
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    LikelihoodT,
    Problem,
    in_pieces,
    is_filtered,
    is_independent,
    is_simulated,
)
from pbrl_ppl.modes import (
    MOST_GROWTH,
    Mode,
    SimulatedMode,
    corrected,
    filtered_mode,
    find_mode,
    fit_pieces,
    fit_pieces_closely,
    growth,
    is_filtered_mode,
    is_simulated_mode,
    piece_lengths,
    simulated_states,
    with_robust_covariance,
)
from pbrl_ppl.parameters import inside, prior_residual, prior_slopes
from pbrl_ppl.scene import state_sizes
from pbrl_ppl.state import Bools, Floats
from pbrl_ppl.threads import in_parallel

#: A refit takes a share of the error away if the regression says this of it.
LIKELY = 0.7
#: A law of so many nats to first order is kept without a fit of the model without it.
_CLEAR = 30.0
#: Log odds of laws that are rare, at most.
_RARE = -5.0
#: With the last digits of the data the evidence of a refit may change by this (nats): friction
#: makes the top rough, and climbs end on different grains of it.
_REPEATABLE = 2.0
#: Share of the joint sizes from which refits begin a second time.
_SHORTER = 0.3


@dataclass(frozen=True)
class Evidence:
    """Evidence of a model beside one with fewer laws.

    Parameters
    ----------
    nats : float
        Log-evidence less its price: parameters, their prior, and what was tried.
    share : float
        Share of the simulation error (root mean square) that is gone.
    """

    nats: float
    share: float

    @classmethod
    def of(
        cls, before: Mode, after: Mode, price: float = 0.0, weight: Floats | None = None
    ) -> Evidence:
        """Compare two modes on the same pieces.

        ``sum over dimensions of n / tau log(sigma_before / sigma_after)``, with the integrated
        autocorrelation time tau of the residual of ``after``, or with other ``weight``, shape
        (state,).
        """
        weight = weights(after) if weight is None else weight
        gained, n = float((weight * np.log(before.sigma / after.sigma)).sum()), weight.sum()
        paid = 0.5 * _more_informed(before, after) * np.log(max(n, 2.0)) + price
        paid += max(_prior_cost(after) - _prior_cost(before), 0.0)
        return cls(gained - float(paid), 1.0 - float(np.exp(-gained / max(n, 1.0))))


def weights(mode: Mode, *, still: float = 1e-4) -> Floats:
    """Return the effective number of measurements of each dimension, shape (state,).

    ``still``: a dimension that moves by less than this share of its natural size counts for none.
    """
    observations = mode.problem.observations
    natural = state_sizes(mode.problem.scene)[list(observations.columns)]
    moves = np.nanstd(observations.values, axis=(0, 1, 2)) > still * natural
    return np.where(moves, mode.problem.likelihood.counts(observations), 0.0)


def _informed(mode: Mode, *, share: float = 0.7) -> Bools:
    """Return which parameters have a posterior of less than a share of the prior's width, (p,)."""
    width = np.sqrt(np.maximum(np.diag(mode.covariance), 0.0))
    slopes = prior_slopes(mode.problem.layout.priors, mode.phi)
    return np.asarray(width * np.abs(slopes) < share)


def _more_informed(before: Mode, after: Mode) -> int:
    """Return how many of a model's further parameters the data inform; all that are scanned."""
    layout, narrow = after.problem.layout, _informed(after)
    return sum(
        attached.effect.scan is not None or bool(narrow[place])
        for attached in after.problem.physics.effects
        if attached not in before.problem.physics.effects
        for place in layout.places(attached.labels)
    )


def _prior_cost(mode: Mode) -> float:
    """Return the negative log-prior of a mode's parameters, up to a constant."""
    return 0.5 * float((prior_residual(mode.problem.layout.priors, mode.phi) ** 2).sum())


def _gained(mode: Mode, other: Mode) -> float:
    """Return the gain in log-posterior by a mode with another law in the place of one (nats)."""
    gain = float((weights(mode) * np.log(mode.sigma / other.sigma)).sum())
    return gain + _prior_cost(mode) - _prior_cost(other)


def with_effects(
    mode: Mode[LikelihoodT],
    effects: tuple[Attached, ...],
    sizes: Mapping[Attached, Floats] | None = None,
) -> tuple[Problem[LikelihoodT], Floats]:
    """Return a mode's problem with other effects, and where a search for its mode begins.

    Parameters
    ----------
    mode : Mode
        A mode of the model with the effects so far.
    effects : tuple of Attached
        All effects of the new model.
    sizes : mapping, optional
        Where the parameters of an effect begin; by default at the mode, or the prior's centre.
    """
    problem = mode.problem.with_physics(effects=effects)
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    for attached, values in (sizes or {}).items():
        phi[layout.places(attached.labels)] = values
    return problem, inside(layout.priors, phi)


def refit(mode: Mode, effects: tuple[Attached, ...], sizes: Mapping[Attached, Floats]) -> Mode:
    """Return the mode with other effects, under the same likelihood, from first sizes."""
    problem, phi = with_effects(mode, effects, sizes)
    if is_simulated(problem):
        return fit_pieces(problem, phi, rounds=8, tolerance=0.5)
    return find_mode(problem, initial=phi)


def drop(mode: Mode, law: Attached) -> Mode:
    """Return the mode without a law."""
    return refit(mode, tuple(one for one in mode.problem.physics.effects if one != law), {})


def _first_order(mode: Mode, law: Attached) -> float:
    """Return the evidence of a law if the other parameters make up for it linearly (nats)."""
    places = mode.problem.layout.places(law.labels)
    phi = mode.phi.copy()
    phi[places] = law.effect.null
    others = np.delete(mode.jacobian, places, axis=1)
    missed = mode.problem.whitened(phi, mode.sigma).ravel()
    if not np.isfinite(missed).all():
        return 0.0
    left = missed - others @ np.linalg.lstsq(others, missed, rcond=None)[0]
    n = max(float(weights(mode).sum()), 2.0)
    share = 1.0 - float((mode.whitened_residual**2).sum() / max((left**2).sum(), 1e-300))
    return worth(max(share, 0.0), len(places), n)


def sizes_of(mode: Mode, law: Attached) -> Floats:
    """Return the parameters of a law at a mode, shape (q,)."""
    return mode.phi[mode.problem.layout.places(law.labels)]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Laws that a search names.

    Parameters
    ----------
    declared, after : Mode
        The declared model and the one with the laws, on the longest pieces.
    laws : dict of Attached to Law
        The laws with what each is worth there, those of most evidence first.
    gains : dict of Attached to tuple of float
        Gain in expected log predictive density by each law, and its standard error (nats).
    confounded : dict of Attached to tuple of Attached
        Effects that explain the data as well as a law.
    lengths : tuple of SearchLength
        What was found at each length of pieces.
    tried : dict of Attached to Evidence
        What each candidate alone is worth to first order, on the shortest pieces.
    rejected : dict of Attached to str
        Why a law that was found on shorter pieces is not among them.
    """

    declared: Mode
    after: Mode
    laws: Mapping[Attached, Law] = field(default_factory=dict)
    gains: Mapping[Attached, tuple[float, float]] = field(default_factory=dict)
    confounded: Mapping[Attached, tuple[Attached, ...]] = field(default_factory=dict)
    lengths: tuple[SearchLength, ...] = ()
    tried: Mapping[Attached, Evidence] = field(default_factory=dict)
    rejected: Mapping[Attached, str] = field(default_factory=dict)

    def on(self, history: History) -> SearchResult:
        """Return the same laws with their models refitted to another history."""

        def refitted(mode: Mode) -> Mode:
            problem = mode.problem.with_data(history=history)
            if not is_simulated_mode(mode):
                return find_mode(problem, initial=mode.phi)
            pieces = in_pieces(problem, problem.data.horizon, problem.data.smoothed_states)
            return with_robust_covariance(fit_pieces_closely(pieces, mode.phi))

        after = refitted(self.after)
        declared = after if self.declared is self.after else refitted(self.declared)
        return replace(self, declared=declared, after=after)


@dataclass(frozen=True, eq=False)
class _Model:
    """A model on the way up.

    Parameters
    ----------
    mode : Mode
        At this length of pieces.
    earlier : dict of Attached to float
        Evidence of each law, summed over shorter lengths, less its price (nats).
    rivals : dict of Attached to dict
        Sizes of effects that explained the data as well as a law where it was found.
    without : dict of Attached to Mode
        The model without each law, where it is fitted.
    """

    mode: Mode
    earlier: Mapping[Attached, float] = field(default_factory=dict)
    rivals: Mapping[Attached, Mapping[Attached, Floats]] = field(default_factory=dict)
    without: Mapping[Attached, Mode] = field(default_factory=dict)

    @property
    def evidence(self) -> dict[Attached, Evidence]:
        """Evidence of each law at this length, beside the others."""
        return {law: Evidence.of(mode, self.mode) for law, mode in self.without.items()}

    @cached_property
    def clear(self) -> dict[Attached, float]:
        """Evidence to first order of the laws that it shows clearly."""
        nats = {law: _first_order(self.mode, law) for law in self.earlier}
        return {law: one for law, one in nats.items() if one > _CLEAR}

    @property
    def nats(self) -> dict[Attached, float]:
        """Evidence of each law, summed over lengths, less its price."""
        here = self.clear | {law: one.nats for law, one in self.evidence.items()}
        return {law: nats + here[law] for law, nats in self.earlier.items()}

    def fitted(self, *, whole: bool = False) -> _Model:
        """Return the model with each law dropped in turn, or those alone that are not clear."""
        laws = [one for one in self.earlier if whole or one not in self.clear]
        smaller = in_parallel(partial(drop, self.mode), laws)
        return replace(self, without=dict(zip(laws, smaller, strict=True)))

    def dropped(self, law: Attached) -> _Model:
        """Return the model without a law."""
        earlier = {one: nats for one, nats in self.earlier.items() if one != law}
        return _Model(self.without[law], earlier, self.rivals)

    def exchanged(self, law: Attached, other: Attached, mode: Mode) -> _Model:
        """Return the model with another law in the place of one, and its prior odds."""
        paid = other.effect.log_odds - law.effect.log_odds
        earlier = {
            other if one == law else one: nats + paid * (one == law)
            for one, nats in self.earlier.items()
        }
        return _Model(mode, earlier, self.rivals)

    def at(self, mode: Mode) -> _Model:
        """Return the model on longer pieces."""
        return _Model(mode, self.nats, self.rivals)


@dataclass(eq=False)
class Search:
    """Search for the laws that a model lacks.

    Parameters
    ----------
    missing : callable
        Returns the candidate effects of a model, given its mode.
    criteria : Criteria
        Thresholds.
    say : callable
        Called with what was found.
    """

    missing: Callable[[Mode], Sequence[Attached]]
    criteria: Criteria = DEFAULT
    say: Callable[[str], None] = field(default=lambda sentence: None)

    def __call__(self, mode: Mode) -> SearchResult:
        """Return the laws that a model's simulation error shows.

        Parameters
        ----------
        mode : Mode
            Of the declared model: of whole trajectories, which are cut into pieces, or of single
            transitions, which are judged as they are.

        Raises
        ------
        HistoryError
            If no trajectory has three rows, or initial states can follow all that was measured.
        """
        if is_independent(mode.problem):
            model, here, before, regression = self._at_length(_Model(mode))
            found = self._judged(mode, mode, model, regression, (here,), _alone(before))
            return replace(found, declared=mode)
        first, *longer = piece_lengths(mode)
        pieces = in_pieces(_apart(mode, first), first, mode.problem.data.smoothed_states)
        model = _Model(fit_pieces(pieces, mode.phi))
        begin = model.mode.phi
        model, here, before, regression = self._at_length(model)
        tried, lengths = _alone(before), [here]
        for length in longer:
            higher = _carried(model.mode, length)
            if _is_lost(model.mode, higher):
                # out of phase: what is significant and takes little away is taken on trial
                trial = self._grown(model, regression, least_share=0.0)
                if trial is model:
                    break
                higher = _carried(trial.mode, length)
                if _is_lost(trial.mode, higher):
                    break
                model = trial
            model, here, _, regression = self._at_length(model.at(higher))
            lengths.append(here)
        # on the longest pieces, where they add up, small corrections as well, if they are common
        common = tuple(
            one for one in regression.subsets
            if all(law.effect.log_odds > _RARE for law in one.laws)
        )  # fmt: skip
        small = replace(regression, subsets=common)
        better = self._grown(model, small, self.criteria.search.small_share)
        if better is not model:
            model, regression = better, self._regression(better.mode)
        declared = _without_all(model, begin)
        found = self._judged(mode, declared, model, regression, tuple(lengths), tried)
        if found.laws:
            found = self._beside(declared, found)
        found = _with_contacts(found, mode, first)
        named = {law: "" for one in lengths for law in one.accepted}
        named |= {_name(law): f": {why}" for law, why in found.rejected.items()}
        for law, why in named.items():
            if law not in map(_name, found.laws):
                self.say(f"dropped {law}{why or ': longer simulations do not need it'}")
        return found

    def _beside(self, declared: Mode, found: SearchResult) -> SearchResult:
        """Return the laws beside the declared model; none if one trajectory shows too little."""
        share = Evidence.of(declared, found.after).share
        history = declared.problem.data.history
        if history.n_trajectories > 1 or share >= self.criteria.search.alone:
            return replace(found, declared=declared)
        # a lasting error of the sensor or a random force follows a single trajectory as well
        why = f"takes {100 * share:.2g} % off the error of a single trajectory, which is too little"
        rejected = {**found.rejected, **dict.fromkeys(found.laws, why)}
        return SearchResult(
            declared, declared, lengths=found.lengths, tried=found.tried, rejected=rejected
        )

    def _at_length(
        self, model: _Model, rounds: int = 3
    ) -> tuple[_Model, SearchLength, Regression, Regression]:
        """Return the model with laws that one length of pieces shows, without needless ones.

        With what was found, and the regressions before and after that.

        ``rounds``: rounds of proposals, at most.
        """
        limits, error = self.criteria.search, _error(model.mode)
        before = tuple(model.earlier)
        model = self._pruned(model.fitted(), least=-limits.least_nats)
        regression = first = self._regression(model.mode)
        for _ in range(rounds):
            better = self._grown(model, regression, limits.least_share)
            if better is model:
                break
            model = better
            regression = self._regression(model.mode)
        data, mode = model.mode.problem.data, model.mode
        times = mode.problem.likelihood.tau if is_simulated_mode(mode) else ()
        here = SearchLength(
            rows=data.horizon,
            seconds=data.horizon * mode.problem.scene.time_step,
            error=error,
            path=tuple(map(_laws_of_size, first.path)),
            accepted=tuple(_name(law) for law in model.earlier if law not in before),
            dropped=tuple(_name(law) for law in before if law not in model.earlier),
            correlated=dict(zip(mode.problem.observations.names, times, strict=False)),
        )
        return model, here, first, regression

    def _regression(
        self, mode: Mode, missing: Sequence[Attached] | None = None, largest: int = 4
    ) -> Regression:
        """Return the subsets of what a model lacks, the noise's shape aside."""
        missing = self.missing(mode) if missing is None else missing
        candidates = [one for one in missing if not isinstance(one.effect.stage, Noise)]
        cheap = corrected(mode) if is_simulated_mode(mode) else mode
        return best_subsets(cheap, candidates, self.criteria, largest=largest)

    def _grown(self, model: _Model, regression: Regression, least_share: float) -> _Model:
        """Return the model with the best subset that takes enough away, or the model itself."""
        limits, mode = self.criteria.search, model.mode
        proposals = _proposals(regression, limits.refits, limits.singles, least_share)
        if not proposals:
            return model
        fits = in_parallel(partial(_with_subset, mode), proposals)
        shares = [Evidence.of(mode, fitted).share for fitted in fits]
        if not any(map(_meets_prediction, proposals, shares)):
            again = _with_subset(mode, proposals[0], sizes=_SHORTER)
            fits[0] = max(fits[0], again, key=lambda one: Evidence.of(mode, one).share)
            shares = [Evidence.of(mode, fitted).share for fitted in fits]
        weight = weights(fits[int(np.argmax(shares))])
        judged = [
            (Evidence.of(mode, fitted, sum(subset.prices.values()), weight), subset, fitted)
            for subset, fitted in zip(proposals, fits, strict=True)
        ]
        enough = [
            one for one in judged
            if one[0].nats >= limits.least_nats
            and one[0].share >= least_share
            and _far_out(one[2], one[1].laws) < self.criteria.far_out
        ]  # fmt: skip
        if not enough:
            return model
        top = max(one[0].nats for one in enough)
        tied = [one for one in enough if one[0].nats > top - limits.least_nats]
        _, subset, fitted = min(tied, key=lambda one: (len(one[2].phi), -one[0].nats))
        # each law has to be worth its price
        paid = {law: -price for law, price in subset.prices.items()}
        grown = _Model(fitted, {**model.earlier, **paid}, model.rivals)
        for law in subset.laws:
            grown = self._exchanged(grown, law, mode, _family(regression, subset, law))
        laws = [law for law in grown.earlier if law not in model.earlier]
        self.say(f"simulations name {' and '.join(map(_name, laws))}")
        close = [one for one in enough if one[0].nats > top - 2.0 * limits.least_nats]
        here = next((one for one in regression.subsets if set(one.laws) == set(laws)), subset)
        rivals = dict(grown.rivals)
        for law, chosen in zip(laws, subset.laws, strict=True):
            beside = _refitted_instead(subset, chosen, [one[1:] for one in close])
            scored = law if law in here.laws else chosen
            beside |= _rivals(regression, here, scored, limits.least_nats)
            named = {one: size for one, size in beside.items() if one not in laws}
            rivals[law] = {**rivals.get(law, {}), **named}
        pruned = self._pruned(replace(grown, rivals=rivals).fitted())
        return pruned if set(pruned.earlier) - set(model.earlier) else model

    def _exchanged(
        self, model: _Model, law: Attached, before: Mode, family: Mapping[Attached, Floats]
    ) -> _Model:
        """Return the model with a law of its family in the place of one that does better.

        In the place of a rare law, common ones are tried as well. They are linearised at the model
        without it, for where other laws are missing as well their derivatives say little.
        """
        begin, least = model.mode, self.criteria.search.least_nats
        if law.effect.log_odds <= _RARE:
            begin = before = drop(model.mode, law)
            others = {one.effect.family for one in model.earlier if one != law} - {""}
            family, least = self._as_common(begin, law, others), 0.0
        swaps = _swaps(begin, law, family)
        net = _net(before, model.mode, law, swaps)
        better = max(net, key=lambda one: net[one], default=law)
        named = better if net.get(better, -np.inf) >= least else law
        # which of those that are nearly as good is named may be a matter of the last digits
        near = net.get(named, 0.0) - 2.0 * self.criteria.search.least_nats
        modes = {law: model.mode, **swaps}
        close = sorted(({law: 0.0} | net).items(), key=lambda one: -one[1])
        rivals = {
            one: sizes_of(modes[one], one) for one, nats in close if nats > near and one != named
        }
        model = replace(model, rivals={**model.rivals, named: rivals})
        if named == law:
            return model
        self.say(f"{_name(named)} explains simulations better than {_name(law)}")
        return model.exchanged(law, named, swaps[named])

    def _as_common(self, mode: Mode, law: Attached, others: set[str]) -> dict[Attached, Floats]:
        """Return common effects and a rare law's family, ``others``' aside, and their sizes."""
        missing = [
            one for one in self.missing(mode)
            if one != law and one.effect.family not in others
            and (one.effect.log_odds > _RARE or _is_alike(one, law))
        ]  # fmt: skip
        sizes: dict[Attached, Floats] = {}
        for subset in self._regression(mode, missing, largest=1).subsets:
            for one, size in subset.sizes.items():
                sizes.setdefault(one, size)
        return sizes

    def _pruned(self, model: _Model, least: float = 0.0) -> _Model:
        """Drop laws whose evidence, summed over lengths, does not pay their price.

        ``least``: those of less evidence than this (nats).
        """
        while nats := model.nats:
            law = min(nats, key=lambda one: nats[one])
            if nats[law] >= least:
                break
            model = model.dropped(law).fitted()
        return model

    def _judged(
        self,
        whole: Mode,
        without: Mode,
        model: _Model,
        regression: Regression,
        lengths: tuple[SearchLength, ...],
        tried: Mapping[Attached, Evidence],
    ) -> SearchResult:
        """Return the laws that are worth it on the longest pieces, and what each is worth.

        A main law takes a large share of the simulation error of the model ``without`` any away
        there. A small correction may stand for something else: innovations of ``whole``
        trajectories must not contradict it.
        """
        least, rejected = self.criteria.search.least_nats, dict[Attached, str]()
        model = model.fitted(whole=True)
        while model.earlier:
            nats, worth, main = model.nats, model.evidence, self._main(without, model)
            weak = {
                law: nats[law] if law in main else min(nats[law], one.nats)
                for law, one in worth.items()
            }
            law: Attached | None = min(weak, key=lambda one: weak[one])
            if law is not None and weak[law] < least:
                why = f"longer simulations do not need it ({weak[law]:.1f} nats)"
            else:
                law, why = self._unconfirmed(
                    whole, model, [one for one in worth if one not in main]
                )
            if law is None:
                break
            model, rejected[law] = model.dropped(law).fitted(whole=True), why
        absorbed = {one.attached for one in regression.signatures if not one.basis.shape[1]}
        model, confounded = self._confounded(model, absorbed)
        worth, main, mode = model.evidence, self._main(without, model), model.mode
        if is_simulated_mode(mode):
            mode = with_robust_covariance(fit_pieces_closely(mode.problem, mode.phi))
        laws = {
            law: law_of(mode, law, worth[law], law in main, confounded[law])
            for law in sorted(worth, key=lambda law: -worth[law].nats)
        }
        gains = {law: elpd_gain(model.without[law], mode) for law in laws}
        return SearchResult(mode, mode, laws, gains, confounded, lengths, tried, rejected)

    def _main(self, without: Mode, model: _Model) -> set[Attached]:
        """Return the laws with a large share in what all take off the error of a model without.

        Laws that replace each other in part are missed little alone: shares are in proportion.
        """
        gains = {law: fall(one.share) for law, one in model.evidence.items()}
        together = fall(Evidence.of(without, model.mode).share)
        scale = max(together / max(sum(gains.values()), 1e-300), 1.0)
        least = fall(self.criteria.search.main_share)
        return {law for law, gain in gains.items() if scale * gain >= least}

    def _unconfirmed(
        self, whole: Mode, model: _Model, small: Sequence[Attached], *, contradicted: float = 0.1
    ) -> tuple[Attached | None, str]:
        """Return a small correction that innovations contradict, and why; None if they do not.

        They would show a law of its size by its score, and do not. Where process noise swallows
        the law they say nothing.

        ``contradicted``: p-value of such a law's score above which they do not show it; one of 40
        that are there has a larger one.
        """
        if not is_filtered_mode(whole):
            return None, ""
        limits = self.criteria.residual
        power = (norm.isf(limits.detection_p) + norm.ppf(limits.detection_power)) ** 2
        for law in small:
            innovations = filtered_mode(whole, model.without[law])
            (scored,) = rank_candidates(innovations, [law], self.criteria)
            if not scored.linear:
                continue
            at = scored.linear[0]
            change = (sizes_of(model.mode, law) - at.values)[list(at.columns)]
            size = np.linalg.lstsq(at.back, change, rcond=None)[0] if at.columns else np.ones(1)
            likely = float(np.exp(scored.log_p))
            if likely > contradicted and (size**2).sum() > power:
                return law, f"small, and innovations do not show it (p = {likely:.2g})"
        return None, ""

    def _confounded(
        self, model: _Model, absorbed: set[Attached], *, most: int = 2
    ) -> tuple[_Model, dict[Attached, tuple[Attached, ...]]]:
        """Return the model, and by law the effects that explain the longest pieces as well.

        Those that the model absorbs there are the same physics; of others at ``most`` so many are
        refitted in a law's place. One that explains the pieces better by as much as a law needs
        takes the place.
        """
        least = self.criteria.search.least_nats
        groups: dict[Attached, tuple[Attached, ...]] = {}
        for law in tuple(model.earlier):
            mode, without = model.mode, model.without[law]
            rivals = model.rivals.get(law, {})
            same = [one for one in rivals if one in absorbed]
            rivals = {one: size for one, size in rivals.items() if one not in absorbed}
            swaps = _swaps(mode, law, rivals, most)
            net = _net(without, mode, law, swaps)
            close = [
                one for one, other in swaps.items()
                if _gained(mode, other) > -least or net[one] > -least - _REPEATABLE
            ]  # fmt: skip
            better = max(net, key=lambda one: net[one], default=law)
            if better != law and net[better] > least:
                self.say(f"{_name(better)} explains whole trajectories better than {_name(law)}")
                model = model.exchanged(law, better, swaps[better]).fitted(whole=True)
                gained = min(_gained(mode, swaps[better]), net[better] - _REPEATABLE)
                close = [law] if gained < least else []
                law = better
            groups[law] = (*same, *close)
        return model, groups


def _apart(mode: Mode, length: int, *, most: float = 0.5) -> Problem:
    """Return a mode's problem with breaks between pieces where bodies touch.

    The instant of a collision is no smooth function of anything, and what it does to a body says
    nothing of the laws between: no piece goes through one. Where pieces of a ``length`` would leave
    more than a share of ``most`` of the measurements out, contacts are simulated.
    """
    problem = mode.problem
    if not is_filtered(problem):
        return problem
    touched, segments = problem.likelihood.noise.touching, problem.segments
    if not touched.any():
        return problem
    states, history = problem.data.smoothed_states, problem.data.history
    breaks = np.zeros(states.shape[:2], dtype=bool)
    breaks[segments.trajectory, segments.step] = touched
    measured, every = (
        np.isfinite(history.pieces(states, length, one).observed).sum() for one in (breaks, None)
    )
    if measured < (1.0 - most) * every:
        return problem
    physics = problem.physics
    enough = min(max(physics.scene.substeps, physics.fine_enough), physics.substeps)
    problem = problem.with_physics(substeps=enough)
    if not any(body.kinematic for body in problem.scene.moving):
        problem = replace(problem, physics=problem.physics.in_parts())
    return problem.with_data(breaks=breaks)


def _with_contacts(
    found: SearchResult, whole: Mode, shortest: int, *, far_out: float = 5.0
) -> SearchResult:
    """Return the result with its models fitted to contacts as well, which have parameters, too.

    These begin where the ``whole`` trajectories have them.

    ``far_out``: errors of collisions above this many noise sizes are those of the engine.
    """
    contacts = found.after.problem.data.breaks
    if contacts is None:
        return found

    def refitted(mode: Mode) -> Mode:
        if not is_simulated_mode(mode):
            return mode
        data, states = mode.problem.data, simulated_states(mode)
        problem = mode.problem.with_data(breaks=None)
        physics = problem.physics.changed(substeps=whole.problem.physics.substeps)
        problem = replace(problem, physics=physics.in_parts(data.history))
        known = problem.layout.from_layout(whole.problem.layout, whole.phi)
        phi = np.where(_informed(mode), mode.phi, known)
        pieces = in_pieces(problem, shortest, states)
        fitted = fit_pieces(pieces, phi)
        # a collision that the engine does not have stays left out
        off = np.abs(fitted.problem.residual(fitted.phi)).max(axis=(1, 2)) > far_out * mode.sigma
        segments, breaks = pieces.segments, np.zeros_like(contacts)
        for i in np.flatnonzero(off.any(axis=1)):
            rows = segments.trajectory[i], slice(segments.step[i], segments.step[i] + shortest)
            breaks[rows] = contacts[rows]
        pieces = in_pieces(problem.with_data(breaks=breaks), data.horizon, states)
        longer = fit_pieces_closely(pieces, fitted.phi)
        fitted = fitted if growth(longer.problem) > MOST_GROWTH else longer
        fitted = with_robust_covariance(fitted)
        return replace(fitted, phi=np.where(_informed(fitted), fitted.phi, known))

    if found.declared is found.after:
        declared = after = refitted(found.after)
    else:
        declared, after = in_parallel(refitted, [found.declared, found.after])
    # collisions inform the rest: a small law that was of their errors is within its own here
    gone = [law for law, one in found.laws.items() if not one.main and _is_null(after, law)]
    for law in gone:
        after = drop(after, law) if len(gone) < len(found.laws) else declared
    why = "small, and not significant with collisions"
    return replace(
        found,
        declared=declared,
        after=after,
        laws={law: one for law, one in found.laws.items() if law not in gone},
        gains={law: one for law, one in found.gains.items() if law not in gone},
        confounded={law: one for law, one in found.confounded.items() if law not in gone},
        rejected={**found.rejected, **dict.fromkeys(gone, why)},
    )


def _is_null(mode: Mode, law: Attached, *, significant: float = 3.0) -> bool:
    """Return whether a law's parameters are within so many standard deviations of its null."""
    places = mode.problem.layout.places(law.labels)
    sd = np.sqrt(np.diag(mode.covariance)[places])
    return bool((np.abs(mode.phi[places] - law.effect.null) < significant * sd).all())


def _carried(mode: Mode, length: int) -> SimulatedMode:
    """Return the mode on longer pieces, which begin on the simulations of shorter ones."""
    return fit_pieces(in_pieces(mode.problem, length, simulated_states(mode)), mode.phi)


def _proposals(
    regression: Regression, refits: int, singles: int, least_share: float
) -> list[Subset]:
    """Return the subsets to refit: the best, and single laws, of those that may be accepted."""
    least = 1.0 - (1.0 - LIKELY * least_share) ** 2
    subsets = [one for one in regression.subsets if one.nats > 0]
    # structures cost contact in the engine: they are refitted where they lead
    first = _structures(subsets[0]) if subsets else set()
    subsets = [one for one in subsets if _structures(one) <= first]
    kinds = {_kind(one): one for one in reversed(subsets) if one.share >= least}
    leading = sorted(kinds.values(), key=lambda one: -one.nats)[:refits]
    alone = [one for one in subsets if len(one.laws) == 1][:singles] if leading else []
    return list({frozenset(one.laws): one for one in (*leading, *alone)}.values())


def _without_all(model: _Model, begin: Floats) -> Mode:
    """Return the mode without any law, from where it was on the shortest pieces or is with them."""
    mode = model.mode
    if not (model.earlier and is_simulated_mode(mode)):
        return mode
    kept = tuple(one for one in mode.problem.physics.effects if one not in model.earlier)
    problem, near = with_effects(mode, kept)
    fits = in_parallel(partial(fit_pieces, problem), [begin, near])
    weight = weights(mode)
    best = min(fits, key=lambda fitted: float((weight * np.log(fitted.sigma)).sum()))
    return with_robust_covariance(best)


def elpd_gain(before: Mode, after: Mode) -> tuple[float, float]:
    """Return the gain in expected log predictive density, and its standard error.

    The gain in log-density at the modes, less one nat for each further parameter that the data
    inform (to first order that of leave-one-out cross-validation: M. Stone, Journal of the Royal
    Statistical Society B 39, 1977). Both count correlated residuals as ``after`` does. The error is
    that of a sum over pieces or transitions; NaN for a single one.
    """

    def densities(mode: Mode) -> Floats:
        problem = mode.problem
        residual = problem.residual(mode.phi)
        if not (is_simulated(problem) and is_simulated_mode(after)):
            return np.asarray(problem.log_density(residual, mode.sigma, mode.phi))
        likelihood = problem.likelihood
        initial, tau = likelihood.initial_states, np.array(after.problem.likelihood.tau)
        rows, begin = likelihood.unwhitened(residual, mode.sigma)
        sensed = initial.column >= 0
        of_start = np.eye(len(mode.sigma))[initial.column[sensed]]
        square = (rows**2).sum((1, 2)) + begin[:, sensed] ** 2 @ of_start
        count = initial.seen.sum((1, 2)) + np.isfinite(initial.begin)[:, sensed] @ of_start
        density = count * np.log(mode.sigma) + 0.5 * square / mode.sigma**2
        return np.asarray(-(density / tau).sum(axis=1))

    gains = densities(after) - densities(before)
    n, total = len(gains), float(gains.sum()) - _more_informed(before, after)
    return total, float(np.sqrt(n) * gains.std(ddof=1)) if n > 1 else float("nan")


def law_of(
    mode: Mode, law: Attached, evidence: Evidence, main: bool, confounded: Sequence[Attached]
) -> Law:
    """Return a law of a mode in words and numbers."""
    effect, places = law.effect, mode.problem.layout.places(law.labels)
    sd = np.sqrt(np.diag(mode.covariance)[places])
    names = [parameter.name for parameter in effect.parameters]
    return Law(
        effect=effect.name,
        body=law.body,
        sentence=effect.sentence,
        estimate=dict(zip(names, mode.phi[places].tolist(), strict=True)),
        sd=dict(zip(names, sd.tolist(), strict=True)),
        units={parameter.name: parameter.unit for parameter in effect.parameters},
        nats=evidence.nats,
        share=evidence.share,
        main=main,
        confounded=tuple(named_beside(rival, law) for rival in confounded),
    )


def _with_subset(mode: Mode, subset: Subset, sizes: float = 1.0) -> Mode:
    """Return the refit with a subset's laws, from their joint sizes or this share of them."""
    begin = dict(subset.sizes)
    for law, size in begin.items():
        if law.effect.scan is None:
            null = np.array(law.effect.null, dtype=float)
            begin[law] = null + sizes * (size - null)
    return refit(mode, (*mode.problem.physics.effects, *subset.laws), begin)


def _meets_prediction(subset: Subset, share: float, *, least: float = 0.5) -> bool:
    """Return whether a refit took enough of what the regression says off the squared error."""
    return 1.0 - (1.0 - share) ** 2 >= least * subset.share


def _swaps(
    mode: Mode, law: Attached, sizes: Mapping[Attached, Floats], most: int = 4
) -> dict[Attached, Mode]:
    """Return refits with one of the first ``most`` effects in the place of a law, from sizes."""
    rest = tuple(one for one in mode.problem.physics.effects if one != law)

    def swapped(rival: Attached) -> Mode:
        return refit(mode, (*rest, rival), {rival: sizes[rival]})

    rivals = [one for one in sizes if one not in rest][:most]
    return dict(zip(rivals, in_parallel(swapped, rivals), strict=True))


def _net(
    before: Mode, mode: Mode, law: Attached, swaps: Mapping[Attached, Mode]
) -> dict[Attached, float]:
    """Return how much more evidence refits with others in a law's place have, with prior odds."""
    weight = weights(mode)

    def evidence(one: Attached, fitted: Mode) -> float:
        return Evidence.of(before, fitted, -one.effect.log_odds, weight).nats

    return {one: evidence(one, other) - evidence(law, mode) for one, other in swaps.items()}


def _is_alike(law: Attached, other: Attached) -> bool:
    """Return whether laws are of one family and body."""
    family = law.effect.family
    return bool(family) and family == other.effect.family and law.body == other.body


def _family(
    regression: Regression, subset: Subset, law: Attached, near: float = 0.85
) -> dict[Attached, Floats]:
    """Return members of a law's family and their sizes, if subsets with them are near as good."""
    sizes: dict[Attached, Floats] = {}
    for one in regression.alternatives(subset, law):
        (other,) = set(one.laws) - set(subset.laws)
        if _is_alike(other, law) and one.share > near * subset.share:
            sizes.setdefault(other, one.sizes[other])
    return sizes


def _refitted_instead(
    subset: Subset, law: Attached, refits: Sequence[tuple[Subset, Mode]]
) -> dict[Attached, Floats]:
    """Return effects that refitted subsets have in the place of one law, and their sizes."""
    rest, sizes = set(subset.laws) - {law}, dict[Attached, Floats]()
    for other, fitted in refits:
        more = set(other.laws) - rest
        if len(more) == 1 and law not in other.laws and rest < set(other.laws):
            (one,) = more
            sizes[one] = sizes_of(fitted, one)
    return sizes


def _rivals(
    regression: Regression, subset: Subset, law: Attached, within: float
) -> dict[Attached, Floats]:
    """Return effects that explain the residual as well as one law of a subset, and their sizes."""
    scored = {one.attached: one.candidate for one in regression.signatures}

    def size(one: Attached) -> Floats:
        return np.array(list(scored[one].estimate.values()))

    rivals = {one: size(one) for one in regression.same.get(law, ())}
    for alternative in regression.alternatives(subset, law):
        if alternative.evidence <= subset.evidence - within:
            continue
        (other,) = set(alternative.laws) - set(subset.laws)
        rivals.setdefault(other, alternative.sizes[other])
        rivals |= {one: size(one) for one in regression.same[other] if one not in rivals}
    return rivals


def _far_out(mode: Mode, laws: Sequence[Attached]) -> float:
    """Return how many prior scales the sizes of laws lie from their priors' centres, at most."""
    layout = mode.problem.layout
    places = [place for law in laws for place in layout.places(law.labels)]
    return float(np.abs(prior_residual(layout.priors, mode.phi)[places]).max(initial=0.0))


def _kind(subset: Subset) -> frozenset[tuple[str, str]]:
    """Return the families of a subset's laws, of which one stands for the others."""
    return frozenset((law.effect.family or law.effect.name, law.body) for law in subset.laws)


def _structures(subset: Subset) -> set[Attached]:
    """Return the laws of a subset that add to the scene."""
    return {law for law in subset.laws if isinstance(law.effect.stage, Structure)}


def _alone(regression: Regression) -> dict[Attached, Evidence]:
    """Return what each candidate alone is worth to first order, share of the error's size."""
    alone: dict[Attached, Evidence] = {}
    for subset in regression.subsets:
        if len(subset.laws) == 1:
            (law,) = subset.laws
            for one in (law, *regression.same[law]):
                share = 1.0 - float(np.sqrt(1.0 - subset.share))
                alone.setdefault(one, Evidence(subset.nats, share))
    return alone


def _is_lost(shorter: Mode, mode: SimulatedMode) -> bool:
    """Return whether pieces are too long to tell a law from.

    Their initial states are magnified, or the error nears the motion's size, where it is out of
    phase.
    """
    values = mode.problem.observations.values
    return growth(mode.problem) > MOST_GROWTH or is_out_of_phase(mode.sigma, shorter.sigma, values)


def is_out_of_phase(
    error: Floats, shorter: Floats, values: Floats, *, far: float = 0.2, more: float = 3.0
) -> bool:
    """Return whether a simulation error nears the size of the motion.

    Parameters
    ----------
    error, shorter : ndarray
        Errors on pieces and on shorter ones, shape (state,), SI units.
    values : ndarray
        Measurements, shape (piece, H, body, state), SI units.
    far, more : float
        Share of the motion, and multiple of the shorter pieces' error, from which it does.
    """
    motion = np.nanstd(values, axis=(0, 1, 2))
    return bool(((error > far * motion) & (error > more * shorter)).any())


def _error(mode: Mode) -> dict[str, float]:
    """Return the simulation error by dimension, SI units."""
    return dict(zip(mode.problem.observations.names, mode.sigma.tolist(), strict=True))


def _name(law: Attached) -> str:
    """Return the names of an effect and its body."""
    return f"{law.effect.name} on {law.body}"


def _laws_of_size(subset: Subset) -> LawsOfSize:
    """Return a subset by names."""
    names = tuple(map(_name, subset.laws))
    return LawsOfSize(names, subset.nats, float(np.sqrt(1.0 - subset.share)))
