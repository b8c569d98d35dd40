"""Ranking of all candidates by their score tests at the mode of the declared model."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.recordings import checked_histories
from pbrl_ppl.criticism.refinement import with_enough_substeps
from pbrl_ppl.criticism.results import Candidate, Stage
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.effects import Attached, Effect, attach, candidates
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem, single_transitions
from pbrl_ppl.modes import Mode, find_mode, trajectory_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Scene, check_substeps
from pbrl_ppl.threads import one_blas_thread


@dataclass(frozen=True)
class Ranking:
    """Score tests of all candidate effects, at the mode of the declared model.

    Parameters
    ----------
    candidates : tuple of Candidate
        Best first.
    mode : dict of str to float
        The declared model's parameters there, by label, SI units.
    unexplained_acceleration : dict of str to float
        Standard deviation of the declared model's process noise, m/s^2 and rad/s^2.
    substeps : int
        Engine steps an interval that were needed.
    """

    candidates: tuple[Candidate, ...]
    mode: dict[str, float]
    unexplained_acceleration: dict[str, float]
    substeps: int


@one_blas_thread
def criticise(
    scene: Scene,
    history: History,
    *,
    catalogue: Iterable[Effect] = full_catalogue,
    seed: int = 0,
    substeps: int | None = None,
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
    substeps : int, optional
        Engine steps an interval to begin with; the scene's by default.
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
    say = progress or (lambda stage: None)
    catalogue = tuple(catalogue)
    mode = checked_mode(scene, history, catalogue, seed, substeps, criteria, say)
    scene, effects = mode.problem.scene, mode.problem.physics.effects
    say(Stage.SCORE)
    ranked = rank_candidates(mode, candidates(scene, effects, catalogue), criteria)
    excess = unexplained_acceleration(mode, criteria)
    return Ranking(
        tuple(signature.candidate for signature in ranked),
        dict(zip(mode.problem.layout.labels, mode.phi.tolist(), strict=True)),
        excess.by_name(excess.size),
        mode.problem.physics.substeps,
    )


def checked_mode(
    scene: Scene,
    history: History,
    catalogue: tuple[Effect, ...],
    seed: int,
    substeps: int | None,
    criteria: Criteria,
    say: Callable[[str], None],
) -> Mode:
    """Return the declared model's mode on a history without bad frames and unused velocities.

    Raises
    ------
    HistoryError
        If the history does not fit the scene.
    EffectError
        If the scene declares an unknown effect.
    """
    if substeps is not None:
        check_substeps(substeps)
    history, _, unused, bad = checked_histories(scene, history, history)
    for sentence in (*(velocity.sentence for velocity in unused), *bad):
        say(sentence)
    scene = with_units(scene, history)
    effects = attach(scene, (), catalogue)
    say(Stage.FIT)
    return declared_mode(scene, history, effects, seed, substeps, say, criteria)


def declared_mode(
    scene: Scene,
    history: History,
    effects: tuple[Attached, ...],
    seed: int,
    substeps: int | None,
    say: Callable[[str], None],
    criteria: Criteria = DEFAULT,
) -> Mode:
    """Return the declared model's mode on whole trajectories, with enough substeps."""
    steps = scene.substeps if substeps is None else substeps
    problem = Problem.of(Physics(scene, effects, steps, threads=2), history)
    if substeps is None:
        physics = problem.physics
        problem = problem.with_physics(substeps=max(physics.substeps, physics.fine_enough))
    mode = find_mode(single_transitions(problem), seed=seed)
    return with_enough_substeps(trajectory_mode(problem, mode.phi), say, criteria)
