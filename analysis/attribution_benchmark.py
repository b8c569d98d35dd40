"""Scoreboard of attribution: whether the loop names the missing effect and no other.

    python analysis/attribution_benchmark.py --cache out/attribution     # resumes after Ctrl-C
    python analysis/attribution_benchmark.py --cache out/attribution --part 1/3 --json board.json
    python analysis/attribution_benchmark.py --quick --method laplace    # a tenth of the cases
    python analysis/attribution_benchmark.py --only cart-linear_drag --verbose
    python analysis/attribution_benchmark.py --seed 1 --list             # other cases

Box2D and MuJoCo make the data. A seed draws the cases: bodies (carts on a wheel, free boxes,
pendulums, pairs, double pendulums), recordings, noises, and a hidden effect: one of the catalogue,
one removed from it, one outside it, or none; some logs are nonsense. An oracle that knows the
effect tests which cases are detectable; scores are over those. Every tenth case uses the loop's
default sampler, the others Laplace's approximation. Measured recordings are on `board.py`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from attribution.cases import METHODS, Case, a_tenth, all_cases
from attribution.one_case import Row, about, cache_path, load, run_case
from attribution.scores import score
from attribution.words import plain, score_table, table, told
from rich.console import Console
from running import begin_worker, part, save, sources

#: Seconds that a case takes a worker, before any has been timed.
SECONDS_A_CASE = 25.0
#: Cases after which a worker restarts: compiled models add up in its memory.
CASES_A_WORKER = 20
_WIDTH = 170


def say(text: str) -> None:
    """Print progress."""
    print(text, file=sys.stderr, flush=True)


def results(cases: list[Case], executor: Executor, options: argparse.Namespace) -> Iterator[Row]:
    """Yield rows as they finish; those in the cache are reused, except for failures."""
    waiting: dict[Future[Row], Case] = {}
    stale, now = 0, sources()
    seed, draws = options.seed, options.draws
    for case in cases:
        row = kept(case, options)
        if row and row.error is None:
            stale += row.sources != now
            yield row
        else:
            waiting[executor.submit(run_case, case, seed, draws, options.limit)] = case
    if stale:
        say(
            f"{stale} rows of the cache were made with other files of this version of pbrl_ppl;"
            " name another --cache to make them again"
        )
    for future in as_completed(waiting):
        case = waiting[future]
        error = future.exception()
        if error is not None:  # of the worker, not of the case
            cure = "it may be short of memory: run again with fewer --workers and the same --cache"
            why = f"{type(error).__name__}: {error}; {cure}"
            row = Row(**about(case), error=why)
        else:
            row = future.result()
        if options.cache is not None:
            save(row, cache_path(options.cache, case, seed, draws))
        yield row


def kept(case: Case, options: argparse.Namespace) -> Row | None:
    """Return the row of a case from the cache, if any."""
    if options.cache is None:
        return None
    return load(cache_path(options.cache, case, options.seed, options.draws))


def in_batches(cases: list[Case], options: argparse.Namespace) -> Iterator[Row]:
    """Yield the rows of all cases, with new workers from time to time.

    An executor's own ``max_tasks_per_child`` never ends on some versions of Python: all of its
    workers leave at once, and none comes.
    """
    size = CASES_A_WORKER * options.workers
    for begin in range(0, len(cases), size):
        executor = ProcessPoolExecutor(
            options.workers, multiprocessing.get_context("spawn"), initializer=begin_worker
        )
        batch = cases[begin : begin + size]
        try:
            yield from results(batch, executor, options)
        finally:
            executor.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()


def watched(rows: Iterator[Row], total: int, made: int, verbose: bool) -> list[Row]:
    """Collect rows and print progress and the remaining time; Ctrl-C keeps finished rows.

    The first ``made`` of the ``total`` rows come from the cache, at once.
    """
    done: list[Row] = []
    begin = time.monotonic()
    try:
        for row in rows:
            done.append(row)
            a_row = (time.monotonic() - begin) / max(len(done) - made, 1)
            left = (total - len(done)) * a_row
            say(
                f"{len(done)}/{total} {row.name}: {row.error or row.verdict}, {row.seconds:.0f} s;"
                f" about {_duration(left)} left"
            )
            if verbose:
                say(told(row))
    except KeyboardInterrupt:
        say(f"interrupted: {len(done)} of {total} cases are done")
    return done


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds > 5400 else f"{seconds / 60:.0f} min"


def chosen(options: argparse.Namespace) -> list[Case]:
    """Return the requested cases, shuffled, so that an interrupted run is representative."""
    cases = all_cases(options.seed, options.method)
    if options.quick:
        cases = a_tenth(cases)
    if options.only:
        cases = [case for case in cases if any(part in case.name for part in options.only)]
    order = np.random.default_rng(options.seed).permutation(len(cases))
    return [cases[i] for i in order]


def parsed() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of the cases")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="cases with this in their name")
    parser.add_argument("--list", action="store_true", help="print the cases' names and stop")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws other cases")
    parser.add_argument("--draws", type=int, help="posterior draws a chain; the loop's by default")
    parser.add_argument(
        "--method", choices=METHODS,
        help="of all cases; by default importance of each tenth, and laplace (no chains, intervals"
        " from the modes' Gaussians) of the others",
    )  # fmt: skip
    parser.add_argument(
        "--part", type=part, default=(1, 1), metavar="I/N",
        help="run the I-th of N parts; all write to the same --cache, and --json has what is there",
    )  # fmt: skip
    parser.add_argument(
        "--limit", type=int, default=180, help="seconds after which a case fails; 0 is none"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--cache", type=Path, help="folder that keeps each case's result")
    parser.add_argument("--json", metavar="FILE", help="write scores and rows; - is stdout")
    parser.add_argument("--verbose", action="store_true", help="tell each case in full")
    options = parser.parse_args()
    for name, least in (("workers", 1), ("limit", 0), ("seed", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name} is {getattr(options, name)}, expected {least} or more")
    return options


def write(name: str | None, found: Mapping[str, object]) -> None:
    """Write the results to the requested outputs."""
    text = json.dumps(found, indent=1)
    if name == "-":
        print(text)
    elif name:
        Path(name).write_text(text + "\n")


def main() -> None:
    """Run the cases and print their table and scores."""
    options = parsed()
    console = Console(stderr=options.json == "-", width=None if sys.stdout.isatty() else _WIDTH)
    cases = chosen(options)
    if not cases:
        sys.exit(f"no case has {' or '.join(options.only)} in its name; --list prints the names")
    if options.list:
        print("\n".join(sorted(case.name for case in cases)))
        return
    i, n = options.part
    mine = cases[i - 1 :: n]
    made = [bool((row := kept(case, options)) and row.error is None) for case in mine]
    mine = [mine[k] for k in np.argsort(np.logical_not(made), kind="stable")]
    kinds = Counter(case.kind for case in mine)
    say(
        f"{len(mine)} cases ({', '.join(f'{k} {kind}' for kind, k in kinds.items())}),"
        f" {sum(made)} of them in the cache; about"
        f" {_duration((len(mine) - sum(made)) * SECONDS_A_CASE / options.workers)}"
    )
    rows = watched(in_batches(mine, options), len(mine), sum(made), options.verbose)
    names = {row.name for row in rows}
    others = (kept(case, options) for case in cases if case.name not in names)
    rows += [row for row in others if row is not None]
    scores = score(rows) | {"cases_not_run": len(cases) - len(rows)}
    console.print(table(rows), score_table(scores))
    ordered = sorted(rows, key=lambda row: row.name)
    write(options.json, scores | {"rows": [plain(row) for row in ordered]})


if __name__ == "__main__":
    main()
