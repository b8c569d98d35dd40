"""Worlds of threads, and a batch's items shared out among them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import calls, compiled, lockstep
from pbrl_ppl.physics.lockstep import free_body
from pbrl_ppl.physics.pointers import pointers
from pbrl_ppl.physics.world import World

Array = NDArray[np.float64]


class Engine:
    """A world of one thread, and where its C objects are.

    Parameters
    ----------
    build : callable
        Builds a world.
    """

    def __init__(self, build: Callable[[], World]) -> None:
        self._build = build
        self._renew()

    def _renew(self) -> None:
        self.world = self._build()
        self.pointers, self.free = pointers(self.world), free_body(self.world)

    def rollout(self, shared: tuple[Any, ...], first: int, last: int, out: Array) -> None:
        """Predict the items ``first`` to ``last`` into ``out``, NaN where the engine diverges.

        Parameters
        ----------
        shared : tuple
            What both rollouts take: see `compiled.rollout`.
        first, last : int
            Of proposals x transitions.
        out : ndarray
            Shape (proposal * transition, H, body, 6).
        """
        items = np.arange(first, last)
        if self.free is not None:
            left = np.zeros(len(items), dtype=bool)
            lockstep.rollout(self.free, *shared, first, last, out, left)
            items = items[left]
        while len(items):
            done = compiled.rollout(calls.FUNCTIONS, self.pointers, *shared, items, out)
            if done < len(items):  # diverged: that world is spoilt, and the item is lost
                out[items[done]] = np.nan
                self._renew()
            items = items[done + 1 :]


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
    chunks = min(8 * workers, max(workers, n // 64))
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
