"""Kill -9 at random moments of every command that writes: no torn file, no lost result.

A try runs a command on a few short trajectories, in a folder that is new or holds an earlier
result, and kills its process alone: half of them at a moment drawn over the command's measured
duration, half within milliseconds of its first temporary file. Then every file under its final name
must be whole, those of the earlier result be it or the new one, and every process of the command
end within five seconds. ``python -m reliability.killed``, in ``analysis/``, goes on after a stop.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pandas as pd

from pbrl_ppl.history.files import COLUMNS
from reliability.commands import Ran, run, warm

ROOT = Path(__file__).parents[2]
#: Seconds after which the children of a killed command must have ended.
PATIENCE = 5.0
FIT = "fit scene.toml train.csv -o out.nc --draws 100"
#: Each command that writes, and its share of the tries: quick ones have more.
COMMANDS = {
    "map": (12, f"{FIT} --method map"),
    "laplace": (8, f"{FIT} --method laplace"),
    "importance": (8, f"{FIT} --method importance"),
    "metropolis": (8, f"{FIT} --method metropolis --tune 100 --chains 2"),
    "smc": (8, f"{FIT} --method smc"),
    "close-loop": (16, "close-loop scene.toml train.csv -o out --test test.csv --method laplace"),
    "many": (
        8,
        "close-loop scene.toml train.csv again.csv -o out --each --jobs 2 --method laplace",
    ),
    "report": (20, "report posterior.nc -o out.html"),
    "update": (8, "update posterior.nc test.csv -o out.nc"),
    "simulate": (20, "simulate posterior.nc test.csv -o out.csv"),
    "simulate-parquet": (16, "simulate posterior.nc test.csv -o out.parquet"),
    "simulate-netcdf": (16, "simulate posterior.nc test.csv -o out.nc"),
    "plan": (16, "plan posterior.nc --start 0,0,0 --goal 1,0,- -o out.csv --nodes 200"),
    "rehearse": (4, "rehearse scene.toml test.csv --noise x=0.01,y=0.01,theta=0.01 -o out.csv"),
    "new": (20, "new models/out.toml --from shopping_cart"),
    "demo": (4, "demo -o out"),
}


def prepare(base: Path) -> None:
    """Write the inputs of all commands: a puck that is pushed, against a drag, and a posterior."""
    (base / "models").mkdir(parents=True)
    (base / "scene.toml").write_text(
        "[world]\ntime_step = 0.1\n\n[[body]]\nname = 'puck'\nknown = { r = 0.5, mu_c = 0.3 }\n"
        "shape = { kind = 'circle', radius = 0.2 }\n"
    )
    generator, rows = np.random.default_rng(1), []
    for trajectory in range(6):
        pose, speed = generator.normal(size=(2, 3))
        for step in range(16):
            if step % 4 == 0:
                force = generator.normal(size=3) * (5, 5, 0.3)
            noise = generator.normal(size=6) * np.repeat((1e-3, 5e-3), 3)
            state = np.concatenate([pose, speed]) + noise
            rows.append([trajectory, step, 0.1 * step, "puck", *state, *force])
            change = force / (2.0, 2.0, 0.04) - np.array([0.4, 0.4, 0.0]) * speed
            pose, speed = pose + 0.1 * speed + 0.005 * change, speed + 0.1 * change
    table = pd.DataFrame(rows, columns=[*COLUMNS])
    for name in ("train", "again"):
        table[table["trajectory"] < 5].to_csv(base / f"{name}.csv", index=False)
    table[table["trajectory"] == 5].to_csv(base / "test.csv", index=False)
    ran = run(command("laplace", False), base)
    if ran.code not in (0, 3):
        raise SystemExit(ran.err)
    (base / "out.nc").rename(base / "posterior.nc")


def without_pictures() -> None:
    """Draw one pixel for each figure: pictures take most of the time, and write no file."""
    from pbrl_ppl.reporting import reports

    reports.picture = lambda plot, *data: "data:image/gif;base64,R0lGODlh"


def command(name: str, again: bool) -> list[str]:
    """Return the arguments of a command."""
    overwrite = ["--overwrite"] if again else []
    return [*COMMANDS[name][1].split(), *overwrite]


def fresh(base: Path, place: Path) -> Path:
    """Return a new folder with the inputs of all commands."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(base, place, ignore=shutil.ignore_patterns(".std*"))
    return place


def written(folder: Path, inputs: set[str]) -> dict[str, str]:
    """Return the digests of the files of a command by name: all but inputs and hidden ones."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    names = {str(path.relative_to(folder)): path for path in files}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in names.items()
        if name not in inputs and not any(part.startswith(".") for part in Path(name).parts)
    }


def torn(path: Path) -> str:
    """Return what is wrong with a file that a command wrote, or nothing."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".html":
            if not path.read_text().rstrip().endswith("</html>"):
                return f"{path.name}: no end"
        elif path.suffix == ".nc":
            with h5py.File(path) as file:
                file.visititems(lambda _, item: isinstance(item, h5py.Dataset) and item[()])
        elif path.suffix == ".parquet":
            pd.read_parquet(path)
        elif path.suffix == ".csv":
            if not path.read_text().endswith("\n"):
                return f"{path.name}: no end"
            pd.read_csv(path)
        elif path.suffix == ".toml":
            from pbrl_ppl import Scene

            Scene.load(path)
        else:
            return f"{path.name}: of what kind?"
    except Exception as error:
        return f"{path.name}: {type(error).__name__}: {error}"
    return ""


