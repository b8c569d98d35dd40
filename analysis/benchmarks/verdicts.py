"""Verdicts of `pbrl-ppl close-loop` on physically similar rigs.

    python analysis/benchmarks/verdicts.py --cache out/verdicts    # resumes after Ctrl-C
    python analysis/benchmarks/verdicts.py --only cart-slope

Takes the five cart recordings beside the project and turns each into those of physically similar
rigs: other units of length, mass and time, every dimensionless number the same. Verdict, names and
sizes, in the cart's units, must be the cart's. Uses ``--method laplace``, one loop at a time, each
in a process of its own with ``--limit`` seconds; seconds are this machine's.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any

import pbrl_ppl as pp

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.helpers.similar import factor, similar, similar_history

#: Recordings beside the project, which holds no copy.
SHARED = Path(__file__).parents[3] / "shared"
#: Factors of length, mass and time: as it is, a fast one, a small one, a car and a ship.
SCALES = ((1, 1, 1), (1, 1, 0.01), (0.1, 0.001, 0.1), (10, 1000, 3), (100, 1e6, 10))


def closed(folder: Path, limit: float) -> dict[str, Any]:
    """Run the loop on a folder; return its report, or what the command said, and the seconds."""
    begin, before = time.perf_counter(), processor()
    with tempfile.TemporaryDirectory() as out:
        command = [Path(sys.executable).parent / "pbrl-ppl", "close-loop", folder / "scene.toml"]
        command += [folder / "train.csv", "--test", folder / "test.csv", "-o", Path(out) / "loop"]
        options = ["--method", "laplace", "--seed", "1", "--quiet"]
        try:
            done = subprocess.run(
                [*map(str, command), *options], capture_output=True, text=True, timeout=limit
            )
        except subprocess.TimeoutExpired:
            return {"verdict": f"none in {limit:g} s", "seconds": limit, "processor": limit}
        took = {"seconds": time.perf_counter() - begin, "processor": processor() - before}
        report = Path(out) / "loop" / "report.json"
        if not report.exists():
            return {"verdict": f"exit {done.returncode}: {done.stderr[-300:]}"} | took
        found = json.loads(report.read_text())
    kept = ("verdict", "added", "error")
    return {name: found[name] for name in kept} | took


def processor() -> float:
    """Return the processor time of ended child processes (s), which other work hardly changes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def scaled(case: Path, scales: tuple[float, float, float], out: Path) -> Path:
    """Write the recording of a similar rig; return its folder."""
    scene = pp.Scene.load(case / "scene.toml")
    for part in ("train", "test"):
        history = pp.History.load(case / f"{part}.csv", scene)
        similar_history(history, scene, *scales).save(out / f"{part}.csv")
    (out / "scene.toml").write_text(similar(scene, *scales).to_toml())
    return out


def sizes(found: dict[str, Any], scales: tuple[float, float, float] = (1, 1, 1)) -> dict[str, str]:
    """Return the added effects with their sizes in the units of the first rig, three digits."""
    return {
        f"{one['effect']} on {one['body']}": ", ".join(
            f"{name} {each['mean'] / factor(each['unit'], *scales):.4g}"
            for name, each in one["parameters"].items()
        )
        for one in found.get("added", [])
    }


def row(name: str, found: dict[str, Any], scales: tuple[float, float, float] = (1, 1, 1)) -> str:
    """Return a row of the table."""
    names = "; ".join(f"{name} ({size})" for name, size in sizes(found, scales).items())
    error = found.get("error", {})
    both = (error.get(each, {}).get("normalised_rmse") for each in ("before", "after"))
    errors = " -> ".join("" if each is None else f"{each:.3g}" for each in both)
    took = f"{found['seconds']:.0f} | {found['processor']:.0f}"
    return f"| {name} | {found['verdict']} | {names or 'nothing'} | {errors} | {took} |"


def main() -> None:
    """Run the loops and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="those with this in their name")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for a loop")
    parser.add_argument("--cache", type=Path, help="folder that keeps each result")
    options = parser.parse_args()
    if not SHARED.exists():
        sys.exit("the recordings beside the project are missing")
    carts = sorted(path.parent for path in SHARED.glob("data/cart-*/scene.toml"))
    print("| recording | verdict | named | error over noise | s | processor s |")
    print("|---|---|---|---|---|---|", flush=True)
    for scales, folder in product(SCALES, carts):
        name = f"{folder.name} x {' '.join(f'{scale:g}' for scale in scales)}"
        if options.only and not any(part in name for part in options.only):
            continue
        kept = options.cache and options.cache / f"{name}.json"
        if kept and kept.exists():
            found = json.loads(kept.read_text())
        else:
            with tempfile.TemporaryDirectory() as out:
                there = folder if scales == (1, 1, 1) else scaled(folder, scales, Path(out))
                found = closed(there, options.limit)
            if kept:
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_text(json.dumps(found))
        print(row(name, found, scales), flush=True)


if __name__ == "__main__":
    main()
