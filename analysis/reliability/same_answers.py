"""Check that a recording in other units, digits, frames, epochs or sizes has the same answer.

Each case is a recording: drawn by seed (a disc with a hidden drag or none), of the models (the
cart, the pendulum), or measured (folders with ``scene.toml``, ``train.csv`` and ``test.csv`` below
``--shared``). The loop is closed on it and on variants of it (`tests/helpers/variants.py`), with
Gaussians at the modes. A fault is another verdict, a named law that the other result neither names
nor reports as confounded, a posterior further off than the variant allows, or an exception.

    python analysis/reliability/same_answers.py --seeds 10
    python analysis/reliability/same_answers.py --seeds 0 --measured measured/quarter-drone
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl import History, Scene
from pbrl_ppl.errors import PbrlWarning

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.helpers.free_puck import Disc  # noqa: E402
from tests.helpers.variants import (  # noqa: E402
    VARIANTS,
    Variant,
    answer,
    changed_names,
    deviation,
)

#: Of measured recordings, whose scenes and laws need not be the same in another frame.
DIGITS = ("units", "digits-1", "digits-2")
#: Standard deviations by which posteriors of the same laws may differ: a millionth where digits
#: alone change, and more where they are lost, climbs end elsewhere, or the noise model is another.
BOUNDS = dict.fromkeys(DIGITS, 1e-6) | {"turned": 0.5}
NEAR = 1e-2

Recording = tuple[Scene, History, History]


def drawn(seed: int) -> Recording:
    """Return a disc's recording by seed: half with a hidden drag, a third of positions alone."""
    rng = np.random.default_rng(seed)
    drag = rng.choice([0.0, 1.0]) * 10.0 ** rng.uniform(-0.5, 0.5)
    shape = {"trajectories": int(rng.integers(3, 7)), "intervals": int(rng.integers(10, 25))}
    disc = Disc(**shape, drag=float(drag), hold=int(rng.integers(1, 4)), seed=seed)
    frame = disc.frame(rng)
    if seed % 3 == 2:
        frame[["vx", "vy", "omega"]] = np.nan
    history = History.from_dataframe(frame, disc.scene)
    return disc.scene, *history.split(0.25, seed)


def stored(folder: Path, trajectories: int | None = None) -> Recording:
    """Return a recording of a folder, or its first trajectories."""
    recorded = folder / "recorded" if (folder / "recorded").is_dir() else folder
    scene = Scene.load(folder / "scene.toml")
    parts = [History.load(recorded / f"{part}.csv", scene) for part in ("train", "test")]
    if trajectories is not None:
        parts = [part.select(range(min(trajectories, part.n_trajectories))) for part in parts]
    return scene, *parts


def cases(options: argparse.Namespace) -> Iterator[tuple[str, tuple[str, ...], Recording]]:
    """Return each case's name, its variants, and its recording."""
    for seed in range(options.seed, options.seed + options.seeds):
        yield f"disc-{seed}", tuple(options.variants or VARIANTS), drawn(seed)
    for name in options.models:
        chosen = tuple(options.variants or VARIANTS)
        yield name, chosen, stored(ROOT / "models" / name, options.trajectories)
    for name in options.measured:
        folder = Path(options.shared) / name
        if not (folder / "scene.toml").is_file():
            print(f"skipped {name}: {folder} has no scene.toml")
            continue
        yield name, tuple(options.variants or DIGITS), stored(folder)


def closed(recording: Recording, variant: Variant | None) -> dict[str, object]:
    """Return the loop's answer on a variant of a recording, and how long it took."""
    scene, *parts = recording
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PbrlWarning)
        try:
            if variant is not None:
                changed = [variant.change(part, scene, Path(folder)) for part in parts]
                scene, parts = changed[0][0], [part for _, part in changed]
            loop = pp.close_loop(scene, *parts, method="laplace", seed=1)
            result = answer(loop)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            result = {"exception": f"{error!r} at {Path(last.filename).name}:{last.lineno}"}
    return result | {"seconds": round(time.monotonic() - begin, 1)}


def judged(name: str, base: dict, result: dict) -> dict[str, object]:
    """Return what is wrong with a variant's answer, and how far its posterior is off."""
    if {"exception"} & {*base, *result}:
        alike = "exception" in base and "exception" in result
        return {"fault": "" if alike else result.get("exception", "no exception"), "off": 0.0}
    off = deviation(base, result, VARIANTS[name])
    fault = ""
    if lost := changed_names(base, result):
        fault = f"names: {', '.join(lost)}"
    elif result["verdict"] != base["verdict"]:
        fault = f"verdict: {result['verdict']}, not {base['verdict']}"
    elif off > BOUNDS.get(name, NEAR):
        fault = f"posterior: {off:.2g} sd"
    return {"fault": fault, "off": off}


def main() -> None:
    """Close the loop on each variant of each case that the output lacks, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="discs")
    parser.add_argument("--seed", type=int, default=0, help="of the first disc")
    parser.add_argument("--models", nargs="*", default=[], help="folders of models/")
    parser.add_argument("--trajectories", type=int, help="of models' recordings, at most")
    parser.add_argument("--measured", nargs="*", default=[], help="folders below --shared")
    parser.add_argument("--shared", default=str(ROOT.parent / "shared"))
    parser.add_argument("--variants", nargs="*", help=f"of {', '.join(VARIANTS)}")
    parser.add_argument("--out", type=Path, default=Path("out/reliability/same_answers.jsonl"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    done = {(line["case"], line["variant"]): line for line in map(json.loads, lines)}
    for case, variants, recording in cases(options):
        for name in ("", *variants):
            if (case, name) in done:
                continue
            line = {"case": case, "variant": name}
            line |= closed(recording, VARIANTS.get(name))
            if name:
                line |= judged(name, done[case, ""], line)
            done[case, name] = line
            with options.out.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(case, name, line.get("verdict"), line.get("fault", ""), flush=True)
    tried = [line for line in done.values() if line["variant"]]
    for name in dict.fromkeys(line["variant"] for line in tried):
        some = [line for line in tried if line["variant"] == name]
        faults = [line for line in some if line["fault"]]
        most = max(line["off"] for line in some)
        print(f"{name}: {len(some)} tries, {len(faults)} faults, posterior {most:.1e} sd off")
    faults = sum(bool(line["fault"]) for line in tried)
    print(f"{len(tried)} tries, {faults} faults, 0 losses")


if __name__ == "__main__":
    main()
