"""Physical effects as values: name, parameters with priors and units, and stage of action.

Stages are a closed set of final classes, in the order of application.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import InitVar, dataclass, replace
from typing import Any, NamedTuple, final

import numpy as np

from pbrl_ppl.errors import EffectError
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import PLACES, WORLD, Body, Joint, Scene, Units, check_product, units_of
from pbrl_ppl.state import Floats

#: Values of an effect's parameters by name: arrays that broadcast, one entry per proposal.
Values = Mapping[str, Floats]

#: ``law(state, command, parameters, wrench)``, all arrays of floats: one body's state (6,), its
#: command, the effect's parameters (q,) and then its constants, and the wrench (3,), which it
#: changes in place. It runs inside the compiled substep loop: plain arithmetic and ``math`` only.
Law = Callable[[Floats, Floats, Floats, Floats], None]
#: Where a law finds, in ``command``, the time since the trajectory's start (s), infinite after the
#: recording; the sampling interval (s); and its memory.
TIME, INTERVAL, MEMORY = 9, 10, 12
#: Numbers that a law may remember.
MOST_MEMORY = 24


class Disc(NamedTuple):
    """A static disc; arrays broadcast over proposals. There is none where the radius is zero.

    Attributes
    ----------
    x, y : ndarray
        Its centre (m).
    radius : ndarray
        Its radius (m).
    """

    x: Floats
    y: Floats
    radius: Floats


class Rod(NamedTuple):
    """A rod from a body to a place; arrays broadcast over proposals. None where length is zero.

    Attributes
    ----------
    a_x, a_y : ndarray
        Its end on the body, in the body's frame (m).
    b_x, b_y : ndarray
        Its end in the world (m).
    length : ndarray
        Its length (m).
    """

    a_x: Floats
    a_y: Floats
    b_x: Floats
    b_y: Floats
    length: Floats


def _no_discs(parameters: Values) -> tuple[Disc, ...]:
    return ()


@final
@dataclass(frozen=True)
class Structure:
    """Stage that adds static discs, or a rod from the body to a place, to the scene.

    Parameters
    ----------
    discs : callable
        ``discs(parameters) -> tuple of Disc``, always of one length; all moving bodies collide with
        them.
    rod : callable, optional
        ``rod(parameters) -> Rod``.
    """

    discs: Callable[[Values], tuple[Disc, ...]] = _no_discs
    rod: Callable[[Values], Rod] | None = None


@final
@dataclass(frozen=True)
class Clock:
    """Times of intervals, as arrays of shape (1, interval); infinite after the recording.

    Parameters
    ----------
    trajectory : ndarray
        Number of the trajectory, from 0.
    begin, end : ndarray
        Time within the trajectory at which the interval begins and ends (s).
    """

    trajectory: Floats
    begin: Floats
    end: Floats

    def after(self, time: Floats) -> Floats:
        """Return the share of each interval after a time in its trajectory (s), 0 to 1."""
        known = np.isfinite(self.end)
        begin, end = np.where(known, self.begin, 0.0), np.where(known, self.end, 1.0)
        return np.where(known, np.clip((end - time) / (end - begin), 0.0, 1.0), 1.0)


@final
@dataclass(frozen=True)
class Properties:
    """Stage that changes the engine's properties of a body.

    Parameters
    ----------
    modify : callable
        ``modify(properties, parameters, clock)`` changes a dict of arrays in place. Its keys are
        :data:`pbrl_ppl.physics.world.COLUMNS`, with two exceptions: ``moment_per_mass``, from
        which the moment of inertia is computed afterwards, and ``gravity_x`` and ``gravity_y``
        (m/s^2), the total gravity.
    timed : bool
        Whether the properties depend on the clock; shapes are then (proposal, interval), else
        (proposal, 1).
    """

    modify: Callable[[dict[str, Floats], Values, Clock], None]
    timed: bool = False


def _check_memory(numbers: int) -> None:
    """Refuse more numbers than a law may remember."""
    if not 0 <= numbers <= MOST_MEMORY:
        raise EffectError(f"a law remembers {numbers} numbers, expected 0 to {MOST_MEMORY}")


@dataclass(frozen=True)
class With:
    """A function with one more argument; unlike a partial it is equal in other processes too."""

    function: Callable[..., Any]
    argument: Any

    def __call__(self, *first: Any) -> Any:
        """Return the function's value."""
        return self.function(*first, self.argument)


def _add(
    properties: dict[str, Floats], parameters: Values, clock: Clock, names: Iterable[Sequence[str]]
) -> None:
    for name, parameter in names:
        properties[name] = properties[name] + parameters[parameter]


