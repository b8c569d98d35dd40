"""Worlds of threads, and a batch's items shared out among them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.physics import calls, compiled, lockstep, lockstep_chain
from pbrl_ppl.physics.calls import pointers
from pbrl_ppl.physics.lockstep import free_bodies
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import World
from pbrl_ppl.state import Floats

Laws = tuple[NDArray[Any], ...]

#: Items of a thread's chunk, at least: each costs as much Python as some hundred items.
_CHUNK = 512
#: Items whose bodies' ways are kept at a time.
_BLOCK = 512


class Batch(NamedTuple):
    """What the rollouts take: see `compiled.rollout`."""

    given: tuple[Floats, ...]
    commands: Laws
    forces: Laws
    start: Floats
    inputs: Floats
    time_step: float
    normal_gravity: float
    counts: NDArray[np.int64]
    weights: Floats

    def alone(self) -> tuple[Batch, ...]:
        """What each body sees."""
        k = self.start.shape[-2]
        return tuple(self._of_body(i) for i in range(k)) if k > 1 else (self,)

    def by_speed(self) -> tuple[Batch, NDArray[np.intp]]:
        """The same with transitions in the order of their first body's speed, and that order.

        They are solved side by side: those that slide alike need as many iterations.
        """
        order = np.argsort((self.start[0, :, 0, 3:5] ** 2).sum(axis=-1), kind="stable")
        if self.given[0].shape[1] > 1:  # the bodies' numbers are those of each interval
            return self, np.arange(len(order))
        start, inputs = self.start[:, order], self.inputs[order]
        return self._replace(start=np.ascontiguousarray(start), inputs=inputs), order

    def _of_body(self, i: int) -> Batch:
        bodies, *others = self.given
        return self._replace(
            given=(_column(bodies, i), *others),
            commands=_own(self.commands, i),
            forces=_own(self.forces, i),
            start=_column(self.start, i),
            inputs=_column(self.inputs, i),
        )


def _column(array: Floats, i: int) -> Floats:
    return np.ascontiguousarray(array[..., i : i + 1, :])


def _own(laws: Laws, i: int) -> Laws:
    addresses, owners, *others = laws
    mine = owners == i
    return (addresses[mine], np.zeros_like(owners[mine]), *(other[mine] for other in others))


class Engine:
    """A world of one thread, and where its C objects are.

    Parameters
    ----------
    build : callable
        Builds a world.
    name : str
        Which engine; see :class:`Physics`.
    """

    def __init__(self, build: Callable[[], World], name: str = "auto") -> None:
        self._build, self._name = build, name
        self._renew()

    def _renew(self) -> None:
        self.world = self._build()
        self.pointers = pointers(self.world)
        fast = self._name != "chipmunk"
        self.free = free_bodies(self.world) if fast else ()
        self.chain = lockstep_chain.chain_of(self.world) if fast else None
        #: Whether friction under bodies is solved for many transitions side by side.
        self.slides = any(len(free.ring) for free in self.free)

    def rollout(
        self, batch: Batch, alone: tuple[Batch, ...], first: int, last: int, out: Floats
    ) -> None:
        """Predict the items ``first`` to ``last`` into ``out``, NaN where the engine diverges.

        Parameters
        ----------
        batch : Batch
            Of all bodies.
        alone : tuple of Batch
            What each body sees, in their order; not needed in a world without free bodies.
        first, last : int
            Of proposals x transitions.
        out : ndarray
            Shape (proposal * transition, H, body, 6).
        """
        items = np.arange(first, last)
        if self.free:
            blocks = range(first, last, _BLOCK)
            left = [self._apart(alone, b, min(b + _BLOCK, last), out) for b in blocks]
            items = items[np.concatenate([np.zeros(0, dtype=bool), *left])]
        elif self.chain is not None and len(items):
            items = self._joined(self.chain, batch, items, out)
        if len(items) and self._name == "contact-free":
            raise SimulationError(
                f"engine 'contact-free': {len(items)} of {last - first} transitions have contacts,"
                " or joints that the fast path lacks; use 'auto' or 'chipmunk'"
            )
        while len(items):
            done = compiled.rollout(calls.FUNCTIONS, self.pointers, batch, items, out)
            if done < len(items):  # diverged: that world is spoilt, and the item is lost
                out[items[done]] = np.nan
                self._renew()
            items = items[done + 1 :]

    def _apart(
        self, alone: tuple[Batch, ...], first: int, last: int, out: Floats
    ) -> NDArray[np.bool_]:
        """Predict each body as if alone, and say in which items it is not."""
        left = np.zeros(last - first, dtype=bool)
        if len(self.free) == 1:
            no_trail = np.empty((0, 0, 2))
            lockstep.rollout(self.free[0], alone[0], first, last, out[first:last], left, no_trail)
            return left
        steps = alone[0].inputs.shape[1] * int(alone[0].counts.sum())
        trails = np.empty((len(self.free), last - first, steps, 2))
        for i, (free, batch) in enumerate(zip(self.free, alone, strict=True)):
            own = np.empty((last - first, *out.shape[1:2], 1, 6))
            lockstep.rollout(free, batch, first, last, own, left, trails[i])
            out[first:last, :, i] = own[:, :, 0]
        for i, j in combinations(range(len(self.free)), 2):
            reach = self.free[i].radius + self.free[j].radius
            lockstep.meet(trails[i], trails[j], reach, left)
        return left

    def _joined(
        self, chain: lockstep_chain.Chain, batch: Batch, items: NDArray[np.int64], out: Floats
    ) -> NDArray[np.int64]:
        """Predict joined bodies where they come near nothing, and say which items are left."""
        mass = batch.given[0][:, 0, chain.chained, COLUMN.mass]
        ratio = mass.max(axis=1) / mass.min(axis=1)  # as iterations go
        items = items[np.argsort(ratio[items // len(batch.inputs)], kind="stable")]
        left = np.zeros(len(items), dtype=bool)
        lockstep_chain.rollout(chain, batch, items, out, left)
        return np.sort(items[left])


def share_out(run: Callable[[Engine, int, int], None], engines: list[Engine], n: int) -> None:
    """Run ``n`` items, a thread an engine.

    Parameters
    ----------
    run : callable
        Runs the items from a first to before a last on an engine.
    engines : list of Engine
        One or more.
    n : int
        Number of items.
    """
    workers = len(engines)
    if workers == 1:
        run(engines[0], 0, n)
        return
    # chunks, so that a thread which the machine slows down takes fewer of them
    chunks = min(4 * workers, max(workers, n // _CHUNK))
    edges = np.linspace(0, n, chunks + 1).astype(int)
    idle: SimpleQueue[Engine] = SimpleQueue()
    for engine in engines:
        idle.put(engine)

    def serve(first: int, last: int) -> None:
        engine = idle.get()
        try:
            run(engine, first, last)
        finally:
            idle.put(engine)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(serve, edges[:-1], edges[1:]))
