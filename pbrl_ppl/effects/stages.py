"""Stages at which effects act: a closed set of final classes, in the order of application."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from pbrl_ppl.errors import EffectError
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


@final
@dataclass(frozen=True)
class Disc:
    """A static disc; arrays broadcast over proposals. There is none where the radius is zero.

    Parameters
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
        :data:`pbrl_ppl.physics.properties.COLUMNS`, with two exceptions: ``moment_per_mass``, from
        which the moment of inertia is computed afterwards, and ``gravity_x`` and ``gravity_y``
        (m/s^2), the total gravity.
    timed : bool
        Whether the properties depend on the clock; shapes are then (proposal, interval), else
        (proposal, 1).
    """

    modify: Callable[[dict[str, Floats], Values, Clock], None]
    timed: bool = False


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
        if not 0 <= 3 * self.memory <= MOST_MEMORY:
            raise EffectError(
                f"a law remembers {self.memory} wrenches, expected 0 to {MOST_MEMORY // 3}"
            )


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
        How many numbers of its own the law has, such as the place of a mass that sloshes.
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
        if not 0 <= self.memory <= MOST_MEMORY:
            raise EffectError(
                f"a law has {self.memory} numbers of its own, expected 0 to {MOST_MEMORY}"
            )


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
