"""PBRL with a categorical prior: each body is like one of those that were learned before."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pbrl_ppl.agents.agent import Agent
from pbrl_ppl.agents.task import Task
from pbrl_ppl.errors import ConvergenceWarning, FitError
from pbrl_ppl.history import from_segments
from pbrl_ppl.likelihood import Problem, TransitionLikelihood
from pbrl_ppl.model import build_model
from pbrl_ppl.modes import choose_from_library
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import build_layout, touching
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import group
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import THETA, wrapped

Array = NDArray[np.float64]

#: Draws of the paper's schedule: 5000 iterations, 1000 burnt in, each tenth kept, one chain.
_DRAWS = 400
#: The share by which a body's data grow before it is looked at again, and errors that are foretold
#: well enough (SI units).
_GROWTH, _FORETOLD = 0.2, 1e-4


@final
class LibraryAgent(Agent):
    """PBRL agent of the paper's apartment (section 5.2): a choice among parameter sets a body.

    A body is judged by the transitions in which it moves or is pushed and touches no other moving
    one, each by itself with a noise of its own: given the noise, bodies apart are independent.
    Bodies of one class with equal attributes share parameters, and so one choice and noise. The
    paper walks among the choices; here the sum over them is exact, and as many draws are kept, or
    with ``method="paper"`` PyMC walks on the schedule of Table 2, which takes seconds a body. The
    most frequent choice (MAP) is planned with; a body of which nothing was seen is like a set drawn
    from the prior.

    Parameters
    ----------
    task : Task
        Scene, goal and actions. The scene declares no effects.
    library : ParameterLibrary
        The sets, and their probabilities.
    method : str
        ``exact``: the sum over the sets; ``paper``: Metropolis, as of :func:`pbrl_ppl.fit`.
    **options
        As of :class:`Agent`.

    Attributes
    ----------
    fits : int
        How often a body, or those of a class, were looked at.

    Raises
    ------
    FitError
        If the scene declares effects, or has a kinematic body.
    ParameterError
        If the library does not fit the scene's bodies.
    ValueError
        If ``method`` is neither.

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
        self.method = method
        scene = task.scene
        if any(body.effects or body.kinematic for body in scene.bodies):
            raise FitError("PBRL: the scene has effects or a kinematic body, which no set is for")
        self.library, self.fits = library, 0
        self._layout = build_layout(scene)
        self._table = library.table(self._layout, scene)
        rng = np.random.default_rng([self.seed, 2])
        names = [body.name for body in scene.moving]
        self._probability = {owner: library.prior(owner) for owner in scene.owners}
        self._choice = {name: int(rng.choice(len(p), p=p)) for name, p in self._probability.items()}
        self._own = {owner: scene.subset(own) for owner, own in scene.owners.items()}
        self._pairs = {
            (a, b): scene.subset([a, b]).replace(walls=())
            for i, a in enumerate(names)
            for b in names[i + 1 :]
        }
        self._seen: dict[str, list[tuple[Array, Array, Array]]] = {name: [] for name in self._own}
        self._fitted = dict.fromkeys(self._own, 0)
        self._dynamics: Dynamics | None = None

    @property
    def model(self) -> Dynamics | None:
        """Eq. 7 at the most probable choice; None before anything was observed."""
        return self._dynamics

    @property
    def estimates(self) -> Mapping[str, float]:
        """Parameters of the most probable choice, by label; SI units."""
        if self._dynamics is None:
            return {}
        return dict(zip(self._layout.labels, self._dynamics.phi[0].tolist(), strict=True))

    @property
    def probabilities(self) -> pd.DataFrame:
        """Posterior probability of every set: one row a body or class, one column a set."""
        return pd.DataFrame(self._probability, index=list(self.library.names)).T

    def observe(self, state: Array, action: Array, next_state: Array) -> None:
        """Keep what a transition says of each body; arguments as of :meth:`Agent.observe`."""
        moved = action.any(axis=1) | state[:, 3:].any(axis=1) | (next_state != state).any(axis=1)
        names = [body.name for body in self.task.scene.moving]
        alone = moved.copy()
        for pair, scene in self._pairs.items():
            i, j = (names.index(name) for name in pair)
            if moved[i] or moved[j]:
                both = [i, j]
                if touching(scene, state[None, both], next_state[None, both])[0]:
                    alone[both] = False
        for owner, own in self.task.scene.owners.items():
            of = [names.index(name) for name in own]
            judged = alone[of, None]
            if judged.any():  # the others of its class stand still, and were not measured
                begin = np.where(judged | (np.arange(state.shape[1]) < 3), state[of], 0.0)
                push, after = judged * action[of], np.where(judged, next_state[of], np.nan)
                self._seen[owner].append((begin, push, after))

    def update(self) -> None:
        """Choose anew for each body or class whose data grew by a fifth and were not foretold."""
        before = self.fits
        for name, seen in self._seen.items():
            fitted = self._fitted[name]
            grown = len(seen) > fitted and len(seen) >= (1.0 + _GROWTH) * fitted
            if grown and (not fitted or self._surprised(name)):
                self._choose(name)
        if self._dynamics is None or self.fits > before:
            self._dynamics = Dynamics(self.task.scene, self._phi(self._layout), threads=1)

    def _surprised(self, name: str) -> bool:
        state, action, after = (np.array(each) for each in zip(*self._seen[name], strict=True))
        scene = self._own[name]
        own = Dynamics(scene, self._phi(build_layout(scene)), threads=1)
        error = abs(after - own.step(state[None], action)[0])
        error[..., THETA] = abs(wrapped(error[..., THETA]))
        return bool((error > _FORETOLD).any())

    def _phi(self, layout: Any) -> Array:
        """Chosen parameters in a layout's order."""
        known = {
            label: self._table[i, self._choice[self._owner(label)]]
            for i, label in enumerate(self._layout.labels)
        }
        return np.array([known[label] for label in layout.labels])

    @staticmethod
    def _owner(label: str) -> str:
        return label.partition("[")[2].rstrip("]")

    def _choose(self, name: str) -> None:
        scene, seen = self._own[name], self._seen[name]
        state, action, after = (np.array(each) for each in zip(*seen, strict=True))
        history = from_segments(scene, state, action[:, None], after[:, None])
        among = _of_one(self.library, scene, name)
        problem = Problem.of(
            scene, history, likelihood=TransitionLikelihood(scalar=True), library=among
        )
        if self.method == "paper":
            with warnings.catch_warnings():  # of one chain, as the paper has it
                warnings.simplefilter("ignore", ConvergenceWarning)
                idata = fit(build_model(problem), method="paper", seed=self.seed, progress=False)
            index = group(idata, "posterior")["library_index"].to_numpy()
        else:
            _, _, index, _, _ = choose_from_library(problem, _DRAWS, 1, self.seed)
        share = np.bincount(index[..., 0].ravel(), minlength=len(among.names)) / _DRAWS
        found = dict(zip(among.names, share.tolist(), strict=True))
        self._probability[name] = np.array([found.get(each, 0.0) for each in self.library.names])
        self._choice[name] = int(self._probability[name].argmax())
        self._fitted[name], self.fits = len(seen), self.fits + 1


def _of_one(library: ParameterLibrary, scene: Scene, name: str) -> ParameterLibrary:
    """The sets that are possible for one body or class, with the parameters that it has."""
    wanted = {block.name for block in build_layout(scene).blocks}
    prior = dict(zip(library.names, library.prior(name).tolist(), strict=True))
    sets = {
        each: {key: value for key, value in dict(values).items() if key in wanted}
        for each, values in library.sets
        if prior[each] > 0
    }
    return ParameterLibrary(sets, {each: prior[each] for each in sets})
