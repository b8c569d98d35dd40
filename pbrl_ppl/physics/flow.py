"""Motion of a tree of links through intervals, to a tolerance.

Between switches of dry friction the equations are smooth: steps of order five whose error is
estimated (J. R. Dormand and P. J. Prince, Journal of Computational and Applied Mathematics 6,
1980), and halved where it is too large. A switch, where a row stops or what sticks gives way, is
located within its step (E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential
Equations I, section II.6): the motion is a continuous function of parameters and start.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import RK45

from pbrl_ppl.physics.calls import compiled, copy, inlined, inner, numbers_at
from pbrl_ppl.physics.laws import begin_held, law_at, remember, set_memory, states_before
from pbrl_ppl.physics.motion import (
    END_Q,
    END_U,
    HAS,
    MODE,
    RIM,
    ROW,
    SHORTEST,
    SIZE,
    SLOPES,
    Q,
    U,
    load,
    row_speed,
    set_coordinates,
    set_first_slide,
    set_inputs,
    set_numbers,
    set_places,
    set_twist,
    solve,
    strain,
)
from pbrl_ppl.physics.solids import near_contact, place_discs
from pbrl_ppl.physics.tree import FRICTION, LINK
from pbrl_ppl.state import Floats


def _tableau() -> tuple[Floats, Floats]:
    """Return the times of the stages, and the weights of the slopes before each, shape (8, 7).

    The last row is those of the error.
    """
    weights = np.zeros((8, 7))
    weights[:6, :5], weights[6, :6], weights[7] = RK45.A, RK45.B, RK45.E
    return np.append(RK45.C, 1.0), weights


_TIMES, _WEIGHTS = _tableau()
#: Speeds of rows that are none, and accuracy of a switch, as shares of the natural speed.
_STILL, _LOCATED = 1e-9, 1e-10


@inner
def _switch(laws, low):  # type: ignore[no-untyped-def]
    """Return the first time after ``low`` at which a command jumps, as a share of the interval."""
    high = 1.0
    for e in range(laws.n_commands):
        law = law_at(laws.commands, e)
        if law.jumps > 0:
            share = numbers_at(laws.commands_values)[law.first]
            share -= math.floor(share)
            if low + SHORTEST < share < high - SHORTEST:
                high = share
    return high


@inner
def _slowest(work, r, coast=0.1):  # type: ignore[no-untyped-def]
    """Return the square of a ring's speed from which friction lets it slide by next to nothing.

    A ring that would slide on less far than ``coast`` tolerances stops.
    """
    ring, points = r - work.n_rows, work.rings.shape[1] - RIM.points
    slowing = work.rings[ring, RIM.grip, 0] * points / work.links[work.kinds[r, 1], HAS.mass]
    return 2.0 * slowing * coast * work.tolerance * work.length


@inner
def _size(work, r):  # type: ignore[no-untyped-def]
    """Return the natural size of a row's way: of a wheel's in m, or of its joint's coordinate."""
    if work.kinds[r, 0] >= FRICTION.along:
        return work.length
    return work.motion[SIZE, work.tree[work.kinds[r, 1], LINK.first]]


@inner
def _set_wheel(work, r, mode):  # type: ignore[no-untyped-def]
    """Set the mode of rows of a wheel, or against turning, under the body of a ring at place r."""
    for row in range(work.n_rows):
        under = work.kinds[row, 1] == work.kinds[r, 1] and work.kinds[row, 0] >= FRICTION.turning
        if under and work.rows[row, ROW.bound] > 0.0:
            work.kinds[row, 2], work.kinds[row, 3] = mode, 2


