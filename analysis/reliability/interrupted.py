"""Ctrl-C at random moments of every command: how long until its end, and what it leaves.

A try sends SIGINT to a command and its children, as a terminal does, at a moment drawn over its
measured duration. It must end within two seconds with 130 and one line that says what is kept,
without a traceback, a torn file or a process left; or have ended. A ``fit`` with chains and a
``close-loop`` that samples write what they have first: they take what that takes, or end within
two seconds of a second interrupt. ``python -m reliability.interrupted``, in ``analysis/``, goes on
after a stop.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

from reliability.commands import Ran, run, warm
from reliability.killed import (
    COMMANDS,
    ROOT,
    command,
    fresh,
    left_behind,
    prepare,
    torn,
    without_pictures,
    written,
)

#: Seconds until an interrupted command ends.
PATIENCE = 2.0
#: Commands that write what they have.
KEEPING = ("metropolis", "close-loop", "demo")


def judge(folder: Path, inputs: set[str], name: str, ran: Ran) -> list[str]:
    """Return what is wrong after an interrupt."""
    faults = [fault for file in written(folder, inputs) if (fault := torn(folder / file))]
    faults += [f"process left: {process}" for process in left_behind(ran.process)]
    if "Traceback" in ran.err:
        faults.append(f"traceback: {ran.err[-300:]}")
    if ran.code not in (0, 1, 3, 130):
        faults.append(f"exit code {ran.code}")
    told = ran.err.count("interrupted; ") + ran.err.count("interrupted: ")
    if ran.code == 130 and told != 1 and ran.err:  # while arguments are read nothing has begun
        faults.append(f"no line, or several: {ran.err[-300:]}")
    keeps = name in KEEPING and ("kept in" in ran.err or "once more" in ran.err)
    if ran.code == 130 and ran.after > PATIENCE and not keeps:
        faults.append(f"{ran.after:.1f} s until the end")
    return faults


def at(seconds: float) -> Callable[[float], bool]:
    """Return whether a moment has come."""
    return lambda elapsed: elapsed >= seconds


def main() -> None:
    """Run the tries that are not yet there, and print their sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "reliability")
    arguments = parser.parse_args()
    log, base = arguments.out / "interrupted.jsonl", arguments.out / "interrupted"
    warm()
    without_pictures()
    if not (base / "posterior.nc").exists():
        shutil.rmtree(base, ignore_errors=True)
        prepare(base)
    inputs = {path.name for path in base.iterdir()}
    log.touch()
    rows = {row["try"]: row for row in map(json.loads, log.read_text().splitlines())}
    for number in range(arguments.tries):
        draw = random.Random(f"{arguments.seed} {number}")
        name = draw.choice(arguments.only)
        if number in rows:
            continue
        timed = base / f".{name}.json"
        place = fresh(base, arguments.out / "interrupted-try")
        if not timed.exists():
            ran = run(command(name, False), place)
            timed.write_text(json.dumps(ran.seconds))
            place = fresh(base, arguments.out / "interrupted-try")
        moment = draw.uniform(0.0, json.loads(timed.read_text()))
        ran = run(command(name, False), place, kill=at(moment), by=signal.SIGINT)
        faults = judge(place, inputs, name, ran)
        row = {
            "try": number, "command": name, "code": ran.code, "moment": round(moment, 2),
            "after": round(ran.after, 2), "load": os.getloadavg()[0], "faults": faults,
        }  # fmt: skip
        rows[number] = row
        with log.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)
    shown = [row for row in rows.values() if row["try"] < arguments.tries]
    caught = sorted(row["after"] for row in shown if row["code"] == 130)
    print(
        f"{len(shown)} tries ({len(caught)} interrupted before their end),"
        f" {sum(bool(row['faults']) for row in shown)} faults; seconds until the end: median"
        f" {caught[len(caught) // 2]:.2f}, most {caught[-1]:.2f}"
    )


if __name__ == "__main__":
    main()
