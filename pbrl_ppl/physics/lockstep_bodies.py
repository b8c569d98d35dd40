"""What a lane is told of its body, and asked: properties, state, wrench, and what it comes near.

States, wrenches and obstacles are of the body's origin; the lane steps its centre of mass.
"""

from __future__ import annotations

import math

import numba

from pbrl_ppl.physics.lockstep_solver import (
    FX,
    FY,
    GX,
    GY,
    II,
    JX_MAX,
    JY_MAX,
    LANES,
    MI,
    OX,
    OY,
    UT,
    UX,
    UY,
    VX,
    VY,
    WC,
    WS,
    WX,
    WY,
    X0,
    Y0,
    A,
    C,
    S,
    T,
    W,
    X,
    Y,
)
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import DIVERGED

_MASS, _MOMENT, _W_X, _W_Y, _W_THETA, _MU_X, _MU_Y = (
    COLUMN[name] for name in ("mass", "moment", "w_x", "w_y", "w_theta", "mu_x", "mu_y")
)
_EXTRA_X, _EXTRA_Y = COLUMN["extra_gravity_x"], COLUMN["extra_gravity_y"]
_COM_X, _COM_Y = COLUMN["com_x"], COLUMN["com_y"]


@numba.njit(nogil=True, cache=True)
def set_body(z, i, row, wheel, normal_gravity, step):  # type: ignore[no-untyped-def]
    """Give lane ``i`` its numbers for an interval; what is stored in joints stays.

    Says whether its centre of mass is off the origin.
    """
    z[MI + i], z[II + i] = 1.0 / row[_MASS], 1.0 / row[_MOMENT]
    z[GX + i], z[GY + i] = row[_MASS] * row[_EXTRA_X], row[_MASS] * row[_EXTRA_Y]
    z[OX + i], z[OY + i] = row[_COM_X], row[_COM_Y]
    if wheel:
        load = row[_MASS] * normal_gravity
        z[WX + i], z[WY + i] = row[_W_X] - row[_COM_X], row[_W_Y] - row[_COM_Y]
        z[WC + i], z[WS + i] = math.cos(row[_W_THETA]), math.sin(row[_W_THETA])
        z[JX_MAX + i], z[JY_MAX + i] = row[_MU_X] * load * step, row[_MU_Y] * load * step
    return row[_COM_X] != 0.0 or row[_COM_Y] != 0.0


@numba.njit(nogil=True, cache=True)
def set_state(z, i, state):  # type: ignore[no-untyped-def]
    """Put the centre of lane ``i`` where the state of its origin has it."""
    z[A + i], z[W + i] = state[2], state[5]
    align(z, i)
    x, y = _arm(z, i)
    z[X + i], z[Y + i] = state[0] + x, state[1] + y
    z[VX + i], z[VY + i] = state[3] - state[5] * y, state[4] + state[5] * x


@numba.njit(nogil=True, cache=True)
def align(z, i):  # type: ignore[no-untyped-def]
    """Take lane ``i``'s heading from its angle, free of what rounding has added."""
    z[C + i], z[S + i] = math.cos(z[A + i]), math.sin(z[A + i])


@numba.njit(nogil=True, cache=True)
def _arm(z, i):  # type: ignore[no-untyped-def]
    """From the origin of lane ``i`` to its centre of mass, in the world's frame."""
    if z[OX + i] == 0.0 and z[OY + i] == 0.0:
        return 0.0, 0.0
    c, s, x, y = z[C + i], z[S + i], z[OX + i], z[OY + i]
    return c * x - s * y, s * x + c * y


@numba.njit(nogil=True, cache=True)
def get_state(z, i, state):  # type: ignore[no-untyped-def]
    """State of the origin of lane ``i``."""
    x, y = _arm(z, i)
    state[0], state[1], state[2] = z[X + i] - x, z[Y + i] - y, z[A + i]
    state[3], state[4] = z[VX + i] + z[W + i] * y, z[VY + i] - z[W + i] * x
    state[5] = z[W + i]


@numba.njit(nogil=True, cache=True)
def add(total, state, weight, level, levels):  # type: ignore[no-untyped-def]
    """Add a level's state to the weighted sum of all."""
    for d in range(6):
        if levels == 1:
            total[d] = state[d]
        else:
            total[d] = weight * state[d] + (total[d] if level else 0.0)


@numba.njit(nogil=True, cache=True)
def set_wrench(z, i, wrench):  # type: ignore[no-untyped-def]
    """Give lane ``i`` the accelerations of a wrench and of the weight beside it."""
    z[UX + i], z[UY + i], z[UT + i] = wrench[0], wrench[1], wrench[2]
    z[FX + i] = (wrench[0] + z[GX + i]) * z[MI + i]
    z[FY + i] = (wrench[1] + z[GY + i]) * z[MI + i]
    z[T + i] = wrench[2] * z[II + i]


@numba.njit(nogil=True, cache=True)
def lever(z):  # type: ignore[no-untyped-def]
    """Turn the bodies by forces on their origins about their centres."""
    for i in range(LANES):
        x = z[C + i] * z[OX + i] - z[S + i] * z[OY + i]
        y = z[S + i] * z[OX + i] + z[C + i] * z[OY + i]
        z[T + i] = (z[UT + i] - (x * z[UY + i] - y * z[UX + i])) * z[II + i]


@numba.njit(nogil=True, cache=True)
def locate(z):  # type: ignore[no-untyped-def]
    """Say where the origins are."""
    for i in range(LANES):
        z[X0 + i] = z[X + i] - (z[C + i] * z[OX + i] - z[S + i] * z[OY + i])
        z[Y0 + i] = z[Y + i] - (z[S + i] * z[OX + i] + z[C + i] * z[OY + i])


@numba.njit(nogil=True, cache=True)
def lose(z, touched):  # type: ignore[no-untyped-def]
    """Mark the lanes that have diverged."""
    for i in range(LANES):
        speed = abs(z[VX + i]) + abs(z[VY + i]) + abs(z[W + i])
        touched[i] |= not speed < DIVERGED  # also true of NaN


@numba.njit(nogil=True, cache=True)
def watch(z, radius, obstacles, discs, touched):  # type: ignore[no-untyped-def]
    """Mark the lanes whose body comes near an obstacle, once it is located."""
    for j in range(len(obstacles)):
        a_x, a_y, size = obstacles[j, 0], obstacles[j, 1], obstacles[j, 4]
        d_x, d_y = obstacles[j, 2] - a_x, obstacles[j, 3] - a_y
        length = d_x * d_x + d_y * d_y
        scale, reach = 1.0 / length if length > 0.0 else 0.0, radius + size
        for i in range(LANES):
            x, y = z[X0 + i] - a_x, z[Y0 + i] - a_y
            t = (x * d_x + y * d_y) * scale
            t = 0.0 if t < 0.0 else t
            t = 1.0 if t > 1.0 else t
            x, y = x - t * d_x, y - t * d_y
            touched[i] |= x * x + y * y <= reach * reach
    for j in range(discs.shape[1]):
        for i in range(LANES):
            x, y, reach = z[X0 + i] - discs[i, j, 0], z[Y0 + i] - discs[i, j, 1], discs[i, j, 2]
            reach = radius + reach if reach > 0.0 else -1.0
            touched[i] |= (x * x + y * y <= reach * reach) & (reach > 0.0)
