"""Search for effects by simulation error: laws judged by simulating whole trajectories.

Without process noise, which would follow whatever is smooth, a missing law piles up along a
trajectory, and the right one takes the error away. Effects that take little of it away are left to
the search by innovations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.refinement import with_effects
from pbrl_ppl.criticism.score import Signature, named_beside, rank_candidates, twins
from pbrl_ppl.effects import Attached, Noise
from pbrl_ppl.history import longest_gap
from pbrl_ppl.likelihood import output_error
from pbrl_ppl.modes import (
    Linear,
    Mode,
    climb_ladder,
    corrected,
    derivatives,
    fit_pieces,
    ladder,
    refined,
    with_robust_covariance,
)
from pbrl_ppl.parameters import prior_residual, prior_slopes
from pbrl_ppl.state import Floats
from pbrl_ppl.threads import in_parallel


@dataclass(frozen=True)
class Law:
    """An effect that takes a large share off the simulation error.

    Parameters
    ----------
    effect, body, sentence : str
        Names of the effect and of the body, and the effect in words.
    estimate, sd, units : dict of str to float or str
        Most probable value of each parameter, its standard deviation, which allows for the
        residual's correlation, and its unit.
    nats : float
        Net log-evidence: what the simulation error loses without it, less its price.
    share : float
        Share of the simulation error (root mean square) that it takes away.
    confounded : tuple of str
        Effects that explain these data as well.
    """

    effect: str
    body: str
    sentence: str
    estimate: dict[str, float]
    sd: dict[str, float]
    units: dict[str, str]
    nats: float
    share: float
    confounded: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Simulated:
    """Result of a search by simulation error.

    Parameters
    ----------
    declared, after : Mode
        The declared model and the one with the laws, at the greatest length.
    laws : tuple of Accepted
        In the order in which they were found.
    without : tuple of Mode
        The model without each law, refitted.
    tried : dict of Attached to (float, float)
        Net log-evidence (nats) of candidates that were refitted beside the declared model, and the
        share of the simulation error that they take away.
    """

    declared: Mode
    after: Mode
    laws: tuple[Accepted, ...]
    without: tuple[Mode, ...]
    tried: Mapping[Attached, tuple[float, float]]

    def described(self) -> tuple[Law, ...]:
        """Return the laws with what each is worth in the last model."""
        after = with_robust_covariance(self.after)
        return tuple(map(partial(_law, after), self.laws, self.without))


@dataclass(frozen=True, eq=False)
class Accepted:
    """A law in the model, and the effects that explain the data as well."""

    attached: Attached
    confounded: tuple[Attached, ...]

    @property
    def confounded_names(self) -> tuple[str, ...]:
        """Names of these effects, with their bodies where they act on another."""
        return tuple(named_beside(rival, self.attached) for rival in self.confounded)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A refit with one or two more laws."""

    laws: tuple[Attached, ...]
    modes: list[Mode]
    choices: float
    same: tuple[Attached, ...] = ()
    gained: float = 0.0
    net: float = -np.inf
    share: float = 0.0


def weights(mode: Mode) -> Floats:
    """Return the effective number of measurements of each dimension, shape (state,)."""
    likelihood = output_error(mode.problem)
    return np.asarray(likelihood.starts.counts / np.array(likelihood.tau))


def nats(before: Mode, after: Mode, weight: Floats | None = None) -> tuple[float, float]:
    """Return the log-evidence of a fall of the simulation error, and the effective sample size.

    ``sum over dimensions of n / tau * log(sigma_before / sigma_after)``, with the integrated
    autocorrelation time tau of the residual under the model with the smaller error, or with other
    ``weight``, shape (state,).
    """
    weight = weights(after) if weight is None else weight
    return float((weight * np.log(before.sigma / after.sigma)).sum()), float(weight.sum())


def net_evidence(
    before: Mode, after: Mode, choices: float = 0.0, weight: Floats | None = None
) -> float:
    """Return the evidence less its price: parameters, their prior, and what was tried.

    ``choices`` is the logarithm of the number of candidates and grid points.
    """
    gained, effective = nats(before, after, weight)
    price = 0.5 * _more_informed(before, after) * np.log(max(effective, 2.0)) + choices
    return float(gained - price - max(_prior(after) - _prior(before), 0.0))


