"""Rehearsal of a recording: which laws would be named, before anything is recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.score import Library, each_grid_point, named_beside, null_sides
from pbrl_ppl.criticism.subsets import Term, worth
from pbrl_ppl.criticism.table import shown_fall, weights
from pbrl_ppl.effects import Attached, Effect, attach, candidates, is_pivoted
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import HistoryError, ParameterError
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem, in_pieces
from pbrl_ppl.modes import MOST_GROWTH, SimulatedMode, corrected, fit_pieces, growth, piece_lengths
from pbrl_ppl.physics import Physics, simulated_recording, touching
from pbrl_ppl.scene import Scene, motion_time, nearest, state_sizes, units_of
from pbrl_ppl.state import STATE, Floats
from pbrl_ppl.system.threads import Say, in_parallel, one_blas_thread, silent


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
        Laws that explain a recording with three times the size as well, within the criteria's nats;
        unusual ones only where common ones leave much more than the noise.
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
    progress: Say | None = None,
) -> Rehearsal:
    """Find out which laws a recording would show, and from which size on, before it is made.

    The declared model is simulated once, with measurement noise. There, on the longest pieces and
    without a refit, each law of the catalogue is linearised as in the search of
    :func:`pbrl_ppl.attribute`, declared parameters and initial states projected out, and the size
    computed at which its log-evidence and its share of the simulation error pass the thresholds of
    :class:`SearchCriteria` for a main law. The law is then added to the residual, and regressions
    on single laws say which name wins; an unusual one wins only where common ones leave much more
    than the noise.

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
        Called with the name of each stage and with counted work.

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
    say, catalogue = progress or silent, tuple(catalogue)
    rng = np.random.default_rng(seed)
    say("simulating the declared model")
    physics = Physics(scene, attach(scene, (), catalogue), threads=2)
    phi = parameters_of(physics, parameters or {})
    commands, states = simulated(physics, phi, commands, rng)
    history, noise = measured(scene, commands, states, rng)
    physics = physics.changed(scene=with_units(scene, history))
    mode = _known_mode(_apart(Problem.of(physics, history), states), phi, states)
    seconds = mode.problem.data.horizon * scene.time_step
    model = physics.scene, physics.effects, catalogue
    every, able = candidates(*model), candidates(*model, history)
    say(f"linearising {len(able)} laws on pieces of {seconds:.3g} s")
    regression = _Regression(mode, able, criteria, say)
    laws = sorted(in_parallel(regression.rehearsed, every), key=lambda law: law.share)
    known = dict(zip(physics.layout.labels, phi.tolist(), strict=True))
    return Rehearsal(tuple(laws), history, known, noise, seconds)


def _apart(problem: Problem, states: Floats) -> Problem:
    """Return the problem with breaks where bodies touch, if that is not most of the time.

    The instant of a collision is no smooth function of anything.
    """
    rows = np.asarray(np.isfinite(states).all(axis=(2, 3)))
    touched = np.logical_and(rows[:, :-1], rows[:, 1:])
    touched[touched] = touching(problem.scene, states[:, :-1][touched], states[:, 1:][touched])
    return problem.with_data(breaks=touched) if 0.0 < touched.mean() < 0.5 else problem


def _known_mode(problem: Problem, phi: Floats, states: Floats) -> SimulatedMode:
    """Return the mode of a simulated recording at its true parameters and states.

    On the longest pieces that do not magnify an initial state, errors as if they were white.
    """

    def at(length: int) -> SimulatedMode:
        return fit_pieces(in_pieces(problem, length, states), phi, rounds=0)

    mode = at(max(states.shape[1] - 1, 2))
    shorter = piece_lengths(mode)[:-1]
    while shorter and growth(mode.problem) > MOST_GROWTH:
        mode = at(shorter.pop())
    mode, white = corrected(mode), (1.0,) * len(mode.sigma)
    return replace(mode, problem=mode.problem.with_likelihood(tau=white))


