"""Actuators of a scene: what the columns of commands mean."""

from collections.abc import Mapping
from dataclasses import dataclass

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import checks
from pbrl_ppl.scene.checks import Named, Point
from pbrl_ppl.state import WRENCH

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
    known: Named = ()
    prior: tuple[tuple[str, Named], ...] = ()

    def __post_init__(self) -> None:
        checks.label(self.name, "actuator: name")
        where = f'actuator "{self.name}"'
        if not self.name.isidentifier():
            raise SceneError(f"{where}: the name is part of parameters' names; use letters and _")
        checks.choice(self.kind, f"{where}: kind", NUMBERS, ", ".join(NUMBERS))
        checks.settle(self, where, at=checks.vector)
        choices = {"servo": ("angle", "speed"), "wrench": WRENCH}.get(self.kind, ("",))
        object.__setattr__(self, "of", self.of or choices[0])
        checks.choice(self.of, f"{where}: of", choices, " or ".join(choices))
        checks.choice(self.frame, f"{where}: frame", ("body", "world"), "body or world")
        allowed = dict.fromkeys(NUMBERS[self.kind], checks.finite)
        if "limit" in allowed:
            allowed["limit"] = checks.not_negative
        electric = dict.fromkeys(_ELECTRIC if self.kind == "motor" else (), checks.positive)
        checks.settle_table(self, where, "known", allowed | electric, "number")
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
        where = f'actuator "{actuator.name}"'
        if actuator.body not in bodies:
            raise SceneError(
                f'{where}: "{actuator.body}" is no body that moves freely'
                f"{checks.nearest(actuator.body, bodies)}"
            )
        mine = [other.name for other in actuators if other.body == actuator.body]
        if len(mine) > len(WRENCH):
            raise SceneError(
                f'body "{actuator.body}" has {len(mine)} actuators ({", ".join(mine)}), expected at'
                f" most {len(WRENCH)}; add up the columns of those that act alike"
            )
