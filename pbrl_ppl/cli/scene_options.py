"""Parts of a new scene from options: outlines, hinges, walls, what is known of bodies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from pbrl_ppl.cli.scene_text import BodyText, HingeText, numbers
from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import WORLD, nearest

SHAPES = "box:0.9x0.55, circle:0.1 or polygon:0,2/-1,-1/1,-1, in m"
HINGE = "arm@0,0.15 (to the world) or upper@0,-0.1=lower@0,0.15"


def outline(text: str) -> tuple[str, str]:
    """Name and shape, as TOML, of ``NAME=box:LENGTHxWIDTH`` and the like.

    Examples
    --------
    >>> outline("arm=box:0.03x0.2")
    ('arm', '{ kind = "box", size = [0.03, 0.2] }')
    """
    name, _, shape = text.rpartition("=")
    kind, _, rest = shape.partition(":")
    sizes = _floats(rest.split("x"))
    corners = [_floats(corner.split(",")) for corner in rest.split("/")]
    if name and kind == "box" and len(sizes) == 2:
        return name, f'{{ kind = "box", size = {numbers(sizes)} }}'
    if name and kind == "circle" and len(sizes) == 1:
        return name, f'{{ kind = "circle", radius = {sizes[0]!r} }}'
    if name and kind == "polygon" and all(len(corner) == 2 for corner in corners):
        listed = ", ".join(map(numbers, corners))
        return name, f'{{ kind = "polygon", vertices = [{listed}] }}'
    raise SceneError(f"--body: {text!r} is not NAME=SHAPE with a shape such as {SHAPES}")


def outlines(given: Iterable[str]) -> dict[str, str]:
    """Shapes by name, as TOML, of all ``--body``."""
    shapes: dict[str, str] = {}
    for name, shape in map(outline, given):
        if name in shapes:
            raise SceneError(f"--body: {name!r} is given twice; leave one out")
        shapes[name] = shape
    return shapes


def hinge(text: str, names: Sequence[str]) -> HingeText:
    """A hinge of ``BODY@X,Y`` to the world's origin, or of ``BODY@X,Y=OTHER@X,Y``.

    Examples
    --------
    >>> hinge("arm@0,0.15", ["arm"])
    HingeText(bodies=('arm', 'world'), anchors=((0.0, 0.15), (0.0, 0.0)))
    """
    ends = [*text.split("="), f"{WORLD}@0,0"][:2] if text.count("=") < 2 else []
    bodies, anchors = [], []
    for end in ends:
        name, _, point = end.rpartition("@")
        anchor = _floats(point.split(","))
        if name and len(anchor) == 2:
            bodies.append(name)
            anchors.append((anchor[0], anchor[1]))
    if len(bodies) != 2:
        raise SceneError(
            f"--hinge: {text!r} is not BODY@X,Y, or two of them with = between, such as {HINGE};"
            " points in the body's own frame, m"
        )
    for name in bodies:
        check_named("--hinge", name, [*names, WORLD])
    return HingeText((bodies[0], bodies[1]), (anchors[0], anchors[1]))


def wall(text: str) -> tuple[list[float], list[float]]:
    """Two points of the world (m) from ``X,Y/X,Y``."""
    ends = [_floats(end.split(",")) for end in text.split("/")]
    if [len(end) for end in ends] != [2, 2]:
        raise SceneError(f"--wall: {text!r} is not X,Y/X,Y, two points such as -2,-1/2,-1, in m")
    return ends[0], ends[1]


def bodies(
    shapes: Mapping[str, str],
    names: Sequence[str],
    *,
    wheels: Iterable[str],
    kinematic: Iterable[str],
    known: Iterable[str],
    effects: Iterable[str],
) -> list[BodyText]:
    """The bodies in order, with what the options say of each.

    Parameters
    ----------
    shapes : mapping of str to str
        By name, as TOML.
    names : sequence of str
        Of the bodies, in order.
    wheels, kinematic : iterable of str
        Names.
    known, effects : iterable of str
        ``NAME.PARAMETER=VALUE`` and ``NAME=EFFECT,...``.
    """
    rolling, led = list(wheels), list(kinematic)
    for option, listed in (("--wheel", rolling), ("--kinematic", led)):
        for name in listed:
            check_named(option, name, names)
    values: dict[str, dict[str, float]] = {name: {} for name in names}
    for text in known:
        place, _, number = text.rpartition("=")
        name, _, parameter = place.rpartition(".")
        value = _floats([number])
        if not (name and parameter and value):
            raise SceneError(f"--known: {text!r} is not BODY.PARAMETER=VALUE, such as arm.mass=0.5")
        check_named("--known", name, names)
        values[name][parameter] = value[0]
    declared: dict[str, list[str]] = {name: [] for name in names}
    for text in effects:
        name, _, listing = text.rpartition("=")
        if not (name and all(listing.split(","))):
            raise SceneError(f"--declare: {text!r} is not BODY=EFFECT, such as arm=inertia_scale")
        check_named("--declare", name, names)
        declared[name] += listing.split(",")
    return [
        BodyText(
            name, shapes[name], name in rolling, name in led, values[name], tuple(declared[name])
        )
        for name in names
    ]


def check_named(option: str, name: str, known: Sequence[str]) -> None:
    """Refuse a name that no body has."""
    if name not in known:
        raise SceneError(
            f"{option}: there is no body {name!r}, only {', '.join(known)}{nearest(name, known)}"
        )


def _floats(texts: Iterable[str]) -> list[float]:
    """Numbers, or none if one of them is no number."""
    try:
        return [float(text) for text in texts]
    except ValueError:
        return []
