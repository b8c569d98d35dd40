"""PBRL: the agent whose model is the posterior of a physics engine's parameters."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.agents.agent import Agent
from pbrl_ppl.agents.task import Task
from pbrl_ppl.errors import BoundWarning, FitError, UninformedWarning
from pbrl_ppl.history import from_segments
from pbrl_ppl.model import physics_model
from pbrl_ppl.planning import Dynamics
from pbrl_ppl.posterior import group
from pbrl_ppl.sampling import fit
from pbrl_ppl.state import THETA, wrapped

Array = NDArray[np.float64]

#: A transition that the model foretells so well teaches it nothing (SI units).
_FORETOLD = 1e-4
#: Errors of this many sigma are a surprise.
_SURPRISE = 4.0


@final
class PBRLAgent(Agent):
    """Agent that infers the physics of what it pushes, and plans with the posterior.

    Before any data it acts at random: a plan at the centre of Table 1's prior, where the wheel
    rolls as badly along as across, is no better than that, and costs a search.

    The posterior is fitted anew, for ``update`` reweights draws, which a few transitions without
    noise leave next to nothing of, and a fit's search for the mode takes a second or two; but only
    when there is something to learn: not while the model foretells what comes exactly, and within
    its noise only when the data have grown by a share, ``growth``. Each transition is one by
    itself: an effect of the scene that remembers the command before sees none.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    draws : int, optional
        Posterior draws to plan with, from the Gaussian at the mode; without it, the mode (MAP), as
        in the paper.
    growth : float
        By what share the data grow before a fit where nothing surprised it.
    sigma : str
        ``scalar``, as in Eq. 11, or ``per_dimension``.
    **options
        As of :class:`Agent`.

    Raises
    ------
    FitError
        If ``draws`` is below 1 or ``growth`` negative.

    Attributes
    ----------
    posterior : InferenceData or DataTree or None
        As :func:`pbrl_ppl.fit` made it last.
    fits : int
        How often it was fitted.
    """

    name: ClassVar[str] = "PBRL"

    def __init__(
        self,
        task: Task,
        *,
        draws: int | None = None,
        growth: float = 0.2,
        sigma: str = "scalar",
        **options: Any,
    ) -> None:
        if (draws is not None and draws < 1) or not growth >= 0:
            raise FitError(
                f"PBRL: draws is {draws} and growth {growth}, expected 1 or more and 0 or more"
            )
        super().__init__(task, **options)
        self.draws, self.growth = draws, growth
        self._noise = sigma
        self._transitions: list[tuple[Array, Array, Array]] = []
        self._dynamics: Dynamics | None = None
        self._sigma = np.empty(0)
        self.posterior: Any = None
        self.fits = self._fitted = 0

    @property
    def model(self) -> Dynamics | None:
        """Eq. 7 at the mode or at draws; None before the first fit."""
        return self._dynamics

    @property
    def estimates(self) -> Mapping[str, float]:
        """The mode, or the draw in the middle of those that it plans with, by label; SI units."""
        if self._dynamics is None:
            return {}
        middle = self._dynamics.single()
        return dict(zip(middle.layout.labels, middle.phi[0].tolist(), strict=True))

    def observe(self, state: Array, action: Array, next_state: Array) -> None:
        """Keep a transition; arguments as of :meth:`Agent.observe`."""
        self._transitions.append((state, action, next_state))

    def update(self) -> None:
        """Fit the posterior, if there is something to learn."""
        if self._due():
            self._fit()

    def _due(self) -> bool:
        new = self._transitions[self._fitted :]
        if not new or self._dynamics is None:
            return bool(new)
        state, action, after = (np.array(each) for each in zip(*new, strict=True))
        foretold = self._dynamics.step(np.repeat(state[None], self._dynamics.draws, 0), action)
        error = abs(after - foretold.mean(axis=0))
        error[..., THETA] = abs(wrapped(error[..., THETA]))
        if (error <= _FORETOLD).all():
            return False
        grown = len(self._transitions) >= (1.0 + self.growth) * self._fitted
        surprised = not (error <= np.maximum(_SURPRISE * self._sigma, _FORETOLD)).all()
        return grown or surprised

    def _fit(self) -> None:
        state, action, after = (np.array(each) for each in zip(*self._transitions, strict=True))
        history = from_segments(self.task.scene, state, action[:, None], after[:, None])
        model = physics_model(self.task.scene, history, sigma=self._noise)
        method = "map" if self.draws is None else "laplace"
        with warnings.catch_warnings():
            # that the data do not say everything yet is why it is still learning
            warnings.simplefilter("ignore", UninformedWarning)
            warnings.simplefilter("ignore", BoundWarning)
            self.posterior = fit(model, seed=self.seed, method=method, progress=False)
        self._dynamics = Dynamics.of(self.posterior, self.draws, seed=self.seed, threads=1)
        self._sigma = np.median(group(self.posterior, "posterior")["sigma"].to_numpy(), axis=(0, 1))
        self.fits, self._fitted = self.fits + 1, len(self._transitions)
