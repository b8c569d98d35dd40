"""Classes of bodies: bodies of one class with equal attributes share Table 1's parameters."""

from __future__ import annotations

from collections.abc import Sequence

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.checks import PARAMETER_NAMES
from pbrl_ppl.scene.parts import WORLD, Body


def check_classes(bodies: Sequence[Body]) -> None:
    """Check that classes have names of their own, and that bodies can share parameters.

    Parameters
    ----------
    bodies : sequence of Body
        All bodies of a scene.

    Raises
    ------
    SceneError
        If a class is called as another body or the world is, or bodies that share parameters differ
        in what shapes these.
    """
    first: dict[str, Body] = {}
    for body in bodies:
        if body.object_class is None:
            continue
        where = f'body "{body.name}"'
        others = [WORLD, *(other.name for other in bodies if other is not body)]
        for name in (body.object_class, body.owner):
            if name in others:
                raise SceneError(
                    f'{where}: its class makes "{name}" the owner of its parameters, which is also'
                    " the name of another body or of the ground; give the class another name"
                )
        if body.static:
            continue
        other = first.setdefault(body.owner, body)
        for key, mine, its in _differing(body, other):
            raise SceneError(
                f'{where}: it shares the parameters of class "{body.owner}" with body'
                f' "{other.name}", and they differ in {key}: {mine} and {its}; make them equal, or'
                " give one of them another class or attributes"
            )


def _differing(body: Body, other: Body) -> list[tuple[str, object, object]]:
    """What shapes the parameters and is not the same of two bodies: its name and both values."""
    pairs: list[tuple[str, object, object]] = [
        (key, getattr(body, key), getattr(other, key))
        for key in ("object_class", "wheel", "kinematic")
    ]
    pairs.append(("known", dict(body.known), dict(other.known)))
    # an effect's parameters are each body's own
    mine, its = (
        {name: dict(hyper) for name, hyper in one.prior if name in PARAMETER_NAMES}
        for one in (body, other)
    )
    pairs.append(("prior", mine, its))
    pairs.append(("attributes", sorted(body.attributes), sorted(other.attributes)))
    if body.wheel:  # its place is bounded by the outline
        pairs.append(("shape", body.shape, other.shape))
    return [pair for pair in pairs if pair[1] != pair[2]]
