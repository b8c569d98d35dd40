"""Search for missing laws by simulation error: common laws first, from short pieces to long ones.

Without process noise, which would follow whatever is smooth, a missing law piles up along a
trajectory. On short pieces that error is nearly linear in all laws, so that one regression proposes
which of them are missing together; a few proposals are refitted there, and longer pieces are
simulated with the laws found so far (output error: L. Ljung, System Identification, 1999). An
unusual law takes a part of any misfit away: it has to explain all that common ones leave.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import Law, SearchLength, Stage
from pbrl_ppl.criticism.score import Library, named_beside
from pbrl_ppl.criticism.subsets import Regression, Subset, best_subsets, by_label
from pbrl_ppl.criticism.table import (
    Table,
    far_out,
    informed,
    moving,
    refit,
    share,
    sizes_of,
    weights,
)
from pbrl_ppl.effects import Attached, Structure
from pbrl_ppl.history import History, drawn_pieces
from pbrl_ppl.likelihood import Problem, in_pieces, is_filtered, is_independent, is_simulated
from pbrl_ppl.modes import (
    MOST_GROWTH,
    FilteredMode,
    Mode,
    SimulatedMode,
    corrected,
    find_mode,
    fit_pieces,
    fit_pieces_closely,
    growth,
    is_simulated_mode,
    piece_lengths,
    simulated_states,
    with_robust_covariance,
)
from pbrl_ppl.state import Bools, Floats
from pbrl_ppl.system.threads import Say, in_parallel, silent


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Laws that a search names.

    Parameters
    ----------
    declared, after : Mode
        The declared model and the one with the laws, on the longest pieces.
    laws : dict of Attached to Law
        The laws with what each is worth there, those that take most of the error off first.
    candidates : dict of Attached to Law
        All candidates by their score tests on the shortest pieces, best first, with what each is
        worth alone to first order and the decision on it.
    lengths : tuple of SearchLength
        What was found at each length of pieces.
    rejected : dict of Attached to str
        Why a law that was found on shorter pieces is not among them.
    lesser : tuple of Law
        Laws that are there and no main ones, those that take most of the error off first.
    hypotheses : tuple of Law
        Unusual laws that explain a part of what common ones leave, to first order.
    doubt : str
        Why the laws that were found are none: gravity is wrong, or a unit.
    """

    declared: Mode
    after: Mode
    laws: Mapping[Attached, Law] = field(default_factory=dict)
    candidates: Mapping[Attached, Law] = field(default_factory=dict)
    lengths: tuple[SearchLength, ...] = ()
    rejected: Mapping[Attached, str] = field(default_factory=dict)
    lesser: tuple[Law, ...] = ()
    hypotheses: tuple[Law, ...] = ()
    doubt: str = ""

    def on(self, whole: Mode) -> SearchResult:
        """Return the same laws with their models refitted to the history of another mode.

        ``whole``: the declared model's, of whole trajectories.
        """
        data = whole.problem.data

        def on_all(mode: Mode) -> Mode:
            problem = mode.problem.with_data(history=data.history, breaks=None)
            if not is_simulated_mode(mode):
                return find_mode(problem, initial=mode.phi)
            pieces = in_pieces(problem, mode.problem.data.horizon, data.smoothed_states)
            return with_robust_covariance(fit_pieces_closely(pieces, mode.phi))

        return self.refitted(on_all)

    def refitted(self, fitted: Callable[[Mode], Mode]) -> SearchResult:
        """Return the same laws with their models refitted; without laws these are one."""
        modes = in_parallel(fitted, [self.declared, self.after] if self.laws else [self.after])
        return replace(self, declared=modes[0], after=modes[-1])


