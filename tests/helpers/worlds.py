"""Bodies with known parameters, and a prediction in one call."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pbrl_ppl.effects import Attached, Effect, attach, catalogue
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.plain import simulator_of

G = 9.81  # m/s^2
BY_NAME = {effect.name: effect for effect in catalogue}


def body(name: str, shape: Shape, *, wheel: bool = False, **known: float) -> Body:
    """Return a body with known parameters: mass 1, no friction or restitution by default."""
    defaults = {"mass": 1.0, "r": 0.0, "mu_c": 0.0}
    if wheel:
        defaults |= {"w_x": 0.0, "w_y": 0.0, "w_theta": 0.0, "mu_x": 0.0, "mu_y": 0.0}
    return Body(name, shape, wheel=wheel, known=defaults | known)


def state(x=0.0, y=0.0, theta=0.0, vx=0.0, vy=0.0, omega=0.0) -> np.ndarray:
    """Return one body's state (6,)."""
    return np.array([x, y, theta, vx, vy, omega], dtype=float)


def simulator(scene: Scene, effects: tuple[Attached | Effect, ...] = (), **options) -> Simulator:
    """Return a simulator; ``engine`` may also be "python", the reference."""
    return simulator_of(Physics(scene, attach(scene, effects)), **options)


def predict(
    scene: Scene,
    start: Any,
    wrench: Any = 0.0,
    *,
    horizon: int = 1,
    effects: Mapping[str, Any] | None = None,
    phi: Any = None,
    **options: Any,
) -> np.ndarray:
    """States (horizon, body, 6) of one transition under a wrench that is held throughout.

    ``effects`` gives catalogue effects on every body they apply to, with the parameters' values;
    ``start`` is (body, 6) or (6,), ``wrench`` broadcasts to (body, 3).
    """
    named = dict(effects or {})
    sim = simulator(scene, tuple(BY_NAME[name] for name in named), **options)
    if phi is None:
        phi = phi_of(sim.physics.layout, named)
    k = len(scene.dynamic)
    start = np.asarray(start, dtype=float).reshape(1, k, 6)
    actions = np.broadcast_to(np.asarray(wrench, dtype=float), (1, horizon, k, 3))
    return sim(np.asarray(phi, dtype=float), start, actions)[0]


def phi_of(layout: Layout, named: Mapping[str, Any]) -> np.ndarray:
    """Phi from the effects' values: a number, or a tuple in the order of the parameters."""
    values = {}
    for name, given in named.items():
        effect = BY_NAME[name]
        for parameter, value in zip(effect.parameters, np.atleast_1d(given), strict=True):
            values[effect.variable(parameter)] = value
    return layout.to_vector(values)
