"""What a declared model lacks, without a verdict: by simulation error, or by score tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.innovations import unexplained_acceleration
from pbrl_ppl.criticism.refinement import Declared
from pbrl_ppl.criticism.results import CANDIDATE, NAMED, ONE_TRAJECTORY, Law, SearchLength
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.criticism.search import Search
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.history import MOST_TRANSITIONS, History
from pbrl_ppl.likelihood import is_simulated
from pbrl_ppl.scene import Scene
from pbrl_ppl.system.files import json_fields
from pbrl_ppl.system.threads import one_blas_thread, silent


@dataclass(frozen=True)
class Attribution:
    """Laws that the simulation error of whole trajectories shows.

    Parameters
    ----------
    laws : tuple of Law
        Those of most evidence first.
    before, after : dict of str to float
        Simulation error of the declared model and with the laws: root mean square of measured minus
        simulated over pieces of ``seconds``, by state dimension, SI units.
    correlated : dict of str to float
        Integrated autocorrelation time of the last residual, in rows: 1 if it is white.
    seconds : float
        Length of the simulated pieces (s).
    trajectories : int
        How many there are.
    search : tuple of SearchLength
        What was found at each length of pieces.
    rejected : dict of str to str
        Why a law that was found on shorter pieces is not among them.
    """

    laws: tuple[Law, ...]
    before: dict[str, float]
    after: dict[str, float]
    correlated: dict[str, float]
    seconds: float
    trajectories: int
    search: tuple[SearchLength, ...] = field(default=(), metadata={"key": "rungs"})
    rejected: Mapping[str, str] = field(default_factory=dict)

    @property
    def sentences(self) -> list[str]:
        """What to know before relying on the laws."""
        said = [ONE_TRAJECTORY] if self.laws and self.trajectories == 1 else []
        for law in self.laws:
            if law.not_separable_from:
                others = " or ".join(law.not_separable_from)
                said.append(f"these data cannot tell {law.effect} on {law.body} from {others}")
        return said

    def to_dict(self) -> dict[str, object]:
        """Return the contents for JSON."""
        return json_fields(self) | {"laws": [law.in_json(NAMED) for law in self.laws]}


@one_blas_thread
def attribute(
    scene: Scene,
    history: History,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    most_transitions: int = MOST_TRANSITIONS,
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> Attribution:
    """Name the effects that take the simulation error of whole trajectories away.

    The declared model is simulated from latent initial states, without process noise, in pieces of
    four rows and then of longer ones. On each length one regression proposes which laws are missing
    together; the best proposals are refitted, and one is added if the error's fall is evidence by
    the effective sample size and large enough. A law that longer pieces do not need is dropped.
    There is no verdict and no held-out data: that is `close_loop`.

    Parameters
    ----------
    scene : Scene
        The declared model.
    history : History
        Measured trajectories.
    catalogue : iterable of Effect
        Effects to consider.
    seed : int
        Seed of the search for the declared model's mode.
    most_transitions : int
        As of :func:`pbrl_ppl.close_loop`.
    criteria : Criteria
        Thresholds; see :class:`SearchCriteria`.
    progress : callable, optional
        Called with the name of each stage and with each law found.

    Returns
    -------
    Attribution
        The laws, and the simulation error before and after.

    Raises
    ------
    HistoryError
        If the history does not fit the scene, no trajectory has three rows, or initial states can
        follow all that was measured.
    EffectError
        If the scene declares an unknown effect.

    Examples
    --------
    ::

        found = pp.attribute(scene, history)
        [law.effect for law in found.laws]  # ['linear_drag', 'sliding_friction']
    """
    declared = Declared(scene, tuple(catalogue), seed, criteria, progress or silent)
    declared, history = declared.cleaned(history, most_transitions)
    _, found = Search(declared.missing, criteria, declared.say).of(history, declared.mode, seed)
    problem = found.after.problem
    names = problem.observations.names
    times = problem.likelihood.tau if is_simulated(problem) else (1.0,) * len(names)
    return Attribution(
        laws=tuple(found.laws.values()),
        before=dict(zip(names, found.declared.sigma.tolist(), strict=True)),
        after=dict(zip(names, found.after.sigma.tolist(), strict=True)),
        correlated=dict(zip(names, times, strict=True)),
        seconds=problem.data.horizon * problem.scene.time_step,
        trajectories=problem.data.history.n_trajectories,
        search=found.lengths,
        rejected={f"{law.effect.name} on {law.body}": why for law, why in found.rejected.items()},
    )


@dataclass(frozen=True)
class Ranking:
    """Score tests of all candidate effects, at the mode of the declared model.

    Parameters
    ----------
    candidates : tuple of Law
        Best first.
    mode : dict of str to float
        The declared model's parameters there, by label, SI units.
    unexplained_acceleration : dict of str to float
        Standard deviation of the declared model's process noise, m/s^2 and rad/s^2.
    substeps : int
        Engine steps an interval that were needed.
    """

    candidates: tuple[Law, ...]
    mode: dict[str, float]
    unexplained_acceleration: dict[str, float]
    substeps: int

    def to_dict(self) -> dict[str, object]:
        """Return the contents for JSON."""
        return vars(self) | {"candidates": [one.in_json(CANDIDATE) for one in self.candidates]}


@one_blas_thread
def criticise(
    scene: Scene,
    history: History,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    most_transitions: int = MOST_TRANSITIONS,
    criteria: Criteria = DEFAULT,
    progress: Callable[[str], None] | None = None,
) -> Ranking:
    """Rank the effects that a declared model might lack by their score tests, without a refit.

    A statistic says that the residual looks like the effect's signature; whether the effect
    explains it, and helps on other data, :func:`pbrl_ppl.close_loop` finds out.

    Parameters
    ----------
    scene : Scene
        The declared model.
    history : History
        Measured transitions.
    catalogue : iterable of Effect
        Effects to consider.
    seed : int
        Seed of the search for the mode.
    most_transitions : int
        As of :func:`pbrl_ppl.close_loop`.
    criteria : Criteria
        When the engine's error is small enough.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Ranking
        The candidates, best first.

    Raises
    ------
    HistoryError
        If the history does not fit the scene.
    EffectError
        If the scene declares an unknown effect.
    """
    declared = Declared(scene, tuple(catalogue), seed, criteria, progress or silent)
    declared, history = declared.cleaned(history, most_transitions)
    mode = declared.mode(history)
    declared.say("scoring what the model might lack")
    ranked = rank_candidates(mode, declared.missing(mode), criteria, declared.say)
    excess = unexplained_acceleration(mode, criteria)
    return Ranking(
        tuple(signature.candidate for signature in ranked),
        dict(zip(mode.problem.layout.labels, mode.phi.tolist(), strict=True)),
        excess.by_name(excess.size),
        mode.problem.physics.substeps,
    )
