"""Benchmark on typical recordings: positions alone, few and short trajectories.

    python analysis/recordings_benchmark.py --cache out/recordings      # go on after Ctrl-C
    python analysis/recordings_benchmark.py --cache out/recordings --part 1/2 --json scores.json
    python analysis/recordings_benchmark.py --only fall-30Hz --verbose
    python analysis/recordings_benchmark.py --seed 1 --list

A ball falls, a rod swings about a hinge, and a block slides on a line: simulated by closed forms
or SciPy's integrator at a relative tolerance of 1e-10, without an engine of the package. There are
144 cases: 3 worlds, 4 rates (10, 30, 100, 500 Hz), one trajectory of 40 rows or twelve of 30, with
white noise, quantised, or with 2 % of the rows off by 30 standard deviations; with drag (linear or
quadratic of a fall, viscous in the hinge, dry under the block) and without. Half of the blocks
start with a speed, half are commanded by a known force. Velocities are empty. The held-out
recording of one trajectory is a second one, that of twelve four more.

An oracle that knows the law and the noise says where the effect is detectable (likelihood ratio,
p < 1e-4). The table has, of each world, rate, shape and noise: named/detectable, and false
names/clean. A case is named if the right effect is added, alone or in a group that the data cannot
separate, and no other. Linear and quadratic drag are both right for a ball, and about a hinge
angular and linear drag are friction in the hinge. A clean case that is not called adequate counts
as a false name.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from recordings.cases import Case, all_cases
from recordings.one_case import Row, cache_path, load, run_case
from recordings.scores import brief, score, table, told
from running import part, save, sources

say = partial(print, file=sys.stderr, flush=True)


def kept(case: Case, options: argparse.Namespace) -> Row | None:
    """Return the row of a case from the cache, if any."""
    if options.cache is None:
        return None
    return load(cache_path(options.cache, case, options.seed, options.bare))


def made(case: Case, options: argparse.Namespace) -> Row:
    """Return the row of a case from the cache, or run it; failures are run again."""
    row = kept(case, options)
    if row is None or row.error is not None:
        row = run_case(case, options.seed, options.bare, options.limit)
        if options.cache is not None:
            save(row, cache_path(options.cache, case, options.seed, options.bare))
    return row


def chosen(options: argparse.Namespace) -> list[Case]:
    """Return the requested cases, shuffled, so that an interrupted run is representative."""
    cases = all_cases(options.seed)
    if options.only:
        cases = [case for case in cases if any(part in case.name for part in options.only)]
    order = np.random.default_rng(options.seed).permutation(len(cases))
    return [cases[i] for i in order]


def parsed() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="cases with this in their name")
    parser.add_argument("--list", action="store_true", help="print the cases' names and stop")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws other cases")
    parser.add_argument(
        "--part", type=part, default=(1, 1), metavar="I/N",
        help="run the I-th of N parts; all write to the same --cache, and the table has its rows",
    )  # fmt: skip
    parser.add_argument(
        "--bare", action="store_true",
        help="leave coordinates that never change empty, rather than 0: x alone, or x and y alone",
    )  # fmt: skip
    parser.add_argument(
        "--limit", type=int, default=300, help="seconds after which a case fails; 0 is none"
    )
    parser.add_argument("--cache", type=Path, help="folder that keeps each case's result")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write scores and rows")
    parser.add_argument("--verbose", action="store_true", help="print each case in full")
    options = parser.parse_args()
    for name in ("limit", "seed"):
        if getattr(options, name) < 0:
            parser.error(f"--{name} is {getattr(options, name)}, expected 0 or more")
    return options


def main() -> None:
    """Run the cases and print their table and scores."""
    options = parsed()
    cases = chosen(options)
    if not cases:
        sys.exit(f"no case has {' or '.join(options.only)} in its name; --list prints the names")
    if options.list:
        print("\n".join(sorted(case.name for case in cases)))
        return
    i, n = options.part
    mine, rows = cases[i - 1 :: n], []
    try:
        for number, case in enumerate(mine, 1):
            rows.append(made(case, options))
            say(f"{number}/{len(mine)} {(told if options.verbose else brief)(rows[-1])}")
    except KeyboardInterrupt:
        say(f"interrupted: {len(rows)} of {len(mine)} cases are done")
    names = {row.name for row in rows}
    others = (kept(case, options) for case in cases if case.name not in names)  # other parts'
    rows += [row for row in others if row is not None]
    stale = sum(row.sources != sources() for row in rows)
    if stale:
        say(f"{stale} rows are of other files of pbrl_ppl; name another --cache to make them again")
    scores = score(rows) | {"cases_not_run": len(cases) - len(rows)}
    print(table(rows), "", sep="\n")
    print("\n".join(f"- `{name}`: {_shown(value)}" for name, value in scores.items()))
    if options.json is not None:
        found = [asdict(row) for row in sorted(rows, key=lambda row: row.name)]
        options.json.write_text(json.dumps(scores | {"rows": found}, indent=1) + "\n")


def _shown(value: float | int | None) -> str:
    if value is None:
        return "no cases"
    return f"{value:.3g}" if isinstance(value, float) else f"{value}"


if __name__ == "__main__":
    main()