class _Regression:
    """Regressions on single laws at the true parameters.

    On the longest pieces: there a law that the search finds on shorter ones has to be a main one.

    Parameters
    ----------
    mode : SimulatedMode
        Of the declared model.
    laws : sequence of Attached
        Candidates, each of which is linearised at all its grid points.
    criteria : Criteria
        Thresholds.
    say : callable
        Called with how many laws are linearised.
    """

    def __init__(
        self, mode: SimulatedMode, laws: Sequence[Attached], criteria: Criteria, say: Say
    ) -> None:
        library = Library(mode, criteria=criteria)
        self.mode, self.criteria, self.test = mode, criteria, library.test()
        self.counts = np.maximum(weights(mode), 1.0)

        def linearised(law: Attached) -> list[Term]:
            points = list(each_grid_point(mode, law)) or library.points(law)[0]
            price = float(np.log(len(laws) * max(len(points), 1))) - law.effect.log_odds
            each = (self.test.at(point, law) for point in points)
            return [Term(law, a, np.arange(len(a.basis.T)), price) for a in each if a.basis.size]

        terms = in_parallel(linearised, laws, f"linearising {len(laws)} laws", say)
        self.terms = dict(zip(laws, terms, strict=True))

    def least(self, term: Term, unit: Floats) -> float:
        """Return the least multiple of a change of the residual, shape (n,), that is seen."""
        initial, limits = self.mode.problem.likelihood.initial_states, self.criteria.search
        n, alone = float(self.counts.sum()), self.mode.problem.data.history.n_trajectories == 1
        main = -float(np.log1p(-(limits.alone if alone else limits.main_share)))
        paid = limits.least_nats + term.price - worth(0.0, len(term.columns), n)
        shape = self.mode.whitened_residual.shape
        square = unit[: np.prod(shape)].reshape(shape) ** 2
        rows, begin = np.split(square, [initial.seen[0].size], axis=1)
        square = initial.totals(rows.reshape(initial.seen.shape), begin) / self.counts
        # from what is enough where one dimension shows it alone, or all of them as much
        first = np.expm1(2.0 * min(main, paid / n)) / max(square.max(), 1e-300)
        squares = first * np.geomspace(1.0, 1e6, 600)
        falls = 0.5 * np.log1p(squares[:, None] * square)
        enough = (shown_fall(falls, self.counts) >= main) & (falls @ self.counts >= paid)
        return float(np.sqrt(squares[int(np.argmax(enough))])) if enough.any() else np.inf

    def named(self, law: Attached, added: Floats) -> tuple[str, tuple[str, ...]]:
        """Return which law is named where one adds to the residual, and others within some nats."""
        noise, limits = self.test.residual, self.criteria.search
        residual, common, found = noise + added, 0.0, dict.fromkeys(self.terms, -np.inf)
        for term in (term for terms in self.terms.values() for term in terms):
            towards = term.linear.basis.T @ residual
            sizes = term.sizes(towards, self.criteria.far_out)
            if sizes is not None and np.array_equal(sizes, term.linear.sizes(towards)):
                taken, n = float(towards @ towards), float(self.counts.sum())
                share = taken / float(residual @ residual)
                found[term.law] = max(found[term.law], worth(share, len(towards), n) - term.price)
                common = max(common, 0.0 if term.law.effect.unusual else taken)
        # the search tries unusual laws where they promise to take much off what common ones leave
        more = (1.0 - limits.promise) ** 2 * (residual @ residual - common) > noise @ noise
        laws = [one for one in found if more or not one.effect.unusual] or [law]
        top = max(found[one] for one in laws)
        near = [one for one in laws if found[one] >= top - limits.least_nats]
        # of the same physics the first in the catalogue
        first = min(near, key=lambda one: (len(one.labels), found[one] < top - 1.0))
        return named_beside(first, law), tuple(named_beside(one, law) for one in near if one != law)

    def rehearsed(self, law: Attached, *, well_seen: float = 3.0) -> RehearsedLaw:
        """Return what is seen of a law.

        ``well_seen``: names are compared at this many times the least size that is seen.
        """
        effect, terms, sides = law.effect, self.terms.get(law, ()), null_sides(law)
        ways, sizes, levels = list[tuple[float, Floats]](), dict[str, float](), list[float]()
        for term in terms:
            units = (term.linear.basis @ np.linalg.pinv(term.linear.back)).T
            for place, unit in zip(term.linear.columns, units, strict=False):
                parameter, size = effect.parameters[place], self.least(term, unit)
                name, scale = parameter.name, parameter.prior.scale
                if size < min(self.criteria.far_out * scale, sizes.get(name, np.inf)):
                    sizes[name] = size
                    well = min(well_seen * size, 0.9 * self.criteria.far_out * scale)
                    ways.append((size / scale, (sides[place] or 1) * well * unit))
            if not term.linear.columns and (share := self.least(term, units[0])) < 1.0:
                levels.append(float(term.linear.values[0]))
                ways.append((share, units[0]))
        share, added = min(ways, key=lambda way: way[0], default=(np.inf, np.zeros(0)))
        named, confounded = self.named(law, added) if ways else ("", ())
        note = "too small" if terms else "declared parameters absorb it, or nothing here shows it"
        if ways:
            note = "" if sizes else f"seen at {len(levels)} of {len(terms)} places, times or levels"
        null, nearest = {one.name: one.null for one in effect.parameters}, dict[str, float]()
        if levels and not sizes and len(null) == 1:
            nearest = {name: min(levels, key=lambda one: abs(one - null[name])) for name in null}
        return RehearsedLaw(
            effect.name, law.body, effect.sentence, sizes, nearest, null,
            {one.name: one.unit for one in effect.parameters}, share, named, confounded, note,
        )  # fmt: skip