@inner
def _decide(work, laws, share):  # type: ignore[no-untyped-def]
    """Set which rows and rings stick and which way the others slip; and the step's first slopes.

    Rows with a speed slip. Of the others all stick first; that which is pulled hardest gives way,
    until no force exceeds its bound.
    """
    motion, kinds, rows = work.motion, work.kinds, work.rows
    count = work.n_rows
    set_places(work, Q, U)
    load(work, laws, U, share)  # for the rows
    stop = _begin_modes(work)
    for _ in range(5 * work.n_kinds + 2):
        load(work, laws, U, share)
        solve(work, U, SLOPES + 1, False)
        worst, back, most = -1, -1, 1.0 - _STILL
        for r in range(count):
            if kinds[r, 3] == 0 and kinds[r, 2] == MODE.stick:
                pull = abs(rows[r, ROW.force]) / max(rows[r, ROW.bound], 1e-300)
                if pull > most:
                    worst, most = r, pull
            elif kinds[r, 3] == 0:
                rate = row_speed(work, r, SLOPES + 1) + rows[r, ROW.bias]
                back = r if kinds[r, 2] * rate < 0.0 else back
        if worst >= 0:
            kinds[worst, 2] = -1 if rows[worst, ROW.force] > 0.0 else 1
            continue
        if back >= 0:  # it holds, since another slips
            kinds[back, 2], kinds[back, 3] = MODE.stick, 1
            continue
        if _slide(work):
            continue
        if not stop:
            break
        solve(work, U, END_U, True)
        for j in range(work.n):
            motion[U, j] = motion[END_U, j]
        set_places(work, Q, U)
        stop = False
    for r in range(count, work.n_kinds):
        set_twist(work, r - count, kinds[r, 1], U, RIM.twist)


@inner
def _begin_modes(work):  # type: ignore[no-untyped-def]
    """Set modes by the speeds: rows and rings with a speed slip, and the others stick.

    Returns whether any that sticks has a speed yet, which is to be stopped.
    """
    kinds, rows, count, moves = work.kinds, work.rows, work.n_rows, False
    for r in range(work.n_kinds):
        # what stuck before moves by the error of steps alone
        still = 100.0 * work.tolerance if kinds[r, 2] == MODE.stick else _STILL
        greatest = rows[r, ROW.bound] if r < count else work.rings[r - count, RIM.grip, 0]
        kinds[r, 2], kinds[r, 3] = MODE.stick if greatest > 0.0 else MODE.smooth, 1
        if greatest == 0.0:
            continue
        if r < count:
            speed = row_speed(work, r, U)
            if abs(speed) * work.time_step > still * _size(work, r):
                kinds[r, 2] = 1 if speed > 0.0 else -1
            moved = speed != 0.0
        else:
            square = set_twist(work, r - count, kinds[r, 1], U, RIM.twist)
            if square > _slowest(work, r):
                kinds[r, 2] = MODE.slide
            moved = square > 0.0
        if kinds[r, 2] == MODE.stick:
            kinds[r, 3] = 0  # not settled
            moves |= moved
    for r in range(count, work.n_kinds):
        if kinds[r, 2] == MODE.stick:
            _set_wheel(work, r, MODE.smooth)  # the ring holds for it
    return moves


@inner
def _slide(work):  # type: ignore[no-untyped-def]
    """Let rings slide whose reaction exceeds what they can hold; return whether any does.

    They get a first speed, with which the direction of their friction is known.
    """
    motion, kinds, rows, count = work.motion, work.kinds, work.rows, work.n_rows
    slid = False
    for r in range(count, work.n_kinds):
        if kinds[r, 2] == MODE.stick and strain(work, r - count, kinds[r, 1]) > 0.0:
            kinds[r, 2], slid = MODE.slide, True
            _set_wheel(work, r, MODE.stick)
    if not slid:
        return False
    set_first_slide(work, U, END_U)
    for r in range(count):
        if kinds[r, 2] == MODE.stick and kinds[r, 3] == 2:
            rate, most = row_speed(work, r, END_U), 0.0
            for j in range(work.n):
                most += abs(rows[r, ROW.g + j] * motion[END_U, j])
            kinds[r, 3] = 0
            if abs(rate) > 0.05 * most:
                kinds[r, 2], kinds[r, 3] = 1 if rate > 0.0 else -1, 1
    for r in range(count, work.n_kinds):
        kinds[r, 3] = 1 if kinds[r, 2] == MODE.slide else 0
    for j in range(work.n):
        motion[U, j] += 1e-6 * work.time_step * motion[END_U, j]
    set_places(work, Q, U)
    return True


