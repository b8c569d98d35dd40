"""Joints and actuators of a scene, and the tables of their kinds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.checks import Named, Point
from pbrl_ppl.state import WRENCH

#: The name of the ground in a joint.
WORLD = "world"


@dataclass(frozen=True)
class JointTraits:
    """What the rest of the package needs to know of a kind of joint.

    Attributes
    ----------
    pins_anchors : bool
        Whether the anchors coincide, so that positions follow from angles and anchors.
    slides : bool
        Whether one body slides along an axis of the other and does not turn against it.
    needs_reference_poses : bool
        Whether it keeps what the anchors' distance is in the bodies' reference poses.
    stops_bodies : bool
        Whether it explains an abrupt stop of a body at the end of a recording.
    """

    pins_anchors: bool = False
    slides: bool = False
    needs_reference_poses: bool = False
    stops_bodies: bool = False

    @property
    def hangs(self) -> bool:
        """Whether one body hangs in it with one coordinate, in which friction may act."""
        return self.pins_anchors or self.slides


#: The kinds of joints by name. A new kind needs an entry here and one in `pbrl_ppl.physics`.
JOINT_KINDS: Mapping[str, JointTraits] = {
    "hinge": JointTraits(pins_anchors=True),
    "slider": JointTraits(slides=True),
    "distance": JointTraits(needs_reference_poses=True, stops_bodies=True),
}


@dataclass(frozen=True)
class Joint:
    """Joint between two bodies, or a body and the world (J_d); omitted fields are inferred.

    Attributes
    ----------
    kind : str
        ``"distance"``, which keeps the distance that the anchors have in the bodies' reference
        poses (zero is a hinge), ``"hinge"``, or ``"slider"``: the first body slides along the line
        through the second's anchor, and keeps the angle against it that their reference poses have
        (`Body.pose`; 0 without one). Friction in a hinge or slider is an effect.
    bodies : tuple of str, optional
        Two names; ``"world"`` is the ground. None to infer which bodies it joins (the indices
        ``i_a`` and ``i_b`` of Table 1).
    anchor_a, anchor_b : tuple of float, optional
        Where it holds the first and the second, each in that body's frame (m). Of a joint that is
        not known these are the centres of the anchors' priors, or None for the default.
    known : bool
        Whether the anchors are given (True) or to be inferred.
    name : str, optional
        Label of its parameters; by default its place in the scene: ``joint1``, ...
    prior : tuple of (str, tuple of (str, float))
        Of a joint of unknown bodies: probabilities of the indices by name, such as
        ``{"i_a": {"cart": 0.7, "world": 0.3}}``, scaled to add up to one; a mapping of mappings is
        accepted. Names left out have none; all are equally probable for an index left out.
    axis : tuple of float, optional
        Direction of a slider in the second body's frame (the world's own), of any length.

    Raises
    ------
    SceneError
        If a kind, name or number is impossible, or a known joint lacks one.

    Examples
    --------
    >>> Joint("hinge", known=False).bodies is None  # the bodies and anchors are to be inferred
    True
    """

    kind: str
    bodies: tuple[str, str] | None = None
    anchor_a: Point | None = None
    anchor_b: Point | None = None
    known: bool = True
    name: str | None = None
    prior: tuple[tuple[str, Named], ...] = ()
    axis: Point | None = None

    def __post_init__(self) -> None:
        checks.settle(self, "joint", kind=checks.choice(JOINT_KINDS), name=checks.label)
        checks.settle(self, "joint", known=checks.flag)
        if self.known and None in (self.bodies, self.anchor_a, self.anchor_b):
            raise SceneError(
                "joint: it lacks bodies, anchor_a or anchor_b; add them, or set known = false to"
                " infer what is left out"
            )
        checks.settle(self, "joint", bodies=_two_names)
        where = f"joint of {' and '.join(self.bodies)}" if self.bodies else "joint"
        allowed = dict.fromkeys(("i_a", "i_b"), checks.index_probabilities)
        checks.settle_table(self, where, "prior", allowed, "index")
        if self.prior and self.bodies is not None:
            raise SceneError(f"{where}: it has bodies and a prior of them; drop one of the two")
        for key in ("anchor_a", "anchor_b"):
            if getattr(self, key) is not None and self.bodies is None:
                raise SceneError(
                    f"{where}: it has {key} and no bodies; in which body's frame is the anchor? Add"
                    f" bodies, or drop {key}"
                )
        checks.settle(self, where, anchor_a=checks.vector, anchor_b=checks.vector)
        if self.axis is not None or self.traits.slides:
            self._check_axis(where)

    def _check_axis(self, where: str) -> None:
        """Refuse a slider without a direction or bodies, and an axis of another joint."""
        if not self.traits.slides:
            raise SceneError(
                f"{where}: it is a {self.kind} and has an axis, which only a slider has; drop axis,"
                ' or set kind = "slider"'
            )
        if self.bodies is None:
            raise SceneError(f"{where}: it is a slider without bodies; name the two that it joins")
        if self.axis is None:
            raise SceneError(
                f"{where}: it is a slider without an axis; add axis = [x, y], a direction in the"
                f" frame of {self.bodies[1]}"
            )
        checks.settle(self, where, axis=checks.vector)
        if not math.hypot(*self.axis) > 0:
            raise SceneError(
                f"{where}: axis is {list(self.axis)}, expected a direction; give two numbers that"
                " are not both 0"
            )

    @property
    def traits(self) -> JointTraits:
        """What its kind implies."""
        return JOINT_KINDS[self.kind]


def _two_names(value: object, where: str) -> tuple[str, ...]:
    """Return the names of a joint's bodies."""
    bodies = checks.each(checks.label, "two names")(value, where)
    if len(bodies) != 2:
        raise SceneError(f"{where} is {list(bodies)}, expected two names")
    if bodies[0] == bodies[1]:
        raise SceneError(f'joint: it joins "{bodies[0]}" with itself; name two bodies')
    return bodies


