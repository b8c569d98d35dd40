"""The paper's baselines as agents: OO-LWR, LWR, and one that knows the true model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.agents.agent import Agent
from pbrl_ppl.agents.task import Task
from pbrl_ppl.oomdp import LWR, OOLWR
from pbrl_ppl.planning import Dynamics

Array = NDArray[np.float64]


class _RegressionAgent(Agent):
    """Learns by regression, as it observes."""

    _regression: ClassVar[type[LWR] | type[OOLWR]]

    def __init__(
        self, task: Task, *, learner: Mapping[str, Any] | None = None, **options: Any
    ) -> None:
        super().__init__(task, **options)
        self._learner = self._regression(task.scene, **(learner or {}))

    @property
    def model(self) -> LWR | OOLWR | None:
        """The regression; None before it has any data."""
        return self._learner if self._learner.transitions else None

    def observe(self, state: Array, action: Array, next_state: Array) -> None:
        """Learn from a transition; arguments as of :meth:`Agent.observe`."""
        self._learner.observe(state, action, next_state)


@final
class OOLWRAgent(_RegressionAgent):
    """Agent with object-oriented LWR (section 3.1).

    Bodies of one class share their models, and a condition is which sectors are in contact, as the
    paper has it. ``learner={"relations": (SectorContacts(by_object=True),)}`` tells apart with
    what, and ``learner={"share_classes": False}`` learns each body alone.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    learner : mapping, optional
        Options of :class:`pbrl_ppl.OOLWR`; Table 2's by default.
    **options
        As of :class:`Agent`.

    Raises
    ------
    FitError
        If an option of the learner is impossible.
    """

    name: ClassVar[str] = "OO-LWR"
    _regression = OOLWR


@final
class LWRAgent(_RegressionAgent):
    """Agent with LWR alone (section 3.1.2): it sees no walls.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    learner : mapping, optional
        Options of :class:`pbrl_ppl.LWR`; Table 2's by default.
    **options
        As of :class:`Agent`.

    Raises
    ------
    FitError
        If an option of the learner is impossible.
    """

    name: ClassVar[str] = "LWR"
    _regression = LWR


@final
class TrueModelAgent(Agent):
    """Agent that knows the true parameters: the upper bound.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    parameters : mapping
        By name, as of :meth:`pbrl_ppl.Dynamics.known`.
    effects : iterable of Effect or Attached
        True effects beside those that the scene declares.
    **options
        As of :class:`Agent`.

    Raises
    ------
    ParameterError
        If a parameter is missing, unknown or impossible.
    """

    name: ClassVar[str] = "true model"

    def __init__(
        self, task: Task, parameters: Mapping[str, object], effects: Any = (), **options: Any
    ) -> None:
        super().__init__(task, **options)
        self._dynamics = Dynamics.known(task.scene, parameters, effects, threads=1)

    @property
    def model(self) -> Dynamics:
        """The truth."""
        return self._dynamics

    def observe(self, state: Array, action: Array, next_state: Array) -> None:
        """Nothing to learn."""