def adding(**parameters: str) -> Properties:
    """Return the stage that adds parameters to the properties of these names."""
    return Properties(With(_add, tuple(parameters.items())))


@final
@dataclass(frozen=True)
class Command:
    """Stage that changes the commanded wrench of a body before it acts.

    Parameters
    ----------
    law : callable
        See :data:`Law`. ``command`` has the wrench of this interval as earlier effects changed it,
        the wrench of the previous interval (zero before the first), the shares of the interval that
        have passed when the substep begins and ends (6, 7), and :data:`TIME`, :data:`INTERVAL` and
        :data:`MEMORY`. ``wrench`` (3,), that of this interval, is to be changed.
    memory : int
        How many past wrenches the law needs, or numbers of its own in threes, such as the wrench
        that an actuator has reached: it acts before laws that need none. They begin as if the
        previous wrench had lasted.
    remember : callable, optional
        ``remember(state, command, parameters, memory)`` changes them at the end of an interval.
        Without it, the memory is the previous wrench alone.
    alone : str
        ``force_x``, ``force_y`` or ``torque`` for a law of one number: it is the first of each
        three, and the others are zero.
    reacts : bool
        Whether the torque acts back on what the body hangs on, and the law sees angle and speed
        relative to it.
    acts : bool
        Whether the law changes the wrench; otherwise it changes how an actuator acts.
    begins : bool
        Whether the last parameter is the share of the first command that a memory begins with where
        a recording begins, 0 to 1: an actuator may have been at work before.
    timed : bool
        Whether the law depends on the time.
    jumps : bool
        Whether the wrench jumps within an interval, as a late one does: at the fractional part of
        the first parameter, as a share of it.

    Raises
    ------
    EffectError
        If the memory is too large.

    Examples
    --------
    A valve that opens by a step in an interval at most, and what it remembers of 5 N:

    >>> def valve(state, command, parameters, wrench):
    ...     step = parameters[0] * command[7]
    ...     wrench[0] = command[12] + min(max(command[0] - command[12], -step), step)
    >>> def remember(state, command, parameters, memory):
    ...     memory[0] += min(max(command[0] - memory[0], -parameters[0]), parameters[0])
    >>> stage = Command(valve, memory=1, remember=remember)
    >>> reached = np.zeros(3)
    >>> for _ in range(3):
    ...     stage.remember(np.zeros(6), np.array([5.0]), np.array([2.0]), reached)
    ...     print(reached[0])
    2.0
    4.0
    5.0
    """

    law: Law
    memory: int = 0
    remember: Law | None = None
    alone: str = ""
    begins: bool = False
    reacts: bool = False
    acts: bool = True
    timed: bool = False
    jumps: bool = False

    @property
    def rank(self) -> int:
        """Where the law is among others: those with most memory first, then of single numbers."""
        return -2 * self.memory - bool(self.alone or not self.acts)

    def __post_init__(self) -> None:
        """Check the memory."""
        _check_memory(3 * self.memory)


@final
@dataclass(frozen=True)
class Force:
    """Stage that adds to the wrench on a body.

    Parameters
    ----------
    law : callable
        See :data:`Law`. ``command`` (3,) is the wrench after the command stage, followed by
        :data:`TIME`, :data:`INTERVAL` and :data:`MEMORY`; ``wrench`` is the sum so far.
    timed : bool
        Whether the law depends on the time.
    memory : int
        How many numbers of its own the law has, such as how far a bearing bends.
    rate : callable, optional
        ``rate(state, command, parameters, change)`` sets their rates of change (1/s).
    begin : callable, optional
        ``begin(state, command, parameters, memory)`` sets them where a transition begins; zero
        without it.

    Raises
    ------
    EffectError
        If the memory is too large.
    """

    law: Law
    timed: bool = False
    memory: int = 0
    rate: Law | None = None
    begin: Law | None = None

    def __post_init__(self) -> None:
        """Check the memory."""
        _check_memory(self.memory)


@final
@dataclass(frozen=True)
class Friction:
    """Stage that changes the greatest force of dry friction: in a body's hinge, or under it.

    Parameters
    ----------
    law : callable
        See :data:`Law`. ``command`` has the torque that is commanded, the torque of all else about
        the hinge (N m; both zero under a body), and the speed of sliding (rad/s, or m/s).
        ``wrench`` (1,) is the greatest torque or force so far.
    under : bool
        Whether it is the friction under the body.
    """

    law: Law
    under: bool = False


