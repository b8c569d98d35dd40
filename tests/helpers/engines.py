"""Worlds for tests of all engine paths."""

import numpy as np

from pbrl_ppl.effects import catalogue
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics import Simulator
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.worlds import G, simulator

BOX = Shape.box(0.9, 0.55)
ARM = Shape.box(0.03, 0.4)
#: Friction in hinges.
PIVOT = [e for e in catalogue if e.name.startswith("pivot")]
TILT = [e for e in catalogue if e.name == "gravity_tilt"]
#: Without hinges there is no friction in them, without obstacles nothing to touch, a wheel is
#: declared, and bodies that are anywhere are on no rod.
_ELSEWHERE = ("pivot", "slider", "gravity", "hidden_obstacle", "wheel", "distance_joint", "encoder")
OTHERS = [e for e in catalogue if not e.name.startswith(_ELSEWHERE)]


def ring(half: float) -> tuple[Wall, ...]:
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    return tuple(Wall(corners[i - 1], corners[i]) for i in range(4))


def cart(walls: bool) -> tuple[Simulator, np.ndarray, np.ndarray]:
    """Return a wheeled cart with unknown parameters and all effects that apply."""
    scene = Scene(
        time_step=0.1,
        normal_gravity=G,
        bodies=(Body("cart", BOX, wheel=True),),
        walls=ring(2.0) if walls else (),
    )
    rng = np.random.default_rng(1)
    start = rng.normal(0, [0.8, 0.8, 1, 2, 2, 1], (40, 1, 6))
    if not walls:
        start[..., :2] *= 5.0
    actions = rng.normal(0, [12, 12, 2], (40, 3, 1, 3))
    return simulator(scene, tuple(OTHERS)), start, actions


def chain() -> tuple[Simulator, np.ndarray, np.ndarray]:
    """Return two hinged arms with friction in both pivots, and a motor on each."""
    scene = Scene(
        time_step=0.05,
        substeps=12,
        gravity=(0.0, -G),
        bodies=(Body("upper", ARM), Body("lower", ARM)),
        joints=(
            Joint("hinge", ("world", "upper"), (0.0, 0.0), (0.0, 0.18)),
            Joint("hinge", ("upper", "lower"), (0.0, -0.18), (0.0, 0.18)),
        ),
    )
    rng = np.random.default_rng(2)
    theta, omega = rng.normal(0, 1, (40, 2)), rng.normal(0, 3, (40, 2))
    place = 0.18 * np.stack([np.sin(theta), -np.cos(theta)], axis=-1)
    speed = omega[..., None] * 0.18 * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    place[:, 1] += 2 * place[:, 0]
    speed[:, 1] += 2 * speed[:, 0]
    start = np.concatenate([place, theta[..., None], speed, omega[..., None]], axis=-1)
    actions = rng.normal(0, [0, 0, 0.3], (40, 3, 2, 3))
    return simulator(scene, (*PIVOT, *TILT)), start, actions


def crowd() -> tuple[Simulator, np.ndarray, np.ndarray]:
    """Nine bodies in a small room, most in contact with several others."""
    shapes = (Shape.circle(0.1), Shape.box(0.2, 0.2))
    bodies = tuple(Body(f"b{i}", shapes[i % 2]) for i in range(9))
    scene = Scene(time_step=0.05, bodies=bodies, walls=ring(0.45))
    rng = np.random.default_rng(3)
    grid = np.array([(x, y) for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.0, 0.3)])
    start = rng.normal(0, [0.01, 0.01, 0.3, 2, 2, 2], (40, 9, 6))
    start[:, :, :2] += grid
    actions = rng.normal(0, [3, 3, 0.01], (40, 2, 9, 3))
    return simulator(scene), start, actions


def mixed() -> tuple[Simulator, np.ndarray, np.ndarray]:
    """A wheeled cart that drags an arm, a loose puck, a post and walls."""
    scene = Scene(
        time_step=0.1,
        normal_gravity=G,
        bodies=(
            Body("cart", BOX, wheel=True),
            Body("arm", ARM),
            Body("puck", Shape.circle(0.15), wheel=True),
            Body("post", Shape.circle(0.2), static=True, pose=(1.5, 0.0, 0.0)),
        ),
        walls=ring(2.0),
        joints=(Joint("hinge", ("cart", "arm"), (-0.5, 0.0), (0.0, 0.18)),),
    )
    rng = np.random.default_rng(4)
    start = rng.normal(0, [0.2, 0.2, 0.2, 1, 1, 1], (40, 3, 6))
    start[:, 2, :2] += (0.9, 0.0)
    start[:, 1, :2] = start[:, 0, :2] + (-0.5, -0.18)
    actions = rng.normal(0, [20, 20, 0.5], (40, 3, 3, 3)) * np.array([1, 0.1, 0.3])[:, None]
    return simulator(scene, tuple(PIVOT)), start, actions


CASES = {
    "free": lambda: cart(walls=False),
    "walls": lambda: cart(walls=True),
    "chain": chain,
    "crowd": crowd,
    "mixed": mixed,
}


def proposals(layout: Layout, n: int) -> np.ndarray:
    """Parameters (n, p) of ordinary size."""
    rng = np.random.default_rng(5)
    phi = np.empty((n, layout.size))
    for i, (label, prior) in enumerate(zip(layout.labels, layout.priors, strict=True)):
        if label.startswith("mass"):
            phi[:, i] = rng.uniform(1, 3, n)
        elif label.startswith(("r[", "mu_")):
            phi[:, i] = rng.uniform(0.05, 0.6, n)
        elif label.startswith("inertia_scale"):
            phi[:, i] = rng.uniform(0.8, 1.2, n)
        elif label.startswith("pivot"):
            phi[:, i] = rng.uniform(0.0, 0.02, n)
        else:
            phi[:, i] = np.clip(0.1 * prior.sample(rng, n), *prior.support)
    return phi
