"""Model comparison over the configurations of the joints: a mode and the evidence of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.optimize import least_squares
from scipy.special import logsumexp

from pbrl_ppl.errors import FitError
from pbrl_ppl.history import lever
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes.configurations import (
    MOST,
    Configuration,
    Weighed,
    configurations,
    nothing,
    number,
    one_more,
)
from pbrl_ppl.modes.importance import Marginal, importance, laplace
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.modes.search import find_mode, find_modes
from pbrl_ppl.parameters import JOINT_ANCHORS, inside, prior_draws
from pbrl_ppl.scene import WORLD, Joint, Scene
from pbrl_ppl.state import Floats
from pbrl_ppl.threads import Say, counted, silent

#: Configurations whose log-evidence is within this much of the best are sought from more starts.
_CONTENDERS = 100.0


def weigh(
    problem: Problem,
    *,
    seed: int = 0,
    progress: Say = silent,
    margin: float = 25.0,
    at_least: int = 2,
) -> tuple[Weighed, ...]:
    """Return the probability of each configuration of the joints of unknown bodies.

    Each gets the mode of the continuous parameters that it leaves; the search for it begins where
    geometry puts the anchors. The evidence is Laplace's, and for those that it cannot rule out an
    importance sampler's.

    All configurations are tried where there are at most 300. Where there are more, each joint is
    tried by itself first, and further ones are added to the best few (beam search), about 300 in
    all. Then the probabilities are among what was tried, and joints that explain the recording only
    together may be missed.

    Parameters
    ----------
    problem : Problem
        Of a scene with such joints.
    seed : int
        The same seed gives the same answer.
    progress : callable
        Called with how many configurations are done.
    margin : float
        A log-evidence this far below the best by the Laplace method is not looked at more closely:
        the approximation's error is a few units, and the same for all configurations in great part.
    at_least : int
        So many of the best are searched in any case.

    Returns
    -------
    tuple of Weighed
        No joint at all first; then as :func:`pbrl_ppl.modes.configurations.configurations` orders
        them, or in the order in which they were tried.

    Raises
    ------
    FitError
        If a single joint may join more pairs than can be tried.
    """
    problem.segments  # noqa: B018  # checks the initial states, once for all
    modes, evidence = _tried(problem, seed, progress)
    tried, worth = tuple(modes), _worth(modes)
    leading = _leading(evidence, _CONTENDERS, at_least=at_least)
    for configuration in counted(leading, len(leading), "looking again", progress):
        mode = modes[configuration]
        if configuration.empty:
            better = _apart(mode.problem, seed + 1)
        else:
            better = _searched_again(mode, configuration, worth, seed)
        if better.log_posterior > mode.log_posterior:
            modes[configuration], evidence[configuration] = better, laplace(better)
    close = _leading(evidence, margin)
    if len(close) > 1:
        rng = np.random.default_rng(seed)
        for configuration in counted(close, len(close), "weighing joints", progress):
            evidence[configuration] = importance(modes[configuration], rng)
    score = np.array([_score(configuration, evidence[configuration]) for configuration in tried])
    probability = np.exp(score - logsumexp(score))
    return tuple(
        Weighed(configuration, modes[configuration], evidence[configuration], float(p))
        for configuration, p in zip(tried, probability, strict=True)
    )


def _tried(
    problem: Problem, seed: int, progress: Say, *, breadth: int = 4
) -> tuple[dict[Configuration, Mode], dict[Configuration, Marginal]]:
    """Return modes and Laplace evidence of the configurations that a search reaches.

    ``breadth``: configurations to which further joints are added, at most.
    """
    scene = problem.scene
    apart = nothing(scene)
    modes = {apart: _apart(apart.problem(problem), seed)}
    evidence = {apart: laplace(modes[apart])}

    def extend(parents: Mapping[Configuration, Configuration], what: str) -> None:
        for configuration, parent in counted(parents.items(), len(parents), what, progress):
            tied = configuration.problem(problem)
            modes[configuration] = _joint(tied, configuration, modes[parent], _worth(modes))
            evidence[configuration] = laplace(modes[configuration])

    if number(scene) <= MOST:
        others = {other: apart for other in configurations(scene) if not other.empty}
        extend(others, "trying joints")
        return modes, evidence
    best, levels = [apart], len(apart.pairs)
    for level in range(levels):
        grown = {
            configuration: parent
            for parent in best
            for configuration in one_more(scene, parent)
            if configuration not in modes
        }
        if not level and len(modes) + len(grown) > MOST:
            raise FitError(_too_many(scene, len(grown)))
        extend(grown, f"trying joint {level + 1} of {levels}")
        # one that is impossible by the prior may lead to what is not: if each joint joins something
        score = {e: evidence[e].log_z + max(e.log_prior, -_CONTENDERS) for e in evidence}
        least = max(score.values()) - 2 * _CONTENDERS
        best = sorted((e for e in grown if score[e] > least), key=lambda e: -score[e])
        room = (MOST - len(modes)) // max(levels - level - 1, 1)
        most = max([1, *(len(one_more(scene, configuration)) for configuration in best[:1])])
        best = best[: int(np.clip(room // most, 1, breadth))]
    return modes, evidence


def _too_many(scene: Scene, count: int) -> str:
    names = scene.joinable
    return (
        f"fit: the joints of unknown bodies have {count} configurations to be tried at once, of"
        f" {len(names)} that they may join ({', '.join(names)}), expected at most {MOST}; name the"
        " bodies of some joints in the scene, leave out bodies that cannot be joined, or give the"
        " joints a prior that leaves them out (prior = { i_a = { ... } })"
    )


def _worth(modes: Mapping[Configuration, Mode], *, hopeless: float = 300.0) -> float:
    """Return the log-posterior below which a mode is given up.

    ``hopeless``: a climb that ends this far below the best log-posterior so far goes no further:
    wrong joints are explained by masses so unlike that the engine takes a hundred times as long.
    """
    return max(mode.log_posterior for mode in modes.values()) - hopeless


def _score(configuration: Configuration, evidence: Marginal) -> float:
    return configuration.log_prior + evidence.log_z


def _leading(
    evidence: dict[Configuration, Marginal], within: float, at_least: int = 1
) -> list[Configuration]:
    """Return configurations with a log-weight near the best, or among the first."""
    score = {each: _score(each, marginal) for each, marginal in evidence.items()}
    order = sorted(score, key=lambda configuration: -score[configuration])
    least = score[order[0]] - within
    return [e for i, e in enumerate(order) if i < at_least or score[e] > least]


def _apart(problem: Problem, seed: int) -> Mode:
    """Return the mode of a problem without joints of unknown bodies."""
    return _best(problem, find_modes(problem.coarse, seed=seed), -np.inf)


def _joint(problem: Problem, configuration: Configuration, fewer: Mode, worth: float) -> Mode:
    """Return the mode from anchors by geometry, and bodies of the prior or of fewer joints.

    The modes are told apart with few engine steps; the best is climbed with the exact engine.
    """
    starts = []
    for anchors in _placed(problem, configuration):
        centre = np.array([prior.centre for prior in problem.layout.priors])
        for start in (centre, _carried(fewer, problem, centre)):
            start[_anchor_places(problem, configuration)] = anchors
            starts.append(start)
    return _best(problem, _climbed(problem, starts), worth)


def _climbed(problem: Problem, starts: list[Floats], rounds: int = 8) -> list[Mode]:
    """Return where a few rounds of climbs with few engine steps lead: they tell modes apart."""
    return [find_mode(problem.coarse, initial=start, rounds=rounds) for start in starts]


def _best(problem: Problem, found: list[Mode], worth: float, *, rounds: int = 2) -> Mode:
    """The best of modes that were found with few engine steps, climbed with the exact engine.

    One that has not come near the log-posterior ``worth`` by then is climbed no further.

    ``rounds``: rounds of the first climb with the exact engine.
    """
    best = max(found, key=lambda mode: mode.log_posterior)
    first = find_mode(problem, initial=best.phi, rounds=rounds)
    return first if first.log_posterior < worth else find_mode(problem, initial=first.phi)


def _searched_again(
    mode: Mode,
    configuration: Configuration,
    worth: float,
    seed: int,
    *,
    starts: int = 4,
    screened: int = 200,
) -> Mode:
    """Return a better mode with the same anchors and any bodies' parameters.

    ``starts``: starts of each of these configurations: a wheel's axes may have been caught in a
    local optimum.

    ``screened``: draws from the prior that they are chosen from.
    """
    problem = mode.problem
    priors = problem.layout.priors
    rng = np.random.default_rng(seed)
    draws = prior_draws(priors, rng, screened)
    places = _anchor_places(problem, configuration)
    draws[:, places] = mode.phi[places]
    draws = inside(priors, draws)
    z = np.nan_to_num(problem.coarse.whitened(draws, mode.sigma), nan=1e6)
    order = np.argsort(np.log1p(z**2).sum(axis=(1, 2)))[:starts]
    return _best(problem, _climbed(problem, [draws[i] for i in order]), worth)


def _carried(base: Mode, problem: Problem, default: Floats) -> Floats:
    """Return a problem's parameters at a base mode's values, or defaults."""
    values = dict(zip(base.problem.layout.labels, base.phi, strict=True))
    labels = problem.layout.labels
    return np.array([values.get(label, x) for label, x in zip(labels, default, strict=True)])


def _joined(problem: Problem, configuration: Configuration) -> Iterator[tuple[str, Joint]]:
    """Yield the names and joints of a configuration, as in its scene."""
    chosen = {name for name, pair in configuration.pairs if pair is not None}
    scene = problem.scene
    for name, joint in zip(scene.joint_names, scene.joints, strict=True):
        if name in chosen:
            yield name, joint


def _anchor_places(problem: Problem, configuration: Configuration) -> list[int]:
    """Return the places in phi of the configuration's anchors, four a joint."""
    return [
        problem.layout.index(anchor, name)
        for name, _ in _joined(problem, configuration)
        for anchor in JOINT_ANCHORS
    ]


