"""Worlds of threads, and a batch's items shared out among them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.physics import calls, compiled, lockstep
from pbrl_ppl.physics.calls import pointers
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import World
from pbrl_ppl.state import Floats

Laws = tuple[NDArray[Any], ...]


class Batch(NamedTuple):
    """What the rollouts take: see `compiled.rollout`."""

    given: tuple[Floats, ...]
    commands: Laws
    forces: Laws
    start: Floats
    inputs: Floats
    time_step: float
    counts: NDArray[np.int64]
    weights: Floats

    def by_speed(self) -> tuple[Batch, NDArray[np.intp]]:
        """The same with transitions in the order of their first body's speed, and that order.

        They are solved side by side: those that slide alike need as many iterations.
        """
        order = np.argsort((self.start[0, :, 0, 3:5] ** 2).sum(axis=-1), kind="stable")
        if self.given[0].shape[1] > 1:  # the bodies' numbers are those of each interval
            return self, np.arange(len(order))
        start, inputs = self.start[:, order], self.inputs[order]
        return self._replace(start=np.ascontiguousarray(start), inputs=inputs), order


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
        self.free = lockstep.free_world(self.world) if self._name != "chipmunk" else None
        self._joints = lockstep.joints_of(self.world)
        #: Whether friction under bodies is solved for many transitions side by side.
        self.slides = self.free is not None and len(self.free.patch_body) > 0

    def rollout(self, batch: Batch, first: int, last: int, out: Floats) -> None:
        """Predict the items ``first`` to ``last`` into ``out``, NaN where the engine diverges.

        Parameters
        ----------
        batch : Batch
            Of all bodies.
        first, last : int
            Of proposals x transitions.
        out : ndarray
            Shape (proposal * transition, H, body, 6).
        """
        items = np.arange(first, last)
        if self.free is not None and len(items):
            items = self._contact_free(self.free, batch, items, out)
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

    def _contact_free(
        self, world: lockstep.FreeWorld, batch: Batch, items: NDArray[np.int64], out: Floats
    ) -> NDArray[np.int64]:
        """Predict where bodies come near nothing, and return which items are left."""
        if world.chained.any():  # neighbours are to have about the same number of iterations
            mass = batch.given[0][:, 0, world.chained, COLUMN.mass]
            ratio = mass.max(axis=1) / mass.min(axis=1)
            items = items[np.argsort(ratio[items // len(batch.inputs)], kind="stable")]
        left = np.zeros(len(items), dtype=bool)
        lockstep.rollout(world, self._joints, batch, items, out, left)
        return np.sort(items[left])


def share_out(
    run: Callable[[Engine, int, int], None], engines: list[Engine], n: int, chunk: int = 512
) -> None:
    """Run ``n`` items, a thread an engine.

    Parameters
    ----------
    run : callable
        Runs the items from a first to before a last on an engine.
    engines : list of Engine
        One or more.
    n : int
        Number of items.
    chunk : int
        Items of a thread's chunk, at least: each costs as much Python as some hundred items.
    """
    workers = len(engines)
    if workers == 1:
        run(engines[0], 0, n)
        return
    # chunks, so that a thread which the machine slows down takes fewer of them
    chunks = min(4 * workers, max(workers, n // chunk))
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
