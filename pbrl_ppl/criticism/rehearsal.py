"""Rehearsal of a recording: which laws would be named, before anything is recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.score import ScoreTest, linearised, named_beside, null_sides
from pbrl_ppl.criticism.subsets import Term, worth
from pbrl_ppl.effects import Attached, Effect, Noise, attach, candidates, is_pivoted
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import HistoryError, ParameterError
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem, in_pieces, output_error
from pbrl_ppl.modes import MOST_GROWTH, Mode, corrected, fit_pieces, growth, piece_lengths
from pbrl_ppl.physics import Physics, simulated_recording, touching
from pbrl_ppl.scene import Scene, motion_time, nearest, state_sizes, units_of
from pbrl_ppl.state import STATE, Floats
from pbrl_ppl.threads import in_parallel, one_blas_thread

#: Measurement noise where none is known, as a share of the motion.
_NOISE = 1e-3
#: Names are compared at this many times the least size that is seen.
_WELL_SEEN = 3.0
#: Sizes that are tried, as multiples of the one that is found in white noise.
_FACTORS = 1.2 ** np.arange(-2, 20)


@dataclass(frozen=True)
class RehearsedLaw:
    """What a recording would show of a law that the model lacks.

    Parameters
    ----------
    effect, body, sentence : str
        Names of the effect and of the body, and the effect in words.
    sizes : dict of str to float
        Least change of each parameter from its null value with which the law is found, the others
        at their null values, SI units; of a threshold, the value nearest to none. Empty if unseen.
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
    parameters and start states projected out, and the size read off at which its log-evidence and
    its share of the simulation error pass the thresholds of :class:`SearchCriteria`. The law is
    then added to the residual, and the same regression says which name wins.

    Parameters
    ----------
    scene : Scene
        The declared model; its ``noise`` is that of the sensors, a thousandth of the motion where
        it says nothing.
    commands : History, optional
        Start states and wrenches. What it measures after the first rows will be measured; if
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
    say, rng, catalogue = progress or (lambda stage: None), np.random.default_rng(seed), (*catalogue,)
    say("simulating the declared model")
    physics = Physics(scene, attach(scene, (), catalogue), threads=2)
    phi = _parameters(physics, parameters or {})
    commands, states = _simulated(physics, phi, commands, rng)
    history, noise = _measured(scene, commands, states, rng)
    physics = physics.changed(scene=with_units(scene, history))
    problem = _apart(Problem.of(physics, history), states)
    tried = [
        one for one in candidates(problem.scene, physics.effects, catalogue)
        if not isinstance(one.effect.stage, Noise)
    ]  # fmt: skip
    modes = _known_modes(problem, phi, states)
    single = history.n_trajectories == 1
    rungs = []
    for mode in modes:
        rows, limits = mode.problem.data.horizon, criteria.search
        say(f"linearising {len(tried)} laws on pieces of {rows * scene.time_step:.3g} s")
        share = limits.small_share if mode is modes[-1] else limits.least_share
        rungs.append(_Rung.of(mode, tried, criteria, limits.alone if single else share))
    say("adding each law to the simulation")
    laws = in_parallel(partial(_rehearsed, rungs), tried)
    return Rehearsal(
        tuple(sorted(laws, key=lambda law: law.share)),
        history,
        dict(zip(physics.layout.labels, phi.tolist(), strict=True)),
        noise,
        rows * scene.time_step,
    )


def _simulated(
    physics: Physics, phi: Floats, commands: History | None, rng: np.random.Generator
) -> tuple[History, Floats]:
    """Return commands and simulated states, shape (trajectory, time, body, 6), SI units.

    Pushes are proposed that move each body by its size, or turn it in its hinge by 0.25 rad.
    """
    # the engine of the pieces, so that their residual is noise alone
    if commands is not None:
        return commands, simulated_recording(physics.rough, phi[None], commands)[0]
    first = rng.bit_generator.state
    for push in (0.25, 1.0, 4.0):
        rng.bit_generator.state = first
        commands = _proposed(physics.scene, rng, push)
        (states,) = simulated_recording(physics.rough, phi[None], commands)
        x, y, theta = np.ptp(states[..., :3], axis=1).mean(axis=0).T
        bodies = zip(physics.scene.moving, np.hypot(x, y), theta, strict=True)
        if all(
            turn > 0.25 if is_pivoted(physics.scene, body) else way > body.shape.bounding_radius
            for body, way, turn in bodies
        ):
            break
    return commands, states