#: What each kind takes: a number's unit, and its value where it is left out (None: inferred).
NUMBERS: Mapping[str, Mapping[str, tuple[str, float | None]]] = {
    "thruster": {"gain": ("N", None), "loss": ("N s/m", 0.0), "direction": ("rad", 0.0)},
    "motor": {"gain": ("N m", None), "loss": ("N m s", 0.0)},
    "servo": {"kp": ("N m/rad", None), "kd": ("N m s", None), "limit": ("N m", 0.0)},
    "wrench": {},
}
#: Data of an electric motor, in place of its gain and loss.
_ELECTRIC = ("torque_constant", "resistance", "supply")


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """What acts on a body for each unit of a column of commands.

    Attributes
    ----------
    name : str
        Its name, and that of its column in the history unless ``column`` says otherwise.
    kind : str
        ``thruster``: a force at a place and in a direction of the body. ``motor``: a torque, which
        acts back on what the body hangs on. ``servo``: a torque towards a goal. ``wrench``: a force
        or torque as commanded.
    body : str
        The body that it acts on; of a hinge the one that hangs in it.
    column : str, optional
        Its column in the history.
    at : tuple of float
        Place of a thruster in the body's frame (m).
    of : str
        Of a servo what the goal is, ``angle`` or ``speed``; of a wrench its component,
        ``force_x``, ``force_y`` or ``torque``.
    frame : str
        Whether directions are the ``body``'s, and turn with it, or the ``world``'s.
    full : float
        Size of a full command in its column's unit, such as 255 of a PWM register: priors of what
        is inferred for each unit, and of thresholds of the command, are relative to it.
    known : tuple of (str, float)
        Numbers that are given, not inferred: force or torque for each unit of the command
        (``gain``), and what the speed takes off it (``loss``), a thruster's ``direction`` (rad);
        ``kp``, ``kd`` and ``limit`` of a servo (0: none); or ``torque_constant`` (N m/A),
        ``resistance`` (ohm) and ``supply`` (V, 1 if the command is in volts) of a motor. A mapping
        is accepted.
    prior : tuple of (str, tuple of (str, float))
        Hyper-parameters of the priors of numbers that are inferred, such as
        ``{"direction": {"mu": 0.0, "sigma": 0.1}}``; a mapping of mappings is accepted.

    Raises
    ------
    SceneError
        If a name, a number or a combination is impossible.

    Examples
    --------
    >>> fan = Actuator(name="left", kind="thruster", body="puck", at=(0.0, 0.1), known={"gain": 2})
    >>> fan.numbers
    {'gain': 2.0, 'loss': 0.0, 'direction': 0.0}
    """

    name: str
    kind: str
    body: str
    column: str = ""
    at: Point = (0.0, 0.0)
    of: str = ""
    frame: str = "body"
    full: float = 1.0
    known: Named = ()
    prior: tuple[tuple[str, Named], ...] = ()

    def __post_init__(self) -> None:
        checks.label(self.name, "actuator: name")
        where = f'actuator "{self.name}"'
        if not self.name.isidentifier():
            raise SceneError(f"{where}: the name is part of parameters' names; use letters and _")
        checks.settle(self, where, kind=checks.choice(NUMBERS), at=checks.vector)
        choices = {"servo": ("angle", "speed"), "wrench": WRENCH}.get(self.kind, ("",))
        object.__setattr__(self, "of", self.of or choices[0])
        checks.settle(self, where, of=checks.choice(choices), full=checks.positive)
        checks.settle(self, where, frame=checks.choice(("body", "world")))
        allowed: dict[str, checks.Check] = dict.fromkeys(NUMBERS[self.kind], checks.finite)
        if "limit" in allowed:
            allowed["limit"] = checks.not_negative
        if self.kind == "motor":
            allowed |= dict.fromkeys(_ELECTRIC, checks.positive)
        checks.settle_table(self, where, "known", allowed, "number")
        priors = dict.fromkeys(NUMBERS[self.kind], checks.hyper_parameters)
        checks.settle_table(self, where, "prior", priors, "number")
        checks.not_both(self.known, self.prior, where)
        known = dict(self.known)
        given = [name for name in _ELECTRIC if name in known]
        if given and (len(given) < 3 or {"gain", "loss"} & known.keys()):
            raise SceneError(
                f"{where}: known has {', '.join(known)}, expected {', '.join(_ELECTRIC)}, or"
                " gain and loss"
            )

    @property
    def numbers(self) -> dict[str, float | None]:
        """Its numbers by name, SI units for each unit of the command; None for one to infer."""
        known = dict(self.known)
        if "resistance" in known:
            per_volt = known["torque_constant"] / known["resistance"]
            known["gain"] = per_volt * known["supply"]
            known["loss"] = per_volt * known["torque_constant"]
        inferred = dict(self.prior)
        return {
            name: None if name in inferred else known.get(name, value)
            for name, (_, value) in NUMBERS[self.kind].items()
        }


def check_actuators(actuators: tuple[Actuator, ...], bodies: list[str]) -> None:
    """Check the actuators of a scene.

    Parameters
    ----------
    actuators : tuple of Actuator
        All of a scene.
    bodies : list of str
        Its dynamic bodies.

    Raises
    ------
    SceneError
        If a body is unknown or has more than three, or two have one name.
    """
    checks.different([actuator.name for actuator in actuators], "actuators")
    for actuator in actuators:
        where = f'actuator "{actuator.name}": no body that moves freely is called'
        checks.known(actuator.body, bodies, where)
        mine = [other.name for other in actuators if other.body == actuator.body]
        if len(mine) > len(WRENCH):
            raise SceneError(
                f'body "{actuator.body}" has {len(mine)} actuators ({", ".join(mine)}), expected at'
                f" most {len(WRENCH)}; add up the columns of those that act alike"
            )