@inner
def _margin(work, u):  # type: ignore[no-untyped-def]
    """Return by how much no row switches, by speeds in a row of the motion and forces as solved."""
    least = 1.0
    for r in range(work.n_rows):
        mode = work.kinds[r, 2]
        if mode == MODE.stick:
            bound = max(work.rows[r, ROW.bound], 1e-300)
            least = min(least, 1.0 - abs(work.rows[r, ROW.force]) / bound)
        elif mode != MODE.smooth:
            least = min(least, mode * row_speed(work, r, u) * work.time_step / _size(work, r))
    return least


@inner
def _first_margin(work):  # type: ignore[no-untyped-def]
    """Return by how much nothing switches where a step begins."""
    least = _margin(work, U)
    for r in range(work.n_rows, work.n_kinds):
        if work.kinds[r, 2] == MODE.stick:
            least = min(least, -strain(work, r - work.n_rows, work.kinds[r, 1]))
    return least


@inner
def _weighted(motion, stage, first, j):  # type: ignore[no-untyped-def]
    """Return the weighted sum of slopes of a coordinate before a stage, of rows from ``first``."""
    total = 0.0
    for k in range(stage):
        total += _WEIGHTS[stage, k] * motion[first + 2 * k, j]
    return total


@inner
def _step(work, laws, share, width):  # type: ignore[no-untyped-def]
    """Try a step of a width (share of the interval) from its first slopes.

    Returns its error over the tolerance, and by how much nothing switches: at its end, and on the
    way.
    """
    motion, kinds, rings = work.motion, work.kinds, work.rings
    n, count, seconds, end, way = work.n, work.n_rows, width * work.time_step, 1.0, 1.0
    ends = n + 1 + work.n_held if work.n_held > 0 else n  # laws' numbers have speeds alone
    for j in range(ends):
        motion[SLOPES, j] = motion[U, j]
    for stage in range(1, 7):
        for j in range(ends):
            motion[END_Q, j] = motion[Q, j] + seconds * _weighted(motion, stage, SLOPES, j)
            if j < n:
                u = motion[U, j] + seconds * _weighted(motion, stage, SLOPES + 1, j)
                motion[END_U, j] = motion[SLOPES + 2 * stage, j] = u
        set_places(work, END_Q, END_U)
        load(work, laws, END_U, share + _TIMES[stage] * width)
        solve(work, END_U, SLOPES + 2 * stage + 1, False)
        for j in range(n + 1, ends):
            motion[SLOPES + 2 * stage, j] = motion[END_U, j]
        end = _margin(work, END_U)
        way = min(way, end)
    for r in range(count, work.n_kinds):
        if kinds[r, 2] == MODE.stick:
            end = min(end, -strain(work, r - count, kinds[r, 1]))
        elif kinds[r, 2] == MODE.slide:
            set_twist(work, r - count, kinds[r, 1], END_U, RIM.twist_end)
            square, along = 0.0, 0.0
            for d in range(3):
                before = rings[r - count, RIM.twist, d]
                square += before * before
                along += before * rings[r - count, RIM.twist_end, d]
            end = min(end, along / square if square > 0.0 else 1.0)
    error = 0.0
    for j in range(ends):
        q = _weighted(motion, 7, SLOPES, j)
        u = _weighted(motion, 7, SLOPES + 1, j) if j < n else 0.0
        error = max(error, seconds * (abs(q) + work.time_step * abs(u)) / motion[SIZE, j])
        if not math.isfinite(q + u):
            return np.inf, end, way
    return error / work.tolerance, end, way