@dataclass(eq=False)
class _Climb:
    """A model on its way up the lengths of pieces.

    Parameters
    ----------
    mode : Mode
        The model.
    table : Table
        Models on pieces of its length.
    unusual : bool
        Whether unusual laws are among the candidates.
    noise : ndarray
        Error on the shortest pieces, shape (state,), SI units.
    earlier : dict of Attached to float
        Evidence of each law, summed over lengths (nats).
    lengths : list of SearchLength
        What was found at each length.
    modes : list of Mode
        The model at each length.
    regressions : list of Regression
        The first regression at each length.
    first_order : dict of Attached to float
        Evidence of each law to first order (nats).
    same : dict of Attached to tuple of Attached
        Candidates that are the same physics as a law.
    small : dict of Attached to float
        Laws that were left out as no main ones, and their shares of the error.
    last : bool
        Whether the pieces are the longest ones.
    """

    mode: Mode
    table: Table
    unusual: bool
    noise: Floats = field(default_factory=lambda: np.zeros(0))
    earlier: dict[Attached, float] = field(default_factory=dict)
    lengths: list[SearchLength] = field(default_factory=list)
    modes: list[Mode] = field(default_factory=list)
    regressions: list[Regression] = field(default_factory=list)
    first_order: dict[Attached, float] = field(default_factory=dict)
    same: dict[Attached, tuple[Attached, ...]] = field(default_factory=dict)
    small: dict[Attached, float] = field(default_factory=dict)
    last: bool = False

    @property
    def laws(self) -> tuple[Attached, ...]:
        """Laws of the model."""
        return self.table.laws(self.mode)

    def excesses(self, mode: Mode) -> Floats:
        """Return errors over those on the shortest pieces and their sampling error, (state,)."""
        weight = weights(mode)
        sampling = 1.0 + 2.0 / np.sqrt(2.0 * np.maximum(weight, 1.0))
        return np.where(weight > 0, mode.sigma / self.noise / sampling, 0.0)

    @property
    def excess(self) -> float:
        """The largest of the model's."""
        return float(self.excesses(self.mode).max(initial=0.0))


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
        Called with what was found, and with what is done now.
    predicted : float
        Least ratio of predicted to required error reduction for a refit.
    clear : float
        Evidence above which drop-one refits are skipped (nats).
    """

    missing: Callable[[Mode], Sequence[Attached]]
    criteria: Criteria = DEFAULT
    say: Say = silent
    predicted: float = 0.7
    clear: float = 30.0

    def __call__(self, mode: Mode, laws: Mapping[Attached, Floats] | None = None) -> SearchResult:
        """Return the laws that a model's simulation error shows.

        Parameters
        ----------
        mode : Mode
            Of the declared model: of whole trajectories, which are cut into pieces, or of single
            transitions, which are judged as they are.
        laws : dict of Attached to ndarray, optional
            Laws to begin with, and their sizes, shape (q,).

        Raises
        ------
        HistoryError
            If no trajectory has three rows, or initial states can follow all that was measured.
        """
        limits, single = self.criteria.search, is_independent(mode.problem)
        lengths = [mode.problem.data.horizon] if single else piece_lengths(mode)
        short: Mode = mode
        if not single:
            states = mode.problem.data.smoothed_states
            short = fit_pieces(in_pieces(_apart(mode, lengths[0]), lengths[0], states), mode.phi)
        declared = short.problem.physics.effects
        tried = max(len(self._candidates(short, single)), 1)
        table = Table(declared, tried, modes={frozenset(): short})
        begun = table.fitted(short, laws or {}, by_label(laws or {}))
        common = best = _Climb(begun, table, unusual=single)
        self._climb(common, lengths)
        self._leave_out(common)
        hypotheses: Mapping[Attached, float] = {}
        several = mode.problem.data.history.n_trajectories > 1 and not single
        lost = len(common.modes) < len(lengths)
        if several and (lost or common.excess > limits.complete):
            i, hypotheses = self._promised(common, lost)
            if i is not None:
                self.say("common laws leave more than the noise: trying unusual ones")
                tried, begun = len(self._candidates(short, True)), common.modes[i]
                modes = {frozenset(table.laws(begun)): begun}
                table = Table(declared, tried, {**common.table.points}, modes)
                more = _Climb(begun, table, True, common.noise, lengths=common.lengths[:i])
                self._climb(more, lengths[i:], common.modes[i:])
                common.regressions.append(more.regressions[0])
                if self._is_complete(more, common):
                    best, hypotheses = more, {}
                    self._leave_out(best)
        found = self._result(best, common.regressions, hypotheses)
        return found if single else _with_contacts(found, mode, lengths[0])

    def _promised(self, common: _Climb, lost: bool) -> tuple[int | None, dict[Attached, float]]:
        """Return at which length an unusual law may take most of the error beyond the noise off.

        To first order, beside the common laws, with one more, or in the place of one or all. The
        longest pieces are asked first, and shorter ones where these are too far off to tell. Also
        the leading ones alone, with their shares of the error on the longest pieces. Of a climb
        that was ``lost`` before these all error is beyond the noise.
        """
        limits, alone = self.criteria.search, dict[Attached, float]()
        found: int | None = None
        for i, mode in reversed([*enumerate(common.modes)]):
            excesses = common.excesses(mode)
            large = excesses > (0.0 if lost else limits.complete)
            if not large.any() or found is not None:
                break
            beyond = 1.0 if lost else 1.0 - float(np.exp(-np.log(excesses[large]).mean()))
            laws = common.table.laws(mode)
            library, now = self._library(mode, laws, large), 0.0
            every = [one for one in self._candidates(mode, True) if one not in laws]
            for without in dict.fromkeys(((), *((law,) for law in laws), laws)):
                total = float((library.test(without).residual ** 2).sum())
                now = now or total
                top = best_subsets(library, every, without, largest=2 - bool(without), say=self.say)
                left = dict[tuple[Attached, ...], float]()
                for one in top.subsets:  # of several grid points the best
                    rest = total * (1.0 - one.share)
                    left[one.laws] = min(rest, left.get(one.laws, rest))
                for laws_of, rest in left.items():
                    unusual = [law for law in laws_of if law.effect.unusual]
                    common_ones = tuple(law for law in laws_of if law not in unusual)
                    before = min(now, left.get(common_ones, now))
                    part = 1.0 - float(np.sqrt(rest / before))
                    if len(unusual) == 1 and part > limits.promise * beyond:
                        found = i
                    if len(unusual) == len(laws_of) == 1 and mode is common.modes[-1]:
                        alone[unusual[0]] = max(part, alone.get(unusual[0], 0.0))
        leading = sorted(alone, key=lambda law: -alone[law])[: limits.refits]
        return found, {law: alone[law] for law in leading if alone[law] >= limits.main_share}

    def of(
        self, train: History, fit: Callable[[History, FilteredMode | None], FilteredMode], seed: int
    ) -> tuple[FilteredMode, SearchResult]:
        """Return the declared model's mode, and the laws that it lacks.

        Of a long recording pieces are searched, and the models are refitted to all of it.

        Parameters
        ----------
        train : History
            Measured trajectories.
        fit : callable
            Returns the declared model's mode of whole trajectories, begun at that of a part of
            them, if any.
        seed : int
            Draws the pieces.
        """
        limits = self.criteria.search
        part, _ = drawn_pieces(train, limits.rows, seed, pieces=limits.pieces)
        mode = fit(part, None)
        self.say(Stage.SIMULATE)
        found = self(mode)
        if part is train:
            return mode, found
        mode = fit(train, mode)
        return mode, found.on(mode)

    def _candidates(self, mode: Mode, unusual: bool) -> list[Attached]:
        """Return the candidates of a model, common ones alone or all."""
        return [one for one in self.missing(mode) if unusual or not one.effect.unusual]

    def _is_complete(self, more: _Climb, common: _Climb) -> bool:
        """Return whether unusual laws explain all that common ones leave, or most of it."""
        plain, rows = common.mode, more.mode.problem.data.horizon
        if not any(law.effect.unusual for law in more.laws) or rows < plain.problem.data.horizon:
            return False
        if is_simulated_mode(plain) and plain.problem.data.horizon < rows:
            plain = _carried(plain, rows)
        return self._explains(more, plain)

    def _explains(self, climb: _Climb, plain: Mode, further: float = 0.0) -> bool:
        """Return whether a model explains all that a plain one leaves, or most of it.

        With a ``further`` share of its errors taken off.
        """
        limits, large = self.criteria.search, climb.excesses(plain) > self.criteria.search.complete
        falls = np.log(climb.mode.sigma / plain.sigma)[large]
        left = (1.0 - further) * float(np.exp(falls.mean() if large.any() else 0.0))
        return (1.0 - further) * climb.excess < limits.complete or left < limits.incomplete

    def _climb(self, climb: _Climb, lengths: Sequence[int], beside: Sequence[Mode] = ()) -> None:
        """Find the laws that pieces of growing length show, from a model at the first.

        ``beside``: models at each length, of which a complete explanation leaves less: the climb
        ends where it does not.
        """
        limits = self.criteria.search
        for i, length in enumerate(lengths):
            if i:
                longer = _carried(climb.mode, length)
                if _is_lost(climb.mode, longer):
                    # out of phase: what is significant and takes little away is taken on trial
                    regression = best_subsets(*self._linearised(climb), say=self.say)
                    trial = self._enlarged(climb, regression, 0.0)
                    longer = _carried(trial, length)
                    if trial is climb.mode or _is_lost(trial, longer):
                        break
                    climb.mode = trial
                climb.table = replace(
                    climb.table, behind={}, modes={frozenset(climb.table.laws(longer)): longer}
                )
                climb.mode = longer
            climb.last = bool(i) and length == lengths[-1]
            plain = beside[i] if i < len(beside) else None
            self._improve(climb, plain)
            if not climb.noise.size:
                climb.noise = climb.mode.sigma
            if plain and share(plain, climb.mode, weights(climb.mode)) < limits.least_share:
                break

    def _linearised(self, climb: _Climb) -> tuple[Library, list[Attached]]:
        """Return derivatives at a climb's model, and candidates beside at most one unusual law."""
        more = climb.unusual and not any(law.effect.unusual for law in climb.laws)
        return self._library(climb.mode, climb.laws), self._candidates(climb.mode, more)

    def _library(
        self, mode: Mode, laws: tuple[Attached, ...], dimensions: Bools | bool = True
    ) -> Library:
        """Return derivatives at a mode, of some dimensions, errors as if they were white.

        A lacking model's errors are correlated because of what it lacks.
        """
        if is_simulated_mode(mode):
            mode = corrected(mode)
            white = (1.0,) * len(mode.problem.likelihood.tau)
            # rounding of what does not move is no error of a law
            sigma = np.where(moving(mode) & dimensions, mode.sigma, np.inf)
            mode = replace(mode, problem=mode.problem.with_likelihood(tau=white), sigma=sigma)
        return Library(mode, laws, self.criteria)

    def _improve(self, climb: _Climb, plain: Mode | None = None, rounds: int = 8) -> None:
        """Improve a model on pieces of one length by moves from model to model.

        These end where no proposal explains most of what a ``plain`` one leaves.
        """
        table, before, begin = climb.table, climb.laws, climb.mode
        limits = self.criteria.search
        for i in range(rounds):
            library, candidates = self._linearised(climb)
            regression = best_subsets(library, candidates, say=self.say)
            if i == 0:
                climb.regressions.append(regression)
            instead = None
            if plain:
                most = max((one.share for one in regression.subsets if one.nats > 0), default=0.0)
                if i and not self._explains(climb, plain, 1.0 - float(np.sqrt(1.0 - most))):
                    break
                instead = best_subsets(library, candidates, climb.laws, largest=1)
            better = self._enlarged(climb, regression, limits.least_share, instead)
            if better is climb.mode:
                better = self._exchanged(climb, library, candidates)
            if better is climb.mode:
                break
            climb.mode = better
        laws, mode = climb.laws, climb.mode
        climb.modes.append(mode)
        for law in laws:
            nats = climb.first_order.get(law, 0.0)
            if nats < self.clear:
                nats = table.value(mode) - table.value(table.without(mode, law))
            climb.earlier[law] = climb.earlier.get(law, 0.0) + nats
        data, names = mode.problem.data, mode.problem.observations.names
        times = mode.problem.likelihood.tau if is_simulated(mode.problem) else ()
        climb.lengths.append(
            SearchLength(
                rows=data.horizon,
                seconds=data.horizon * mode.problem.scene.time_step,
                error=dict(zip(names, begin.sigma.tolist(), strict=True)),
                accepted=tuple(_name(law) for law in laws if law not in before),
                dropped=tuple(_name(law) for law in before if law not in laws),
                correlated=dict(zip(names, times, strict=False)),
            )
        )

    def _enlarged(
        self,
        climb: _Climb,
        regression: Regression,
        least_share: float,
        instead: Regression | None = None,
    ) -> Mode:
        """Return the model with the best of a few proposed subsets, or the climb's own.

        ``instead``: laws in the place of all that the climb has, which may stand in for one.
        """
        limits, least = self.criteria.search, 1.0 - (1.0 - self.predicted * least_share) ** 2
        least /= max(int(moving(climb.mode).sum()), 1)  # one dimension may show it alone
        for one in regression.signatures:
            climb.table.points[one.attached] = one.candidate.n_grid_points
        subsets = [
            one for one in regression.subsets
            if one.nats > 0 and one.share >= least
            and sum(bool(law.effect.unusual) for law in one.laws) <= 1
        ]  # fmt: skip
        # structures cost contact in the engine: they are refitted where they lead
        first = _structures(subsets[0]) if subsets else set()
        subsets = [one for one in subsets if _structures(one) <= first]
        proposals = subsets[: limits.refits]
        worth = 0.5 * subsets[0].nats if subsets else 0.0
        singles = [one for one in subsets if len(one.laws) == 1][: limits.singles]
        proposals += [one for one in singles if one.nats > worth]
        # friction has kinks, by which a regression underrates it
        everyday = [one for one in subsets if all(law.effect.log_odds == 0 for law in one.laws)]
        proposals += {len(one.laws): one for one in reversed(everyday)}.values()
        labels = climb.mode.problem.layout.labels
        moves = {frozenset((*climb.laws, *one.laws)): one.begin(labels) for one in proposals}
        for subset in proposals:  # a spring has the constant torque of its anchor
            kin = [law for law in climb.laws if any(_are_kin(law, new) for new in subset.laws)]
            if kin and any(law.effect.unusual for law in subset.laws):
                laws = frozenset((*climb.laws, *subset.laws)) - {*kin}
                moves[laws] = _without(subset.begin(labels), *kin)
        for subset in instead.subsets[: limits.singles] if instead and climb.laws else ():
            moves.setdefault(frozenset(subset.laws), subset.begin(_labels(climb.mode, *climb.laws)))
        return self._best(climb, moves, least_share)

    def _exchanged(self, climb: _Climb, library: Library, candidates: Sequence[Attached]) -> Mode:
        """Return the best model without a law or with another one in its place, or the same."""
        moves: dict[frozenset[Attached], Mapping[str, float]] = {}
        for law in climb.laws:
            rest, labels = frozenset(climb.laws) - {law}, _labels(library.mode, law)
            unusual = law.effect.unusual
            others = self._candidates(library.mode, climb.unusual) if unusual else candidates
            instead = best_subsets(library, [law, *others], (law,), largest=1, say=self.say)
            groups = [{first, *more} for first, more in instead.same.items()]
            same = next((group for group in groups if law in group), {law})
            climb.same[law] = tuple(one for one in others if one in same)
            own = max((one.nats for one in instead.subsets if one.laws[0] in same), default=0.0)
            climb.first_order[law] = own
            if own < self.clear:
                left = library.test((law,)).phi.tolist()
                moves[rest] = dict(zip(labels, left, strict=True))
            swaps = [
                one for one in instead.subsets
                if one.nats > 0.5 * max(own, 0.0) and one.laws[0] not in same
            ]  # fmt: skip
            alike = [one for one in instead.subsets if are_alike(law, one.laws[0])]
            for one in () if unusual else alike:  # a simpler one that is nearly as good
                simple = climb.table.fitted(climb.mode, rest | {*one.laws}, one.begin(labels))
                more = share(simple, climb.mode, climb.table.weight)
                if more < self.criteria.search.least_share:
                    return simple
            for one in (*swaps[: self.criteria.search.singles], *alike):
                moves.setdefault(rest | {*one.laws}, one.begin(labels))
        return self._best(climb, moves, 0.0)

    def _best(
        self,
        climb: _Climb,
        moves: Mapping[frozenset[Attached], Mapping[str, float]],
        least_share: float,
    ) -> Mode:
        """Return the best of some models, of those nearly as good the smallest; or the same."""
        table, now, laws = climb.table, climb.mode, frozenset(climb.laws)
        least, most = self.criteria.search.least_nats, self.criteria.far_out
        table.race(now, moves, self.say)
        fair = {  # a law of an impossible size takes no others with it
            key - {law}: _without(begin, law)
            for key, begin in moves.items() if key in table.modes
            for law in table.laws(table.modes[key])
            if law not in laws and far_out(table.modes[key], [law]) >= most
        }  # fmt: skip
        moves = {**moves, **fair}
        table.race(now, {key: begin for key, begin in fair.items() if len(key) > len(laws)})
        judged = [
            (*gain, table.modes[key]) for key in moves if key in table.modes and key != laws
            if (gain := self._gain(climb, key, least_share))
        ]  # fmt: skip
        top = max([0.0, *(gain for gain, *_ in judged)])
        near = [one for one in judged if one[0] >= one[1] and one[0] > top - least]
        if not near:
            return now
        _, needed, mode = min(near, key=lambda one: (len(one[2].phi), -one[0]))
        # repeatability of refits: friction has kinks, and the better model may only have been
        # climbed from elsewhere
        kept = by_label({law: sizes_of(now, law) for law in laws})
        again = refit(mode, now.problem.physics.effects, kept)
        if table.value(again) > table.value(now):
            table.modes[laws] = climb.mode = again
            if table.value(mode) - table.value(again) < needed:
                return again
        if new := [law for law in table.laws(mode) if law not in laws]:
            self.say(f"simulations name {' and '.join(map(_name, new))}")
        return mode

    def _gain(
        self, climb: _Climb, key: frozenset[Attached], least_share: float
    ) -> tuple[float, float] | None:
        """Return what a model with other laws gains, and has to gain (nats); None if it is none."""
        limits, table, now, laws = self.criteria.search, climb.table, climb.mode, {*climb.laws}
        mode = table.modes[key]
        gain = table.value(mode) - table.value(now)
        if key < laws:
            return gain - sum(climb.earlier.get(law, 0.0) for law in laws - key), 0.0
        # in a law's place one of more parameters follows whatever else is missing
        larger, more = len(key) > len(laws), len(mode.phi) - len(now.phi)
        needed_share = max(least_share, limits.least_share * (not larger and more > 0))
        if climb.last and len(key) > len(laws) + 1:  # no handful of small ones at the end
            needed_share = limits.main_share
        taken = share(now, mode, table.weight)
        if taken < needed_share or far_out(mode, key) >= self.criteria.far_out:
            return None
        # of two that are nearly as good the simpler one
        return gain, -limits.least_nats if not larger and more < 0 else limits.least_nats

    def _leave_out(self, climb: _Climb) -> None:
        """Leave out laws without evidence, and those that take less off than a main law."""
        limits, table, before = self.criteria.search, climb.table, climb.laws
        # a lasting error of the sensor or a random force follows a single trajectory as well
        single = climb.mode.problem.data.history.n_trajectories == 1
        least = limits.alone if single else limits.main_share
        while laws := climb.laws:
            law = min(laws, key=lambda one: climb.earlier.get(one, limits.least_nats))
            if climb.earlier.get(law, limits.least_nats) >= limits.least_nats:
                shares = table.shares(climb.mode, limits.main_share)
                law, part = next((one for one in shares if one[1] < least), (law, 1.0))
                if part >= least:
                    break
                climb.small[law] = part
            climb.mode = table.without(climb.mode, law)
        if climb.laws != before:
            better = self._exchanged(climb, *self._linearised(climb))
            if len(table.laws(better)) >= len(climb.laws):
                climb.mode = better
        for law in climb.laws:
            climb.small.pop(law, None)

    def _result(
        self, climb: _Climb, regressions: Sequence[Regression], hypotheses: Mapping[Attached, float]
    ) -> SearchResult:
        """Return what a table says of its best model and of what was tried."""
        table, mode, limits = climb.table, climb.mode, self.criteria.search
        by_share = sorted(table.shares(mode, limits.main_share), key=lambda one: -one[1])
        shares, declared = dict(by_share), table.fitted(mode, ())
        rejected = dict[Attached, str]()
        doubt = next(filter(None, (_weightless(mode, law) for law in shares)), "")
        if doubt:
            rejected, shares, mode = dict.fromkeys(shares, doubt), {}, declared
        if is_simulated_mode(mode):
            mode = with_robust_covariance(fit_pieces_closely(mode.problem, mode.phi))
        before = declared if shares else mode
        if shares and is_simulated_mode(before):
            before = with_robust_covariance(before)
        rivals = dict[Attached, list[Attached]]()
        for law in shares:  # a law of the same physics may have been refitted as well
            others = table.rivals(climb.mode, law, limits.least_nats)
            rivals[law] = [*dict.fromkeys((*climb.same.get(law, ()), *others))]
        named = {name for one in climb.lengths for name in one.accepted}
        for law in (one for one in climb.earlier if one not in {*shares, *climb.small, *rejected}):
            if _name(law) in named:
                rejected[law] = "longer simulations do not need it"
        for law, why in rejected.items():
            self.say(f"dropped {_name(law)}: {why}")
        decided = rejected | {
            rival: f"explains these data as well as {law.effect.name.replace('_', ' ')}"
            for law, others in rivals.items() for rival in others
        }  # fmt: skip
        for law, part in {**climb.small, **hypotheses}.items():
            decided[law] = f"takes {100 * part:.2g} % off the error of simulated trajectories"
        decided |= dict.fromkeys(shares, "added")
        scored = _scored(regressions)
        laws = {
            law: _named(law, scored.get(law), climb, mode, part, rivals[law])
            for law, part in shares.items()
        }
        little = "takes too little off the error of simulated trajectories"
        tried = {law: replace(one, why=decided.get(law, little)) for law, one in scored.items()}
        aside = _aside(climb.small), _aside(hypotheses)
        return SearchResult(
            before, mode, laws, tried, tuple(climb.lengths), rejected, *aside, doubt
        )


