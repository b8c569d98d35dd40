"""Stages: what an effect changes, as a closed set of final classes in the order of application."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Values of an effect's parameters by name; arrays that broadcast, one entry a proposal.
Values = Mapping[str, Array]

#: ``law(state, command, parameters, wrench)``, all arrays of floats: one body's state (6,), its
#: command, the effect's parameters (q,), and the wrench (3,), which it changes in place. It runs
#: inside the compiled substep loop: plain arithmetic and ``math`` only.
Law = Callable[[Any, Any, Any, Any], None]


@final
@dataclass(frozen=True)
class Disc:
    """A static disc; each an array that broadcasts over proposals. No radius is no disc.

    Parameters
    ----------
    x, y : ndarray
        Its middle (m).
    radius : ndarray
        Its radius (m).
    """

    x: Array
    y: Array
    radius: Array


class Rod(NamedTuple):
    """A rod between a body and a place; each an array that broadcasts over proposals.

    Attributes
    ----------
    a_x, a_y : ndarray
        Its end on the body, in the body's frame (m).
    b_x, b_y : ndarray
        Its end in the world (m).
    length : ndarray
        Its length (m). No length is no rod.
    """

    a_x: Array
    a_y: Array
    b_x: Array
    b_y: Array
    length: Array


def _no_discs(parameters: Values) -> tuple[Disc, ...]:
    return ()


@final
@dataclass(frozen=True)
class Structure:
    """Adds to the scene: static discs, or a rod that ties the body to a place.

    Parameters
    ----------
    discs : callable
        ``discs(parameters) -> tuple of Disc``, always as many; every moving body bounces off them.
    rod : callable, optional
        ``rod(parameters) -> Rod``.
    """

    discs: Callable[[Values], tuple[Disc, ...]] = _no_discs
    rod: Callable[[Values], Rod] | None = None


@final
@dataclass(frozen=True)
class Clock:
    """When intervals are, as arrays of shape (1, interval); infinite after the recording.

    Parameters
    ----------
    trajectory : ndarray
        Number of the trajectory, from 0.
    begin, end : ndarray
        Time within the trajectory at which the interval begins and ends (s).
    """

    trajectory: Array
    begin: Array
    end: Array

    def after(self, time: Array) -> Array:
        """Share of each interval that lies after a moment of its trajectory (s), 0 to 1."""
        known = np.isfinite(self.end)
        begin, end = np.where(known, self.begin, 0.0), np.where(known, self.end, 1.0)
        return np.where(known, np.clip((end - time) / (end - begin), 0.0, 1.0), 1.0)


@final
@dataclass(frozen=True)
class Properties:
    """Changes the engine's numbers of a body.

    Parameters
    ----------
    modify : callable
        ``modify(properties, parameters, clock)`` changes a dict of arrays in place, keys as
        :data:`pbrl_ppl.physics.properties.COLUMNS`, but that the moment of inertia follows after,
        as mass times ``moment_per_mass``, and that ``gravity_x`` and ``gravity_y`` (m/s^2) are the
        whole of gravity.
    timed : bool
        Whether the numbers depend on the clock; shapes are then (proposal, interval), else
        (proposal, 1).
    """

    modify: Callable[[dict[str, Array], Values, Clock], None]
    timed: bool = False


@final
@dataclass(frozen=True)
class Command:
    """Changes the commanded wrench of a body before it acts.

    Parameters
    ----------
    law : callable
        See :data:`Law`. ``command`` (8,) is the wrench held over this interval and the one held
        over the interval before (zero before the first), both as the effects before this one have
        left them, then the share of the interval that has gone when the substep begins and ends.
        ``wrench`` (3,) is the held one, to be changed.
    memory : bool
        Whether the law looks at the wrench before.
    """

    law: Law
    memory: bool = False


@final
@dataclass(frozen=True)
class Force:
    """Adds to the wrench on a body.

    Parameters
    ----------
    law : callable
        See :data:`Law`. ``command`` (3,) is the wrench as the command stage left it; ``wrench`` is
        what acts so far.
    """

    law: Law


@final
@dataclass(frozen=True)
class Sensor:
    """Changes what is measured of a body's state.

    Parameters
    ----------
    measure : callable
        ``measure(state, parameters) -> measured``, both of shape (..., 6); parameters broadcast
        over the leading axes.
    invert : callable
        ``invert(measured, parameters) -> state``, its inverse.
    """

    measure: Callable[[Array, Values], Array]
    invert: Callable[[Array, Values], Array]


@final
@dataclass(frozen=True)
class Noise:
    """Changes the density of the whitened noise of a body's measured states.

    Parameters
    ----------
    tail : callable
        ``tail(parameters) -> ndarray``: the reciprocal of the degrees of freedom of a Student-t;
        zero is a Gaussian.
    """

    tail: Callable[[Values], Array]


Stage = Structure | Properties | Command | Force | Sensor | Noise
STAGES: tuple[type, ...] = (Structure, Properties, Command, Force, Sensor, Noise)
