"""What joints of unknown bodies may join: every choice, and the problem that each one leaves."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement, product
from typing import Any

from pbrl_ppl.errors import FitError, PosteriorError
from pbrl_ppl.model import Problem
from pbrl_ppl.modes.evidence import Evidence
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.scene import Scene

#: Two names in the order of ``scene.joinable``, or None where there is no joint.
Pair = tuple[str, str] | None

#: Beyond so many configurations a fit is refused: each takes about a second.
MOST = 300
#: A joint that joins nothing, in the tables that people read.
NONE = "none"
#: Where a posterior's attributes hold the configurations.
ATTRIBUTE = "configurations"
#: Two standard errors of the evidence may move a probability by so much.
_MATERIAL = 0.02
#: With fewer effective draws, the standard error itself says little.
_FEW = 50


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
        """The scene with these joints' bodies named, and without those that join nothing."""
        chosen = dict(self.pairs)
        joints = [
            replace(joint, name=name, bodies=joint.bodies or chosen[name])
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
    """A configuration, and how probable it is.

    Parameters
    ----------
    configuration : Configuration
        What is joined.
    mode : Mode
        Of its problem.
    evidence : Evidence
        Of its problem.
    probability : float
        Among all configurations.
    """

    configuration: Configuration
    mode: Mode
    evidence: Evidence
    probability: float


def configurations(scene: Scene) -> tuple[Configuration, ...]:
    """Every choice for the joints whose bodies the scene does not name, no joint at all first.

    Joints of one kind are exchangeable: of the ways to share pairs out among them, the one in
    order counts for all.

    Parameters
    ----------
    scene : Scene
        Its ``joinable`` are what a joint may join.

    Raises
    ------
    FitError
        If there are more than can be tried.

    Examples
    --------
    >>> from pbrl_ppl.scene.scene import Body, Joint, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.1)) for name in "ab")
    >>> scene = Scene(time_step=0.1, bodies=pucks, joints=(Joint("hinge", known=False),))
    >>> [each.pairs[0][1] for each in configurations(scene)]
    [None, ('a', 'b'), ('a', 'world'), ('b', 'world')]
    """
    names = scene.joinable
    n = len(names)
    choices: list[Pair] = [*combinations(names, 2), None]
    free: dict[str, list[str]] = {}
    for name, joint in zip(scene.joint_names, scene.joints, strict=True):
        if joint.bodies is None:
            free.setdefault(joint.kind, []).append(name)
    count = math.prod(math.comb(len(choices) + len(own) - 1, len(own)) for own in free.values())
    if count > MOST:
        joints = [name for own in free.values() for name in own]
        raise FitError(
            f"fit: {len(joints)} joints of unknown bodies ({', '.join(joints)}) and {n} that they"
            f" may join ({', '.join(names)}) make {count} configurations, expected at most {MOST};"
            " name the bodies of some joints in the scene, or leave out bodies that cannot be"
            " joined"
        )
    found = []
    for each in product(*(combinations_with_replacement(choices, len(o)) for o in free.values())):
        chosen: dict[str, Pair] = {}
        weight = 1.0
        for own, pairs in zip(free.values(), each, strict=True):
            chosen |= zip(own, pairs, strict=True)
            weight *= math.factorial(len(pairs))  # whichever of them is called the first
            for times in Counter(pairs).values():
                weight /= math.factorial(times)
            weight *= math.prod((n if pair is None else 2) / n**2 for pair in pairs)
        found.append(Configuration(tuple(chosen.items()), math.log(weight)))
    return tuple(sorted(found, key=lambda one: not one.empty))


def stored(found: Sequence[Weighed]) -> str:
    """Configurations as a posterior's attribute, the most probable first."""
    rows = [
        {
            "joints": dict(each.configuration.pairs),
            "probability": each.probability,
            "log_evidence": each.evidence.log_z,
            "error": each.evidence.error,
            "ess": each.evidence.ess,
        }
        for each in sorted(found, key=lambda each: -each.probability)
    ]
    return json.dumps(rows)


def joint_probabilities(idata: Any) -> dict[str, dict[str, float]]:
    """How probable it is what a joint of unknown bodies joins.

    Parameters
    ----------
    idata : InferenceData or DataTree
        A posterior as made by :func:`pbrl_ppl.fit`, or as loaded from its file, of a scene with a
        joint whose bodies are unknown.

    Returns
    -------
    dict of str to dict of str to float
        For each such joint, the probability of each pair of bodies and of ``none``, the most
        probable first. They come from the evidences, and are finer than the draws can show.

    Raises
    ------
    PosteriorError
        If no joint of the posterior has unknown bodies.

    Examples
    --------
    ::

        idata = pp.fit(pp.physics_model(scene, history), seed=1)
        pp.joint_probabilities(idata)  # {'joint1': {'cart-trailer': 0.998, 'none': 0.002, ...}}
    """
    if ATTRIBUTE not in idata.attrs:
        raise PosteriorError(
            "posterior: the bodies of all its joints were named in the scene; leave out bodies of a"
            " [[joint]], with known = false, and fit again"
        )
    table: dict[str, dict[str, float]] = {}
    for row in json.loads(str(idata.attrs[ATTRIBUTE])):
        for joint, pair in row["joints"].items():
            own = table.setdefault(joint, {})
            name = NONE if pair is None else "-".join(pair)
            own[name] = own.get(name, 0.0) + row["probability"]
    return {
        joint: dict(sorted(own.items(), key=lambda item: -item[1])) for joint, own in table.items()
    }


def doubts(idata: Any) -> str | None:
    """What is to be said where the evidences are too rough for their probabilities, if they are."""
    for row in json.loads(str(idata.attrs.get(ATTRIBUTE, "[]"))):
        probability, error, ess = row["probability"], row["error"], row["ess"]
        if error is None:
            continue
        move = 2.0 * error * probability * (1.0 - probability)
        if move > _MATERIAL or (ess < _FEW and 4.0 * probability * (1.0 - probability) > _MATERIAL):
            joined = ", ".join(
                f"{joint}: {NONE if pair is None else '-'.join(pair)}"
                for joint, pair in row["joints"].items()
            )
            return (
                f"which bodies are joined is rough: the probability {probability:.3g} of {joined}"
                f" may be off by {max(move, _MATERIAL):.2g} (log-evidence to within {error:.2g},"
                f" {ess:.0f} effective draws); record motions that load the joint, or give"
                " parameters that the data say nothing of in the scene (known = ...)"
            )
    return None