def _scored(regressions: Sequence[Regression]) -> dict[Attached, Law]:
    """Return each candidate's first score test, and what it is worth alone to first order."""
    laws = dict[Attached, Law]()
    for regression in regressions:
        for signature in regression.signatures:
            laws.setdefault(signature.attached, signature.candidate)
        for subset in (one for one in regression.subsets if len(one.laws) == 1):
            part = 1.0 - float(np.sqrt(1.0 - subset.share))
            for law in (*subset.laws, *regression.same[subset.laws[0]]):
                if (one := laws[law]).simulated_nats is None:
                    laws[law] = replace(one, simulated_nats=subset.nats, simulated_share=part)
    return laws


def _aside(shares: Mapping[Attached, float]) -> tuple[Law, ...]:
    """Return laws that are not added, those that take the largest shares off first."""
    by_share = sorted(shares.items(), key=lambda one: -one[1])
    return tuple(Law(law.effect.name, law.body, simulated_share=part) for law, part in by_share)


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


def _with_contacts(found: SearchResult, whole: Mode, shortest: int) -> SearchResult:
    """Return the result with its models fitted to contacts as well, which have parameters, too.

    These begin where the ``whole`` trajectories have them.
    """
    contacts = found.after.problem.data.breaks
    if contacts is None:
        return found

    def with_contacts(mode: Mode) -> Mode:
        if not is_simulated_mode(mode):
            return mode
        data, states = mode.problem.data, simulated_states(mode)
        problem = mode.problem.with_data(breaks=None)
        physics = problem.physics.changed(substeps=whole.problem.physics.substeps)
        problem = replace(problem, physics=physics.in_parts(data.history))
        known = problem.layout.from_layout(whole.problem.layout, whole.phi)
        pieces = in_pieces(problem, shortest, states)
        fitted = fit_pieces(pieces, _informed_or(known, mode))
        # a collision that the engine does not have, five times the noise off, stays left out
        off = np.abs(fitted.problem.residual(fitted.phi)).max(axis=(1, 2)) > 5.0 * mode.sigma
        segments, breaks = pieces.segments, np.zeros_like(contacts)
        for i in np.flatnonzero(off.any(axis=1)):
            rows = segments.trajectory[i], slice(segments.step[i], segments.step[i] + shortest)
            breaks[rows] = contacts[rows]
        pieces = in_pieces(problem.with_data(breaks=breaks), data.horizon, states)
        longer = fit_pieces_closely(pieces, fitted.phi)
        last = with_robust_covariance(fitted if growth(longer.problem) > MOST_GROWTH else longer)
        return replace(last, phi=_informed_or(known, last))

    return found.refitted(with_contacts)


