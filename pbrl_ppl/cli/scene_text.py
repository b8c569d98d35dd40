"""Text of a new scene, and its parts from options."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import WORLD, Recording, nearest
from pbrl_ppl.scene import toml as scene_toml

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
normal_gravity = {gravity!r:<9} # m/s^2, presses bodies on the floor
"""
_SIDE = """\
gravity = [0.0, -{gravity!r}]     # m/s^2 in the plane: seen from the side
"""
_CLOCK = """\
time_step = {time_step:<14g} # s between rows of the history
substeps = 10              # engine steps in that time; close-loop takes more where they matter

# [noise]                  # errors of measuring that are known; what is left out is inferred
# x = 0.002                # one standard deviation, m
# theta = 0.01             # rad
"""
_RECORDING = """\
[recording]                # how the files are laid out; forces that they lack are zero"""
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


def scene_text(
    bodies: Mapping[str, str],
    *,
    side: bool,
    time_step: float,
    hinges: Sequence[str] = (),
    walls: Sequence[str] = (),
    gravity: float = 9.81,
    recording: Recording | None = None,
    said: Sequence[str] = (),
) -> str:
    """Return a commented scene as TOML.

    Parameters
    ----------
    bodies : mapping of str to str
        Text of each by name, as of :func:`body_texts`; at least one.
    side : bool
        Whether it is seen from the side.
    time_step : float
        Between rows of the history (s).
    hinges, walls : sequence of str
        Text of each; without one, a comment says how to declare one.
    gravity : float
        Size of the acceleration (m/s^2).
    recording : Recording, optional
        How the recording is laid out.
    said : sequence of str
        What was seen in it, as comments.
    """
    layout = ""
    if recording is not None:
        lines = "".join(f"# {sentence}\n" for sentence in said)
        layout = "\n".join(["", _RECORDING, scene_toml.write([("", recording.table())]).strip()])
        layout += f"\n{lines}"
    seen = (_SIDE if side else _TOP).format(gravity=gravity)
    parts = [_HEAD, seen, _CLOCK.format(time_step=time_step), layout]
    parts += bodies.values()
    no_joint = _NO_JOINT.format(name=_quoted(next(iter(bodies))))
    return "".join([*parts, *(walls or [_NO_WALL]), *(hinges or [no_joint])])


def _numbers(values: Sequence[float]) -> str:
    """Return numbers as TOML."""
    return f"[{', '.join(map(repr, values))}]"


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
        return name, f'{{ kind = "box", size = {_numbers(sizes)} }}'
    if name and kind == "circle" and len(sizes) == 1:
        return name, f'{{ kind = "circle", radius = {sizes[0]!r} }}'
    if name and kind == "polygon" and all(len(corner) == 2 for corner in corners):
        listed = ", ".join(map(_numbers, corners))
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


def hinge(text: str, names: Sequence[str]) -> str:
    """Return a hinge as TOML from ``BODY@X,Y`` (to the world's origin) or ``BODY@X,Y=OTHER@X,Y``.

    Examples
    --------
    >>> print(hinge("arm@0,0.15", ["arm"]))
    <BLANKLINE>
    [[joint]]
    kind = "hinge"             # or "distance", a rod
    bodies = ["arm", "world"]
    anchor_a = [0.0, 0.15]     # in arm's frame, m
    anchor_b = [0.0, 0.0]      # in the world, m
    <BLANKLINE>
    """
    ends = [*text.split("="), f"{WORLD}@0,0"][:2] if text.count("=") < 2 else []
    joined, anchors = [], []
    for end in ends:
        name, _, point = end.rpartition("@")
        anchor = _floats(point.split(","))
        if name and len(anchor) == 2:
            joined.append(name)
            anchors.append(_numbers(anchor))
    if len(joined) != 2:
        raise SceneError(
            f"--hinge: {text!r} is not BODY@X,Y, or two of them with = between, such as {HINGE};"
            " points in the body's frame, m"
        )
    for name in joined:
        _check_named("--hinge", name, [*names, WORLD])
    a, b = map(_quoted, joined)
    in_a, in_b = ("in the world" if name == WORLD else f"in {name}'s frame" for name in joined)
    return _HINGE.format(a=a, b=b, anchor_a=anchors[0], anchor_b=anchors[1], in_a=in_a, in_b=in_b)


def wall(text: str) -> str:
    """Return a wall as TOML from ``X,Y/X,Y``, two points of the world (m)."""
    ends = [_floats(end.split(",")) for end in text.split("/")]
    if [len(end) for end in ends] != [2, 2]:
        raise SceneError(f"--wall: {text!r} is not X,Y/X,Y, two points such as -2,-1/2,-1, in m")
    return _WALL.format(start=_numbers(ends[0]), end=_numbers(ends[1]))


def body_texts(
    shapes: Mapping[str, str],
    names: Sequence[str],
    *,
    wheels: Sequence[str],
    kinematic: Sequence[str],
    known: Iterable[str],
    effects: Iterable[str],
) -> dict[str, str]:
    """Return the bodies as TOML by name, in order, with the options of each.

    Parameters
    ----------
    shapes : mapping of str to str
        By name, as TOML.
    names : sequence of str
        Of the bodies, in order.
    wheels, kinematic : sequence of str
        Names of the bodies that have a wheel, and of those that follow their recorded path.
    known, effects : iterable of str
        ``NAME.PARAMETER=VALUE`` (SI units) and ``NAME=EFFECT,...``.

    Examples
    --------
    >>> from pbrl_ppl.scene import Scene
    >>> shapes = dict([outline("cart=box:0.9x0.55")])
    >>> cart = body_texts(shapes, ["cart"], wheels=["cart"], kinematic=(), known=(), effects=())
    >>> Scene.from_toml(scene_text(cart, side=False, time_step=0.1)).moving[0].wheel
    True
    """
    for option, given in (("--wheel", wheels), ("--kinematic", kinematic)):
        for name in given:
            _check_named(option, name, names)
    values: dict[str, dict[str, float]] = {name: {} for name in names}
    for text in known:
        place, _, number = text.rpartition("=")
        name, _, parameter = place.rpartition(".")
        value = _floats([number])
        if not (name and parameter and value):
            raise SceneError(f"--known: {text!r} is not BODY.PARAMETER=VALUE, such as arm.mass=0.5")
        _check_named("--known", name, names)
        values[name][parameter] = value[0]
    declared: dict[str, list[str]] = {name: [] for name in names}
    for text in effects:
        name, _, listing = text.rpartition("=")
        if not (name and all(listing.split(","))):
            raise SceneError(f"--declare: {text!r} is not BODY=EFFECT, such as arm=inertia_scale")
        _check_named("--declare", name, names)
        declared[name] += map(_quoted, listing.split(","))
    texts = {}
    for name in names:
        path = name in kinematic
        parts = [
            _SHAPE.format(name=_quoted(name), shape=shapes[name]),
            _KINEMATIC if path else _WHEEL.format(wheel=str(name in wheels).lower()),
            "" if path else _NOT_KNOWN,
            "" if path else _PRIOR,
            "" if path else _NO_EFFECTS,
        ]
        if values[name]:
            listed = ", ".join(f"{_key(key)} = {value!r}" for key, value in values[name].items())
            parts[2] = _KNOWN.format(known=f"{{ {listed} }}")
        if declared[name]:
            parts[4] = _EFFECTS.format(effects=f"[{', '.join(declared[name])}]")
        texts[name] = "".join(parts)
    return texts


def _check_named(option: str, name: str, known: Sequence[str]) -> None:
    """Raise if no body has this name."""
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
