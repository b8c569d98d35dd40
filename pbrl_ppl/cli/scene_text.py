"""Text of a new scene, and its parts from options."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import WORLD, nearest

_HEAD = """\
# What is known before a measurement. SI units: m, kg, s, N, rad.
# What this file does not say is inferred, under the priors of Table 1:
#   mass          log-normal of median 2.7 kg: mu = 1.0, sigma = 1.5, both of the LOGARITHM of kg
#   r             restitution, log-normal of median 0.22: mu = -1.5, sigma = 1.0, of its logarithm
#   mu_c          friction in contacts, normal cut off to [0, 1]: mu = 0.5, sigma = 1.0
#   mu_x, mu_y    friction along and across a wheel's axle: as mu_c
#   w_x, w_y      where the wheel is (m), normal cut off to the body's bounds: mu = 0, sigma = width
#   w_theta       how the wheel is turned (rad), von Mises: mu = 0, kappa = 0 (uniform)

[world]
"""
_TOP = """\
gravity = [0.0, 0.0]       # m/s^2 in the plane: seen from above
normal_gravity = 9.81      # m/s^2, presses bodies on the floor
"""
_SIDE = """\
gravity = [0.0, -9.81]     # m/s^2 in the plane: seen from the side
"""
_CLOCK = """\
time_step = {time_step:<14g} # s between rows of the history
substeps = 10              # engine steps in that time; close-loop takes more where they matter