def _informed_or(known: Floats, mode: Mode) -> Floats:
    """Return a mode's parameters, known ones where its data do not inform them, shape (p,)."""
    return np.where(informed(mode), mode.phi, known)


def _carried(mode: Mode, length: int) -> SimulatedMode:
    """Return the mode on longer pieces, which begin on the simulations of shorter ones."""
    return fit_pieces(in_pieces(mode.problem, length, simulated_states(mode)), mode.phi)


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
    paid = max(int(informed(after).sum()) - int(informed(before).sum()), 0)
    n, total = len(gains), float(gains.sum()) - paid
    return total, float(np.sqrt(n) * gains.std(ddof=1)) if n > 1 else float("nan")


def _named(
    law: Attached,
    scored: Law | None,
    climb: _Climb,
    mode: Mode,
    part: float,
    rivals: Sequence[Attached],
) -> Law:
    """Return a law with its sizes at a mode and what a climb says of it.

    It takes a ``part`` of the error off, has the score test ``scored``, if any, and ``rivals``.
    """
    effect, places = law.effect, mode.problem.layout.places(law.labels)
    sd = np.sqrt(np.diag(mode.covariance)[places])
    names = [parameter.name for parameter in effect.parameters]
    gain, error = elpd_gain(climb.table.without(climb.mode, law), mode)
    return replace(
        scored or Law(effect.name, law.body, effect.sentence),
        estimate=dict(zip(names, mode.phi[places].tolist(), strict=True)),
        sd=dict(zip(names, sd.tolist(), strict=True)),
        units={parameter.name: parameter.unit for parameter in effect.parameters},
        simulated_nats=climb.earlier.get(law, 0.0),
        simulated_share=part,
        not_separable_from=tuple(named_beside(rival, law) for rival in rivals),
        elpd_difference=gain,
        elpd_difference_se=error,
    )


