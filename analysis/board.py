"""Board of all recordings beside the project: names of missing laws, right or wrong.

    python analysis/board.py                       # all, in turn; resumes after Ctrl-C
    python analysis/board.py cart pendulum-torque  # those with this in their names
    python analysis/board.py --raw                 # raw logs alone
    python analysis/board.py --page                # all, and the page On hardware

Measured rigs, simulated carts and pairs, and raw logs, which are read as a new user would: by
``pbrl-ppl new``, one edit of the scene, and the loop. Each runs in a process of its own, until
``--limit`` seconds of processor time. A line for each tells the judgement, the verdict, the names
that were added (confounded ones after a slash) and the processor seconds to the verdict:

- right: all laws that are physically there are named, and no other;
- partly: some of them, and no other; missed: none, and no other;
- wrong: a name is false;
- unexplained: what is named is right, and the loop says that more is missing;
- late: no verdict within the limit; failed: none at all.

Names that make the same data as a law are as good. Results of the same code are kept in the
``--cache``; a failed recording is run again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import sys
from collections import Counter
from pathlib import Path

from attribution.measured import (
    MEASURED,
    SEED,
    SHARED,
    Recording,
    Result,
    children,
    judgement,
    run,
)
from attribution.measured_page import PAGE, RESULTS, counts, write_page
from attribution.raw import RAW
from running import apart, cache_file, sources

#: Names that the catalogue has for what a truth.json leaves undeclared.
_CATALOGUED = {
    "linear_drag": "linear_drag",
    "offset_push": "push_offset",
    "slope": "constant_force",
    "thrust_bias": "body_force",
}
_METHODS = ("laplace", "importance", "smc")
#: Seconds on the clock for each of the processor: a process that sleeps has to end, too.
_PATIENCE = 10


def simulated() -> tuple[Recording, ...]:
    """Return the simulated recordings beside the project; those without a law are clean."""
    return tuple(map(_simulated, sorted(SHARED.glob("data/*/truth.json"))))


def _simulated(path: Path) -> Recording:
    truth = json.loads(path.read_text())
    hidden = dict(truth["undeclared"])
    body = hidden.pop("body", None)
    return Recording(
        path.parent.name,
        path.parent,
        body="" if body is None else truth["truth"]["bodies"][body]["name"],
        laws=tuple(_CATALOGUED[name] for name in hidden),
    )


def chosen(options: argparse.Namespace) -> list[Recording]:
    """Return the requested recordings."""
    every = RAW if options.raw else (*MEASURED, *simulated(), *RAW)
    names = options.names or [""]
    return [each for each in every if any(name in each.name for name in names)]


def result_of(recording: Recording, options: argparse.Namespace) -> tuple[Result, Path]:
    """Return the loop's result on a recording, kept or new, and its file."""
    settings = (sources(), options.method, SEED, *recording.inputs)
    path = cache_file(options.cache, recording.name, settings)
    kept = Result.load(path)
    if kept is None or kept.verdict == "failed" or is_short(kept, options.limit):
        path.unlink(missing_ok=True)
        path.with_suffix(".png").unlink(missing_ok=True)
        run_apart(recording, path, options)
        kept = Result.load(path)
    return kept, path


def is_short(result: Result, limit: int) -> bool:
    """Return whether a result is late by a limit that was shorter by more than a second."""
    return result.verdict == "late" and result.seconds < limit - 1


def run_apart(recording: Recording, path: Path, options: argparse.Namespace) -> None:
    """Run the loop on a recording in its own process; one that gives no verdict is a result."""
    method, limit, before = options.method, options.limit, children()
    try:
        apart(run, recording, path, method, limit, limit=_PATIENCE * limit)
    except (TimeoutError, ChildProcessError) as error:
        if path.is_file():  # it had a verdict
            print(f"{recording.name}: no forecasts: {error}", file=sys.stderr, flush=True)
            return
        seconds = children() - before
        # the system counts some seconds that are not counted for ended children
        spent = f"exit code {-signal.SIGXCPU}" in str(error)
        is_late = isinstance(error, TimeoutError) or spent or seconds > limit - 1
        seconds = max(seconds, limit) if spent else seconds
        why = f"no verdict in {limit} s" if is_late else f"{type(error).__name__}: {error}"
        verdict = "late" if is_late else "failed"
        Result.of(recording, method, verdict=verdict, error=why, seconds=seconds).save(path)


def line(recording: Recording, result: Result, limit: int) -> str:
    """Return a line of the board."""
    added = zip(result.added, result.names, strict=True)
    names = ", ".join(f"{'/'.join(group)} of {each['body']}" for each, group in added)
    told = names or "nothing" if result.error is None else " ".join(result.error.split())
    judged = judgement(recording, result, limit)
    return f"{recording.name:26} {judged:11} {result.verdict:13} {result.seconds:4.0f} s  {told}"


def parsed() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="recordings with this in a name")
    parser.add_argument("--limit", type=int, default=300, help="processor seconds to a verdict")
    parser.add_argument("--method", choices=_METHODS, default="laplace", help="of the posteriors")
    parser.add_argument("--cache", type=Path, default=Path("out/board"), help="keeps each result")
    parser.add_argument("--raw", action="store_true", help="raw logs alone")
    parser.add_argument(
        "--page", action="store_true",
        help="keep results of measured rigs in the docs, and write their page On hardware",
    )  # fmt: skip
    options = parser.parse_args()
    if options.limit < 1:
        parser.error(f"--limit is {options.limit}, expected 1 or more")
    return options


def main() -> None:
    """Run the loops and print the board."""
    options = parsed()
    if not SHARED.is_dir():
        print(f"the recordings are not part of the project: none at {SHARED}", file=sys.stderr)
        sys.exit(2)
    recordings = [each for each in chosen(options) if each.is_there]
    if not recordings:
        sys.exit(f"no recording has {' or '.join(options.names)} in its name")
    judged: Counter[str] = Counter()
    seconds = 0.0
    try:
        for recording in recordings:
            result, path = result_of(recording, options)
            judged[judgement(recording, result, options.limit)] += 1
            seconds += result.seconds
            print(line(recording, result, options.limit), flush=True)
            if options.page and recording in MEASURED:
                keep(result, path)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    print(f"{judged.total()} of {len(recordings)} recordings: {counts(judged)}; {seconds:.0f} s")
    if options.page:
        write_page()
        print(f"wrote {PAGE}", file=sys.stderr)


def keep(result: Result, path: Path) -> None:
    """Keep a result and its picture beside the page."""
    result.save(RESULTS / f"{result.name}.json")
    picture = RESULTS / f"{result.name}.png"
    picture.unlink(missing_ok=True)
    if path.with_suffix(".png").is_file():
        shutil.copyfile(path.with_suffix(".png"), picture)


if __name__ == "__main__":
    main()