@final
@dataclass(frozen=True)
class Sensor:
    """Stage that changes the measurement of a body's state.

    Parameters
    ----------
    measure : callable
        ``measure(state, parameters) -> measured``, both of shape (..., 6); parameters broadcast
        over the leading axes.
    invert : callable
        ``invert(measured, parameters) -> state``, its inverse.
    timed : bool
        Whether ``time`` is among the parameters: that since the trajectory's start (s), infinite
        after the recording.
    """

    measure: Callable[[Floats, Values], Floats]
    invert: Callable[[Floats, Values], Floats]
    timed: bool = False


@final
@dataclass(frozen=True)
class Noise:
    """Stage that changes the density of the whitened noise of a body's measured states.

    Parameters
    ----------
    tail : callable
        ``tail(parameters) -> ndarray``: the reciprocal of a Student-t's degrees of freedom; zero
        is a Gaussian.
    """

    tail: Callable[[Values], Floats]


Stage = Structure | Properties | Command | Force | Friction | Sensor | Noise
STAGES: tuple[type, ...] = (Structure, Properties, Command, Force, Friction, Sensor, Noise)

#: ``scan(scene, history, body) -> (point, q)``: grid of parameter values at which an effect is
#: tried if its derivative at the null vanishes. The derivative is taken by parameters that are
#: NaN, at their null value.
Scan = Callable[[Scene, History, Body], Floats]


#: Priors of what is positive, or has a sign, in natural units: an effect of this size is of the
#: order of what else acts on the body. And of an angle that may be any.
SIZE, SIGNED = Prior("half_normal", sigma=1.0), Prior("normal", sigma=1.0)
ANY_ANGLE = Prior("von_mises", mu=0.0, kappa=0.0)


