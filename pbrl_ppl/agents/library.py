"""PBRL agent with a categorical prior: each body has one of a library's parameter sets."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar, final

import numpy as np
import pandas as pd

from pbrl_ppl.agents.agent import PhysicsAgent, Task, meetings, prediction_errors
from pbrl_ppl.agents.pbrl import NEGLIGIBLE
from pbrl_ppl.errors import ConvergenceWarning, FitError
from pbrl_ppl.history import from_segments
from pbrl_ppl.likelihood import Problem, TransitionLikelihood
from pbrl_ppl.modes import choose_from_library
from pbrl_ppl.parameters import Layout, ParameterLibrary
from pbrl_ppl.physics import Physics, build_layout
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import group
from pbrl_ppl.sampling import sample
from pbrl_ppl.scene import body_sizes
from pbrl_ppl.state import Floats


@final
class LibraryAgent(PhysicsAgent):
    """PBRL agent of the paper's apartment (section 5.2): one parameter set per body.

    The data of a body are the transitions in which it moves or is pushed and touches no other
    moving body. Each body has its noise; given the noise, bodies apart are independent. Bodies of
    one class with equal attributes share parameters, and so the choice and the noise. The paper
    samples the choices by Metropolis; here the sum over them is exact and as many draws are taken,
    or with ``method="paper"`` PyMC samples on the schedule of Table 2, which takes seconds a body.
    The agent plans with the most frequent choice (MAP); a body without data has a set drawn from
    the prior.

    Parameters
    ----------
    task : Task
        Scene, goal and actions. The scene declares no effects.
    library : ParameterLibrary
        The sets, and their probabilities.
    method : str
        ``exact``: the sum over the sets; ``paper``: Metropolis, see :func:`pbrl_ppl.fit`.
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
        if method not in ("exact", "paper"):
            raise ValueError(f"method is {method!r}, expected 'exact' or 'paper'")
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
        return bool((error > NEGLIGIBLE * body_sizes(scene)).any())

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
        if self.method == "paper":
            with warnings.catch_warnings():  # one chain, as in the paper
                warnings.simplefilter("ignore", ConvergenceWarning)
                posterior = sample(problem, method="paper", seed=self.seed).posterior
            index = group(posterior, "posterior")["library_index"].to_numpy()
        else:
            # as many draws as the paper's schedule gives
            _, _, index, _ = choose_from_library(problem, 400, 1, self.seed)
        drawn = np.array(among.names)[index[..., 0].ravel()]
        self._probability[name] = np.array([(drawn == one).mean() for one in self.library.names])
        self._choice[name] = int(self._probability[name].argmax())
        self._fitted[name], self.fits = len(state), self.fits + 1
