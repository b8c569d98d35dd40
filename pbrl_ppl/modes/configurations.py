"""Configurations of joints of unknown bodies, and the problem of each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement, product
from typing import Any

import numpy as np

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes.importance import Marginal
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.parameters import Prior
from pbrl_ppl.physics import index_priors
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

#: Two names in the order of ``scene.joinable``, or None where there is no joint.
Pair = tuple[str, str] | None

#: So many configurations are tried at most: each takes about a second.
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
        pairs = combinations(range(len(p_a)), 2)
        weighed: list[tuple[Pair, float]] = [
            ((scene.joinable[i], scene.joinable[j]), float(both[i, j] + both[j, i]))
            for i, j in pairs
        ]
        possible = [option for option in weighed if option[1] > 0]
        alikes.append(Alike(tuple(names), (*possible, (None, float(both.trace())))))
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
    possible = [
        configuration
        for configuration in listed
        if configuration.empty or np.isfinite(configuration.log_prior)
    ]
    return tuple(sorted(possible, key=lambda configuration: not configuration.empty))


def nothing(scene: Scene) -> Configuration:
    """Return the configuration without joints, whether or not the prior allows it."""
    groups = alike(scene)
    return _configuration(groups, [[None] * len(group.names) for group in groups])


def one_more(scene: Scene, configuration: Configuration) -> tuple[Configuration, ...]:
    """Yield the configurations with one more joint."""
    groups, chosen, larger = alike(scene), dict(configuration.pairs), []
    for i, alike_joints in enumerate(groups):
        order = [pair for pair, _ in alike_joints.weights]
        pairs_of = [[chosen[name] for name in group.names] for group in groups]
        if None not in pairs_of[i]:
            continue
        for pair in order[:-1]:
            grown = sorted([*pairs_of[i][: pairs_of[i].index(None)], pair], key=order.index)
            held_now = [*grown, *[None] * (len(alike_joints.names) - len(grown))]
            larger.append(_configuration(groups, [*pairs_of[:i], held_now, *pairs_of[i + 1 :]]))
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


def evidence_warning(
    rows: Iterable[Mapping[str, Any]], *, material: float = 0.02, few: int = 50
) -> str | None:
    """Return a warning if the evidences of :func:`stored` rows are too uncertain, or None.

    ``material``: two standard errors of the evidence may move a probability by so much.
    ``few``: with fewer effective draws, the standard error itself says little.
    """
    for row in rows:
        probability, error, ess = row["probability"], row["error"], row["ess"]
        if error is None:
            continue
        move = 2.0 * error * probability * (1.0 - probability)
        if move > material or (ess < few and 4.0 * probability * (1.0 - probability) > material):
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
