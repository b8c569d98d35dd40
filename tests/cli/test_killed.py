"""What a command that is killed leaves behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_stack

SCRIPT = """
import multiprocessing, time
from concurrent.futures import ThreadPoolExecutor
from pbrl_ppl.cli.close_loop import Each

class Sleeps(Each):
    def close(self, name, log):
        time.sleep(60.0)

if __name__ == "__main__":
    with ThreadPoolExecutor(1) as pool:
        pool.submit(Sleeps(*[None] * 5).apart, "log", None)
        while not multiprocessing.active_children():
            time.sleep(0.1)
        time.sleep({wait})
        print(multiprocessing.active_children()[0].pid, flush=True)
        time.sleep(60.0)
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="processes are listed there")
def test_a_worker_ends_with_its_parent(tmp_path) -> None:
    """A log's process went on for minutes, and then waited for ever, after a kill."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(wait=4.0))  # its initializer has begun by then
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = Path("/proc", parent.stdout.readline().strip())
        assert worker.exists()
        os.kill(parent.pid, signal.SIGKILL)
        until = time.monotonic() + 10.0
        while worker.exists() and time.monotonic() < until:
            time.sleep(0.05)
        left = worker.exists()
        if left:
            os.kill(int(worker.name), signal.SIGKILL)
        assert not left