def _weightless(mode: Mode, law: Attached, *, least: float = 0.9) -> str:
    """Return why a force that takes most of a body's weight off is none; empty if it does not."""
    scene, force = mode.problem.scene, sizes_of(mode, law)
    gravity = np.array(scene.gravity)
    if law.effect.name != "constant_force" or not gravity.any():
        return ""
    body = scene.body(law.body)
    known = dict(body.known).get("mass")
    mass = known or mode.phi[mode.problem.layout.index("mass", body.owner)]
    share = float(-(force @ gravity) / (mass * (gravity @ gravity)))
    why = (
        f"{law.body} falls with {100 * (1 - share):.2g} % of gravity: a wrong gravity, or a wrong"
        " unit of time or length"
    )
    return why if least < share <= 1.0 else ""


def are_alike(law: Attached, other: Attached) -> bool:
    """Return whether another law is a simpler one of a law's family, or any of an unusual law's.

    What an unusual law's grid points promise says little.
    """
    if other == law or not _are_kin(law, other):
        return False
    return bool(law.effect.unusual) or len(other.labels) < len(law.labels)


def _are_kin(law: Attached, other: Attached) -> bool:
    """Return whether two laws of a body are of one family."""
    family = law.effect.family
    return bool(family) and (family, law.body) == (other.effect.family, other.body)