def _proposed(
    scene: Scene,
    rng: np.random.Generator,
    push: float,
    *,
    trajectories: int = 4,
    intervals: int = 100,
    turn: float = 0.2,
) -> History:
    """Return pushes, pauses and pushes back of random sizes, from rest at the scene's poses.

    Each is held for the time in which a typical force changes the motion. A body in a hinge is
    turned with ``push`` typical torques at most, another is pushed with as many typical forces and
    turned with a share ``turn`` of them.

    Raises
    ------
    HistoryError
        If a body follows a path.
    """
    bodies = scene.moving
    if any(body.kinematic for body in bodies):
        raise HistoryError("rehearse: a body follows a path; give a file of commands that has it")
    hold = max(2, round(motion_time(scene) / scene.time_step))
    states = np.full((trajectories, intervals + 1, len(bodies), len(STATE)), np.nan)
    most = np.zeros((len(bodies), 3))
    for i, body in enumerate(bodies):
        units, hinged = units_of(scene, body.name), is_pivoted(scene, body)
        states[:, 0, i] = (*(body.pose or (0.0, 0.0, 0.0)), 0.0, 0.0, 0.0)
        if hinged:  # the hinge says where it is
            states[:, 0, i, [0, 1, 3, 4]] = np.nan
        force = 0.0 if hinged else push * units.force
        most[i] = force, force, (1.0 if hinged else turn) * push * units.torque
    count = -(-intervals // (4 * hold))
    size = rng.uniform(-1.0, 1.0, (trajectories, count, len(bodies), 3)) * most
    pieces = np.stack([size, 0.0 * size, -size, 0.0 * size], axis=2)
    wrenches = np.repeat(pieces.reshape(trajectories, -1, len(bodies), 3), hold, axis=1)
    return History.of_arrays(states, scene, wrenches[:, :intervals])


def _apart(problem: Problem, states: Floats) -> Problem:
    """Return the problem with breaks where bodies touch, if that is not most of the time.

    The instant of a collision is no smooth function of anything.
    """
    rows = np.isfinite(states).all(axis=(2, 3))
    touched = rows[:, :-1] & rows[:, 1:]
    begin, end = states[:, :-1][touched], states[:, 1:][touched]
    touched[touched] = touching(problem.scene, begin, end)
    return problem.with_data(breaks=touched) if 0.0 < touched.mean() < 0.5 else problem


def _known_modes(problem: Problem, phi: Floats, states: Floats) -> list[Mode]:
    """Return the modes of a simulated recording at its true parameters and states.

    On pieces, the shortest first, up to where a start state is magnified.
    """

    def at(length: int) -> Mode:
        return fit_pieces(in_pieces(problem, length, states), phi, rounds=0)

    longest = at(max(states.shape[1] - 1, 2))
    modes = [at(length) for length in piece_lengths(longest)[:-1]]
    kept = [mode for mode in (*modes, longest) if growth(mode.problem) <= MOST_GROWTH]
    return [corrected(mode) for mode in kept or [longest]]


def _parameters(physics: Physics, given: Mapping[str, float]) -> Floats:
    """Return the parameters that are given by label or name, others at the prior's centre, (p,)."""
    labels = physics.layout.labels
    names = [label.partition("[")[0] for label in labels]
    for name in given:
        if name not in (*labels, *names):
            raise ParameterError(
                f'parameters: there is no parameter "{name}"{nearest(name, [*names, *labels])}'
            )
    return np.array(
        [
            given.get(label, given.get(name, prior.centre))
            for label, name, prior in zip(labels, names, physics.layout.priors, strict=True)
        ]
    )


def _measured(
    scene: Scene, commands: History, states: Floats, rng: np.random.Generator
) -> tuple[History, dict[str, float]]:
    """Return the recording of simulated states, and its noise by dimension, SI units."""
    dataset, known = commands.dataset.copy(), dict(scene.noise)
    seen = np.isfinite(dataset["observed"].to_numpy())
    if not seen[:, 1:].any():
        seen = np.isin(STATE, list(known) or STATE[:3]) & np.isfinite(states)
    motion = np.nanstd(states, axis=(0, 1)).max(axis=0)
    sd = _NOISE * np.where(motion > 0, motion, state_sizes(scene))
    sd = np.array([known.get(name, size) for name, size in zip(STATE, sd, strict=True)])
    free = ~dataset["kinematic"].to_numpy()[:, None]
    noisy = states + free * sd * rng.standard_normal(states.shape)
    dataset["observed"] = dataset["observed"].copy(data=np.where(seen, noisy, np.nan))
    dataset["start"] = dataset["start"].copy(data=states)
    recorded = seen.any(axis=(0, 1, 2))
    noise = {name: float(sd[d]) for d, name in enumerate(STATE) if recorded[d]}
    return History(dataset), noise


class _Way(NamedTuple):
    """A size of a law: of one of its parameters (None: of all of them), in a term's direction."""

    share: float  # of the parameter's scale, or of a whole change
    factor: float  # least size that is found
    place: int | None
    term: Term
    rung: _Rung


@dataclass(frozen=True, eq=False)
class _Rung:
    """Regression at the true parameters on pieces of one length, and what a law adds to it.

    Parameters
    ----------
    mode : Mode
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
    """

    mode: Mode
    tests: ScoreTest
    terms: tuple[Term, ...]
    basis: Floats
    least_share: float
    criteria: Criteria

    @classmethod
    def of(
        cls, mode: Mode, tried: Sequence[Attached], criteria: Criteria, least_share: float
    ) -> _Rung:
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
        return cls(mode, tests, tuple(terms), np.hstack(bases), least_share, criteria)

    @cached_property
    def counts(self) -> Floats:
        """Degrees of freedom of each dimension, shape (state,)."""
        return np.maximum(output_error(self.mode.problem).starts.counts, 1.0)

    def ways(self, law: Attached) -> list[_Way]:
        """Return the sizes of a law that are found, and of whole changes those that are."""
        ways, parameters = list[_Way](), law.effect.parameters
        for term in (term for term in self.terms if term.law == law):
            places = term.linear.columns or (None,)
            for place, unit in zip(places, np.linalg.pinv(term.linear.back).T, strict=True):
                if np.any(unit):
                    scale = 1.0 if place is None else parameters[place].prior.scale
                    factor = self.needed(term) / float(np.linalg.norm(unit))
                    ways.append(_Way(factor / scale, factor, place, term, self))
        return sorted(ways, key=lambda way: way.share)

    def needed(self, term: Term) -> float:
        """Return the size of a signature, in units of noise, that pays its price in white noise."""
        n = float(self.counts.sum())
        paid = self.criteria.search.least_nats + term.price - worth(0.0, len(term.columns), n)
        share = max(-np.expm1(-2.0 * paid / n), 1.0 - (1.0 - self.least_share) ** 2)
        return float(np.sqrt(n * share / (1.0 - share)))

    def finds(self, term: Term, added: Floats) -> bool:
        """Return whether what a law adds is proposed and accepted.

        A regression proposes it with the residual's autocorrelation time, which a slow law makes
        long; a refit, whose residual is white, confirms it.
        """
        n, likelihood = self.counts, output_error(self.mode.problem)
        rows = (self.tests.residual + added)[: len(self.mode.whitened_residual.ravel())]
        rows = rows.reshape(self.mode.whitened_residual.shape)
        shape = self.mode.problem.observations.values.shape
        residual = rows[:, : np.prod(shape[1:])].reshape(shape) * self.mode.sigma
        square = np.maximum((residual**2).sum((0, 1, 2)) / self.mode.sigma**2 / n, 1.0)
        tau = likelihood.correlation_times(residual, self.mode.sigma * np.sqrt(square))
        share = min(float((n / tau * (1.0 - 1.0 / square)).sum() / (n / tau).sum()), 1.0 - 1e-12)
        proposed = worth(share, len(term.columns), (n / tau).sum()) - term.price
        gain, total = float((0.5 * n * np.log(square)).sum()), float(n.sum())
        accepted = gain + worth(0.0, len(term.columns), total) - term.price
        enough = -np.expm1(-gain / total) >= self.least_share
        return bool(proposed > 0 and accepted >= self.criteria.search.least_nats and enough)

    def least(self, way: _Way) -> float:
        """Return the factor from which on a way is found, one of a few, or inf.

        Of a whole change, 1 where that is found.
        """
        direction = way.term.linear.basis @ self.unit(way)
        if way.place is None:
            return 1.0 if way.factor < 1.0 and self.finds(way.term, direction) else np.inf
        factors = way.factor * _FACTORS
        lost = [i for i, each in enumerate(factors) if not self.finds(way.term, each * direction)]
        first = lost[-1] + 1 if lost else 0
        return float(factors[first]) if first < len(factors) else np.inf

    def unit(self, way: _Way) -> Floats:
        """Return the coordinates of a unit of a way in the term's basis, on the allowed side."""
        units = np.linalg.pinv(way.term.linear.back)
        if way.place is None:
            return np.asarray(units[:, 0])
        side = -1.0 if null_sides(way.term.law)[way.place] < 0 else 1.0
        return np.asarray(side * units[:, way.term.linear.columns.index(way.place)])

    def added(self, way: _Way, factor: float) -> Floats:
        """Return what a law adds to the residual, simulated, in units of noise, shape (n,)."""
        law, problem = way.term.law, self.mode.problem
        values = way.term.linear.values.astype(float)
        if way.place is not None:
            values[way.place] += -factor if null_sides(law)[way.place] < 0 else factor
        wide = problem.with_physics(effects=(*problem.physics.effects, law)).rough
        phi = np.tile(wide.layout.from_layout(problem.layout, self.mode.phi), (2, 1))
        phi[:, wide.layout.places(law.labels)] = law.effect.null, values
        null, there = np.nan_to_num(wide.whitened(phi, self.mode.sigma)).reshape(2, -1)
        return self.tests.left(np.pad(null - there, (0, len(self.mode.phi))))

    def named(self, law: Attached, added: Floats) -> tuple[str, tuple[str, ...]]:
        """Return which law is named where one adds to the residual, and which explain it as well."""
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
        if law not in nats:
            return "", ()
        tied = [one for one, value in nats.items() if value > max(nats.values()) - within]
        first = min(tied, key=lambda one: (len(one.labels), -round(nats[one], 2)))
        evidence = {one: value - one.effect.log_odds for one, value in nats.items()}
        close = [one for one in nats if one != law and evidence[one] > evidence[law] - within]
        return named_beside(first, law), tuple(named_beside(one, law) for one in close)


def _rehearsed(rungs: Sequence[_Rung], law: Attached) -> RehearsedLaw:
    """Return what is seen of a law on pieces of any length."""
    effect, parameters = law.effect, law.effect.parameters
    names = [parameter.name for parameter in parameters]
    unseen = RehearsedLaw(
        effect.name, law.body, effect.sentence, {}, dict(zip(names, effect.null, strict=True)),
        {parameter.name: parameter.unit for parameter in parameters}, np.inf, "", (),
        "declared parameters absorb it, or it changes nothing here",
    )  # fmt: skip
    ways = [way for rung in rungs for way in rung.ways(law)]
    if not ways:
        return unseen
    sized = {(way.rung, way.place): way for way in reversed(ways) if way.place is not None}
    found = []
    for way in sized.values() or ways:
        factor = way.rung.least(way)
        share = way.share if way.place is None else factor / parameters[way.place].prior.scale
        if factor < np.inf and share < rungs[0].criteria.far_out:
            found.append(way._replace(share=share, factor=factor))
    if not found:
        return replace(unseen, note="too small, or it looks like the sensor's correlated error")
    sizes: dict[str, float] = {}
    for way in sorted(found, key=lambda way: way.share):
        if way.place is not None:
            sizes.setdefault(names[way.place], way.factor)
    best = min(found, key=lambda way: way.share)
    note = ""
    if best.place is None:
        note = f"seen at {len(found)} of {len(ways)} places, times or levels"
        if len(names) == 1:
            levels = [float(way.term.linear.values[0]) for way in found]
            sizes[names[0]] = min(levels, key=lambda level: abs(level - effect.null[0]))
    times = 1.0 if best.place is None else _WELL_SEEN * best.factor
    named, confounded = best.rung.named(law, best.rung.added(best, times))
    return replace(
        unseen, sizes=sizes, share=best.share, named=named, confounded=confounded, note=note
    )
