"""Step change of a body's mass at some trajectory or time."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

_LOOKS = 20


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    # the interval in which it happens has its share of it
    loaded = clock.after(parameters["time"]) * (clock.trajectory > parameters["trajectory"] - 0.5)
    properties["mass"] = properties["mass"] * (1.0 + (parameters["factor"] - 1.0) * loaded)


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """From some trajectory on, or in every trajectory from some time on."""
    data = history.dataset
    numbers = data["number"].to_numpy()
    last = float(np.nanmax(data["clock"].to_numpy()))
    begins = (
        np.unique(np.quantile(numbers[1:] - 0.5, np.linspace(0, 1, _LOOKS), method="nearest"))
        if len(numbers) > 1
        else np.zeros(0)
    )
    times = np.linspace(0, last, _LOOKS + 2)[1:-1]
    unknown = np.nan
    looks = [(unknown, begin, 0.0) for begin in begins] + [(unknown, 0.0, t) for t in times]
    return np.array(looks).reshape(-1, 3)


mass_change = Effect(
    "mass_change",
    (
        EffectParameter("factor", "1", Prior("log_normal", mu=0.0, sigma=0.5), null=1.0),
        EffectParameter("trajectory", "1", Prior("half_normal", sigma=100.0)),
        EffectParameter("time", "s", Prior("half_normal", sigma=100.0)),
    ),
    "the body is heavier or lighter from some trajectory, or some time, on: it carries a load",
    "a change point in the mass",
    Properties(_modify, timed=True),
    scan=_scan,
)
