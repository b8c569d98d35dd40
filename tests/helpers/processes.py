"""Calls for other processes that die there; without imports, which take each of them seconds."""

import os
import signal
from pathlib import Path


def dies(folder: str, times: int) -> int:
    """Dies so many times, then gives the process's number."""
    before = len(list(Path(folder).iterdir()))
    (Path(folder) / f"{before}").touch()
    if before < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()
