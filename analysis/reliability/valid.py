"""Valid in, verdict out: drawn scenes and recordings through all commands.

Each case is drawn by its seed (`tests.helpers.drawn`) and goes through ``check``, then
``close-loop``, ``fit``, ``report``, ``simulate`` and ``plan``, each in a forked child. ``check``
may refuse it with one message; after it everything must end in a verdict. Results are lines of JSON
in ``out/reliability/valid.jsonl``; seeds that are there are not run again, and the same command
goes on after an interrupt. Run from the root of the repository::

    python -m reliability.valid --from 0 --to 100
    python -m reliability.valid --show 17 case/     # writes the case, prints its commands
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
if str(ROOT) not in sys.path:  # the drawn cases are shared with the tests
    sys.path.insert(0, str(ROOT))

from reliability.commands import Ran, run, warm  # noqa: E402
from tests.helpers.drawn import Case, drawn_case  # noqa: E402

#: Seconds that a command may take.
LIMIT = 900.0
#: What ``check`` says of a recording that the loop cannot split, and of a scene that it cannot fit.
ONE = "one trajectory: close-loop"
UNKNOWN = "close-loop needs them in the scene"


def commands(
    case: Case, recording: str, checked: str = ""
) -> list[tuple[list[str], tuple[int, ...]]]:
    """Return each command after ``check``, with the exit codes that are right.

    Where ``check`` said that there is one trajectory, the loop gets the recording again as the
    test; where it said that the loop needs to know which bodies are joined, there is none.
    """
    fitted = ["scene.toml", recording]
    test = ["--test", recording] if ONE in checked else []
    loop, method = "loop/after.nc", "map"
    if UNKNOWN in checked:
        loop, method = "map.nc", "laplace"
    listed = [
        (["close-loop", *fitted, *test, "--method", "laplace", "-o", "loop"], (0, 3)),
        (["fit", *fitted, "--method", method, "-o", "map.nc"], (0, 3)),
        (["report", loop, "-o", "r.html"], (0,)),
        (["simulate", loop, recording, "-o", "predicted.csv"], (0,)),
        (["plan", loop, *case.plan, "--nodes", "1000", "-o", "plan.csv"], (0, 1)),
    ]
    return listed[UNKNOWN in checked :]


def tried(case: Case, most: int, until: int) -> dict[str, object]:
    """Return what came of a case: its words, seconds, refusal or faults, and warnings.

    ``until``: how many commands are run after ``check``.
    """
    result: dict[str, object] = {"seed": case.seed, "most": most}
    result["about"] = case.about + case.suffix
    with tempfile.TemporaryDirectory(prefix="valid") as name:
        folder = Path(name)
        recording = case.write(folder)
        checked = run(["check", "scene.toml", recording], folder, LIMIT)
        result["check"] = round(checked.seconds, 1)
        fault = checked.fault((0, 2))
        said = _said(checked, "warning: ")
        if fault:
            return result | {"faults": {"check": fault}, "warnings": said}
        if checked.code == 2:
            return result | {"refused": _said(checked, "error: ")[0]}
        faults, seconds, peak = {}, {}, 0.0
        for argv, codes in commands(case, recording, checked.out)[:until]:
            if not all((folder / part).exists() for part in argv if part == "loop/after.nc"):
                continue  # the loop's fault is told
            ran = run(argv, folder, LIMIT)
            seconds[argv[0]], peak = round(ran.seconds, 1), max(peak, ran.peak)
            said += _said(ran, "warning: ")
            if fault := ran.fault(codes):
                faults[argv[0]] = fault + _where(ran)
    told = {"seconds": seconds, "peak": round(peak), "warnings": [*dict.fromkeys(said)]}
    return result | told | ({"faults": faults} if faults else {})


def _said(ran: Ran, beginning: str) -> list[str]:
    return [line for line in ran.err.splitlines() if line.startswith(beginning)]


def _where(ran: Ran) -> str:
    """Return the end of a traceback."""
    _, traceback, rest = ran.err.partition("Traceback (most recent call last)")
    return ": " + rest[-1500:] if traceback else ""


def results(path: Path) -> dict[int, dict[str, object]]:
    """Return the results so far by seed; the last of each counts."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {entry["seed"]: entry for entry in map(json.loads, lines)}


def kinds(entries: list[dict[str, object]]) -> Counter[str]:
    """Return the number of faults by command and kind."""
    faults = (entry.get("faults", {}) for entry in entries)
    found = (item for each in faults if isinstance(each, dict) for item in each.items())
    return Counter(f"{command}: {text.partition(':')[0]}" for command, text in found)


def show(seed: int, most: int, folder: Path) -> None:
    """Write a case into a folder, and print its commands."""
    folder.mkdir(parents=True, exist_ok=True)
    case = drawn_case(seed, most)
    recording = case.write(folder)
    print(f"# {case.about}\ncd {folder}\npbrl-ppl check scene.toml {recording}")
    for argv, _ in commands(case, recording):
        print(shlex.join(["pbrl-ppl", *argv]))


def main() -> None:
    """Run the seeds that have no result yet."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--from", dest="first", type=int, default=0, help="first seed")
    parser.add_argument("--to", type=int, default=500, help="seed after the last")
    parser.add_argument("--rows", type=int, default=2500, help="most rows of a case, rarely twice")
    parser.add_argument("--bodies", type=int, default=9, help="leave out cases of more")
    parser.add_argument("--until", type=int, default=9, help="commands after check")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no case after these")
    parser.add_argument("--again", action="store_true", help="run seeds with faults again")
    parser.add_argument("--show", nargs=2, metavar=("SEED", "FOLDER"), help="write a case")
    parser.add_argument("--output", type=Path, default=ROOT / "out" / "reliability" / "valid.jsonl")
    options = parser.parse_args()
    if options.show:
        show(int(options.show[0]), options.rows, Path(options.show[1]))
        return
    begin = time.monotonic()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    done = results(options.output)
    warm()
    for seed in range(options.first, options.to):
        if seed in done and not (options.again and done[seed].get("faults")):
            continue
        if time.monotonic() - begin > 60.0 * options.minutes:
            break
        case = drawn_case(seed, options.rows)
        if len(case.scene.moving) > options.bodies:
            continue
        entry = tried(case, options.rows, options.until)
        with options.output.open("a") as lines:
            lines.write(json.dumps(entry) + "\n")
        state = entry.get("faults") or entry.get("refused") or entry.get("seconds")
        print(seed, str(state)[:600], flush=True)
    entries = [e for s, e in results(options.output).items() if options.first <= s < options.to]
    faults = kinds(entries)
    refused = sum("refused" in entry for entry in entries)
    print(
        f"tries {len(entries)}, refused {refused}, faults {sum(faults.values())}"
        f" in {sum('faults' in entry for entry in entries)} cases: {dict(faults)}"
    )


if __name__ == "__main__":
    main()