def _without(begin: Mapping[str, float], *laws: Attached) -> dict[str, float]:
    """Return where parameters begin, by their labels, without those of some laws."""
    gone = {label for law in laws for label in law.labels}
    return {label: value for label, value in begin.items() if label not in gone}


def _labels(mode: Mode, *laws: Attached) -> list[str]:
    """Return the labels of a mode's parameters without those of some laws, in their order."""
    gone = {label for law in laws for label in law.labels}
    return [label for label in mode.problem.layout.labels if label not in gone]


def _structures(subset: Subset) -> set[Attached]:
    """Return the laws of a subset that add to the scene."""
    return {law for law in subset.laws if isinstance(law.effect.stage, Structure)}


def _is_lost(shorter: Mode, mode: SimulatedMode, *, far: float = 0.2, more: float = 3.0) -> bool:
    """Return whether pieces are too long to tell a law from.

    Their initial states are magnified, or the error nears the motion's size, where it is out of
    phase: from this share of the motion and multiple of the ``shorter`` pieces' error on.
    """
    motion = np.nanstd(mode.problem.observations.values, axis=(0, 1, 2))
    out_of_phase = (mode.sigma > far * motion) & (mode.sigma > more * shorter.sigma)
    return growth(mode.problem) > MOST_GROWTH or bool(out_of_phase.any())


def _name(law: Attached) -> str:
    """Return the names of an effect and its body."""
    return f"{law.effect.name} on {law.body}"
