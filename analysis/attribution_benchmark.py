"""The scoreboard of attribution: whether the loop names what is missing, and nothing else.

    python analysis/attribution_benchmark.py --cache out/attribution     # hours; go on after Ctrl-C
    python analysis/attribution_benchmark.py --quick                     # a tenth of the cases
    python analysis/attribution_benchmark.py --only cart-linear_drag --verbose
    python analysis/attribution_benchmark.py --list
    python analysis/attribution_benchmark.py --measured double_pendulum push    # no cases: minutes

Box2D makes the data (models/shopping_cart/make_history.py): a cart on a wheel, a free puck and a
pendulum, each effect at three sizes; each with itself left out of the catalogue; effects that are
not in it; clean data; and logs that are nonsense. An oracle that knows what is hidden says which
cases can be told at all: scores are over those. Where the measured pendulum lies beside the
project, the loop's forecasts of it are told too (``--only`` leaves them out); those of the other
measured recordings take minutes each, and are told where ``--measured`` names them.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np
from attribution.cases import Case, a_tenth, all_cases
from attribution.measured import MEASURED, SHARED, SWING, pendulum_errors
from attribution.one_case import Row, cache_path, load, run_case, save, sources
from attribution.scores import score
from attribution.words import plain, score_table, table, told
from rich.console import Console

#: Seconds that a case takes a worker, before any has been timed.
SECONDS_A_CASE = 100.0
#: Cases after which a worker starts anew: compiled models add up in its memory.
CASES_A_WORKER = 20
_WIDTH = 170

say = partial(print, file=sys.stderr, flush=True)


def begin_worker() -> None:
    """Leave Ctrl-C to the process that stops the workers, and start chains as anywhere else."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, end_worker)
    # a spawned process would spawn its chains too, and each would load PyMC anew
    multiprocessing.set_start_method(None, force=True)


def end_worker(number: int, frame: object) -> None:
    """End the chains that a worker has begun, and the worker: they would wait for it for ever."""
    for child in multiprocessing.active_children():
        child.terminate()
    os._exit(1)


def results(
    cases: list[Case],
    executor: Executor,
    seed: int,
    draws: int | None,
    method: str,
    cache: Path | None,
) -> Iterator[Row]:
    """Rows as they are done; those in the cache are not made again."""
    waiting: dict[Future[Row], Case] = {}
    stale, now = 0, sources()
    for case in cases:
        kept = cache and load(cache_path(cache, case, seed, draws, method))
        if kept:
            stale += kept.sources != now
            yield kept
        else:
            waiting[executor.submit(run_case, case, seed, draws, method)] = case
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
            yield Row(case.name, case.kind, case.body, case.effect, error=why)
            continue
        row = future.result()
        if cache is not None:
            save(row, cache_path(cache, case, seed, draws, method))
        yield row


def in_batches(cases: list[Case], options: argparse.Namespace) -> Iterator[Row]:
    """Rows of all cases, with new workers from time to time.

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
            yield from results(
                batch, executor, options.seed, options.draws, options.method, options.cache
            )
        finally:
            executor.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()


def watched(rows: Iterator[Row], total: int, kept: int, verbose: bool) -> list[Row]:
    """Collect rows, telling progress and the time left; Ctrl-C keeps those that are done.

    The first ``kept`` of the ``total`` rows come from the cache, at once.
    """
    done: list[Row] = []
    begin = time.monotonic()
    try:
        for row in rows:
            done.append(row)
            a_row = (time.monotonic() - begin) / max(len(done) - kept, 1)
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
    """The cases asked for, shuffled: those done by an interrupted run stand for all."""
    cases = all_cases(options.repeats)
    if options.quick:
        cases = a_tenth(cases)
    if options.only:
        cases = [case for case in cases if any(part in case.name for part in options.only)]
    order = np.random.default_rng(options.seed).permutation(len(cases))
    return [cases[i] for i in order]


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of the cases")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="cases with this in their name")
    parser.add_argument(
        "--measured", nargs="+", choices=MEASURED, help="measured recordings, and no cases"
    )
    parser.add_argument("--list", action="store_true", help="print the cases' names and stop")
    parser.add_argument("--repeats", type=int, default=1, help="each case so often, new data each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--draws", type=int, help="posterior draws a chain; the loop's by default")
    parser.add_argument(
        "--method", default="metropolis", choices=("metropolis", "laplace"),
        help="laplace: no chains, intervals from the modes' Gaussians; in a quarter of the time",
    )  # fmt: skip
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--cache", type=Path, help="folder that keeps each case's result")
    parser.add_argument("--json", metavar="FILE", help="write scores and rows; - is stdout")
    parser.add_argument("--verbose", action="store_true", help="tell each case in full")
    options = parser.parse_args()
    for name in ("repeats", "workers"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} is {getattr(options, name)}, expected 1 or more")
    return options


def write(name: str | None, found: Mapping[str, object]) -> None:
    """Write what was found where it is asked for."""
    text = json.dumps(found, indent=1)
    if name == "-":
        print(text)
    elif name:
        Path(name).write_text(text + "\n")


def main() -> None:
    """Run the cases and print their table and scores."""
    options = parsed()
    console = Console(stderr=options.json == "-", width=None if sys.stdout.isatty() else _WIDTH)
    if options.measured:
        scores: dict[str, float | int | None] = {}
        for name in options.measured:
            say(f"the measured {name.replace('_', ' ')}")
            scores |= MEASURED[name](seed=options.seed)
        if None in scores.values():
            say(f"not all recordings are there, in {SHARED}")
        console.print(score_table(scores))
        write(options.json, scores)
        return
    cases = chosen(options)
    if not cases:
        sys.exit(f"no case has {' or '.join(options.only)} in its name; --list prints the names")
    if options.list:
        print("\n".join(sorted(case.name for case in cases)))
        return
    kinds = Counter(case.kind for case in cases)
    kept = 0
    if options.cache:
        settings = options.seed, options.draws, options.method
        made = [cache_path(options.cache, case, *settings).is_file() for case in cases]
        cases = [cases[i] for i in np.argsort(np.logical_not(made), kind="stable")]
        kept = sum(made)
    say(
        f"{len(cases)} cases ({', '.join(f'{n} {kind}' for kind, n in kinds.items())}),"
        f" {kept} of them in the cache; about"
        f" {_duration((len(cases) - kept) * SECONDS_A_CASE / options.workers)}"
    )
    rows = watched(in_batches(cases, options), len(cases), kept, options.verbose)
    scores = score(rows)
    if not options.only:
        say("the measured pendulum" + ("" if SWING.is_dir() else f": none at {SWING}"))
        scores |= pendulum_errors(seed=options.seed)
    console.print(table(rows), score_table(scores))
    ordered = sorted(rows, key=lambda row: row.name)
    write(options.json, scores | {"rows": [plain(row) for row in ordered]})


if __name__ == "__main__":
    main()
