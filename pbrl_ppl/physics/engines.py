"""Worlds of threads, and a batch's items shared out among them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

import numpy as np

from pbrl_ppl.physics.lockstep import free_body
from pbrl_ppl.physics.pointers import pointers
from pbrl_ppl.physics.world import World


class Engine:
    """A world of one thread, and where its C objects are."""

    def __init__(self, world: World) -> None:
        self.renew(world)

    def renew(self, world: World) -> None:
        """Take another world."""
        self.world, self.pointers, self.free = world, pointers(world), free_body(world)


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