def of_session(leader: int) -> Iterator[int]:
    """Yield the processes of a session that run."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == leader and fields[0] != "Z":
                yield int(entry.name)


def left_behind(leader: int) -> list[str]:
    """Return what runs of a session after `PATIENCE`, and end it."""
    until = time.monotonic() + PATIENCE
    while (running := list(of_session(leader))) and time.monotonic() < until:
        time.sleep(0.05)
    names = []
    for process in running:
        try:
            names.append(Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")[-80:])
            os.kill(process, signal.SIGKILL)
        except OSError:
            continue
    return names


def moment(seconds: float, draw: random.Random, folder: Path) -> Callable[[float], bool]:
    """Return the moment of a kill: at random, or soon after a temporary file is there."""
    if draw.random() < 0.5:
        at = draw.uniform(0.0, seconds)
        return lambda elapsed: elapsed >= at
    wait, seen = draw.choice((0.0, draw.uniform(0.0, 0.05), draw.uniform(0.0, 0.5))), list[float]()

    def due(elapsed: float) -> bool:
        if not seen and elapsed > 0.05:
            hidden = (path for path in folder.rglob(".*") if not path.name.startswith(".std"))
            seen.extend([elapsed] if any(hidden) else [])
        return bool(seen) and elapsed >= seen[0] + wait

    return due


def judge(folder: Path, inputs: set[str], earlier: dict[str, str], ran: Ran) -> dict[str, object]:
    """Return the faults and the losses of a try, and what it left."""
    after = written(folder, inputs)
    faults = [fault for name in after if (fault := torn(folder / name))]
    faults += [f"process left: {name}" for name in left_behind(ran.process)]
    gone = [name for name in earlier if name not in after]
    # a set of files that a kill caught between two renames: the marker says so
    mixed = [name for name in gone if Path(name).name == "report.json"]
    lost = [name for name in gone if name not in mixed]
    parts = {Path(name).parent for name in after if Path(name).name == "report.json"}
    for part in parts & {Path(name).parent for name in earlier}:
        both = [name for name in earlier if Path(name).parent == part and name in after]
        if len({after[name] == earlier[name] for name in both}) > 1:
            faults.append(f"old and new files beside {part}/report.json")
    hidden = [
        str(path.relative_to(folder))
        for path in folder.rglob(".*")
        if not path.name.startswith(".std")
    ]
    return {"faults": faults, "losses": lost, "mixed": mixed, "left": hidden}


def main() -> None:
    """Run the tries that are not yet there, and print their sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "reliability")
    arguments = parser.parse_args()
    log, base = arguments.out / "killed.jsonl", arguments.out / "killed"
    warm()
    without_pictures()
    if not (base / "posterior.nc").exists():
        shutil.rmtree(base, ignore_errors=True)
        prepare(base)
    inputs = {path.name for path in base.iterdir()}
    log.touch()
    rows = {row["try"]: row for row in map(json.loads, log.read_text().splitlines())}
    results = arguments.out / "killed-results"
    for number in range(arguments.tries):
        draw = random.Random(f"{arguments.seed} {number}")
        (name,) = draw.choices(arguments.only, [COMMANDS[each][0] for each in arguments.only])
        if number in rows:
            continue
        whole = results / name
        timed = results / f"{name}.json"
        if not timed.exists():
            ran = run(command(name, False), fresh(base, whole))
            timed.write_text(json.dumps({"seconds": ran.seconds, "code": ran.code}))
            if ran.code not in (0, 1, 3):
                raise SystemExit(f"{name}: {ran.err}")
        again = draw.random() < 0.5
        place = fresh(whole if again else base, arguments.out / "killed-try")
        earlier = written(place, inputs) if again else {}
        if again:  # so that the new result differs from the earlier one
            for changed in (place / "train.csv", place / "test.csv"):
                pd.read_csv(changed).assign(x=lambda table: table["x"] + 1e-4).to_csv(
                    changed, index=False
                )
        seconds = json.loads(timed.read_text())["seconds"]
        ran = run(command(name, again), place, kill=moment(seconds, draw, place))
        row = {"try": number, "command": name, "again": again, "code": ran.code,
               "seconds": round(ran.seconds, 2), "error": ran.err[-300:] * (ran.code == 2),
               **judge(place, inputs, earlier, ran)}  # fmt: skip
        if draw.random() < 0.1 or (
            row["left"] and not again
        ):  # nothing stands in the next run's way
            then = run(command(name, bool(written(place, inputs))), place)
            row["next"] = fault = then.fault((0, 1, 3))
            row["faults"] += [f"the next run: {fault}"] if fault else []
        rows[number] = row
        with log.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)
    shown = [row for row in rows.values() if row["try"] < arguments.tries]
    faults, losses = (sum(bool(row[key]) for row in shown) for key in ("faults", "losses"))
    killed = sum(row["code"] == -signal.SIGKILL for row in shown)
    mixed, left = (sum(bool(row[key]) for row in shown) for key in ("mixed", "left"))
    print(
        f"{len(shown)} tries ({killed} killed before their end), {faults} faults, {losses} losses;"
        f" {mixed} sets without their marker, {left} left a temporary file"
    )


if __name__ == "__main__":
    main()