def parameters_of(physics: Physics, given: Mapping[str, float]) -> Floats:
    """Return the parameters that are given by label or name, others at the prior's centre, (p,)."""
    labels = physics.layout.labels
    names = [label.partition("[")[0] for label in labels]
    both = [*names, *labels]
    for name in sorted({*given} - {*both}):
        raise ParameterError(f'parameters: there is no parameter "{name}"{nearest(name, both)}')
    priors = zip(labels, names, physics.layout.priors, strict=True)
    return np.array([given.get(one, given.get(name, prior.centre)) for one, name, prior in priors])


def measured(
    scene: Scene, commands: History, states: Floats, rng: np.random.Generator
) -> tuple[History, dict[str, float]]:
    """Return the recording of simulated states, and its noise by dimension, SI units.

    What the commands' file measures after the first rows is measured; if nothing, the dimensions of
    the scene's noise, or else x, y and theta. Unknown noise is a thousandth of the motion.
    """
    dataset, known = commands.dataset.copy(), dict(scene.noise)
    seen = np.isfinite(dataset["observed"].to_numpy())
    if not seen[:, 1:].any():
        seen = np.isin(STATE, list(known) or STATE[:3]) & np.isfinite(states)
    motion = np.nanstd(states, axis=(0, 1)).max(axis=0)
    sd = 1e-3 * np.where(motion > 0, motion, state_sizes(scene))
    sd = np.array([known.get(name, size) for name, size in zip(STATE, sd, strict=True)])
    free = ~dataset["kinematic"].to_numpy()[:, None]
    noisy = states + free * sd * rng.standard_normal(states.shape)
    dataset["observed"] = dataset["observed"].copy(data=np.where(seen, noisy, np.nan))
    dataset["start"] = dataset["start"].copy(data=states)
    noise = {name: float(sd[d]) for d, name in enumerate(STATE) if seen[..., d].any()}
    return History(dataset), noise


def simulated(
    physics: Physics, phi: Floats, commands: History | None, rng: np.random.Generator
) -> tuple[History, Floats]:
    """Return commands and simulated states, shape (trajectory, time, body, 6), SI units.

    Pushes are proposed that move each body by its size, or turn it in its hinge by 0.25 rad.
    """
    for push in (0.25, 1.0, 4.0):
        tried = _proposed(physics.scene, rng, push) if commands is None else commands
        # the engine of the pieces, so that their residual is noise alone
        (states,) = simulated_recording(physics.medium, phi[None], tried)
        x, y, theta = np.ptp(states[..., :3], axis=1).mean(axis=0).T
        bodies = zip(physics.scene.moving, np.hypot(x, y), theta, strict=True)
        if commands is not None or all(
            turn > 0.25 if is_pivoted(physics.scene, body) else way > body.shape.bounding_radius
            for body, way, turn in bodies
        ):
            break
    return tried, states


def _proposed(scene: Scene, rng: np.random.Generator, push: float) -> History:
    """Return pushes, pauses and pushes back of random sizes, from rest at the scene's poses.

    Each is held for the time in which a typical force changes the motion. A body in a hinge is
    turned with ``push`` typical torques at most, another is pushed with as many typical forces and
    turned with a fifth of them.

    Raises
    ------
    HistoryError
        If a body follows a path.
    """
    bodies = scene.moving
    if any(body.kinematic for body in bodies):
        raise HistoryError("rehearse: a body follows a path; give a file of commands that has it")
    trajectories, intervals = 4, 100
    hold = max(2, round(motion_time(scene) / scene.time_step))
    states = np.full((trajectories, intervals + 1, len(bodies), len(STATE)), np.nan)
    most = np.zeros((len(bodies), 3))
    for i, body in enumerate(bodies):
        units, hinged = units_of(scene, body.name), is_pivoted(scene, body)
        shares = (0.0, 0.0, 1.0) if hinged else (1.0, 1.0, 0.2)
        most[i] = push * np.array(shares) * (units.force, units.force, units.torque)
        states[:, 0, i] = (*(body.pose or (0.0, 0.0, 0.0)), 0.0, 0.0, 0.0)
        if hinged:  # the hinge says where it is
            states[:, 0, i, [0, 1, 3, 4]] = np.nan
    count = -(-intervals // (4 * hold))
    size = rng.uniform(-1.0, 1.0, (trajectories, count, len(bodies), 3)) * most
    pieces = np.stack([size, 0.0 * size, -size, 0.0 * size], axis=2)
    wrenches = pieces.reshape(trajectories, -1, len(bodies), 3).repeat(hold, axis=1)
    return History.of_arrays(states, scene, wrenches[:, :intervals])
