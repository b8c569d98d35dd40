"""Joints of a scene, and the table of their kinds."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.checks import Named, Point

#: The name of the ground in a joint.
WORLD = "world"


@dataclass(frozen=True)
class JointKind:
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
JOINT_KINDS: Mapping[str, JointKind] = {
    "hinge": JointKind(pins_anchors=True),
    "slider": JointKind(slides=True),
    "distance": JointKind(needs_reference_poses=True, stops_bodies=True),
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
        kinds = " or ".join(f'"{kind}"' for kind in JOINT_KINDS)
        checks.choice(self.kind, "joint: kind", JOINT_KINDS, kinds)
        checks.settle(self, "joint", name=checks.label, known=checks.flag)
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
    def traits(self) -> JointKind:
        """What its kind implies."""
        return JOINT_KINDS[self.kind]


def _two_names(value: object, where: str) -> tuple[str, ...]:
    """Return the names of a joint's bodies."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise SceneError(f"{where} is {value!r}, expected two names")
    bodies = tuple(checks.label(name, where) for name in value)
    if len(bodies) != 2:
        raise SceneError(f"{where} is {list(bodies)}, expected two names")
    if bodies[0] == bodies[1]:
        raise SceneError(f'joint: it joins "{bodies[0]}" with itself; name two bodies')
    return bodies
