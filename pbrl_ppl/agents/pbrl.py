"""PBRL agents: their models are posteriors of an engine, revised or over a library."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from itertools import combinations, compress
from typing import Any, ClassVar, final

import numpy as np
import pandas as pd

from pbrl_ppl.agents.agent import Agent, Revision, Task
from pbrl_ppl.criticism import DEFAULT, Search, Table, are_alike, share, sizes_of
from pbrl_ppl.effects import Attached, Effect, Structure, attach, candidates
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import BoundWarning, ConvergenceWarning, FitError, UninformedWarning
from pbrl_ppl.history import from_segments, with_units
from pbrl_ppl.likelihood import Problem, TransitionLikelihood, declared_problem, try_own_effects
from pbrl_ppl.modes import Mode, choose_from_library, find_mode
from pbrl_ppl.parameters import Layout, ParameterLibrary
from pbrl_ppl.physics import Physics, build_layout, touching
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import group
from pbrl_ppl.sampling import sample
from pbrl_ppl.scene import Scene, body_sizes
from pbrl_ppl.state import THETA, Bools, Floats, wrapped


def revise(
    problem: Problem,
    added: Iterable[Revision],
    catalogue: Iterable[Effect],
    level: float,
    floor: Floats,
    seed: int = 0,
) -> tuple[tuple[Revision, ...], Mode]:
    """Return the effects that a declared model lacks, and the mode with them.

    Parameters
    ----------
    problem : Problem
        Of the declared model and single transitions, whose starts are exact (Eq. 11).
    added : iterable of Revision
        Effects added before, which all data have to bear out.
    catalogue : iterable of Effect
        Candidates. Effects of the structure stage, whose search takes too long, and of the noise
        stage, which would take misfit for noise, are not tried.
    level : float
        Significance level, corrected for the candidates.
    floor : ndarray
        A model with errors up to this is exact, and lacks nothing, shape (body, 6), SI units.
    seed : int
        Of the searches for modes.

    Returns
    -------
    tuple of Revision
        Those of most evidence first.
    Mode
        Mode of the model with them.
    """
    tried = [effect for effect in catalogue if not isinstance(effect.stage, Structure)]
    least = max(DEFAULT.search.least_nats, -np.log(level))
    limits = replace(DEFAULT.search, least_nats=least, refits=8)

    def missing(mode: Mode) -> tuple[Attached, ...]:
        return candidates(problem.scene, mode.problem.physics.effects, tried)

    @cache
    def of(laws: frozenset[Attached]) -> Mode:
        return find_mode(problem.with_physics(effects=(*problem.physics.effects, *laws)), seed=seed)

    def highest(laws: Iterable[Attached]) -> Mode:
        return of(frozenset(laws))

    # priors are in units that the data show, and change with them
    every = {(law.effect.name, law.body): law for law in missing(highest(()))}
    before = {every[one.effect, one.body]: one for one in added}
    mode = highest(before)
    error = abs(mode.problem.residual(mode.phi))
    if (error <= floor[:, list(problem.observations.columns)]).all():
        return tuple(replace(one, attached=law) for law, one in before.items()), mode
    begin = {law: sizes_of(mode, law) for law in before}
    found = Search(missing, replace(DEFAULT, search=limits))(highest(()), begin).laws
    table = Table(problem.physics.effects, max(len(every), 1))
    simpler = [
        {*found, kin} - {law} for law in found for kin in every.values() if are_alike(law, kin)
    ]
    sets = {frozenset(laws): highest(laws) for laws in (found, before, *simpler)}
    table.modes |= sets
    top = max(map(table.value, sets.values()))
    near = [laws for laws, mode in sets.items() if table.value(mode) > top - least]
    fewest = min(near, key=lambda laws: len(sets[laws].phi))
    nats = _borne_out(table, highest, fewest, least)
    mode = highest(nats)
    revisions = [
        Revision(
            law,
            before[law].transitions if law in before else problem.segments.n,
            lost,
            share(table.without(mode, law), mode, table.weight),
            found[law].not_separable_from if law in found else (),
        )
        for law, lost in nats.items()
    ]
    return tuple(sorted(revisions, key=lambda law: -law.nats)), mode


def _borne_out(
    table: Table,
    highest: Callable[[Iterable[Attached]], Mode],
    laws: Iterable[Attached],
    least: float,
) -> dict[Attached, float]:
    """Return the laws that a model needs: what it loses without each is not less than some nats.

    ``highest`` searches from many starts: a local climb may end too low to do without a law.
    """
    kept = [*laws]
    while kept:
        without = {law: highest(one for one in kept if one != law) for law in kept}
        table.modes |= {frozenset(kept): highest(kept)}
        table.modes |= {frozenset(kept) - {law}: mode for law, mode in without.items()}
        nats = {law: table.value(highest(kept)) - table.value(without[law]) for law in kept}
        weakest = min(nats, key=nats.__getitem__)
        if nats[weakest] >= least:
            return nats
        kept.remove(weakest)
    return {}


class PhysicsAgent(Agent):
    """Agent whose model is :class:`pbrl_ppl.Dynamics` of estimated parameters."""

    model: Dynamics | None = None
    #: Share of the natural sizes up to which prediction errors carry no information: the engine's.
    negligible: ClassVar[float] = 1e-4

    @property
    def estimates(self) -> Mapping[str, float]:
        """Return parameters by label, SI units: the mode, or the draw nearest to the mean."""
        if self.model is None:
            return {}
        middle = self.model.single()
        return dict(zip(middle.layout.labels, middle.phi[0].tolist(), strict=True))


def prediction_errors(
    dynamics: Dynamics, state: Floats, action: Floats, after: Floats, previous: Floats | None = None
) -> Floats:
    """Return the absolute errors of the mean prediction of each transition, shape (n, body, 6).

    Parameters
    ----------
    dynamics : Dynamics
        Model.
    state, after : ndarray
        States at the ends of the intervals, shape (n, body, 6), SI units.
    action, previous : ndarray
        Wrenches in the intervals, and before them, shape (n, body, 3), N and N m.
    """
    states = np.repeat(state[None], dynamics.draws, 0)
    error = abs(after - dynamics.step(states, action, previous).mean(axis=0))
    error[..., THETA] = abs(wrapped(error[..., THETA]))
    return np.asarray(error)


def meetings(scene: Scene, moved: Bools, state: Floats, after: Floats) -> Iterator[list[int]]:
    """Yield the places of every two moving bodies that touch in a transition, or nearly do.

    Parameters
    ----------
    scene : Scene
        Orders the bodies.
    moved : ndarray of bool
        Bodies of which one is among the two, shape (body,); what a caller adds to them counts for
        later pairs.
    state, after : ndarray
        States at the ends of the intervals, shape (n, body, 6), SI units.
    """
    for i, j in combinations(range(len(scene.moving)), 2):
        pair = scene.subset([scene.moving[i].name, scene.moving[j].name]).replace(walls=())
        if moved[[i, j]].any() and touching(pair, state[:, [i, j]], after[:, [i, j]]).any():
            yield [i, j]


@final
class PBRLAgent(PhysicsAgent):
    """Agent that infers the physics of the bodies it pushes, and plans with the posterior.

    Before any data it acts at random: a plan at the centre of Table 1's prior, where the wheel's
    friction is the same along and across, is no better, and costs a search.

    The posterior is refitted (reweighting draws, as ``update`` does, degenerates after a few
    transitions without noise; a fit takes a second or two). There is no refit while predictions are
    exact; while errors are within the noise, a refit follows when the data have grown by the share
    ``growth``. Transitions are fitted separately: effects with memory of the previous command see
    none.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    draws : int, optional
        Posterior draws to plan with, from the Gaussian at the mode; by default the mode (MAP), as
        in the paper.
    growth : float
        Share by which the data grow before a refit while errors are within the noise.
    effects : iterable of Effect or Attached
        Effects of its model in addition to those that the scene declares.
    revise : bool
        Whether to criticise the model and add missing effects.
    catalogue : iterable of Effect
        Candidates for missing effects.
    **options
        Options of :class:`Agent`.

    Raises
    ------
    FitError
        If ``draws`` is below 1 or ``growth`` negative.
    EffectError
        If an effect does not apply to the scene, or is given twice.

    Attributes
    ----------
    posterior : InferenceData or DataTree or None
        Latest posterior, as made by :func:`pbrl_ppl.fit`.
    fits : int
        Number of fits.
    criticisms : int
        Number of criticisms.
    added : tuple of Revision
        Effects added to the model, with the evidence for each; their parameters are among the
        estimates.
    """

    name: ClassVar[str] = "PBRL"

    def __init__(
        self,
        task: Task,
        *,
        draws: int | None = None,
        growth: float = 0.2,
        effects: Iterable[Effect | Attached] = (),
        revise: bool = False,
        catalogue: Iterable[Effect] = full_catalogue,
        **options: Any,
    ) -> None:
        if (draws is not None and draws < 1) or not growth >= 0:
            raise FitError(f"PBRL: draws is {draws}, growth {growth}; expected at least 1 and 0")
        super().__init__(task, **options)
        self.draws, self.growth = draws, growth
        self.revise = revise
        self._catalogue = tuple(catalogue)
        declared = len(attach(task.scene, (), self._catalogue))
        self._given = attach(task.scene, effects, self._catalogue)[declared:]
        self._transitions: list[tuple[Floats, Floats, Floats]] = []
        self._sigma = np.empty(0)
        self._negligible = self.negligible * body_sizes(task.scene)
        self.fits = self._fitted = self.criticisms = self._criticised = 0

    def observe(self, state: Floats, action: Floats, next_state: Floats) -> None:
        """Store a transition; arguments as for :meth:`Agent.observe`."""
        self._transitions.append((state, action, next_state))

    def _is_informed(self, surprise: float = 4.0) -> bool:
        """Return whether new transitions inform: there are many, or errors above so many sigma."""
        if len(self._transitions) == self._fitted or self.model is None:
            return len(self._transitions) > self._fitted
        state, inputs, after = (array[self._fitted :] for array in self._data())
        error = prediction_errors(self.model, state, inputs[..., :3], after, inputs[..., 3:6])
        grown = len(self._transitions) >= (1.0 + self.growth) * self._fitted
        expected = 0.0 if grown else surprise * self._sigma
        return not (error <= np.maximum(expected, self._negligible)).all()

    def _data(self) -> tuple[Floats, Floats, Floats]:
        """Return states, inputs as in `pbrl_ppl.state.INPUT`, and next states."""
        state, action, after = (np.array(column) for column in zip(*self._transitions, strict=True))
        before = np.concatenate([np.zeros_like(action[:1]), action[:-1]])
        begin = self.task.scene.time_step * np.arange(len(action))
        clock = np.stack([0 * begin, begin, begin + self.task.scene.time_step], axis=1)
        clock = np.repeat(clock[:, None], action.shape[1], axis=1)
        return state, np.concatenate([action, before, clock], axis=2), after

    def _problem(
        self,
        effects: tuple[Attached, ...],
        rows: Bools | slice = slice(None),
        bodies: Bools | None = None,
        step: Floats | None = None,
    ) -> Problem:
        """Return the problem of some transitions, and of some bodies alone.

        ``step``: measurements are rounded to multiples of it, shape (body, 6).
        """
        scene = self.task.scene
        state, inputs, after = (values[rows] for values in self._data())
        if step is not None:
            after = step * np.round(after / step)
        if bodies is not None:
            scene = scene.subset([body.name for body in compress(scene.moving, bodies)])
            state, inputs, after = (values[:, bodies] for values in (state, inputs, after))
        history = from_segments(scene, state, inputs[:, None], after[:, None])
        there = [one for one in effects if one.body in {body.name for body in scene.moving}]
        physics = Physics.declare(with_units(scene, history), there)
        try_own_effects(physics, history)
        return declared_problem(physics, history, likelihood=TransitionLikelihood(scalar=True))

    def _criticise(self, *, least: int = 3, false_alarm: float = 0.01) -> Mode | None:
        """Criticise the declared model; return the mode found if it is of all data.

        ``least``: fewest transitions for criticism.
        ``false_alarm``: significance level over a whole episode.
        """
        state, _, after = self._data()
        free = ~touching(self.task.scene, state, after)
        if free.sum() < least or len(free) < (1.0 + self.growth) * self._criticised:
            return None
        self.criticisms, self._criticised = self.criticisms + 1, len(free)
        level = false_alarm / (self.criticisms * (self.criticisms + 1))
        # one sigma is of all dimensions, and so is the coarsest precision
        step = np.full_like(self._negligible, 2.0 * self._negligible.max())
        problem = self._problem(self._given, free, step=step)
        self.added, mode = revise(problem, self.added, self._catalogue, level, step, self.seed)
        return mode if free.all() else None

    def _of_moved(self, effects: tuple[Attached, ...]) -> Mode | None:
        """Return the mode of the bodies that moved alone; None if all did, or none.

        Bodies that nothing moved or touched keep their prior. Those that moved are fitted first to
        the transitions without contact, whose likelihood is smooth, then to all.
        """
        scene, (state, inputs, after) = self.task.scene, self._data()
        moved = (state != state[0]).any(axis=(0, 2)) | state[0, :, 3:].any(axis=1)
        moved |= inputs[..., :3].any(axis=(0, 2))
        for pair in meetings(scene, moved, state, after):
            moved[pair] = True
        if moved.all() or not moved.any():
            return None
        initial, free = None, ~touching(scene, state, after)
        if free.any():
            initial = find_mode(self._problem(effects, free, moved), seed=self.seed).phi
        return find_mode(self._problem(effects, bodies=moved), seed=self.seed, initial=initial)

    def update(self) -> None:
        """Refit the posterior if new transitions are informative."""
        if not self._is_informed():
            return
        near = self._criticise() if self.revise else None
        effects = (*self._given, *(law.attached for law in self.added))
        problem, near = self._problem(effects), near or self._of_moved(effects)
        start = None
        if near is not None:
            initial = problem.layout.from_layout(near.problem.layout, near.phi)
            start = find_mode(problem, initial=initial)
        method = "map" if self.draws is None else "laplace"
        with warnings.catch_warnings():
            # early in an episode the data do not inform all parameters
            warnings.simplefilter("ignore", UninformedWarning)
            warnings.simplefilter("ignore", BoundWarning)
            drawn = sample(problem, seed=self.seed, method=method, start=start)
        self.posterior = drawn.posterior
        self.model = Dynamics.of(
            self.posterior, self.draws, seed=self.seed, effects=self._catalogue, threads=1
        )
        self._sigma = np.median(group(self.posterior, "posterior")["sigma"].to_numpy(), axis=(0, 1))
        self.fits, self._fitted = self.fits + 1, len(self._transitions)


@final
class LibraryAgent(PhysicsAgent):
    """PBRL agent of the paper's apartment (section 5.2): one parameter set per body.

    The data of a body are the transitions in which it moves or is pushed and touches no other
    moving body. Each body has its noise; given the noise, bodies apart are independent. Bodies of
    one class with equal attributes share parameters, and so the choice and the noise. The paper
    samples the choices by Metropolis; here the sum over them is exact and as many draws are taken,
    or with ``method="metropolis"`` PyMC samples on the schedule of Table 2, which takes seconds a
    body. The agent plans with the most frequent choice (MAP); a body without data has a set drawn
    from the prior.

    Parameters
    ----------
    task : Task
        Scene, goal and actions. The scene declares no effects.
    library : ParameterLibrary
        The sets, and their probabilities.
    method : str
        ``exact``: the sum over the sets; ``metropolis``: PyMC, see :func:`pbrl_ppl.fit`.
    **options
        Options of :class:`Agent`.

    Attributes
    ----------
    fits : int
        Number of updates of a body's or class's choice.

    Raises
    ------
    FitError
        If the scene declares effects, or has a kinematic body.
    ParameterError
        If the library does not fit the scene's bodies.
    ValueError
        If ``method`` is another.

    References
    ----------
    Scholz et al. (2014), section 5.2; Table 2 has the schedule.
    """

    name: ClassVar[str] = "PBRL, categorical"

    def __init__(
        self, task: Task, library: ParameterLibrary, *, method: str = "exact", **options: Any
    ) -> None:
        if method not in ("exact", "metropolis"):
            raise ValueError(f"method is {method!r}, expected 'exact' or 'metropolis'")
        super().__init__(task, **options)
        self.method, scene = method, task.scene
        if any(body.effects or body.kinematic for body in scene.bodies):
            raise FitError("PBRL: no library is for effects or kinematic bodies; take PBRLAgent")
        self.library, self.fits = library, 0
        self._layout = build_layout(scene)
        self._table = library.table(self._layout, scene)
        rng = np.random.default_rng([self.seed, 2])
        self._probability = {owner: library.prior(owner) for owner in scene.owners}
        self._choice = {name: int(rng.choice(len(p), p=p)) for name, p in self._probability.items()}
        self._seen = {owner: list[tuple[Floats, Floats, Floats]]() for owner in scene.owners}
        self._fitted = dict.fromkeys(scene.owners, 0)

    @property
    def probabilities(self) -> pd.DataFrame:
        """Return posterior probabilities: one row per body or class, one column per set."""
        return pd.DataFrame(self._probability, index=list(self.library.names)).T

    def observe(self, state: Floats, action: Floats, next_state: Floats) -> None:
        """Store a transition of each body that it informs; see :meth:`Agent.observe`."""
        moved = action.any(axis=1) | state[:, 3:].any(axis=1) | (next_state != state).any(axis=1)
        alone, scene = moved.copy(), self.task.scene
        for pair in meetings(scene, moved, state[None], next_state[None]):
            alone[pair] = False
        names = [body.name for body in scene.moving]
        for owner, bodies in scene.owners.items():
            rows = [names.index(name) for name in bodies]
            used = alone[rows, None]
            if used.any():  # other bodies of the class are at rest and count as not measured
                begin = np.where(used | (np.arange(state.shape[1]) < 3), state[rows], 0.0)
                push, after = used * action[rows], np.where(used, next_state[rows], np.nan)
                self._seen[owner].append((begin, push, after))

    def update(self, *, growth: float = 0.2) -> None:
        """Update the choice of bodies and classes whose data grew and were not predicted.

        ``growth``: share by which a body's data grow before its choice is updated.
        """
        before = self.fits
        for name, seen in self._seen.items():
            fitted = self._fitted[name]
            grown = len(seen) > fitted and len(seen) >= (1.0 + growth) * fitted
            if grown and (not fitted or self._surprised(name)):
                self._choose(name)
        if self.model is None or self.fits > before:
            self.model = Dynamics(self.task.scene, self._phi(self._layout), threads=1)

    def _surprised(self, name: str) -> bool:
        scene = self.task.scene.subset(self.task.scene.owners[name])
        dynamics = Dynamics(scene, self._phi(build_layout(scene)), threads=1)
        error = prediction_errors(dynamics, *map(np.array, zip(*self._seen[name], strict=True)))
        return bool((error > self.negligible * body_sizes(scene)).any())

    def _phi(self, layout: Layout) -> Floats:
        """Return the chosen parameters in a layout's order."""
        owners = [label.partition("[")[2].rstrip("]") for label in layout.labels]
        chosen = [self._choice[owner] for owner in owners]
        return np.asarray(self._table[self._layout.places(layout.labels), chosen])

    def _choose(self, name: str) -> None:
        scene = self.task.scene.subset(self.task.scene.owners[name])
        state, action, after = map(np.array, zip(*self._seen[name], strict=True))
        history = from_segments(scene, state, action[:, None], after[:, None])
        wanted = {block.name for block in build_layout(scene).blocks}
        prior = dict(zip(self.library.names, self.library.prior(name).tolist(), strict=True))
        sets = {
            label: {key: value for key, value in dict(values).items() if key in wanted}
            for label, values in self.library.sets
            if prior[label] > 0
        }
        among = ParameterLibrary(sets, {label: prior[label] for label in sets})
        noise = TransitionLikelihood(scalar=True)
        problem = Problem.of(Physics(scene), history, likelihood=noise, library=among)
        if self.method == "metropolis":
            with warnings.catch_warnings():  # one chain, as in the paper
                warnings.simplefilter("ignore", ConvergenceWarning)
                posterior = sample(problem, method="metropolis", seed=self.seed).posterior
            index = group(posterior, "posterior")["library_index"].to_numpy()
        else:
            # as many draws as the paper's schedule gives
            _, _, index, _ = choose_from_library(problem, 400, 1, self.seed)
        drawn = np.array(among.names)[index[..., 0].ravel()]
        self._probability[name] = np.array([(drawn == one).mean() for one in self.library.names])
        self._choice[name] = int(self._probability[name].argmax())
        self._fitted[name], self.fits = len(state), self.fits + 1