def _more_informed(before: Mode, after: Mode) -> int:
    """Return how many of a model's further parameters the data inform; all that are scanned."""
    layout = after.problem.layout
    width = np.sqrt(np.maximum(np.diag(after.covariance), 0.0))
    informed = width * np.abs(prior_slopes(layout.priors, after.phi)) < DEFAULT.selection.informed
    return sum(
        attached.effect.scan is not None or bool(informed[place])
        for attached in after.problem.physics.effects
        if attached not in before.problem.physics.effects
        for place in layout.places(attached.labels)
    )


def worth_of(mode: Mode, attached: Attached, sizes: Floats, enough: float) -> float:
    """Return the net evidence of one more law, its first sizes given, shape (q,): credit by drop.

    ``mode`` is of simulated pieces. A first fit that is worth ``enough`` is not carried on.
    """
    effects, known = mode.problem.physics.effects, [derivatives(mode)]
    within = climb_ladder([with_effects(mode, (*effects, attached), {attached: sizes})], known)
    for _ in range(2):
        (dropped,) = climb_ladder([with_effects(within[0], effects)], known)
        before = dropped if nats(mode, dropped)[0] > 0 else mode
        worth = net_evidence(before, within[0])
        if worth >= enough:
            break
        within = refined(within)
    return worth


def share_taken(before: Mode, after: Mode) -> float:
    """Return the share of the simulation error that is gone, over all dimensions by evidence."""
    gained, effective = nats(before, after)
    return 1.0 - float(np.exp(-gained / max(effective, 1.0)))


