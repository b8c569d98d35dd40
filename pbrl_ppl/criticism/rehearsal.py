"""Rehearsal of a recording: which laws would be named, before anything is recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.score import ScoreTest, linearised, named_beside, null_sides
from pbrl_ppl.criticism.search import LIKELY, is_out_of_phase
from pbrl_ppl.criticism.subsets import Term, worth
from pbrl_ppl.criticism.trial_recording import measured, parameters_of, simulated
from pbrl_ppl.effects import Attached, Effect, Noise, attach, candidates
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem, in_pieces
from pbrl_ppl.modes import MOST_GROWTH, SimulatedMode, corrected, fit_pieces, growth, piece_lengths
from pbrl_ppl.physics import Physics, touching
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats
from pbrl_ppl.threads import in_parallel, one_blas_thread

#: Names are compared at this many times the least size that is seen.
_WELL_SEEN = 3.0
#: Sizes that are tried, as multiples of the one that is found in white noise.
_FACTORS = 1.3 ** np.arange(20)


@dataclass(frozen=True)
class RehearsedLaw:
    """What a recording would show of a law that the model lacks.

    Parameters
    ----------
    effect, body, sentence : str
        Names of the effect and of the body, and the effect in words.
    sizes : dict of str to float
        Change of each parameter from its null value from which on the law is found, the others at
        their null values, SI units; empty if unseen.
    levels : dict of str to float
        Of a threshold or a limit, the value nearest to none at which it is found, SI units.
    null, units : dict of str to float or str
        Null value and unit of each parameter.
    share : float
        Least of the sizes over the scale of the parameter's prior, which is its typical size;
        infinite if unseen. Of a whole change, as by a threshold, the share that would be seen.
    named : str
        The law that is named; another one where that is the same here, or explains the recording as
        well and is simpler. Empty if unseen.
    confounded : tuple of str
        Laws that explain a recording with three times the size as well, within the criteria's nats.
    note : str
        Where it is seen, or why it is not.
    """

    effect: str
    body: str
    sentence: str
    sizes: Mapping[str, float]
    levels: Mapping[str, float]
    null: Mapping[str, float]
    units: Mapping[str, str]
    share: float
    named: str
    confounded: tuple[str, ...]
    note: str


@dataclass(frozen=True)
class Rehearsal:
    """What a recording would show of each law of a catalogue.

    Parameters
    ----------
    laws : tuple of RehearsedLaw
        Those that are seen best first.
    history : History
        The declared model's simulation, with measurement noise.
    parameters, noise : dict of str to float
        What it was simulated with, SI units.
    seconds : float
        Length of the simulated pieces (s).
    """

    laws: tuple[RehearsedLaw, ...]
    history: History
    parameters: Mapping[str, float]
    noise: Mapping[str, float]
    seconds: float


@one_blas_thread
def rehearse(
    scene: Scene,
    commands: History | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> Rehearsal:
    """Find out which laws a recording would show, and from which size on, before it is made.

    The declared model is simulated once, with measurement noise. There, without a refit, each law
    of the catalogue is linearised as in the search of :func:`pbrl_ppl.attribute`, declared
    parameters and initial states projected out, and the size read off at which its log-evidence and
    its share of the simulation error pass the thresholds of :class:`SearchCriteria`. The law is
    then added to the residual, and the same regression says which name wins.

    Parameters
    ----------
    scene : Scene
        The declared model; its ``noise`` is that of the sensors, a thousandth of the motion where
        it says nothing.
    commands : History, optional
        Initial states and wrenches. What it measures after the first rows will be measured; if
        nothing, the dimensions of the scene's ``noise``, or else x, y and theta. By default four
        trajectories of pushes, pauses and pushes back of random sizes are proposed.
    parameters : mapping of str to float, optional
        Values of declared parameters by label, such as ``mass[cart]``, or by name for all bodies,
        SI units; the prior's centre by default.
    catalogue : iterable of Effect
        Effects to consider.
    seed : int
        Seed of the noise and of proposed pushes.
    criteria : Criteria
        Thresholds of the search.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Rehearsal
        Each law, and the simulated recording.

    Raises
    ------
    HistoryError
        If the commands do not fit the scene, or none can be proposed.
    ParameterError
        If a parameter is unknown.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> puck = Body("puck", Shape.circle(0.1), known={"mass": 1.0, "r": 0.2, "mu_c": 0.2})
    >>> scene = Scene(time_step=0.1, normal_gravity=9.81, bodies=(puck,))
    >>> drag = [effect for effect in full_catalogue if effect.name == "linear_drag"]
    >>> (law,) = rehearse(scene, catalogue=drag).laws
    >>> law.named, 0.0 < law.sizes["coefficient"] < 0.1  # kg/s
    ('linear_drag', True)
    """
    say, catalogue = progress or (lambda stage: None), tuple(catalogue)
    rng = np.random.default_rng(seed)
    say("simulating the declared model")
    physics = Physics(scene, attach(scene, (), catalogue), threads=2)
    phi = parameters_of(physics, parameters or {})
    commands, states = simulated(physics, phi, commands, rng)
    history, noise = measured(scene, commands, states, rng)
    physics = physics.changed(scene=with_units(scene, history))
    problem = _apart(Problem.of(physics, history), states)
    tried = [
        one for one in candidates(problem.scene, physics.effects, catalogue)
        if not isinstance(one.effect.stage, Noise)
    ]  # fmt: skip
    regressions: list[_Regression] = []
    for mode in _known_modes(problem, phi, states)[::-1]:
        seconds = mode.problem.data.horizon * scene.time_step
        say(f"linearising {len(tried)} laws on pieces of {seconds:.3g} s")
        longer = regressions[-1] if regressions else None
        regressions.append(_Regression.of(mode, tried, criteria, longer))
    say("adding each law to the simulation")
    laws = in_parallel(partial(_rehearsed, regressions), tried)
    return Rehearsal(
        tuple(sorted(laws, key=lambda law: law.share)),
        history,
        dict(zip(physics.layout.labels, phi.tolist(), strict=True)),
        noise,
        regressions[0].mode.problem.data.horizon * scene.time_step,
    )


def _apart(problem: Problem, states: Floats) -> Problem:
    """Return the problem with breaks where bodies touch, if that is not most of the time.

    The instant of a collision is no smooth function of anything.
    """
    rows = np.asarray(np.isfinite(states).all(axis=(2, 3)))
    touched = np.logical_and(rows[:, :-1], rows[:, 1:])
    begin, end = states[:, :-1][touched], states[:, 1:][touched]
    touched[touched] = touching(problem.scene, begin, end)
    return problem.with_data(breaks=touched) if 0.0 < touched.mean() < 0.5 else problem


def _known_modes(problem: Problem, phi: Floats, states: Floats) -> list[SimulatedMode]:
    """Return the modes of a simulated recording at its true parameters and states.

    On pieces, the shortest first, up to where an initial state is magnified.
    """

    def at(length: int) -> SimulatedMode:
        return fit_pieces(in_pieces(problem, length, states), phi, rounds=0)

    longest = at(max(states.shape[1] - 1, 2))
    modes = [at(length) for length in piece_lengths(longest)[:-1]]
    kept = [mode for mode in (*modes, longest) if growth(mode.problem) <= MOST_GROWTH]
    return [corrected(mode) for mode in kept or [longest]]


class _Way(NamedTuple):
    """A law of some size: by one of its parameters at a grid point, or by all of them.

    Parameters
    ----------
    share : float
        The size over the scale of the parameter's prior.
    size : float
        Change of the parameter; of a whole change, its share that is found in white noise.
    place : int or None
        The parameter; None for a whole change.
    direction : ndarray
        What a unit of it adds to the residual, to first order, in units of noise, shape (n,).
    term : Term
        The grid point.
    regression : _Regression
        Pieces of one length.
    """

    share: float
    size: float
    place: int | None
    direction: Floats
    term: Term
    regression: _Regression


@dataclass(frozen=True, eq=False)
class _Regression:
    """Regression at the true parameters on pieces of one length, and what a law adds to it.

    Parameters
    ----------
    mode : SimulatedMode
        Of the declared model.
    tests : ScoreTest
        Its residual, and what parameters absorb.
    terms : tuple of Term
        A candidate at a grid point each.
    basis : ndarray
        Their columns, shape (n, column).
    least_share : float
        Share of the simulation error that a law takes away.
    criteria : Criteria
        Other thresholds.
    longer : _Regression or None
        That on longer pieces.
    """

    mode: SimulatedMode
    tests: ScoreTest
    terms: tuple[Term, ...]
    basis: Floats
    least_share: float
    criteria: Criteria
    longer: _Regression | None

    @classmethod
    def of(
        cls,
        mode: SimulatedMode,
        tried: Sequence[Attached],
        criteria: Criteria,
        longer: _Regression | None,
    ) -> _Regression:
        """Linearise candidates at a mode."""
        tests, linear = linearised(mode, tried, criteria)
        visible, width, terms = sum(map(bool, linear.values())), 0, []
        bases = [np.zeros((len(tests.residual), 0))]
        for law, points in linear.items():
            price = np.log(visible * max(len(points), 1)) - law.effect.log_odds
            for point in points:
                columns = np.arange(width, width + point.basis.shape[1])
                terms.append(Term(law, point, columns, float(price)))
                bases.append(point.basis)
                width += len(columns)
        limits = criteria.search
        least = limits.least_share if longer else limits.small_share
        least = limits.alone if mode.problem.data.history.n_trajectories == 1 else least
        return cls(mode, tests, tuple(terms), np.hstack(bases), least, criteria, longer)

    @cached_property
    def counts(self) -> Floats:
        """Degrees of freedom of each dimension, shape (state,)."""
        return np.maximum(self.mode.problem.likelihood.initial_states.counts, 1.0)

    def ways(self, law: Attached) -> list[_Way]:
        """Return the sizes of a law that pay its price in white noise, the least share first."""
        ways, parameters, sides = list[_Way](), law.effect.parameters, null_sides(law)
        for term in (term for term in self.terms if term.law == law):
            linear, n = term.linear, float(self.counts.sum())
            paid = self.criteria.search.least_nats + term.price - worth(0.0, len(term.columns), n)
            places = linear.columns or (None,)
            for place, unit in zip(places, np.linalg.pinv(linear.back).T, strict=True):
                if not np.any(unit):
                    continue
                size = float(np.sqrt(2.0 * paid) / np.linalg.norm(unit))
                scale = 1.0 if place is None else parameters[place].prior.scale
                side = -1.0 if place is not None and sides[place] < 0 else 1.0
                direction = linear.basis @ (side * unit)
                ways.append(_Way(size / scale, size, place, direction, term, self))
        return sorted(ways, key=lambda way: way.share)

    def finds(self, way: _Way, size: float = 1.0) -> bool:
        """Return whether what a law of a size adds is proposed and accepted.

        A regression proposes it with the residual's autocorrelation time, which a slow law makes
        long; a refit, whose residual is white, confirms it. Where longer pieces are out of phase,
        its share does not matter.
        """
        n, sigma = self.counts, self.mode.sigma
        residual, square = self.refitted(size * way.direction)
        likelihood = self.mode.problem.likelihood
        tau = likelihood.correlation_times(residual * sigma, sigma * np.sqrt(square))
        share = min(float((n / tau * (1.0 - 1.0 / square)).sum() / (n / tau).sum()), 1.0 - 1e-12)
        gain, total, q = (
            float((0.5 * n * np.log(square)).sum()),
            float(n.sum()),
            len(way.term.columns),
        )
        accepted = gain + worth(0.0, q, total) - way.term.price >= self.criteria.search.least_nats
        if worth(share, q, (n / tau).sum()) < way.term.price or not accepted:
            return False
        enough = -np.expm1(-gain / total) >= self.least_share
        if enough and share >= 1.0 - (1.0 - LIKELY * self.least_share) ** 2:
            return True
        return self.longer is not None and self.longer.is_lost(way, size, sigma * np.sqrt(square))

    def is_lost(self, way: _Way, size: float, shorter: Floats) -> bool:
        """Return whether a law's error nears the motion's size; ``shorter`` is that before."""
        values = self.mode.problem.observations.values
        square = self.refitted(self.added(way, size))[1]
        return is_out_of_phase(self.mode.sigma * np.sqrt(square), shorter, values)

    def refitted(self, added: Floats) -> tuple[Floats, Floats]:
        """Return the residual of a refit with what a law adds, and its squared size, (state,)."""
        square = np.ones(len(self.counts))
        for _ in range(3):  # noise and parameters depend on each other
            residual = self.fitted(self.tests.residual + added, square)
            square = np.maximum((residual**2).sum((0, 1, 2)) / self.before, 1.0)
        return residual, square

    @cached_property
    def before(self) -> Floats:
        """Squared residual of each dimension without any law, shape (state,)."""
        residual = self.fitted(self.tests.residual, np.ones(len(self.counts)))
        return np.asarray((residual**2).sum((0, 1, 2)))

    def fitted(self, z: Floats, square: Floats) -> Floats:
        """Return whitened rows after a refit of the declared parameters with other noise.

        Shape (piece, H, body, state), in units of the noise; ``square`` are the squared sizes of
        the other noise in these units, shape (state,).
        """
        pieces = self.mode.whitened_residual.shape
        shape = self.mode.problem.observations.values.shape
        column = self.mode.problem.likelihood.initial_states.column
        weight = 1.0 / np.sqrt(square)
        begin = np.where(column < 0, 1.0, weight[column])
        rows = np.concatenate([np.tile(weight, shape[1] * shape[2]), begin])
        weight = np.append(np.tile(rows, pieces[0]), np.ones(len(self.mode.phi)))
        q = np.linalg.qr(weight[:, None] * self.tests.q)[0]
        left = (weight * z - q @ (q.T @ (weight * z))) / weight
        return left[: np.prod(pieces)].reshape(pieces)[:, : np.prod(shape[1:])].reshape(shape)

    def least(self, way: _Way) -> _Way | None:
        """Return the least of a few sizes from which on a law is found, or None.

        A whole change has one size.
        """
        if way.place is None:
            return way if way.size < 1.0 and self.finds(way) else None
        found = takewhile(lambda each: self.finds(way, each * way.size), _FACTORS[::-1])
        factor = min(found, default=None)
        if factor is None:
            return None
        return way._replace(share=float(factor * way.share), size=float(factor * way.size))

    def added(self, way: _Way, size: float) -> Floats:
        """Return what a law adds to the residual, simulated, in units of noise, shape (n,)."""
        law, problem = way.term.law, self.mode.problem
        values = way.term.linear.values.astype(float)
        if way.place is not None:
            values[way.place] += -size if null_sides(law)[way.place] < 0 else size
        enlarged = problem.with_physics(effects=(*problem.physics.effects, law)).medium
        phi = np.tile(enlarged.layout.from_layout(problem.layout, self.mode.phi), (2, 1))
        phi[:, enlarged.layout.places(law.labels)] = law.effect.null, values
        null, there = np.nan_to_num(enlarged.whitened(phi, self.mode.sigma)).reshape(2, -1)
        return self.tests.left(np.pad(null - there, (0, len(self.mode.phi))))

    def named(self, law: Attached, added: Floats) -> tuple[str, tuple[str, ...]]:
        """Return which law is named where one adds to the residual, and those within some nats."""
        residual, within = self.tests.residual + added, self.criteria.search.least_nats
        towards, total = self.basis.T @ residual, float(residual @ residual)
        nats: dict[Attached, float] = {}
        for term in self.terms:
            coordinates = towards[term.columns]
            clipped = term.sizes(coordinates, self.criteria.far_out)
            if clipped is None or not np.allclose(clipped, term.linear.sizes(coordinates)):
                continue
            share = min(float(coordinates @ coordinates) / total, 1.0 - 1e-12)
            value = worth(share, len(term.columns), float(self.counts.sum())) - term.price
            nats[term.law] = max(value, nats.get(term.law, -np.inf))
        tied = [one for one, value in nats.items() if value > max(nats.values()) - within]
        few = min(len(one.labels) for one in tied)
        simple = [one for one in tied if len(one.labels) == few]
        # of the same physics the first in the catalogue
        first = next(one for one in simple if nats[one] > max(map(nats.__getitem__, simple)) - 1.0)
        evidence = {one: value - one.effect.log_odds for one, value in nats.items()}
        least = evidence.get(law, max(evidence.values())) - within
        close = [one for one in nats if one != law and evidence[one] > least]
        return named_beside(first, law), tuple(named_beside(one, law) for one in close)


def _rehearsed(regressions: Sequence[_Regression], law: Attached) -> RehearsedLaw:
    """Return what is seen of a law on pieces of any length."""
    effect, parameters = law.effect, law.effect.parameters
    names = [parameter.name for parameter in parameters]
    unseen = RehearsedLaw(
        effect.name, law.body, effect.sentence, {}, {}, dict(zip(names, effect.null, strict=True)),
        {parameter.name: parameter.unit for parameter in parameters}, np.inf, "", (),
        "declared parameters absorb it, or it changes nothing here",
    )  # fmt: skip
    ways = [way for one in regressions for way in one.ways(law)]
    if not ways:
        return unseen
    sized = {
        (id(way.regression), way.place): way for way in reversed(ways) if way.place is not None
    }
    least: dict[tuple[int | None, bytes], _Way] = {}
    for way in sorted(sized.values(), key=lambda way: way.share) or ways:
        # of a whole change, each point
        key = way.place, b"" if way.place is not None else way.term.linear.values.tobytes()
        if key not in least or way.share < least[key].share:  # of white noise, the least
            one = way.regression.least(way)
            if one is not None and one.share < way.regression.criteria.far_out:
                least[key] = min(one, least.get(key, one), key=lambda way: way.share)
    found = sorted(least.values(), key=lambda way: way.share)
    if not found:
        return replace(unseen, note="too small, or like a correlated error of the sensor")
    best, note, levels = found[0], "", dict[str, float]()
    sizes = {names[way.place]: way.size for way in found if way.place is not None}
    if best.place is None:
        points = {way.term.linear.values.tobytes() for way in ways}
        note = f"seen at {len(found)} of {len(points)} places, times or levels"
        if len(names) == 1:
            seen = [float(way.term.linear.values[0]) for way in found]
            levels[names[0]] = min(seen, key=lambda level: abs(level - effect.null[0]))
    named, confounded = best.regression.named(
        law, best.regression.added(best, _WELL_SEEN * best.size)
    )
    return RehearsedLaw(
        effect.name, law.body, effect.sentence, sizes, levels, unseen.null, unseen.units,
        best.share, named, confounded, note,
    )  # fmt: skip
