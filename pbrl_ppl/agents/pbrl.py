"""PBRL agent: its model is the posterior of a physics engine's parameters."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations, compress
from typing import Any, ClassVar, final

import numpy as np

from pbrl_ppl.agents.agent import PhysicsAgent, Task, prediction_errors
from pbrl_ppl.agents.revision import select_effects
from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import BoundWarning, FitError, UninformedWarning
from pbrl_ppl.history import from_segments, with_units
from pbrl_ppl.likelihood import Problem, TransitionLikelihood, declared_problem
from pbrl_ppl.modes import Mode, find_mode
from pbrl_ppl.physics import Physics, touching
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import group
from pbrl_ppl.sampling import sample, try_own_effects
from pbrl_ppl.scene import body_sizes
from pbrl_ppl.state import Bools, Floats

#: Prediction errors up to this share of the natural sizes carry no information: they are the
#: engine's.
NEGLIGIBLE = 1e-4


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
    sigma : str
        ``scalar``, as in Eq. 11, or ``per_dimension``.
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
    looks : int
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
        sigma: str = "scalar",
        effects: Iterable[Effect | Attached] = (),
        revise: bool = False,
        catalogue: Iterable[Effect] = full_catalogue,
        **options: Any,
    ) -> None:
        if (draws is not None and draws < 1) or not growth >= 0:
            raise FitError(
                f"PBRL: draws is {draws} and growth {growth}, expected 1 or more and 0 or more"
            )
        super().__init__(task, **options)
        self.draws, self.growth = draws, growth
        self._likelihood, self.revise = TransitionLikelihood.declare(sigma), revise
        self._catalogue = tuple(catalogue)
        self._declared = attach(task.scene, effects, self._catalogue)
        self._transitions: list[tuple[Floats, Floats, Floats]] = []
        self._sigma = np.empty(0)
        self._negligible = NEGLIGIBLE * body_sizes(task.scene)
        self.fits = self._fitted = self.looks = self._looked = 0

    def observe(self, state: Floats, action: Floats, next_state: Floats) -> None:
        """Store a transition; arguments as for :meth:`Agent.observe`."""
        self._transitions.append((state, action, next_state))

    def update(self) -> None:
        """Refit the posterior if new transitions are informative."""
        if self._is_informed():
            self._fit()

    def _is_informed(self, surprise: float = 4.0) -> bool:
        """Return whether new transitions inform: there are many, or errors above so many sigma."""
        if len(self._transitions) == self._fitted or self._dynamics is None:
            return len(self._transitions) > self._fitted
        state, inputs, after = (array[self._fitted :] for array in self._data())
        action, previous = inputs[..., :3], inputs[..., 3:6]
        error = prediction_errors(self._dynamics, state, action, after, previous)
        if (error <= self._negligible).all():
            return False
        surprised = not (error <= np.maximum(surprise * self._sigma, self._negligible)).all()
        return self._grown(self._fitted) or surprised

    def _grown(self, since: int) -> bool:
        return len(self._transitions) >= (1.0 + self.growth) * since

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
    ) -> Problem:
        """Return the problem of some transitions, and of some bodies alone."""
        scene = self.task.scene
        state, inputs, after = (values[rows] for values in self._data())
        if bodies is not None:
            scene = scene.subset([body.name for body in compress(scene.moving, bodies)])
            state, inputs, after = (values[:, bodies] for values in (state, inputs, after))
        history = from_segments(scene, state, inputs[:, None], after[:, None])
        declared = {body.name: body.effects for body in scene.moving}
        beside = [
            attached
            for attached in effects
            if attached.body in declared and attached.effect.name not in declared[attached.body]
        ]
        physics = Physics.declare(with_units(scene, history), beside)
        try_own_effects(physics, history)
        return declared_problem(physics, history, likelihood=self._likelihood)

    def _revised(self, *, least: int = 3, false_alarm: float = 0.01) -> Mode | None:
        """Criticise the declared model; return the mode found if it is of all data.

        ``least``: fewest transitions for criticism.
        ``false_alarm``: significance level over a whole episode.
        """
        state, _, after = self._data()
        free = ~touching(self.task.scene, state, after)
        if free.sum() < least or not self._grown(self._looked):
            return None

        def search(effects: tuple[Attached, ...]) -> Mode:
            return find_mode(self._problem(effects, free), seed=self.seed)

        self.looks, self._looked = self.looks + 1, len(free)
        level = false_alarm / (self.looks * (self.looks + 1))
        selected, mode = select_effects(
            search, self._declared, self.added, self._catalogue, level=level, floor=self._negligible
        )
        known = {revision.attached: revision.transitions for revision in self.added}
        self.added = tuple(
            replace(law, transitions=known.get(law.attached, len(free))) for law in selected
        )
        return mode if free.all() else None

    def _start(self, effects: tuple[Attached, ...], whole: Problem) -> Mode | None:
        """Return the mode found from that of the bodies that moved; None if all moved.

        Bodies that nothing moved or touched keep their prior. Those that moved are fitted first to
        the transitions without contact, whose likelihood is smooth, then to all.
        """
        scene, (state, inputs, after) = self.task.scene, self._data()
        names = [body.name for body in scene.moving]
        moved = (state != state[0]).any(axis=(0, 2)) | state[0, :, 3:].any(axis=1)
        moved |= inputs[..., :3].any(axis=(0, 2))
        for i, j in combinations(range(len(names)), 2):
            pair = scene.subset([names[i], names[j]]).replace(walls=())
            if moved[[i, j]].any() and touching(pair, state[:, [i, j]], after[:, [i, j]]).any():
                moved[[i, j]] = True
        if moved.all() or not moved.any():
            return None
        initial, free = None, ~touching(scene, state, after)
        if free.any():
            apart = self._problem(effects, free, moved)
            initial = find_mode(apart, seed=self.seed).phi
        part = self._problem(effects, bodies=moved)
        mode = find_mode(part, seed=self.seed, initial=initial)
        return find_mode(whole, initial=whole.layout.from_layout(part.layout, mode.phi))

    def _fit(self) -> None:
        start = self._revised() if self.revise else None
        effects = (*self._declared, *(law.attached for law in self.added))
        problem = self._problem(effects)
        start = start or self._start(effects, problem)
        method = "map" if self.draws is None else "laplace"
        with warnings.catch_warnings():
            # early in an episode the data do not inform all parameters
            warnings.simplefilter("ignore", UninformedWarning)
            warnings.simplefilter("ignore", BoundWarning)
            drawn = sample(problem, seed=self.seed, method=method, start=start)
        self.posterior = drawn.posterior
        self._dynamics = Dynamics.of(
            self.posterior, self.draws, seed=self.seed, effects=self._catalogue, threads=1
        )
        self._sigma = np.median(group(self.posterior, "posterior")["sigma"].to_numpy(), axis=(0, 1))
        self.fits, self._fitted = self.fits + 1, len(self._transitions)