@inner
def _advance(work, laws, still, budget, wanted):  # type: ignore[no-untyped-def]
    """Move through a piece of an interval in which no command jumps.

    Begins with steps of a ``wanted`` width. Returns the steps left, and the width wanted next. Left
    is 0 where the motion has no prediction, and -1 where a body comes near an obstacle.
    """
    share, fresh = work.low, True  # whether modes are to be decided
    left = 0.0  # by how much nothing switches where the step begins
    while share < work.high:
        if fresh:
            _decide(work, laws, share)
            fresh, left = False, _first_margin(work)
        width = min(wanted, _way(work, still)) if still.watched else wanted
        last, width = width >= work.high - share, min(width, work.high - share)
        error, end, way, width, budget, located = _attempt(work, laws, share, width, left, budget)
        short, switches = width <= SHORTEST, end < -_LOCATED
        if budget <= 0 or (short and not located and not error < np.inf):
            return 0, wanted
        if located:
            fresh, last = True, False
        elif not short and not error <= 1.0:
            wanted = width * (max(0.1, 0.9 * error**-0.2) if error < np.inf else 0.25)
            continue
        # it has just switched, or switches on the way alone
        elif not short and (left <= _LOCATED if switches else way < -_LOCATED):
            wanted = 0.5 * width
            continue
        else:
            fresh, left = switches, end
            wider = width * min(5.0, 0.9 * max(error, 1e-9) ** -0.2)
            wanted = min(1.0, max(wanted, wider) if last or wanted > width else wider)
        fresh |= _accept(work)
        share = work.high if last else share + width
        _follow_paths(work, work.time_step * width)
        if still.watched and near_contact(
            work.states, still.radii, still.obstacles, still.can_touch
        ):
            return -1, wanted
    return budget, wanted


@inner
def _attempt(work, laws, share, width, left, budget):  # type: ignore[no-untyped-def]
    """Try a step; one in which something switches is narrowed to the switch.

    By regula falsi (Illinois) from its begin, where nothing switches by ``left``. Returns what
    `_step` does, the width, the steps left, and whether it ends at a switch.
    """
    begin, before, until, after, kept = 0.0, left, width, 0.0, 0
    located = False
    while True:
        budget -= 1
        if budget <= 0:
            return np.inf, 0.0, 0.0, width, budget, located
        error, end, way = _step(work, laws, share, width)
        if not located:
            wide = width > SHORTEST and error <= 1.0 and left > _LOCATED
            if not wide or not end < -_LOCATED:
                return error, end, way, width, budget, located
            located, after = True, end
        elif not (abs(end) > _LOCATED and until - begin > 1e-12):
            return error, end, way, width, budget, located
        elif end > 0.0:
            begin, before = width, end
            after *= 0.5 if kept == 1 else 1.0
            kept = 1
        else:
            until, after = width, end
            before *= 0.5 if kept == -1 else 1.0
            kept = -1
        width = begin + (until - begin) * before / (before - after)


@inner
def _accept(work):  # type: ignore[no-untyped-def]
    """Begin the next step where one ends; return whether a ring that slides is to stop."""
    motion, n, stops = work.motion, work.n, False
    for j in range(n + 1 + work.n_held if work.n_held > 0 else n):
        motion[Q, j], motion[U, j] = motion[END_Q, j], motion[END_U, j]
        motion[SLOPES + 1, j] = motion[SLOPES + 13, j]
    for r in range(work.n_rows, work.n_kinds):
        ring, square = r - work.n_rows, 0.0
        for d in range(3):
            work.rings[ring, RIM.twist, d] = work.rings[ring, RIM.twist_end, d]
            square += work.rings[ring, RIM.twist, d] ** 2
        stops |= work.kinds[r, 2] == MODE.slide and square <= _slowest(work, r)
    return stops


