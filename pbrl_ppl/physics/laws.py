"""Laws of effects in the compiled loops: what acts on bodies, and what laws remember."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached, Command, Force, Friction, at_stage, holder
from pbrl_ppl.physics.calls import (
    call_law,
    from_place,
    inner,
    law_address,
    numbers_at,
    record_reader,
    start_of,
)
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH, Floats

#: Width of the window in which a command is evaluated, as a share of the interval.
WINDOW = 1e-7
#: Columns of what acts on a body: its command, the one of the interval before, the wrench, and when
#: it is; see :data:`pbrl_ppl.effects.effect.TIME`.
COMMAND, PREVIOUS, WRENCHES, TIME, INTERVAL, ACTED = 0, 3, 6, 9, 10, 12
#: Further rows of what acts: a law's command and its memory, and the wrench of a law of one number.
MORE = 4
#: A law: its address, body, and first parameter; its first number in the memory, and how many; the
#: address of what changes them (of a force, that of their rates), and of what a force begins with
#: (0: none); the component that is alone (-1: none); whether it is under a body; whether the
#: command jumps in an interval, at the fractional part of the first parameter; the parameter that
#: is the share of the first command that the memory begins with (-1: none); and the body that the
#: torque acts back on, relative to which the law sees angle and speed (-1: none).
LAW = np.dtype(
    [(name, np.int64) for name in ("law", "body", "first", "slot", "slots", "change", "begin")]
    + [(name, np.int64) for name in ("alone", "under", "jumps", "begins", "other")]
)
law_at = record_reader(LAW)


def law_tables(scene: Scene, effects: tuple[Attached, ...]) -> list[NDArray[np.void]]:
    """Return the records of command, force and friction laws, each of dtype `LAW`."""
    bodies, tables = [body.name for body in scene.moving], []
    for kind in (Command, Force, Friction):
        attached = at_stage(effects, kind)
        table = np.zeros(len(attached), dtype=LAW)
        table["alone"] = table["begins"] = table["other"] = -1
        first = slot = 0
        for law, one in zip(table, attached, strict=True):
            last = first + len(one.effect.parameters)
            law["body"], law["first"], law["slot"] = bodies.index(one.body), first, slot
            _fill(one.effect.stage, law, last - 1, holder(scene, one))
            first, slot = last + len(one.effect.constants), slot + law["slots"]
        tables.append(table)
    return tables


@singledispatch
def _fill(stage: object, law: np.void, last: int, other: int) -> None:
    """Set a law's fields, by its stage, its last parameter and what its body hangs on."""


@_fill.register
def _(stage: Command, law: np.void, last: int, other: int) -> None:
    law["law"], law["jumps"] = law_address(stage.law), stage.jumps
    if stage.remember is not None:
        law["change"], law["slots"] = law_address(stage.remember), 3 * stage.memory
    if stage.alone:
        law["alone"] = WRENCH.index(stage.alone)
    if stage.begins:
        law["begins"] = last
    if stage.reacts:
        law["other"] = other


@_fill.register
def _(stage: Force, law: np.void, last: int, other: int) -> None:
    law["law"] = law_address(stage.law)
    if stage.rate is not None:
        law["change"], law["slots"] = law_address(stage.rate), stage.memory
        law["begin"] = 0 if stage.begin is None else law_address(stage.begin)


@_fill.register
def _(stage: Friction, law: np.void, last: int, other: int) -> None:
    law["law"], law["under"] = law_address(stage.law), stage.under


#: Laws of a proposal: how many commands, forces and frictions; the addresses of their records, of
#: dtype `LAW`, and of their parameters. Then how many numbers command laws remember, and force laws
#: have of their own; the number of bodies, the columns of a body's inputs and the interval (s).
LAWS = np.dtype(
    [(name, np.int64) for name in ("n_commands", "commands", "commands_values")]
    + [(name, np.int64) for name in ("n_forces", "forces", "forces_values")]
    + [(name, np.int64) for name in ("n_frictions", "frictions", "frictions_values")]
    + [(name, np.int64) for name in ("n_slots", "n_held", "n_bodies", "width")]
    + [("time_step", np.float64)],
    align=True,
)


