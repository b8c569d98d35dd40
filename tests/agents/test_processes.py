"""Processes for episodes: what they answer, how they end."""

import os
import time
from concurrent.futures import wait
from multiprocessing import active_children

import pytest

from pbrl_ppl.agents.processes import processes
from pbrl_ppl.errors import EpisodeError

pytestmark = pytest.mark.one_stack


def test_an_interrupt_ends_them_at_once() -> None:
    """Of the caller alone, while one is busy for a minute."""
    before, begin = set(active_children()), time.monotonic()
    with pytest.raises(KeyboardInterrupt), processes(2) as executor:
        pids = [executor.submit(os.getpid) for _ in range(2)]
        waiting = [executor.submit(time.sleep, 60.0) for _ in range(4)]
        wait(pids)
        raise KeyboardInterrupt
    for child in set(active_children()) - before:
        child.join(10.0)
    while not all(future.done() for future in waiting) and time.monotonic() - begin < 30.0:
        time.sleep(0.01)  # the executor's own thread cancels what waits
    assert all(future.done() for future in waiting) and time.monotonic() - begin < 30.0
    assert os.getpid() not in {each.result() for each in pids}


def test_a_process_that_dies() -> None:
    with pytest.raises(EpisodeError, match="ended before its call"), processes(1) as executor:
        executor.submit(os._exit, 1).result()
    with pytest.raises(EpisodeError, match="workers is 0"), processes(0):
        pass
