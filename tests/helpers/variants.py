"""The same recording written, placed, dated or scaled another way, and how results differ."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pbrl_ppl import Loop
from pbrl_ppl.history import History
from pbrl_ppl.scene import Recording, Scene
from pbrl_ppl.state import STATE
from tests.helpers.similar import factor, in_frame, similar, similar_history

#: Of each column of a history: another program's, its unit, and how large that is in SI units.
FOREIGN = {
    "time": ("stamp", "ms", 1e-3),
    "x": ("place_x", "mm", 1e-3),
    "y": ("place_y", "mm", 1e-3),
    "theta": ("heading", "deg", np.pi / 180),
    "vx": ("speed_x", "mm/s", 1e-3),
    "vy": ("speed_y", "mm/s", 1e-3),
    "omega": ("turning", "deg/s", np.pi / 180),
    "force_x": ("push_x", "mN", 1e-3),
    "force_y": ("push_y", "mN", 1e-3),
    "torque": ("twist", "mN mm", 1e-6),
}
#: In 2023 (ms since 1970).
EPOCH = 1.7e12


def in_other_units(history: History, scene: Scene, folder: Path) -> tuple[Scene, History]:
    """Return the history as it is read after another program wrote it, in full digits.

    Lengths are in mm, angles in degrees, times in milliseconds since 1970, forces in mN.
    """
    frame = history.to_dataframe()
    table = pd.DataFrame({"run": frame["trajectory"], "part": frame["body"]})
    for name, (column, _, size) in FOREIGN.items():
        table[column] = frame[name] / size + EPOCH * (name == "time")
    path = folder / "foreign.csv"
    table.map(lambda cell: repr(float(cell)) if isinstance(cell, float) else cell).to_csv(
        path, index=False
    )
    layout = Recording(
        columns={"trajectory": "run", "body": "part"}
        | {name: column for name, (column, _, _) in FOREIGN.items()},
        units={name: unit for name, (_, unit, _) in FOREIGN.items()},
    )
    return scene, History.load(path, scene.replace(recording=layout))


def nudged(history: History, scene: Scene, seed: int, share: float = 1e-13) -> History:
    """Return the history with each measurement changed by this share of itself, up or down."""
    rng, frame = np.random.default_rng(seed), history.to_dataframe()
    for name in STATE:
        frame[name] *= 1.0 + share * rng.choice([-1.0, 1.0], len(frame))
    return History.from_dataframe(frame, scene)


@dataclass(frozen=True)
class Variant:
    """A change of a recording that changes no answer.

    Parameters
    ----------
    change : callable
        Takes a history, its scene and a folder for files; returns the other scene and history.
    scales : tuple of float
        Factors of length, mass and time.
    """

    change: Callable[[History, Scene, Path], tuple[Scene, History]]
    scales: tuple[float, float, float] = (1.0, 1.0, 1.0)


def _nudge(seed: int) -> Variant:
    return Variant(lambda history, scene, folder: (scene, nudged(history, scene, seed)))


def _frame(**options: object) -> Variant:
    return Variant(lambda history, scene, folder: in_frame(history, scene, **options))


def scaled(length: float, mass: float, time: float) -> Variant:
    """Return the variant with other lengths, masses and times."""
    scales = (length, mass, time)
    return Variant(
        lambda history, scene, folder: (
            similar(scene, *scales),
            similar_history(history, scene, *scales),
        ),
        scales,
    )


#: Changes that apply to every recording; gravity and walls turn with the frame. Noise has a size
#: along x and one along y: another frame than a quarter turned one has another noise model.
VARIANTS: Mapping[str, Variant] = {
    "units": Variant(in_other_units),
    "digits-1": _nudge(1),
    "digits-2": _nudge(2),
    "epoch": _frame(later=1.7e9),
    "turns": _frame(turns=160),
    "far": _frame(shift=(1e6, -1e6)),
    "quarter": _frame(turn=np.pi / 2),
    "turned": _frame(turn=0.7),
    "mirrored": _frame(mirrored=True),
    "gram": scaled(0.1, 1e-3, 0.1),
    "milligram": scaled(0.01, 1e-6, 1e-3),
    "ship": scaled(10.0, 1e3, 10.0),
}


def answer(loop: Loop) -> dict[str, Any]:
    """Return the verdict, the laws with their sizes, and the held-out error, as of JSON."""
    laws = [
        {
            "effect": one.effect,
            "body": one.body,
            "beside": list(one.not_separable_from),
            "sizes": {name: [at.mean, at.sd, at.unit] for name, at in one.parameters.items()},
        }
        for one in loop.added
    ]
    return {"verdict": loop.verdict, "laws": laws, "error": loop.after.normalised_rmse}


def named(result: Mapping[str, Any]) -> dict[tuple[str, str], set[str]]:
    """Return the laws of an answer, each with those that are not separable from it."""
    return {(law["effect"], law["body"]): {*law["beside"]} for law in result["laws"]}


def changed_names(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Return laws of one answer that the other neither names nor reports as confounded."""
    pairs = ((named(first), named(second)), (named(second), named(first)))
    return [
        law
        for here, there in pairs
        for law, body in here
        if (law, body) not in there and not any(law in beside for beside in there.values())
    ]


def deviation(first: Mapping[str, Any], second: Mapping[str, Any], variant: Variant) -> float:
    """Return by how many standard deviations the posteriors of named laws differ, at most.

    Components of vectors, angles and places, which turn with the frame, are left out.
    """
    there, most = {(law["effect"], law["body"]): law["sizes"] for law in second["laws"]}, 0.0
    for law in first["laws"]:
        other = there.get((law["effect"], law["body"]), {})
        for name, (mean, sd, unit) in law["sizes"].items():
            if name in other and unit not in ("N", "rad", "m"):
                own, wide = (value / factor(unit, *variant.scales) for value in other[name][:2])
                sd = max(sd, 1e-300)
                most = max(most, abs(own - mean) / sd, abs(wide / sd - 1.0))
    return most