def laws_of(
    tables: Sequence[NDArray[np.void]], values: Sequence[Floats], inputs: Floats, time_step: float
) -> NDArray[np.void]:
    """Return the record of each proposal's laws, shape (proposal,); the arrays must be kept.

    Parameters
    ----------
    tables : sequence of ndarray
        Records of commands, forces and frictions, shape (law,); see `law_tables`.
    values : sequence of ndarray
        Their parameters, shape (proposal, parameter).
    inputs : ndarray
        Shape (transition, H, body, column).
    time_step : float
        Length of an interval (s).
    """
    records = np.zeros(len(values[0]), dtype=LAWS)
    records["n_slots"], records["n_held"] = (table["slots"].sum() for table in tables[:2])
    records["n_bodies"], records["width"] = inputs.shape[2:]
    records["time_step"] = time_step
    kinds = ("commands", "forces", "frictions")
    for kind, rows, numbers in zip(kinds, tables, values, strict=True):
        records[f"n_{kind}"], records[kind] = len(rows), rows.ctypes.data
        places = numbers.strides[0] * np.arange(len(numbers))
        records[f"{kind}_values"] = numbers.ctypes.data + places
    return records


@inner
def act(state, inputs, laws, begin, end, acted, memory, held, rates):  # type: ignore[no-untyped-def]
    """Compute the wrench on each body in a substep: the command stage, then the force stage.

    Arrays are pointers to their numbers: ``state`` (body, 6), and ``inputs`` of the interval,
    (body, column); ``begin`` and ``end`` of the substep are shares of the interval. ``acted`` (body
    + 4, 12) becomes command, command before and wrench of each body; of the other rows a command
    law sees the first three. ``memory`` is that of command laws when the interval begins. ``held``
    has the numbers of force laws, and ``rates`` gets their rates of change.
    """
    _command(state, inputs, laws, begin, end, acted, memory, False)
    for e in range(laws.n_forces):
        law = law_at(laws.forces, e)
        on, at = from_place(acted, ACTED * law.body), from_place(state, 6 * law.body)
        values, sees = from_place(numbers_at(laws.forces_values), law.first), on
        if law.slots > 0:
            sees = from_place(acted, ACTED * laws.n_bodies)
            _see(sees, on, held, law)
            call_law(law.change, at, sees, values, from_place(rates, law.slot))
        call_law(law.law, at, sees, values, from_place(on, WRENCHES))


@inner
def _command(state, inputs, laws, begin, end, acted, memory, after):  # type: ignore[no-untyped-def]
    """Compute what is commanded of each body; ``after`` the interval, bring memory up to date."""
    known = laws.width > 3
    for i in range(laws.n_bodies):
        row, to = from_place(inputs, laws.width * i), from_place(acted, ACTED * i)
        for w in range(3):
            to[COMMAND + w] = row[w]
            to[PREVIOUS + w] = row[3 + w] if known else 0.0
            to[WRENCHES + w] = 0.0  # by how much actuators are turned, for now
        to[TIME] = row[7] + begin * laws.time_step if known else np.inf
        to[INTERVAL] = laws.time_step
    for e in range(laws.n_commands):
        _change(law_at(laws.commands, e), laws, state, begin, end, acted, memory, after)
    for i in range(laws.n_bodies):
        to = from_place(acted, ACTED * i)
        for w in range(3):
            to[WRENCHES + w] = to[COMMAND + w]
    for e in range(laws.n_commands):
        law = law_at(laws.commands, e)
        if law.other >= 0:
            acted[ACTED * law.other + WRENCHES + 2] -= acted[ACTED * law.body + COMMAND + 2]


@inner
def _see(seen, on, numbers, law):  # type: ignore[no-untyped-def]
    """Set what a law with numbers of its own sees: what acts on its body, and these."""
    for w in range(ACTED):
        seen[w] = on[w]
    for s in range(law.slots):
        seen[ACTED + s] = numbers[law.slot + s]


@inner
def _change(law, laws, state, begin, end, acted, memory, after):  # type: ignore[no-untyped-def]
    """Let a command law change the command on its body; see `act`."""
    seen = from_place(acted, ACTED * laws.n_bodies)
    on, at = from_place(acted, ACTED * law.body), from_place(state, 6 * law.body)
    values, wrench = from_place(numbers_at(laws.commands_values), law.first), on
    _see(seen, on, memory, law)
    seen[6], seen[7] = begin, end
    by_itself = from_place(seen, 3 * ACTED)
    if law.alone >= 0:
        wrench = by_itself
        for w in range(3):
            seen[w] = seen[PREVIOUS + w] = wrench[w] = 0.0
        seen[0] = wrench[0] = on[law.alone]
        seen[PREVIOUS] = on[PREVIOUS + law.alone]
    if law.other >= 0:
        holder_at, relative = from_place(state, 6 * law.other), from_place(by_itself, 6)
        for d in range(6):
            relative[d] = at[d] - (holder_at[d] if d in (2, 5) else 0.0)
        at = relative
    call_law(law.law, at, seen, values, wrench)
    if law.alone >= 0:
        on[law.alone] = wrench[0]
    if after and law.slots > 0:
        call_law(law.change, at, seen, values, from_place(memory, law.slot))


