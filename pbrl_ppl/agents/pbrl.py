"""PBRL agent: its model is the posterior of a physics engine's parameters."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from itertools import compress
from typing import Any, ClassVar, final

import numpy as np

from pbrl_ppl.agents.agent import PhysicsAgent, Task, meetings, prediction_errors
from pbrl_ppl.agents.revision import revise
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
        sigma: str = "scalar",
        effects: Iterable[Effect | Attached] = (),
        revise: bool = False,
        catalogue: Iterable[Effect] = full_catalogue,
        **options: Any,
    ) -> None:
        if (draws is not None and draws < 1) or not growth >= 0:
            raise FitError(f"PBRL: draws is {draws}, growth {growth}; expected at least 1 and 0")
        super().__init__(task, **options)
        self.draws, self.growth = draws, growth
        self._likelihood, self.revise = TransitionLikelihood.declare(sigma), revise
        self._catalogue = tuple(catalogue)
        declared = len(attach(task.scene, (), self._catalogue))
        self._given = attach(task.scene, effects, self._catalogue)[declared:]
        self._transitions: list[tuple[Floats, Floats, Floats]] = []
        self._sigma = np.empty(0)
        self._negligible = NEGLIGIBLE * body_sizes(task.scene)
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
        return declared_problem(physics, history, likelihood=self._likelihood)

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
        # one sigma is of all dimensions, and so is then the coarsest precision
        step = 2.0 * np.maximum(self._negligible, self._likelihood.scalar * self._negligible.max())
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
