"""Configurations of joints of unknown bodies: a mode and the evidence of each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement, product
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import logsumexp

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes.importance import Marginal, importance, laplace
from pbrl_ppl.modes.search import Mode, find_mode, find_modes
from pbrl_ppl.parameters import JOINT_ANCHORS, Prior, inside, prior_draws
from pbrl_ppl.physics import index_priors
from pbrl_ppl.scene import WORLD, Joint, Scene
from pbrl_ppl.state import Floats
from pbrl_ppl.system.threads import Say, counted, silent

#: Two names in the order of ``scene.joinable``, or None where there is no joint.
Pair = tuple[str, str] | None

#: Most configurations that are tried; each takes about a second.
MOST = 300
#: A joint that joins nothing, in the tables that people read.
NONE = "none"


@dataclass(frozen=True)
class Configuration:
    """One choice of what each joint of unknown bodies joins.

    Parameters
    ----------
    pairs : tuple of (str, tuple of (str, str) or None)
        The joint's name and its two bodies, in the order of ``scene.joinable``; None where it joins
        nothing.
    log_prior : float
        Logarithm of its probability under Table 1's categorical indices, with all that it stands
        for: a pair has both orders, no joint every ``i_a = i_b``.
    """

    pairs: tuple[tuple[str, Pair], ...]
    log_prior: float

    @property
    def empty(self) -> bool:
        """Whether nothing is joined."""
        return all(pair is None for _, pair in self.pairs)

    def scene(self, scene: Scene) -> Scene:
        """The scene with named bodies of these joints, without joints of nothing."""
        chosen = dict(self.pairs)
        joints = [
            replace(joint, name=name, bodies=joint.bodies or chosen[name], prior=())
            for name, joint in zip(scene.joint_names, scene.joints, strict=True)
            if joint.bodies is not None or chosen[name] is not None
        ]
        return scene.replace(joints=tuple(joints))

    def problem(self, problem: Problem) -> Problem:
        """The problem of the parameters that are left, all of them continuous.

        The data stay, and with them their check: bodies deep inside each other that nothing joins
        here are pushed apart, for one configuration must not refuse what the others explain.
        """
        return problem.with_physics(scene=self.scene(problem.scene))


@dataclass(frozen=True, eq=False)
class Weighed:
    """A configuration with its mode, evidence and posterior probability.

    Parameters
    ----------
    configuration : Configuration
        What is joined.
    mode : Mode
        Of its problem.
    evidence : Marginal
        Of its problem.
    probability : float
        Among all configurations.
    """

    configuration: Configuration
    mode: Mode
    evidence: Marginal
    probability: float


@dataclass(frozen=True)
class Alike:
    """Exchangeable joints: of unknown bodies, of one kind and one prior.

    Parameters
    ----------
    names : tuple of str
        The joints.
    weights : tuple of (tuple of (str, str) or None, float)
        What each may join, and the probability of that; no joint last, and always among them.
    """

    names: tuple[str, ...]
    weights: tuple[tuple[Pair, float], ...]


def alike(scene: Scene) -> tuple[Alike, ...]:
    """Return groups of exchangeable joints of unknown bodies."""
    groups: dict[tuple[str, Prior, Prior], list[str]] = {}
    for name, joint in zip(scene.joint_names, scene.joints, strict=True):
        if joint.bodies is None:
            groups.setdefault((joint.kind, *index_priors(scene, joint)), []).append(name)
    alikes = []
    for (_, *priors), names in groups.items():
        p_a, p_b = (prior.probabilities for prior in priors)
        both = np.outer(p_a, p_b)
        either = both + both.T
        weighed: list[tuple[Pair, float]] = [
            ((scene.joinable[i], scene.joinable[j]), float(either[i, j]))
            for i, j in combinations(range(len(p_a)), 2)
            if either[i, j] > 0
        ]
        alikes.append(Alike(tuple(names), (*weighed, (None, float(both.trace())))))
    return tuple(alikes)


def index_law(pair: Pair, scene: Scene, p_a: Floats, p_b: Floats) -> Floats:
    """Probabilities of (i_a, i_b), shape (n, n), given what is joined.

    The two orders of a pair are the same joint. Where the indices have one prior, it is given in
    the order of ``scene.joinable``; else each order has the probability that the priors give it.

    Parameters
    ----------
    pair : tuple of (str, str) or None
        What is joined.
    scene : Scene
        Its ``joinable`` are what the indices count.
    p_a, p_b : ndarray
        Prior probabilities of the indices, shape (n,).
    """
    both = np.outer(p_a, p_b)
    law = np.zeros_like(both)
    if pair is None:
        np.fill_diagonal(law, np.diag(both))
    else:
        i, j = sorted(scene.joinable.index(name) for name in pair)
        law[i, j], law[j, i] = both[i, j], both[j, i]
        if np.array_equal(p_a, p_b):
            law[j, i] = 0.0
    return np.asarray(law / law.sum())


def number(scene: Scene) -> int:
    """Return the number of configurations."""
    return math.prod(
        math.comb(len(group.weights) + len(group.names) - 1, len(group.names))
        for group in alike(scene)
    )


def configurations(scene: Scene) -> tuple[Configuration, ...]:
    """Yield all configurations of the joints of unknown bodies, no joint at all first.

    Joints that are alike are exchangeable: of the ways to share pairs out among them, the one in
    order counts for all.

    Parameters
    ----------
    scene : Scene
        Its ``joinable`` are what a joint may join.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Joint, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.1)) for name in "ab")
    >>> scene = Scene(time_step=0.1, bodies=pucks, joints=(Joint("hinge", known=False),))
    >>> [configuration.pairs[0][1] for configuration in configurations(scene)]
    [None, ('a', 'b'), ('a', 'world'), ('b', 'world')]
    """
    groups = alike(scene)
    ways = (
        combinations_with_replacement([pair for pair, _ in group.weights], len(group.names))
        for group in groups
    )
    listed = [_configuration(groups, pairs) for pairs in product(*ways)]
    possible = [each for each in listed if each.empty or np.isfinite(each.log_prior)]
    return tuple(sorted(possible, key=lambda each: not each.empty))


def nothing(scene: Scene) -> Configuration:
    """Return the configuration without joints, whether or not the prior allows it."""
    groups = alike(scene)
    return _configuration(groups, [[None] * len(group.names) for group in groups])


def one_more(scene: Scene, configuration: Configuration) -> tuple[Configuration, ...]:
    """Yield the configurations with one more joint."""
    groups, chosen, larger = alike(scene), dict(configuration.pairs), []
    pairs_of = [[chosen[name] for name in group.names] for group in groups]
    for i, group in enumerate(groups):
        order = [pair for pair, _ in group.weights]
        if None not in pairs_of[i]:
            continue
        for pair in order[:-1]:
            grown = pairs_of[i].copy()
            grown[grown.index(None)] = pair
            grown.sort(key=order.index)
            larger.append(_configuration(groups, [*pairs_of[:i], grown, *pairs_of[i + 1 :]]))
    return tuple(larger)


def _configuration(groups: Sequence[Alike], pairs_of: Sequence[Sequence[Pair]]) -> Configuration:
    """Return a configuration from the pairs of each group, with its prior."""
    chosen: dict[str, Pair] = {}
    weight = 1.0
    for group, pairs in zip(groups, pairs_of, strict=True):
        chosen |= zip(group.names, pairs, strict=True)
        weight *= math.factorial(len(pairs))  # whichever of them is called the first
        for times in Counter(pairs).values():
            weight /= math.factorial(times)
        law = dict(group.weights)
        weight *= math.prod(law[pair] for pair in pairs)
    return Configuration(tuple(chosen.items()), math.log(weight) if weight else -math.inf)


def stored(configurations: Sequence[Weighed]) -> list[dict[str, Any]]:
    """Return configurations for a posterior's record, most probable first."""
    return [
        {
            "joints": dict(weighed.configuration.pairs),
            "probability": weighed.probability,
            "log_evidence": weighed.evidence.log_z,
            "error": weighed.evidence.error,
            "ess": weighed.evidence.ess,
        }
        for weighed in sorted(configurations, key=lambda weighed: -weighed.probability)
    ]