def always(scene: Scene, body: Body) -> bool:
    """Return that an effect applies to a body."""
    return True


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Parameters
    ----------
    name : str
        Its name within the effect.
    unit : str
        SI unit.
    prior : Prior
        Its prior once the effect is in the model.
    null : float
        The value at which the effect vanishes.
    scale : str
        Product of natural units of the body, names of :class:`pbrl_ppl.scene.Units`, in which the
        prior and the null value are numbers, such as ``force/speed``: the effect then suits a rig
        of any size. SI units without it.
    origin : str
        ``x`` or ``y``: for places, which are counted from the body's mean position.
    hinged : bool
        Whether a body on a hinge has it: what is measured of it is its angle.
    given : bool
        Whether it is known, and has its null value.

    Raises
    ------
    SceneError
        If the scale names an unknown unit.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape, units_of
    >>> puck = Body("puck", Shape.circle(0.5), typical={"force": 6.0, "speed": 2.0})
    >>> units = units_of(Scene(time_step=0.1, bodies=(puck,)), "puck")
    >>> prior = Prior("half_normal", sigma=1.0)
    >>> EffectParameter("coefficient", "kg/s", prior, scale="force/speed").in_si(units).prior.sigma
    3.0
    """

    name: str
    unit: str
    prior: Prior
    null: float = 0.0
    scale: str = ""
    origin: str = ""
    hinged: bool = True
    given: bool = False

    @classmethod
    def each(cls, *names: str, unit: str, prior: Prior, **same: Any) -> tuple[EffectParameter, ...]:
        """Return parameters that differ in their names alone."""
        return tuple(cls(name, unit, prior, **same) for name in names)

    def __post_init__(self) -> None:
        """Check the scale."""
        check_product(self.scale)
        if self.origin not in ("", *PLACES):
            raise EffectError(
                f"parameter {self.name}: origin is {self.origin!r}, expected {' or '.join(PLACES)}"
            )

    def in_si(self, units: Units) -> EffectParameter:
        """Return the parameter with its prior and null value in SI units."""
        if not self.scale:
            return self
        factor, origin = units.of(self.scale), getattr(units, self.origin) if self.origin else 0.0
        return replace(
            self,
            prior=self.prior.scaled(factor, origin),
            null=origin + factor * self.null,
            scale="",
            origin="",
        )


@dataclass(frozen=True)
class Effect:
    """A physical effect that a model may declare or lack.

    Parameters
    ----------
    name : str
        Its name in the catalogue, in scene files and in reports.
    parameters : tuple of EffectParameter
        Its parameters.
    sentence : str
        What it means, for a reader who knows no statistics.
    reference : str
        Source of the law.
    stage : Structure, Properties, Command, Force, Sensor or Noise
        What it changes. Effects of an earlier stage act first,
        whatever their order.
    applies : callable
        ``applies(scene, body) -> bool``.
    scan : callable, optional
        Grid of parameters to try if the derivative at the null vanishes; see :data:`Scan`.
    constants : tuple of str
        Products of natural units of the body, as for a parameter's scale: the law finds their SI
        values after its parameters, so that a shape that is no power of a unit suits a rig of any
        size.
    family : str
        Name of laws of which one may be taken for another, such as a lag and a delay: where one is
        found the others are tried in its place.
    log_odds : float
        Logarithm of the prior odds that a rig has this effect, beside common ones such as drag,
        friction or a constant force (nats, at most 0): part of the price of a law in a search.
    unusual : str
        Why few rigs have this effect, in a sentence; empty for a common one. A search tries unusual
        effects last, and adds them only where they explain what common ones leave.
    needs : tuple of str
        What a recording must have for it, besides commands for a law of the command: ``commands``;
        ``places`` that repeat; a ``camera``; a body that is ``free`` to move, in no hinge under
        gravity; or measurements of a dimension, such as ``theta``.
    force : callable, optional
        Short for ``stage=Force(force)``.

    Raises
    ------
    EffectError
        If it has no name or no stage, no parameters (which an effect of the command may lack),
        positive log odds, or a null value outside its prior's support.

    Examples
    --------
    >>> from pbrl_ppl.parameters import Prior
    >>> def law(state, command, parameters, wrench):
    ...     wrench[0] -= parameters[0] * state[3] ** 3
    >>> cubic_drag = Effect(
    ...     "cubic_drag_x",
    ...     (EffectParameter("coefficient", "N s^3/m^3", Prior("half_normal", sigma=10.0)),),
    ...     "a force against the motion along x that grows with the cube of the speed",
    ...     "an example",
    ...     Force(law),
    ... )
    >>> cubic_drag.on("cart").body
    'cart'
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    sentence: str
    reference: str
    stage: Stage = None  # type: ignore[assignment]  # never None once made
    applies: Callable[[Scene, Body], bool] = always
    scan: Scan | None = None
    constants: tuple[str | float, ...] = ()
    family: str = ""
    log_odds: float = 0.0
    unusual: str = ""
    needs: tuple[str, ...] = ()
    force: InitVar[Law | None] = None

    def __post_init__(self, force: Law | None) -> None:
        """Check the fields."""
        if not self.name.isidentifier():
            raise EffectError(f"effect name {self.name!r} is not an identifier; use letters and _")
        for constant in self.constants:
            if isinstance(constant, str) and constant not in PLACES:
                check_product(constant)
        if not self.parameters and not isinstance(self.stage, Command):
            raise EffectError(f"effect {self.name} has no parameters; give it at least one")
        if force is not None and self.stage is None:
            object.__setattr__(self, "stage", Force(force))
        elif force is not None or not isinstance(self.stage, STAGES):
            names = ", ".join(stage.__name__ for stage in STAGES)
            raise EffectError(
                f"effect {self.name}: stage is {self.stage!r}, expected one of {names}, or a law"
                " as force="
            )
        if not self.log_odds <= 0.0:
            raise EffectError(
                f"effect {self.name}: log_odds is {self.log_odds}, expected 0 or less; 0 is as"
                " common as drag"
            )
        for parameter in self.parameters:
            lower, upper = parameter.prior.support
            if not lower <= parameter.null <= upper:
                raise EffectError(
                    f"effect {self.name}: the null value {parameter.null} of {parameter.name} is"
                    f" outside its prior's support [{lower}, {upper}]"
                )

    def on(self, body: str) -> Attached:
        """Return the effect attached to the body of this name."""
        return Attached(self, body)

    def over(self, scene: Scene) -> tuple[Attached, ...]:
        """Return the effect on every dynamic body that it applies to.

        Raises
        ------
        EffectError
            If there is none.
        """
        on = tuple(self.on(body.name) for body in scene.dynamic if self.applies(scene, body))
        if not on:
            raise EffectError(f"effect {self.name} applies to no body of this scene")
        return on

    def in_si(self, units: Units) -> Effect:
        """Return the effect with its priors and null values in SI units."""
        parameters = tuple(parameter.in_si(units) for parameter in self.parameters)
        constants = tuple(
            getattr(units, c) if c in PLACES else units.of(c) if isinstance(c, str) else c
            for c in self.constants
        )
        if (parameters, constants) == (self.parameters, self.constants):
            return self
        return replace(self, parameters=parameters, constants=constants)

    @property
    def null(self) -> tuple[float, ...]:
        """Values of the parameters at which the effect vanishes."""
        return tuple(parameter.null for parameter in self.parameters)

    def variable(self, parameter: EffectParameter) -> str:
        """Return the name of a parameter's random variable in a model."""
        return f"{self.name}_{parameter.name}"