# [noise]                  # errors of measuring that are known; what is left out is inferred
# x = 0.002                # one standard deviation, m
# theta = 0.01             # rad
"""
_SHAPE = """
[[body]]
name = {name:<20} # as in the history's column "body"
shape = {shape}   # m; boxes, circles and polygons, about the centroid
"""
_WHEEL = """\
wheel = {wheel:<20}# whether it resists motion along one axis more than along the other
"""
_KINEMATIC = """\
kinematic = true           # follows its recorded path whatever it meets, as a robot's finger does
"""
_KNOWN = """\
known = {known}   # SI units: given, not inferred
"""
_NOT_KNOWN = """\
# known = { mass = 6.0 }                          # kg: given, not inferred
"""
_PRIOR = """\
# prior = { mass = { mu = 1.8, sigma = 0.5 } }    # exp(1.8) = 6 kg, within a factor of 1.6
"""
_EFFECTS = """\
effects = {effects}   # declared from the start; close-loop finds others
"""
_NO_EFFECTS = """\
# effects = ["linear_drag"]                       # declared; close-loop finds others
"""
_WALL = """
[[wall]]                   # an edge that bodies hit
from = {start}
to = {end}   # m
"""
_NO_WALL = """
# [[wall]]                 # an edge that bodies hit
# from = [-2.0, -1.0]      # m
# to = [2.0, -1.0]
"""
_HINGE = """
[[joint]]
kind = "hinge"             # or "distance", a rod
bodies = [{a}, {b}]
anchor_a = {anchor_a:<15} # {in_a}, m
anchor_b = {anchor_b:<15} # {in_b}, m
"""
_NO_JOINT = """
# [[joint]]
# kind = "hinge"           # or "distance", a rod
# bodies = [{name}, "world"]
# anchor_a = [0.0, 0.1]    # in the body's frame, m
# anchor_b = [0.0, 0.0]    # in the world, m
"""


@dataclass(frozen=True)
class BodyText:
    """A body of a new scene.

    Parameters
    ----------
    name, shape : str
        The shape as TOML.
    wheel, kinematic : bool
        Whether it has a wheel; whether it follows its recorded path.
    known : mapping of str to float
        Parameters that are given (SI units).
    effects : tuple of str
        Declared from the start.
    """

    name: str
    shape: str
    wheel: bool = False
    kinematic: bool = False
    known: Mapping[str, float] = field(default_factory=dict)
    effects: tuple[str, ...] = ()


@dataclass(frozen=True)
class HingeText:
    """A hinge of two bodies, or of one and ``"world"``, and where it holds each (m)."""

    bodies: tuple[str, str]
    anchors: tuple[tuple[float, float], tuple[float, float]]


def scene_text(
    bodies: Iterable[BodyText],
    *,
    side: bool,
    time_step: float,
    hinges: Iterable[HingeText] = (),
    walls: Iterable[tuple[Sequence[float], Sequence[float]]] = (),
) -> str:
    """Return a commented scene as TOML.

    Parameters
    ----------
    bodies : iterable of BodyText
        At least one.
    side : bool
        Whether it is seen from the side.
    time_step : float
        Between rows of the history (s).
    hinges : iterable of HingeText
        All joints; without one, a comment says how to declare one.
    walls : iterable of tuple
        Both ends of each (m); as with hinges.

    Examples
    --------
    >>> cart = BodyText("cart", '{ kind = "box", size = [0.9, 0.55] }', True)
    >>> from pbrl_ppl.scene import Scene
    >>> Scene.from_toml(scene_text([cart], side=False, time_step=0.1)).moving[0].wheel
    True
    """
    names = []
    parts = [_HEAD, _SIDE if side else _TOP, _CLOCK.format(time_step=time_step)]
    for body in bodies:
        names.append(_quoted(body.name))
        parts.append(_body(body))
    edges = [_WALL.format(start=numbers(start), end=numbers(end)) for start, end in walls]
    joints = [_hinge(each) for each in hinges]
    parts += [*(edges or [_NO_WALL]), *(joints or [_NO_JOINT.format(name=names[0])])]
    return "".join(parts)


def numbers(values: Sequence[float]) -> str:
    """Return numbers as TOML."""
    return f"[{', '.join(map(repr, values))}]"


def _body(body: BodyText) -> str:
    parts = [_SHAPE.format(name=_quoted(body.name), shape=body.shape)]
    parts.append(_KINEMATIC if body.kinematic else _WHEEL.format(wheel=str(body.wheel).lower()))
    if body.known:
        known = ", ".join(f"{_key(name)} = {value!r}" for name, value in body.known.items())
        parts.append(_KNOWN.format(known=f"{{ {known} }}"))
    elif not body.kinematic:
        parts.append(_NOT_KNOWN)
    if not body.kinematic:
        parts.append(_PRIOR)
    if body.effects:
        listed = ", ".join(map(_quoted, body.effects))
        parts.append(_EFFECTS.format(effects=f"[{listed}]"))
    elif not body.kinematic:
        parts.append(_NO_EFFECTS)
    return "".join(parts)


def _hinge(hinge: HingeText) -> str:
    frames = ["in the world" if name == "world" else f"in {name}'s frame" for name in hinge.bodies]
    (a, b), (anchor_a, anchor_b) = map(_quoted, hinge.bodies), map(numbers, hinge.anchors)
    return _HINGE.format(
        a=a, b=b, anchor_a=anchor_a, anchor_b=anchor_b, in_a=frames[0], in_b=frames[1]
    )


def _quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _key(name: str) -> str:
    return name if name.isidentifier() and name.isascii() else _quoted(name)


SHAPES = "box:0.9x0.55, circle:0.1 or polygon:0,2/-1,-1/1,-1, in m"
HINGE = "arm@0,0.15 (to the world) or upper@0,-0.1=lower@0,0.15"


def outline(text: str) -> tuple[str, str]:
    """Return the name and the shape, as TOML, from ``NAME=box:LENGTHxWIDTH`` and the like.

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
    """Return shapes by name, as TOML, from all ``--body``."""
    shapes: dict[str, str] = {}
    for name, shape in map(outline, given):
        if name in shapes:
            raise SceneError(f"--body: {name!r} is given twice; leave one out")
        shapes[name] = shape
    return shapes


def hinge(text: str, names: Sequence[str]) -> HingeText:
    """Return a hinge from ``BODY@X,Y`` (to the world's origin) or ``BODY@X,Y=OTHER@X,Y``.

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
    """Return two points of the world (m) from ``X,Y/X,Y``."""
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
    """Return the bodies in order, with the options of each.

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
    wheeled, led = list(wheels), list(kinematic)
    for option, listed in (("--wheel", wheeled), ("--kinematic", led)):
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
            name, shapes[name], name in wheeled, name in led, values[name], tuple(declared[name])
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
    """Return numbers; none if one of the texts is no number."""
    try:
        return [float(text) for text in texts]
    except ValueError:
        return []