def evidence_warning(rows: Iterable[Mapping[str, Any]]) -> str | None:
    """Return a warning if the evidences of :func:`stored` rows are too uncertain, or None."""
    material = 0.02  # two standard errors of the evidence may move a probability by so much
    for row in rows:
        probability, error, ess = row["probability"], row["error"], row["ess"]
        if error is None:
            continue
        move = 2.0 * error * probability * (1.0 - probability)
        # with fewer than 50 effective draws, the standard error itself says little
        if move > material or (ess < 50 and 4.0 * probability * (1.0 - probability) > material):
            joined = ", ".join(
                f"{joint}: {NONE if pair is None else '-'.join(pair)}"
                for joint, pair in row["joints"].items()
            )
            return (
                f"which bodies are joined is uncertain: the probability {probability:.3g} of"
                f" {joined} may be off by {max(move, material):.2g} (log-evidence to within"
                f" {error:.2g}, {ess:.0f} effective draws); record motions that load the joint, or"
                " give parameters that the data say nothing of in the scene (known = ...)"
            )
    return None


# -- search --------------------------------------------------------------------------------------


#: Log-evidence (nats) below the best up to which a configuration is sought from more starts.
_CONTENDERS = 100.0


def weigh(problem: Problem, *, seed: int = 0, progress: Say = silent) -> tuple[Weighed, ...]:
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
    worth, leading = _worth(modes), _leading(evidence, _CONTENDERS, at_least=2)
    for configuration in counted(leading, len(leading), "looking again", progress):
        mode = modes[configuration]
        if configuration.empty:
            better = _apart(mode.problem, seed + 1)
        else:
            better = _searched_again(mode, configuration, worth, seed)
        if better.log_posterior > mode.log_posterior:
            modes[configuration], evidence[configuration] = better, laplace(better)
    # Laplace's error is a few nats, and the same for all configurations in great part
    close = _leading(evidence, 25.0)
    if len(close) > 1:
        rng = np.random.default_rng(seed)
        for configuration in counted(close, len(close), "weighing joints", progress):
            evidence[configuration] = importance(modes[configuration], rng)
    score = np.array([e.log_prior + evidence[e].log_z for e in modes])
    probability = np.exp(score - logsumexp(score))
    return tuple(
        Weighed(configuration, mode, evidence[configuration], float(p))
        for (configuration, mode), p in zip(modes.items(), probability, strict=True)
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
        extend({e: apart for e in configurations(scene) if not e.empty}, "trying joints")
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
            raise FitError(
                f"fit: the joints of unknown bodies have {len(grown)} configurations to be tried"
                f" at once, of {len(scene.joinable)} that they may join"
                f" ({', '.join(scene.joinable)}), expected at most {MOST}; name the bodies of some"
                " joints in the scene, leave out bodies that cannot be joined, or give the joints a"
                " prior that leaves them out (prior = { i_a = { ... } })"
            )
        extend(grown, f"trying joint {level + 1} of {levels}")
        # one that is impossible by the prior may lead to what is not: if each joint joins something
        score = {e: evidence[e].log_z + max(e.log_prior, -_CONTENDERS) for e in evidence}
        least = max(score.values()) - 2 * _CONTENDERS
        best = sorted((e for e in grown if score[e] > least), key=lambda e: -score[e])
        room = (MOST - len(modes)) // max(levels - level - 1, 1)
        most = max([1, *(len(one_more(scene, configuration)) for configuration in best[:1])])
        best = best[: int(np.clip(room // most, 1, breadth))]
    return modes, evidence


def _worth(modes: Mapping[Configuration, Mode], *, hopeless: float = 300.0) -> float:
    """Return the log-posterior below which a mode is given up.

    ``hopeless``: a climb that ends this far below the best log-posterior so far goes no further:
    wrong joints are explained by masses so unlike that the engine takes a hundred times as long.
    """
    return max(mode.log_posterior for mode in modes.values()) - hopeless


def _leading(
    evidence: dict[Configuration, Marginal], within: float, at_least: int = 1
) -> list[Configuration]:
    """Return configurations with a log-weight near the best, or among the first."""
    score = {each: each.log_prior + marginal.log_z for each, marginal in evidence.items()}
    order = sorted(score, key=lambda each: -score[each])
    least = score[order[0]] - within
    return [e for i, e in enumerate(order) if i < at_least or score[e] > least]


def _apart(problem: Problem, seed: int) -> Mode:
    """Return the mode of a problem without joints of unknown bodies."""
    return _best(problem, find_modes(problem.coarse, seed=seed), -np.inf)


def _joint(problem: Problem, configuration: Configuration, fewer: Mode, worth: float) -> Mode:
    """Return the mode from anchors by geometry, and bodies of the prior or of fewer joints.

    The modes are told apart with few engine steps; the best is climbed with the exact engine.
    """
    layout, starts = problem.layout, []
    for anchors in _placed(problem, configuration):
        centre = np.array([prior.centre for prior in layout.priors])
        for start in (centre, layout.from_layout(fewer.problem.layout, fewer.phi)):
            start[_anchor_places(problem, configuration)] = anchors
            starts.append(start)
    return _best(problem, _climbed(problem, starts), worth)


def _climbed(problem: Problem, starts: Iterable[Floats], rounds: int = 8) -> list[Mode]:
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


def _searched_again(mode: Mode, configuration: Configuration, worth: float, seed: int) -> Mode:
    """Return a better mode with the same anchors and any bodies' parameters.

    It begins at the best four of 200 draws from the prior: a wheel's axes may have been caught in a
    local optimum.
    """
    problem, priors = mode.problem, mode.problem.layout.priors
    draws = prior_draws(priors, np.random.default_rng(seed), 200)
    places = _anchor_places(problem, configuration)
    draws[:, places] = mode.phi[places]
    draws = inside(priors, draws)
    z = np.nan_to_num(problem.coarse.whitened(draws, mode.sigma), nan=1e6)
    order = np.argsort(np.log1p(z**2).sum(axis=(1, 2)))[:4]
    return _best(problem, _climbed(problem, draws[order]), worth)


def _joined(problem: Problem, configuration: Configuration) -> list[tuple[str, Joint]]:
    """Return the names and joints of a configuration, as in its scene."""
    chosen, scene = dict(configuration.pairs), problem.scene
    named = zip(scene.joint_names, scene.joints, strict=True)
    return [(name, joint) for name, joint in named if chosen.get(name) is not None]


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
    alternatives = [_anchors(problem, *named) for named in _joined(problem, configuration)]
    return [np.concatenate(anchors) for anchors in zip(*alternatives, strict=False)]


def _anchors(problem: Problem, name: str, joint: Joint) -> list[Floats]:
    """Return anchors that keep their distance over the recording: zero for a hinge.

    A hinge's are linear least squares; a rod's are not: the best two from twelve starts.
    """
    priors = [problem.layout.priors[problem.layout.index(anchor, name)] for anchor in JOINT_ANCHORS]
    a, b = (_states(problem, body) for body in joint.bodies or ())
    by_anchors = np.concatenate([_turns(a), -_turns(b)], axis=2)

    bounds = np.array([prior.support for prior in priors]).T
    size = float(np.ptp(bounds, axis=0).min())  # so that the optimiser's tolerances have no unit

    def miss(u: Floats) -> tuple[Floats, Floats]:
        """Return how far from their distance anchors are, and its derivative, in units of size."""
        apart = (a - b)[:, :2] + by_anchors @ (size * u)
        if joint.kind == "hinge":
            return apart[:-1].ravel() / size, by_anchors[:-1].reshape(-1, len(u))
        length = np.maximum(np.linalg.norm(apart, axis=1), np.finfo(float).tiny)
        slope = np.einsum("ri,ria->ra", apart / length[:, None], by_anchors)
        return (length[:-1] - length[-1]) / size, slope[:-1] - slope[-1]

    starts = prior_draws(priors, np.random.default_rng(0), 12)
    starts[0] = [prior.centre for prior in priors]
    starts = inside(priors, starts[:1] if joint.kind == "hinge" else starts)
    results = [
        least_squares(lambda u: miss(u)[0], start / size, lambda u: miss(u)[1], bounds / size)
        for start in starts
    ]
    results.sort(key=lambda result: float(result.cost))
    return [size * result.x for result in results[:2]]


def _states(problem: Problem, body: str, *, most_rows: int = 500) -> Floats:
    """Return a body's recorded initial states and its reference pose, shape (row + 1, 6).

    They are zero for the world.

    ``most_rows``: rows of the recording that the geometry is taken from, at most.
    """
    start = problem.data.history.dataset["start"].to_numpy()
    rows = start[np.isfinite(start).all(axis=(-1, -2))]
    rows = rows[:: -(-len(rows) // most_rows)]
    if body == WORLD:
        return np.zeros((len(rows) + 1, 6))
    names = [mover.name for mover in problem.scene.moving]
    pose = problem.scene.body(body).pose or (0.0, 0.0, 0.0)
    return np.vstack([rows[:, names.index(body)], [*pose, 0.0, 0.0, 0.0]])


def _turns(states: Floats) -> Floats:
    """Return the rotations of states from a body's frame to the world, shape (row, 2, 2)."""
    cos, sin = np.cos(states[:, 2]), np.sin(states[:, 2])
    return np.moveaxis(np.array([[cos, -sin], [sin, cos]]), -1, 0)