@dataclass(frozen=True)
class Attached:
    """An effect on one body."""

    effect: Effect
    body: str

    def over(self, scene: Scene) -> tuple[Attached, ...]:
        """Return itself, which is on one body; see :meth:`Effect.over`."""
        return (self,)

    def in_si(self, scene: Scene) -> Attached:
        """Return the same with what the body has of it in SI units; see :func:`units_of`."""
        effect = self.effect
        if not all(p.hinged for p in effect.parameters) and is_pivoted(
            scene, scene.body(self.body)
        ):
            effect = replace(effect, parameters=tuple(p for p in effect.parameters if p.hinged))
        return Attached(effect.in_si(units_of(scene, self.body)), self.body)

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the random variables of its parameters in a model."""
        free = (parameter for parameter in self.effect.parameters if not parameter.given)
        return tuple(self.effect.variable(parameter) for parameter in free)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of its parameters in a model's layout."""
        return tuple(f"{variable}[{self.body}]" for variable in self.variables)


def at_stage(effects: tuple[Attached, ...], stage: type) -> list[Attached]:
    """Return the effects that act at a stage, in their order; commands with a memory first."""
    acting = [attached for attached in effects if isinstance(attached.effect.stage, stage)]
    if stage is Command:  # what is late is late as it was sent; wrenches of actuators come after
        acting.sort(key=lambda one: getattr(one.effect.stage, "rank", 0))
    return acting


def needs_inputs(effects: tuple[Attached, ...]) -> bool:
    """Return whether any effect needs the previous command or the clock."""
    stages = [attached.effect.stage for attached in effects]
    return any(
        getattr(stage, "timed", False) or (isinstance(stage, Command) and stage.memory > 0)
        for stage in stages
    )


def is_pivoted(scene: Scene, body: Body) -> bool:
    """Return whether the body hangs in a hinge: the hinge's friction acts on this body."""
    hinges = (joint for joint in scene.joints if joint.traits.pins_anchors and joint.bodies)
    return any(hanging_body(scene, joint) == body.name for joint in hinges)


def is_sliding(scene: Scene, body: Body) -> bool:
    """Return whether the body slides on an axis: the slider's friction acts on this body."""
    sliders = (joint for joint in scene.joints if joint.traits.slides)
    return any(hanging_body(scene, joint) == body.name for joint in sliders)


def is_unpivoted(scene: Scene, body: Body) -> bool:
    """Return whether the body hangs in no hinge; along a hinge's circle many forces look alike."""
    return not is_pivoted(scene, body)


def is_unjoined(scene: Scene, body: Body) -> bool:
    """Return whether the body hangs in no hinge or slider: a rod would hold its one coordinate."""
    return not (is_pivoted(scene, body) or is_sliding(scene, body))


def hanging_body(scene: Scene, joint: Joint) -> str:
    """Return the name of the body that hangs in a hinge or slider: the farther from the world.

    Raises
    ------
    EffectError
        If it is not known which bodies the joint joins.
    """
    if joint.bodies is None:
        raise EffectError("which bodies the joint joins is to be inferred; none hangs in it yet")
    depth = {body.name: 0 for body in scene.bodies if body.static or body.kinematic} | {WORLD: 0}
    pairs = [each.bodies for each in scene.joints if each.traits.hangs and each.bodies]
    for _ in pairs:
        for pair in pairs:
            for near, far in (pair, pair[::-1]):
                if near in depth and far not in depth:
                    depth[far] = depth[near] + 1
    # of two bodies that nothing ties to the world, the second hangs on the first
    first, second = joint.bodies
    return first if depth.get(first, 0) > depth.get(second, 1) else second


def holder(scene: Scene, attached: Attached) -> int:
    """Return the place among the moving bodies of what an effect's body hangs on, or -1."""
    names = [body.name for body in scene.moving]
    for joint in scene.joints:
        if joint.kind == "hinge" and joint.bodies and hanging_body(scene, joint) == attached.body:
            (other,) = set(joint.bodies) - {attached.body}
            return names.index(other) if other in names else -1
    return -1


def measured(history: History, body: Body, *names: str) -> Floats:
    """Return a body's states where these coordinates are all known, shape (n, name)."""
    rows = history.dataset["start"].sel(body=body.name, state=list(names)).to_numpy()
    rows = rows.reshape(-1, len(names))
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def body_points(body: Body) -> Floats:
    """Return the middle of a body and a point towards each side, in its frame, shape (5, 2), m."""
    x_min, x_max, y_min, y_max = body.shape.bounds
    shares = np.array([(0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7)])
    return np.asarray(0.5 * np.array([x_max - x_min, y_max - y_min]) * shares)
