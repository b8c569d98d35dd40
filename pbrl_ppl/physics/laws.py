"""Laws of effects in the compiled loops: what acts on bodies, and what laws remember."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached, Command, Force, Friction, at_stage, holder
from pbrl_ppl.physics.calls import call_law, inner, law_address, put_at, real_at, whole_at
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH, Floats, Ints

#: When an interval is nearly over, as a share of it.
LATE = 1.0 - 1e-7
#: Columns of what acts on a body: its command, the one of the interval before, the wrench, and when
#: it is; see :data:`pbrl_ppl.effects.effect.TIME`.
COMMAND, PREVIOUS, WRENCHES, TIME, INTERVAL, ACTED = 0, 3, 6, 9, 10, 12
#: Further rows of what acts: a law's command and its memory, and the wrench of a law of one number.
MORE = 4
#: Columns of a law: its address, body, first parameter, the address of `remember`, its first number
#: in the memory, how many, the component that is alone (-1: none), whether it is under a body,
#: whether the command jumps in an interval, at the fractional part of the first parameter, the
#: parameter that is the share of the first command that the memory begins with (-1: none), and the
#: body that the torque acts back on, relative to which the law sees angle and speed (-1: none). Of
#: a force, REMEMBER is the address of `rate`, and JUMPS that of `begin` (0: none).
LAW, ON, FIRST, REMEMBER, SLOT, SLOTS, ALONE, UNDER, JUMPS, BEGINS, OTHER = range(11)
ROW, _ACTED = 8 * (OTHER + 1), 8 * ACTED  # bytes of a law, and of a row of what acts


def law_tables(scene: Scene, effects: tuple[Attached, ...]) -> tuple[Ints, Ints, Ints, int, int]:
    """Return the rows of command, force and friction laws, with columns as above.

    And how many numbers command laws remember, and force laws have of their own.
    """
    tables, slots = [], []
    for kind in (Command, Force, Friction):
        rows: list[Ints] = []
        first = slot = 0
        for attached in at_stage(effects, kind):
            if isinstance(attached.effect.stage, Command | Force | Friction):
                rows.append(_row(scene, attached, attached.effect.stage, first, slot))
                first += len(attached.effect.parameters) + len(attached.effect.constants)
                slot += int(rows[-1][SLOTS])
        tables.append(np.array(rows, dtype=np.int64).reshape(-1, OTHER + 1))
        slots.append(slot)
    commands, forces, frictions = tables
    return commands, forces, frictions, slots[0], slots[1]


def _row(
    scene: Scene, attached: Attached, stage: Command | Force | Friction, first: int, slot: int
) -> Ints:
    """Return the row of a law whose parameters, and numbers, begin at these places."""
    row = np.zeros(OTHER + 1, dtype=np.int64)
    row[[ALONE, BEGINS, OTHER]] = -1
    row[ON] = [body.name for body in scene.moving].index(attached.body)
    row[LAW], row[FIRST], row[SLOT] = law_address(stage.law), first, slot
    if isinstance(stage, Command):
        if stage.remember is not None:
            row[REMEMBER], row[SLOTS] = law_address(stage.remember), 3 * stage.memory
        if stage.alone:
            row[ALONE] = WRENCH.index(stage.alone)
        if stage.begins:
            row[BEGINS] = first + len(attached.effect.parameters) - 1
        if stage.reacts:
            row[OTHER] = holder(scene, attached)
        row[JUMPS] = stage.jumps
    elif isinstance(stage, Force) and stage.rate is not None:
        row[REMEMBER], row[SLOTS] = law_address(stage.rate), stage.memory
        row[JUMPS] = 0 if stage.begin is None else law_address(stage.begin)
    elif isinstance(stage, Friction):
        row[UNDER] = stage.under
    return row


#: Laws of a proposal: how many commands, forces and frictions; the addresses of their rows, with
#: columns as above, and of their parameters. Then the number of bodies, the columns of a body's
#: inputs and the interval (s). One record: to pass arrays costs more than most laws.
LAWS = np.dtype(
    [
        (name, np.int64)
        for kind in ("commands", "forces", "frictions")
        for name in (f"n_{kind}", kind, f"{kind}_values")
    ]
    + [("n_bodies", np.int64), ("width", np.int64), ("time_step", np.float64)],
    align=True,
)


def laws_of(
    tables: Sequence[Ints], values: Sequence[Floats], inputs: Floats, time_step: float
) -> NDArray[np.void]:
    """Return the record of each proposal's laws, shape (proposal,); the arrays must be kept.

    Parameters
    ----------
    tables : sequence of ndarray
        Rows of commands, forces and frictions, shape (law, column).
    values : sequence of ndarray
        Their parameters, shape (proposal, parameter).
    inputs : ndarray
        Shape (transition, H, body, column).
    time_step : float
        Length of an interval (s).
    """
    records = np.zeros(len(values[0]), dtype=LAWS)
    records["n_bodies"], records["width"] = inputs.shape[2:]
    records["time_step"] = time_step
    kinds = ("commands", "forces", "frictions")
    for kind, rows, numbers in zip(kinds, tables, values, strict=True):
        records[f"n_{kind}"], records[kind] = len(rows), rows.ctypes.data
        places = numbers.strides[0] * np.arange(len(numbers))
        records[f"{kind}_values"] = numbers.ctypes.data + places
    return records


@inner
def act(  # type: ignore[no-untyped-def]
    state, inputs, laws, begin, end, acted, memory, held, n_held, after
):  # fmt: skip
    """Compute the wrench on each body in a substep: the command stage, then the force stage.

    Arrays are given by their addresses: ``state`` (body, 6), and ``inputs`` of the interval, (body,
    column); ``begin`` and ``end`` of the substep are shares of the interval. ``acted`` (body + 4,
    12) becomes command, command before and wrench of each body; of the other rows a command law
    sees the first three. ``memory`` is that of command laws when the interval begins; ``after`` it,
    it is brought up to date. ``held`` (2, ``n_held``) has the numbers of force laws, and gets their
    rates of change.
    """
    k, known = laws.n_bodies, laws.width > 3
    seen = acted + _ACTED * k  # by command laws, and by force laws with numbers of their own
    alone_at = seen + 3 * _ACTED
    for i in range(k):
        row, to = inputs + 8 * laws.width * i, acted + _ACTED * i
        for w in range(3):
            put_at(to, COMMAND + w, real_at(row, w))
            put_at(to, PREVIOUS + w, real_at(row, 3 + w) if known else 0.0)
            put_at(to, WRENCHES + w, 0.0)  # by how much actuators are turned, for now
        put_at(to, TIME, real_at(row, 7) + begin * laws.time_step if known else np.inf)
        put_at(to, INTERVAL, laws.time_step)
    for e in range(laws.n_commands):
        law = laws.commands + ROW * e
        i, alone = whole_at(law, ON), whole_at(law, ALONE)
        slot, slots, other = whole_at(law, SLOT), whole_at(law, SLOTS), whole_at(law, OTHER)
        on, state_at = acted + _ACTED * i, state + 48 * i
        values = laws.commands_values + 8 * whole_at(law, FIRST)
        for w in range(ACTED):
            put_at(seen, w, real_at(on, w))
        put_at(seen, 6, begin)
        put_at(seen, 7, end)
        for s in range(slots):
            put_at(seen, ACTED + s, real_at(memory, slot + s))
        wrench = on
        if alone >= 0:
            wrench = alone_at
            for w in range(3):
                now, before = real_at(on, alone), real_at(on, PREVIOUS + alone)
                put_at(seen, w, now if w == 0 else 0.0)
                put_at(seen, PREVIOUS + w, before if w == 0 else 0.0)
                put_at(alone_at, w, now if w == 0 else 0.0)
        if other >= 0:
            for d in range(6):
                off = real_at(state + 48 * other, d) if d in (2, 5) else 0.0
                put_at(alone_at, 6 + d, real_at(state_at, d) - off)
            state_at = alone_at + 48
        call_law(whole_at(law, LAW), state_at, seen, values, wrench)
        if alone >= 0:
            put_at(on, alone, real_at(alone_at, 0))
        if after and slots > 0:
            call_law(whole_at(law, REMEMBER), state_at, seen, values, memory + 8 * slot)
    for i in range(k):
        to = acted + _ACTED * i
        for w in range(3):
            put_at(to, WRENCHES + w, real_at(to, COMMAND + w))
    for e in range(laws.n_commands):
        law = laws.commands + ROW * e
        if whole_at(law, OTHER) >= 0:
            torque = real_at(acted + _ACTED * whole_at(law, ON), COMMAND + 2)
            back = acted + _ACTED * whole_at(law, OTHER)
            put_at(back, WRENCHES + 2, real_at(back, WRENCHES + 2) - torque)
    for e in range(0 if after else laws.n_forces):
        law = laws.forces + ROW * e
        i, slot, slots = whole_at(law, ON), whole_at(law, SLOT), whole_at(law, SLOTS)
        on, state_at = acted + _ACTED * i, state + 48 * i
        see, values = on, laws.forces_values + 8 * whole_at(law, FIRST)
        if slots > 0:
            see = seen
            for w in range(ACTED):
                put_at(seen, w, real_at(on, w))
            for s in range(slots):
                put_at(seen, ACTED + s, real_at(held, slot + s))
            rates = held + 8 * (n_held + slot)
            call_law(whole_at(law, REMEMBER), state_at, see, values, rates)
        call_law(whole_at(law, LAW), state_at, see, values, on + 8 * WRENCHES)


@inner
def remember(state, inputs, laws, acted, memory, held):  # type: ignore[no-untyped-def]
    """Bring what command laws remember up to date after an interval; see `act`."""
    act(
        state.ctypes.data, inputs, laws, LATE, 1.0, acted.ctypes.data, memory, held.ctypes.data,
        held.shape[1], True,
    )  # fmt: skip


@inner
def begin_held(state, laws, acted, held):  # type: ignore[no-untyped-def]
    """Set the numbers of force laws where a transition begins."""
    k = len(acted) - MORE
    for s in range(held.shape[1]):
        held[0, s] = held[1, s] = 0.0
    for e in range(laws.n_forces):
        law = laws.forces + ROW * e
        begin = whole_at(law, JUMPS)
        if whole_at(law, SLOTS) > 0 and begin != 0:
            call_law(
                begin, state.ctypes.data + 48 * whole_at(law, ON),
                acted.ctypes.data + 8 * ACTED * k,
                laws.forces_values + 8 * whole_at(law, FIRST),
                held.ctypes.data + 8 * whole_at(law, SLOT),
            )  # fmt: skip


@inner
def set_memory(batch, laws, p, t, begin, start, acted, memory, held, at):  # type: ignore[no-untyped-def]
    """Set what command laws remember before the interval ``begin`` of the transition ``t``.

    ``memory[1]``, shape (slot,), depends on commands alone: those of all intervals that follow each
    other in the recording up to this one, at the state ``start`` (body, 6). ``memory[0]`` is that
    before the first interval of the transition ``at[1]`` of the proposal ``at[0]``.
    """
    if memory.shape[1] == 0:
        return
    inputs, first = batch.inputs, t
    while batch.follows[first] and not (at[0] == p and at[1] == first):
        first -= 1
    if not (at[0] == p and at[1] == first):
        _begin_memory(laws, inputs[first, 0], start, acted, memory[0], held)
    for earlier in range(first, t):
        for h in range(inputs.shape[1]):
            at_interval = inputs[earlier, h].ctypes.data
            remember(start, at_interval, laws, acted, memory.ctypes.data, held)
    at[0], at[1] = p, t
    for s in range(memory.shape[1]):
        memory[1, s] = memory[0, s]
    now = memory.ctypes.data + 8 * memory.shape[1]
    for h in range(begin):
        remember(start, inputs[t, h].ctypes.data, laws, acted, now, held)


@inner
def _begin_memory(laws, interval, start, acted, memory, held):  # type: ignore[no-untyped-def]
    """Set what laws remember where nothing but the inputs (body, 9 or more) is known.

    As if the oldest wrench had lasted: the previous one, or the last of those before it.
    """
    older = (interval.shape[1] - 9) // 3
    oldest = PREVIOUS if older == 0 else 6 + 3 * older
    for e in range(laws.n_commands):
        law = laws.commands + ROW * e
        i, alone, begins = whole_at(law, ON), whole_at(law, ALONE), whole_at(law, BEGINS)
        for s in range(whole_at(law, SLOTS)):
            w = s % 3 if alone < 0 else alone
            last, now = interval[i, oldest + w], interval[i, w]
            if begins >= 0 and interval[0, 7] < np.inf:
                last += real_at(laws.commands_values, begins) * (now - last)
            there = alone < 0 or s % 3 == 0
            memory[whole_at(law, SLOT) + s] = last if there else 0.0
    past = np.zeros((laws.n_bodies, laws.width))
    for age in range(older - 1, -1, -1):
        now, before = PREVIOUS if age == 0 else 6 + 3 * age, 9 + 3 * age
        for i in range(len(past)):
            for w in range(3):
                past[i, w] = interval[i, now + w]
                past[i, PREVIOUS + w] = interval[i, before + w]
        remember(start, past.ctypes.data, laws, acted, memory.ctypes.data, held)


@inner
def bound(base, laws, i, under, state, torque, rest, speed, acted):  # type: ignore[no-untyped-def]
    """Return the greatest force of dry friction in the hinge of body ``i``, or under it."""
    k, data = len(acted) - MORE, acted.ctypes.data
    for e in range(laws.n_frictions):
        law = laws.frictions + ROW * e
        if whole_at(law, ON) == i and whole_at(law, UNDER) == under:
            acted[k, 0], acted[k, 1], acted[k, 2] = torque, rest, speed
            acted[k + 3, 0] = base
            call_law(
                whole_at(law, LAW), state.ctypes.data + 48 * i, data + 8 * ACTED * k,
                laws.frictions_values + 8 * whole_at(law, FIRST),
                data + 8 * ACTED * (k + 3),
            )  # fmt: skip
            base = max(acted[k + 3, 0], 0.0)
    return base


@inner
def states_before(batch, out, item, h):  # type: ignore[no-untyped-def]
    """Return the states (body, 6) before an interval of an item of ``out``."""
    p, t = item // len(batch.inputs), item % len(batch.inputs)
    if h > 0:
        return out[item, h - 1]
    return batch.start[p if len(batch.start) > 1 else 0, t]