@dataclass(eq=False)
class SimulatedSearch:
    """Stepwise search for effects by simulation error.

    Parameters
    ----------
    missing : callable
        Returns the candidate effects of a model, given its mode.
    criteria : Criteria
        Thresholds.
    say : callable
        Called with what was found.
    """

    missing: Callable[[Mode], tuple[Attached, ...]]
    criteria: Criteria = DEFAULT
    say: Callable[[str], None] = field(default=lambda sentence: None)

    def __call__(self, mode: Mode) -> Simulated:
        """Return the laws that the simulation error of a model's trajectories shows.

        Parameters
        ----------
        mode : Mode
            Of whole trajectories.

        Raises
        ------
        HistoryError
            If no trajectory has three rows, or start states can follow all that was measured.
        """
        limits = self.criteria.simulation
        now = ladder(mode)
        declared = now[-1]
        laws: list[Accepted] = []
        tried: dict[Attached, tuple[float, float]] = {}
        again = limits.restarts
        while len(laws) < self.criteria.most_added and not self._white(now):
            trials = self._trials(now, pairs=not laws)
            if not laws:
                tried = {
                    law: (trial.net, trial.share)
                    for trial in trials if len(trial.laws) == 1
                    for law in (*trial.laws, *trial.same)
                }  # fmt: skip
            best = self._best(trials)
            while best is not None and again:
                dropped = _without(best.modes[-1], best.laws)
                if nats(now[-1], dropped)[0] <= 1.0:
                    break
                again -= 1  # it was not at its optimum
                now = [*now[:-1], dropped]
                declared = declared if laws else dropped
                trials = _compared(now, trials)
                best = self._best(trials)
            if best is None:
                break
            close = [
                law for trial in trials for law in (*trial.laws, *trial.same)
                if len(trial.laws) == 1 and trial.gained > best.gained - limits.least_nats
            ]  # fmt: skip
            now = best.modes
            for law in best.laws:
                others = tuple(rival for rival in close if rival not in best.laws)
                laws.append(Accepted(law, others))
                self.say(f"simulations name {law.effect.name} on {law.body}")
        last, laws, without = self._pruned(now[-1], laws)
        named = {law.attached for law in laws}
        laws = [
            replace(law, confounded=tuple(rival for rival in law.confounded if rival not in named))
            for law in laws
        ]
        return Simulated(declared, last, tuple(laws), tuple(without), tried)

    def _white(self, now: list[Mode]) -> bool:
        """Return whether the residual is white at every length: a law would leave it correlated.

        Short or sparse trajectories do not show it: fitted start states take the correlation away.
        """
        limits, data = self.criteria.simulation, now[-1].problem.data
        shown = data.horizon >= limits.long and longest_gap(data.history) == 1
        times = [max(output_error(mode.problem).tau, default=1.0) for mode in now]
        return shown and max(times) < limits.white

    def _best(self, trials: list[_Trial]) -> _Trial | None:
        """Return the trial to accept: of nearly equal ones the simpler, then the earlier."""
        limits, share = self.criteria.simulation, self.criteria.simulation.least_share
        if trials and trials[0].modes[-1].problem.data.history.n_trajectories == 1:
            share = limits.least_share_alone
        enough = [
            tried for tried in trials if tried.net >= limits.least_nats and tried.share >= share
        ]  # fmt: skip
        if not enough:
            return None
        highest = max(trial.net for trial in enough)
        single = [trial for trial in enough if len(trial.laws) == 1]
        if single and max(trial.net for trial in single) > highest - limits.least_nats:
            enough, highest = single, max(trial.net for trial in single)
        tied = [trial for trial in enough if trial.net > highest - self.criteria.selection.tie]
        return max(tied, key=lambda trial: (-len(trial.modes[-1].phi), trial.net))

    def _trials(self, now: list[Mode], pairs: bool) -> list[_Trial]:
        """Return refits with leading candidates and, where the best leaves a law, with their pairs.

        Pairs are tried if ``pairs`` says so, and where no candidate alone is good enough.
        """
        limits = self.criteria.simulation
        candidates = [
            candidate
            for candidate in self.missing(now[-1])
            if not isinstance(candidate.effect.stage, Noise)
        ]
        cheap = [corrected(mode) for mode in now]
        ranked = [rank_candidates(mode, candidates, self.criteria) for mode in cheap]
        scores = [{signature.attached: signature for signature in scored} for scored in ranked]

        def same(one: Attached) -> tuple[Attached, ...]:
            """Return the candidates that are the same law here, to rounding."""
            return tuple(
                other for other in candidates
                if other is one
                or (
                    len(other.labels) == len(one.labels)
                    and all(twins(scored[one], scored[other], self.criteria) for scored in scores)
                )
            )  # fmt: skip

        parents = [derivatives(mode) for mode in cheap]
        leaders: dict[Attached, Floats] = {}
        for signatures in ranked:
            leading = 0
            for signature in sorted(signatures, key=lambda signature: -signature.fall):
                if 2 * signature.fall < limits.least_score or leading == limits.leaders:
                    break
                if leaders.keys().isdisjoint((signature.attached, *same(signature.attached))):
                    leaders[signature.attached] = self._first_size(signature)
                    leading += 1
        distinct: list[Attached] = []
        for candidate in candidates:
            seen = any(scored[candidate].basis.shape[1] for scored in scores)
            if seen and set(distinct).isdisjoint(same(candidate)):
                distinct.append(candidate)
        choices = {
            law: float(np.log(len(distinct) * max(1, scores[-1][law].candidate.looks)))
            for law in leaders
        }

        def alone(law: Attached) -> _Trial:
            trial = self._trial(now, parents, {law: leaders[law]}, choices[law])
            return replace(
                trial, same=tuple(candidate for candidate in same(law) if candidate != law)
            )

        if leaders:
            self.say(f"simulating with each of {len(leaders)} candidates")
        trials = self._refined(now, in_parallel(alone, leaders))
        if trials and not self._white(trials[0].modes) and (pairs or self._best(trials) is None):
            both: list[dict[Attached, Floats]] = []
            some = [trial for trial in trials if trial.share >= self.criteria.negligible]
            for pair in combinations(some[: limits.paired], 2):
                first, second = (scores[-1][trial.laws[0]] for trial in pair)
                if twins(first, second, self.criteria):
                    continue
                both.append(
                    {trial.laws[0]: sizes_of(trial.modes[0], trial.laws[0]) for trial in pair}
                )

            def together(begin: dict[Attached, Floats]) -> _Trial:
                return self._trial(now, parents, begin, sum(choices[law] for law in begin))

            if both:
                self.say(f"simulating with {len(both)} pairs of them")
            trials += self._refined(now, in_parallel(together, both))
        return _compared(now, trials)

    def _first_size(self, signature: Signature) -> Floats:
        """Return where a candidate's refit begins, shape (q,).

        The score's estimate, no farther out than an effect's size may be: one that the declared
        parameters nearly absorb has no finite estimate.
        """
        effect = signature.attached.effect
        size = np.array(list(signature.candidate.estimate.values()))
        if effect.scan is not None:
            return size
        most = self.criteria.far_out * np.array([p.prior.scale for p in effect.parameters])
        null = np.array(effect.null)
        return np.asarray(null + np.clip(size - null, -most, most))

    def _refined(self, now: list[Mode], trials: list[_Trial]) -> list[_Trial]:
        """Return trials, best first, the leading ones fitted until they gain no more."""
        limits, done = self.criteria.simulation, list[_Trial]()
        rough = _compared(now, trials)
        while rough:
            best = max((trial.net for trial in done), default=0.0)
            near = rough[0].net > limits.worth_refining * max(best, 0.0)
            # with little evidence in the data none may stand out before its optimum
            large = rough[0].share >= limits.least_share
            if not (near or (best < limits.least_nats and large and len(done) < limits.leaders)):
                break
            trial = rough.pop(0)
            done.append(replace(trial, modes=refined(trial.modes)))
            rough, done = _compared(now, rough), _compared(now, done)
        return [*done, *rough]

    def _trial(
        self,
        now: list[Mode],
        parents: list[Linear],
        begin: dict[Attached, Floats],
        choices: float,
    ) -> _Trial:
        """Return the refit with some laws, at every length."""
        laws = tuple(begin)
        starts = [with_effects(m, (*m.problem.physics.effects, *laws), begin) for m in now]
        return _Trial(laws, climb_ladder(starts, parents), choices)

    def _pruned(self, mode: Mode, laws: list[Accepted]) -> tuple[Mode, list[Accepted], list[Mode]]:
        """Drop laws that later ones have made needless; return the models without each as well."""
        while True:
            without = in_parallel(partial(_without, mode), [(law.attached,) for law in laws])
            if len(laws) < 2:
                break
            worth = [net_evidence(smaller, mode) for smaller in without]
            taken = [share_taken(smaller, mode) for smaller in without]
            least = int(np.argmin(worth))
            enough = worth[least] > self.criteria.simulation.least_nats
            if enough and taken[least] > self.criteria.negligible:
                break
            mode = without[least]
            laws = [law for law in laws if law is not laws[least]]
        return mode, laws, without