@inner
def remember(state, inputs, laws, acted, memory):  # type: ignore[no-untyped-def]
    """Bring what command laws remember up to date after an interval; see `act`."""
    _command(start_of(state), inputs, laws, 1.0 - WINDOW, 1.0, start_of(acted), memory, True)


@inner
def begin_held(state, laws, acted, held):  # type: ignore[no-untyped-def]
    """Set the numbers of force laws where a transition begins."""
    for s in range(laws.n_held):
        held[0, s] = held[1, s] = 0.0
    seen = from_place(start_of(acted), ACTED * laws.n_bodies)
    for e in range(laws.n_forces):
        law = law_at(laws.forces, e)
        if law.begin != 0:
            at = from_place(start_of(state), 6 * law.body)
            values = from_place(numbers_at(laws.forces_values), law.first)
            call_law(law.begin, at, seen, values, from_place(start_of(held), law.slot))


@inner
def set_memory(batch, laws, p, t, begin, start, acted, memory, at):  # type: ignore[no-untyped-def]
    """Set what command laws remember before the interval ``begin`` of the transition ``t``.

    ``memory[1]``, shape (slot,), depends on commands alone: those of all intervals that follow each
    other in the recording up to this one, at the state ``start`` (body, 6). ``memory[0]`` is that
    before the first interval of the transition ``at[1]`` of the proposal ``at[0]``.
    """
    if laws.n_slots == 0:
        return
    inputs, first = batch.inputs, t
    while batch.follows[first] and not (at[0] == p and at[1] == first):
        first -= 1
    if not (at[0] == p and at[1] == first):
        _begin_memory(laws, inputs[first, 0], start, acted, memory[0])
    before_first, now = start_of(memory), from_place(start_of(memory), laws.n_slots)
    for earlier in range(first, t):
        for h in range(inputs.shape[1]):
            remember(start, start_of(inputs[earlier, h]), laws, acted, before_first)
    at[0], at[1] = p, t
    for s in range(laws.n_slots):
        memory[1, s] = memory[0, s]
    for h in range(begin):
        remember(start, start_of(inputs[t, h]), laws, acted, now)


@inner
def _begin_memory(laws, interval, start, acted, memory):  # type: ignore[no-untyped-def]
    """Set what laws remember where nothing but the inputs (body, 9 or more) is known.

    As if the oldest wrench had lasted: the previous one, or the last of those before it.
    """
    older = (interval.shape[1] - 9) // 3
    oldest = PREVIOUS if older == 0 else 6 + 3 * older
    for e in range(laws.n_commands):
        law = law_at(laws.commands, e)
        for s in range(law.slots):
            w = s % 3 if law.alone < 0 else law.alone
            last, now = interval[law.body, oldest + w], interval[law.body, w]
            if law.begins >= 0 and interval[0, 7] < np.inf:
                last += numbers_at(laws.commands_values)[law.begins] * (now - last)
            there = law.alone < 0 or s % 3 == 0
            memory[law.slot + s] = last if there else 0.0
    past = np.zeros((laws.n_bodies, laws.width))
    for age in range(older - 1, -1, -1):
        now, before = PREVIOUS if age == 0 else 6 + 3 * age, 9 + 3 * age
        for i in range(len(past)):
            for w in range(3):
                past[i, w] = interval[i, now + w]
                past[i, PREVIOUS + w] = interval[i, before + w]
        remember(start, start_of(past), laws, acted, start_of(memory))


@inner
def bound(base, laws, i, under, state, torque, rest, speed, acted):  # type: ignore[no-untyped-def]
    """Return the greatest force of dry friction in the hinge of body ``i``, or under it."""
    seen = from_place(start_of(acted), ACTED * laws.n_bodies)
    most = from_place(seen, 3 * ACTED)
    for e in range(laws.n_frictions):
        law = law_at(laws.frictions, e)
        if law.body == i and law.under == under:
            seen[0], seen[1], seen[2], most[0] = torque, rest, speed, base
            values = from_place(numbers_at(laws.frictions_values), law.first)
            call_law(law.law, from_place(start_of(state), 6 * i), seen, values, most)
            base = max(most[0], 0.0)
    return base


@inner
def states_before(batch, out, item, h):  # type: ignore[no-untyped-def]
    """Return the states (body, 6) before an interval of an item of ``out``."""
    p, t = item // len(batch.inputs), item % len(batch.inputs)
    if h > 0:
        return out[item, h - 1]
    return batch.start[p if len(batch.start) > 1 else 0, t]