# -- where geometry puts the anchors ---------------------------------------------------------------


def _placed(problem: Problem, configuration: Configuration) -> list[Floats]:
    """Return likely anchors of a configuration's joints, four a joint, best first."""
    alternatives = [
        _anchors(problem, name, joint) for name, joint in _joined(problem, configuration)
    ]
    count = min(len(anchors) for anchors in alternatives)
    return [np.concatenate([anchors[i] for anchors in alternatives]) for i in range(count)]


def _anchors(
    problem: Problem, name: str, joint: Joint, *, n_starts: int = 12, kept: int = 2
) -> list[Floats]:
    """Return anchors that keep their distance over the recording: zero for a hinge.

    A hinge's are linear least squares; a rod's are not, and are sought from several starts.

    ``n_starts``: starts of the search by geometry.
    ``kept``: anchors that are kept.
    """
    priors = [problem.layout.priors[problem.layout.index(anchor, name)] for anchor in JOINT_ANCHORS]
    a, b = (_states(problem, body) for body in joint.bodies or ())
    reference = [_reference(problem, body) for body in joint.bodies or ()]

    def miss(anchors: Floats) -> Floats:
        apart = _at(a, anchors[:2]) - _at(b, anchors[2:])
        if joint.kind == "hinge":
            return np.asarray(apart.ravel())
        length = _at(reference[0], anchors[:2]) - _at(reference[1], anchors[2:])
        return np.asarray(np.linalg.norm(apart, axis=1) - np.linalg.norm(length, axis=1))

    rng = np.random.default_rng(0)
    starts = prior_draws(priors, rng, n_starts)
    starts[0] = [prior.centre for prior in priors]
    if joint.kind == "hinge":
        starts = starts[:1]
    starts = inside(priors, starts)
    bounds = np.array([prior.support for prior in priors]).T
    size = float(np.ptp(bounds, axis=0).min())  # so that the optimiser's tolerances have no unit
    results = [
        least_squares(lambda u: miss(size * u) / size, start / size, bounds=bounds / size)
        for start in starts
    ]
    results.sort(key=lambda result: float(result.cost))
    return [size * result.x for result in results[:kept]]


def _states(problem: Problem, body: str, *, most_rows: int = 500) -> Floats:
    """Return a body's recorded initial states, shape (row, 6); zero for the world.

    ``most_rows``: rows of the recording that the geometry is taken from, at most.
    """
    start = problem.data.history.dataset["start"].to_numpy()
    rows = start[np.isfinite(start).all(axis=(-1, -2))]
    rows = rows[:: -(-len(rows) // most_rows)]
    if body == WORLD:
        return np.zeros((len(rows), 6))
    names = [mover.name for mover in problem.scene.moving]
    return np.asarray(rows[:, names.index(body)])


def _reference(problem: Problem, body: str) -> Floats:
    """Return a body at rest in its reference pose, shape (1, 6)."""
    pose = None if body == WORLD else problem.scene.body(body).pose
    return np.array([[*(pose or (0.0, 0.0, 0.0)), 0.0, 0.0, 0.0]])


def _at(states: Floats, anchor: Floats) -> Floats:
    """Return an anchor's position in the world, shape (row, 2)."""
    return np.asarray(states[:, :2] + lever(states, (anchor[0], anchor[1]))[0])