@inner
def _follow_paths(work, seconds):  # type: ignore[no-untyped-def]
    """Move the bodies that follow a path."""
    for k in range(work.n_bodies):
        for d in range(3 if work.bodies[k] < 0 else 0):
            work.states[k, d] += seconds * work.states[k, 3 + d]


@inner
def _way(work, still):  # type: ignore[no-untyped-def]
    """Return the share of an interval in which no body moves by more than half the smallest."""
    fastest = 1e-300
    for k in range(work.n_bodies):
        fastest = max(fastest, math.sqrt(work.states[k, 3] ** 2 + work.states[k, 4] ** 2))
    return max(SHORTEST, 0.5 * still.length / (fastest * work.time_step))


@inlined
def _begin(work, laws, batch, out, item, h, memory, at):  # type: ignore[no-untyped-def]
    """Begin an item before an interval; nothing is known of the friction."""
    n, states = len(batch.inputs), states_before(batch, out, item, h)
    for r in range(work.n_kinds):
        work.kinds[r, 2] = MODE.smooth
    set_coordinates(work, states)
    copy(states, work.states)
    set_memory(batch, laws, item // n, item % n, h, work.states, work.acted, memory, at)
    begin_held(work.states, laws, work.acted, work.held)
    for s in range(work.n_held):
        work.motion[Q, work.n + 1 + s] = work.held[0, s]


@inlined
def _write(work, still, out):  # type: ignore[no-untyped-def]
    """Write the states (body, 6); return whether one has diverged."""
    lost = False
    for k in range(work.n_bodies):
        speed = abs(work.states[k, 3]) + abs(work.states[k, 4])
        speed += still.length * abs(work.states[k, 5])
        lost |= not speed < still.fastest  # also true of NaN
        for d in range(6):
            out[k, d] = work.states[k, d]
    return lost


@compiled
def rollout_tree(  # type: ignore[no-untyped-def]
    works, still, batch, items, begins, out, most_steps=4000
):
    """Predict ``items`` of ``out``, whose shape is (proposal * transition, H, body, 6).

    ``begins``, shape (item,), are their first intervals; they become those in which a body comes
    near an obstacle, H where none does. Those that diverge, or take more than ``most_steps`` steps
    of an interval (laws that are stiffer, or jump more often), are NaN from there on.
    """
    rows, joints, discs = batch.given[:3]
    work = works[0]
    n, horizon, proposal = len(batch.inputs), batch.inputs.shape[1], -1
    timed = rows.shape[1] > 1
    slots, work.n_held = batch.laws[0].n_slots, batch.laws[0].n_held
    memory, at = np.zeros((2, slots)), np.full(2, -1)
    work.memory = memory.ctypes.data + 8 * slots
    work.time_step, work.tolerance, work.length = batch.time_step, batch.tolerance, still.length
    for place in range(len(items)):
        item = items[place]
        p, t = item // n, item % n
        laws = batch.laws[p]
        if p != proposal:
            proposal = p
            place_discs(still, discs[p])
        first, wanted = begins[place], 1.0
        begins[place] = horizon
        for h in range(first, horizon):
            if h == first or timed:
                row = rows[p, t * horizon + h if timed else 0]
                set_numbers(work, still, row, joints[p])
            if h == first:
                _begin(work, laws, batch, out, item, h, memory, at)
            set_inputs(work, batch.inputs[t, h])
            work.high, budget = 0.0, most_steps
            while work.high < 1.0 and budget > 0:
                work.low = work.high
                work.high = _switch(laws, work.low)
                budget, wanted = _advance(work, laws, still, budget, wanted)
            if slots > 0:
                memory_at, inputs_at = numbers_at(work.memory), numbers_at(work.inputs)
                remember(work.states, inputs_at, laws, work.acted, memory_at)
            if budget < 0:
                begins[place] = h
                break
            if _write(work, still, out[item, h]) or budget == 0:
                out[item, h:] = np.nan
                break
