"""Where the C objects of a world are, for the compiled rollout."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymunk import _chipmunk_cffi

from pbrl_ppl.physics.world import RING, World


class Pointers(NamedTuple):
    """The C objects of one world, for the compiled loop."""

    space: int
    iterations: int
    chained: NDArray[np.bool_]
    padding: int
    bodies: NDArray[np.int64]
    kinematic: NDArray[np.bool_]
    shapes: NDArray[np.int64]
    shape_body: NDArray[np.int64]
    wheels: NDArray[np.int64]  # (2, wheel): the rod along x, the rod along y
    wheel_body: NDArray[np.int64]
    links: NDArray[np.int64]
    link_joint: NDArray[np.int64]
    link_rod: NDArray[np.bool_]
    discs: NDArray[np.int64]
    pivots: NDArray[np.int64]  # (2, pivot): the motor, the damper
    pivot_body: NDArray[np.int64]
    patches: NDArray[np.int64]  # (2, patch, point of the ring): what holds it, the rod
    patch_body: NDArray[np.int64]
    ring: NDArray[np.float64]
    radii: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    can_touch: NDArray[np.bool_]


def pointers(world: World) -> Pointers:
    """Where the C objects of a world are; the world must be kept alive."""
    ffi = _chipmunk_cffi.ffi

    def at(objects: list[Any]) -> NDArray[np.int64]:
        return np.array(
            [int(ffi.cast("intptr_t", c_object)) for c_object in objects], dtype=np.int64
        )

    def whole(numbers: list[int]) -> NDArray[np.int64]:
        return np.array(numbers, dtype=np.int64)

    wheels, links, pivots = world.wheels, world.links, world.pivots
    return Pointers(
        space=int(ffi.cast("intptr_t", world.space._space)),
        iterations=world.iterations,
        chained=world.chained,
        padding=world.padding,
        bodies=at([body._body for body in world.bodies]),
        kinematic=world.kinematic,
        shapes=at([shape._shape for _, shape in world.shapes]),
        shape_body=whole([i for i, _ in world.shapes]),
        wheels=np.stack(
            [
                at([wheel.along_x._constraint for wheel in wheels]),
                at([wheel.along_y._constraint for wheel in wheels]),
            ]
        ),
        wheel_body=whole([wheel.body for wheel in wheels]),
        links=at([link.constraint._constraint for link in links]),
        link_joint=whole([link.joint for link in links]),
        link_rod=np.array([link.rod for link in links], dtype=bool),
        discs=at([disc._shape for disc in world.discs]),
        pivots=np.stack(
            [
                at([pivot.motor._constraint for pivot in pivots]),
                at([pivot.damper._constraint for pivot in pivots]),
            ]
        ),
        pivot_body=whole([pivot.body for pivot in pivots]),
        patches=at(
            [hold._constraint for patch in world.patches for hold in patch.holds]
            + [rod._constraint for patch in world.patches for rod in patch.rods]
        ).reshape(2, -1, len(RING)),
        patch_body=whole([patch.body for patch in world.patches]),
        ring=np.array(RING),
        radii=world.radii,
        obstacles=world.obstacles,
        can_touch=world.can_touch,
    )
