"""Worlds of threads, and a batch's items shared out among them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.physics import calls, compiled, flow, lockstep
from pbrl_ppl.physics.calls import pointers, still
from pbrl_ppl.physics.motion import work_of
from pbrl_ppl.physics.tree import MOST, tree_of
from pbrl_ppl.physics.world import World
from pbrl_ppl.state import Floats, Ints

#: Bodies are near each other within this multiple of their radii: a step of half a radius that
#: passes through the edge of a bounding circle ends in it.
_NEAR = 1.04


class Batch(NamedTuple):
    """What the rollouts take: see `compiled.rollout`."""

    given: tuple[Floats, ...]
    commands: Ints
    forces: Ints
    frictions: Ints
    slots: int
    held: int
    follows: NDArray[np.bool_]
    start: Floats
    inputs: Floats
    time_step: float
    counts: NDArray[np.int64]
    weights: Floats
    tolerance: float


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
        self._wheels = self._tree = None
        if self._name == "chipmunk":
            return
        self._wheels = lockstep.free_wheels(self.world)
        self._still = still(self.world, _NEAR if self._wheels is None else 1.0)
        if self._wheels is None:
            self._tree = tree_of(self.world)
        if self._tree is not None:
            self._work = work_of(self._tree, self.world.size)

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
        items, horizon = np.arange(first, last), batch.inputs.shape[1]
        begins = np.zeros(len(items), dtype=np.int64)
        tree = self._tree
        if tree is not None and batch.held > max(0, MOST - 1 - tree.size):
            tree = None  # laws' own numbers have no place beside the coordinates
        whole = self._wheels is None and tree is None
        while len(items):
            if self._wheels is not None:
                lockstep.rollout(self._wheels, self._still, batch, items, begins, out)
            elif tree is not None:
                flow.rollout(self._work, self._still, batch, items, begins, out)
            left = begins < horizon
            items, begins = items[left], begins[left]
            if len(items) and self._name == "contact-free":
                raise SimulationError(
                    f"engine 'contact-free': {len(items)} of {last - first} transitions have"
                    " contacts, or joints that the fast path lacks; use 'auto' or 'chipmunk'"
                )
            if len(items):
                self.world.check_steps()
            done = 0
            while done < len(items):
                done += compiled.rollout(
                    calls.FUNCTIONS, self.pointers, batch, items[done:], begins[done:], whole, out
                )
                if done < len(items):  # diverged: that world is spoilt, and the item is lost
                    out[items[done]], begins[done] = np.nan, horizon
                    self._renew()
                    done += 1
            left = begins < horizon
            items, begins = items[left], begins[left]


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