def _law(mode: Mode, accepted: Accepted, without: Mode) -> Law:
    """Return an accepted law with what it is worth in the last model."""
    attached = accepted.attached
    effect = attached.effect
    places = mode.problem.layout.places(attached.labels)
    sd = np.sqrt(np.diag(mode.covariance)[places])
    names = [parameter.name for parameter in effect.parameters]
    return Law(
        effect=effect.name,
        body=attached.body,
        sentence=effect.sentence,
        estimate=dict(zip(names, mode.phi[places].tolist(), strict=True)),
        sd=dict(zip(names, sd.tolist(), strict=True)),
        units={parameter.name: parameter.unit for parameter in effect.parameters},
        nats=net_evidence(without, mode),
        share=share_taken(without, mode),
        confounded=accepted.confounded_names,
    )


def _compared(now: list[Mode], trials: list[_Trial]) -> list[_Trial]:
    """Return trials with their evidence beside a model, best first.

    All are judged by the correlation of the smallest residual: a model whose residual is white
    would else outdo one with a smaller error.
    """
    if not trials:
        return []
    before = now[-1]
    shares = [share_taken(before, trial.modes[-1]) for trial in trials]
    weight = weights(trials[int(np.argmax(shares))].modes[-1])
    judged = [
        replace(
            trial, share=share, gained=nats(before, trial.modes[-1], weight)[0],
            net=net_evidence(
                before, trial.modes[-1], trial.choices, weight
            ),
        )
        for trial, share in zip(trials, shares, strict=True)
    ]  # fmt: skip
    return sorted(judged, key=lambda trial: -trial.net)


def _without(mode: Mode, laws: Sequence[Attached]) -> Mode:
    """Return the mode without some laws, refitted from where they were."""
    kept = tuple(law for law in mode.problem.physics.effects if law not in laws)
    return fit_pieces(*with_effects(mode, kept))


def sizes_of(mode: Mode, law: Attached) -> Floats:
    """Return the parameters of a law at a mode, shape (q,)."""
    return mode.phi[mode.problem.layout.places(law.labels)]


def _prior(mode: Mode) -> float:
    """Return the negative log-prior of a mode's parameters, up to a constant."""
    return 0.5 * float((prior_residual(mode.problem.layout.priors, mode.phi) ** 2).sum())
