"""Speed of the engine as ratios, both sides measured in turn in one run.

    python analysis/benchmarks/engine.py          # a table
    python analysis/benchmarks/engine.py --json   # one JSON object

Every ratio is the median of rounds in which the two sides follow each other, so that what else the
machine does in the meantime hits both.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numba
import numpy as np
import pymunk
import pytensor
import pytensor.tensor as pt

from pbrl_ppl import Body, History, Joint, Physics, Scene, Shape, SimulatorOp, Wall
from pbrl_ppl.effects import attach
from pbrl_ppl.history import fill_joints
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.parameters import Layout, box, differentiate
from pbrl_ppl.physics import PartedSimulator, Simulator, build_layout, calls, compiled
from pbrl_ppl.physics.world import World

MODELS = Path(__file__).parents[2] / "models"
APARTMENT = MODELS / "apartment" / "scene.toml"
RECORDED = MODELS / "shopping_cart"
G, TIME_STEP, SUBSTEPS, TRANSITIONS = 9.81, 0.1, 10, 100
#: Transitions of which what a call costs by itself is a small share.
MANY = 10_000
CART = {"mass": 8.0, "r": 0.2, "mu_c": 0.3, "w_x": -0.3, "w_y": 0.0, "w_theta": 0.1}
CART |= {"mu_x": 0.05, "mu_y": 0.4}
#: Effects of the commands' stage and of the forces', and their parameters.
EFFECTS = ("linear_drag", "constant_force", "actuator_delay")
SIZES = {"linear_drag_coefficient": 1.5, "actuator_delay_share": 0.3}
SIZES |= {"constant_force_force_x": 1.0, "constant_force_force_y": -1.0}
BOX = Shape.box(0.9, 0.55)
ROUNDS = 5


@dataclass(frozen=True)
class Row:
    """One ratio: what it compares, its bound, and how to measure both sides (s)."""

    key: str
    what: str
    bound: str
    above: Callable[[], float]
    below: Callable[[], float]
    offset: float = 0.0

    def measure(self) -> float:
        """Return the median over the rounds."""
        return float(np.median([self.above() / self.below() for _ in range(ROUNDS)])) + self.offset


def seconds(function: Callable[[], object], least: float = 0.1) -> float:
    """Return the time of one call: the mean over as many as take ``least`` seconds."""
    function()
    calls, begin = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - begin) < least:
        function()
        calls += 1
    return elapsed / calls


def timed(function: Callable[[], object]) -> Callable[[], float]:
    """Return a function that measures the given function's time."""
    return lambda: seconds(function)


# -- the worlds ------------------------------------------------------------------------------------


def cart_scene(wheel: bool = True, effects: tuple[str, ...] = ()) -> Scene:
    """Return a cart on a floor without walls, with a wheel by default."""
    cart = Body("cart", BOX, wheel=wheel, effects=effects)
    return Scene(time_step=TIME_STEP, substeps=SUBSTEPS, normal_gravity=G, bodies=(cart,))


def cart_data(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random initial states (n, 1, 6) and wrenches (n, 1, 1, 3)."""
    rng = np.random.default_rng(1)
    start = rng.normal(0, [3.0, 3.0, 1.5, 1.5, 1.5, 1.0], (n, 1, 6))
    return start, rng.normal(0, [40.0, 40.0, 5.0], (n, 1, 1, 3))


def hung(scene: Scene, start: np.ndarray) -> np.ndarray:
    """Return initial states (n, body, 6) that satisfy the hinges."""
    start = start.copy()
    for i, body in enumerate(scene.dynamic):
        if any(body.name in (joint.bodies or ()) for joint in scene.joints):
            start[:, i, [0, 1, 3, 4]] = np.nan  # they follow from theta and omega
    fill_joints(start[:, None], scene)
    return start


def apartment_data(scene: Scene, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states of moving furniture near its reference poses, pushes on all, and parameters."""
    rng = np.random.default_rng(2)
    k = len(scene.dynamic)
    start = rng.normal(0, [0.05, 0.05, 0.1, 0.5, 0.5, 0.5], (n, k, 6))
    start[..., :3] += [body.pose for body in scene.dynamic]
    layout = build_layout(scene)
    phi = np.array([prior.centre for prior in layout.priors])
    return phi, hung(scene, start), rng.normal(0, [60.0, 60.0, 10.0], (n, 1, k, 3))


def arms_scene() -> Scene:
    """Return two hinged arms in a vertical plane, with moments and centres of mass unknown."""
    effects = ("inertia_scale", "com_offset")
    bodies = (
        Body("upper", Shape.box(0.05, 0.2), effects=effects),
        Body("lower", Shape.box(0.05, 0.3), effects=effects),
    )
    joints = (
        Joint("hinge", ("upper", "world"), (0.0, 0.1), (0.0, 0.0)),
        Joint("hinge", ("upper", "lower"), (0.0, -0.1), (0.0, 0.15)),
    )
    return Scene(time_step=0.01, gravity=(0.0, -G), substeps=20, bodies=bodies, joints=joints)


def arms_sides(n: int) -> tuple[Callable[[], float], Callable[[], float]]:
    """Return timers of ``n`` transitions of the arms: contact-free fast path and engine."""
    scene = arms_scene()
    attached = attach(scene)
    layout = build_layout(scene, attached)
    phi = np.array([prior.centre for prior in layout.priors])
    rng = np.random.default_rng(4)
    start = np.zeros((n, 2, 6))
    start[..., 2], start[..., 5] = rng.normal(0, 1, (n, 2)), rng.normal(0, 4, (n, 2))
    start, actions = hung(scene, start), np.zeros((n, 1, 2, 3))
    actions[..., 2] = rng.normal(0, 0.3, (n, 1, 2))
    fast = Simulator(Physics(scene, attached))
    engine = Simulator(Physics(scene, attached, engine="chipmunk"))
    np.testing.assert_allclose(
        fast(phi, start, actions), engine(phi, start, actions), rtol=1e-9, atol=1e-9
    )
    return timed(lambda: fast(phi, start, actions)), timed(lambda: engine(phi, start, actions))


def naive(
    start: np.ndarray,
    actions: np.ndarray,
    values: Mapping[str, float] = CART,
    shape: Shape = BOX,
    walls: Sequence[Wall] = (),
    substeps: int = SUBSTEPS,
) -> np.ndarray:
    """Naive baseline: a new Space for each transition, stepped from Python."""
    out = np.empty((len(start), 1, 1, 6))
    step = TIME_STEP / substeps
    mass, wheel = values["mass"], (values["w_x"], values["w_y"])
    iterations = 10 if walls else 5
    for t, (state, action) in enumerate(zip(start[:, 0], actions[:, 0, 0], strict=True)):
        space = pymunk.Space()
        space.iterations = iterations
        body = pymunk.Body(mass, mass * shape.unit_moment)
        box = pymunk.Poly(body, shape.outline)
        box.elasticity, box.friction = values["r"], values["mu_c"]
        ground = space.static_body
        along_x, along_y = (pymunk.PinJoint(body, ground, wheel, (0, 0)) for _ in range(2))
        along_x.max_bias = along_y.max_bias = 0.0
        along_x.max_force = values["mu_x"] * mass * G
        along_y.max_force = values["mu_y"] * mass * G
        segments = [pymunk.Segment(ground, wall.start, wall.end, 0) for wall in walls]
        space.add(body, box, along_x, along_y, *segments)
        body.position, body.angle = (state[0], state[1]), state[2]
        body.velocity, body.angular_velocity = (state[3], state[4]), state[5]
        for _ in range(substeps):
            body.force, body.torque = (action[0], action[1]), action[2]
            theta = body.angle + body.angular_velocity * step
            here = pymunk.Vec2d(*wheel).rotated(theta) + body.position + body.velocity * step
            axis = pymunk.Vec2d(1.0, 0.0).rotated(theta + values["w_theta"])
            along_x.anchor_b, along_y.anchor_b = here + axis, here + axis.perpendicular()
            space.step(step)
        out[t, 0, 0] = (*body.position, body.angle, *body.velocity, body.angular_velocity)
    return out


@numba.njit(nogil=True)
def _prepare(fn, world, bodies, joints):  # type: ignore[no-untyped-def]
    compiled.set_properties(fn, world, bodies, joints)
    compiled.set_solver(fn, world, bodies, True)


@numba.njit(nogil=True)
def _bare(fn, world, start, step, substeps):  # type: ignore[no-untyped-def]
    body = world.bodies[0]
    for t in range(len(start)):
        calls.call2(fn.cpBodySetPosition, body, start[t, 0, 0], start[t, 0, 1])
        calls.call1(fn.cpBodySetAngle, body, start[t, 0, 2])
        calls.call2(fn.cpBodySetVelocity, body, start[t, 0, 3], start[t, 0, 4])
        calls.call1(fn.cpBodySetAngularVelocity, body, start[t, 0, 5])
        for _ in range(substeps):
            calls.call1(fn.cpSpaceStep, world.space, step)


def bare(simulator: Simulator, phi: np.ndarray, start: np.ndarray) -> Callable[[], None]:
    """Return the engine's bare C stepping of the same world from the same states."""
    world = World(simulator.physics.scene)
    world.space.iterations = world.iterations
    given = simulator._properties(phi[None])
    where = calls.pointers(world)
    _prepare(calls.FUNCTIONS, where, given.bodies[0, 0], given.joints[0])

    def run() -> None:
        _bare(calls.FUNCTIONS, where, start, TIME_STEP / SUBSTEPS, SUBSTEPS)
        if not world.bodies:  # the world must outlive its pointers
            raise RuntimeError

    return run


# -- the ratios ------------------------------------------------------------------------------------


def free_sides(
    n: int, wheel: bool = True, effects: tuple[str, ...] = ()
) -> tuple[Callable[[], float], Callable[[], float]]:
    """Return timers of ``n`` contact-free transitions, and of bare C stepping without effects."""
    start, actions = cart_data(n)
    simulators = []
    for acting in (effects, ()):
        scene = cart_scene(wheel, acting)
        attached = attach(scene)
        layout = build_layout(scene, attached)
        given = {block.name: (CART | SIZES)[block.name] for block in layout.blocks}
        simulators.append(
            (Simulator(Physics(scene, attached, extrapolate=False)), layout.to_vector(given))
        )
    (ours, phi), (theirs, known) = simulators
    return timed(lambda: ours(phi, start, actions)), timed(bare(theirs, known, start))


def free_rows(n: int = MANY) -> list[Row]:
    """Return rows of contact-free predictions: one thread, without extrapolation."""
    what = f"{n} contact-free transitions / bare C stepping: "
    return [
        Row("free_over_c", what + "with a wheel", "<= 0.15", *free_sides(n)),
        Row("free_plain_over_c", what + "without", "<= 0.10", *free_sides(n, wheel=False)),
        Row("free_effects_over_c",
            what + "with a wheel and three effects (the C stepping without these)", "<= 0.2",
            *free_sides(n, effects=EFFECTS)),
    ]  # fmt: skip


def jacobian_rows() -> list[Row]:
    """Return rows of the demo's Jacobian: as for a mode's covariance, and as in the search."""
    scene = Scene.load(RECORDED / "scene.toml").with_effects("cart", *EFFECTS)
    history = History.load(RECORDED / "recorded" / "train.csv", scene)
    problem = Problem.of(Physics.declare(scene), history)
    layout, sigma = problem.layout, problem.noise_prior[0]
    phi = layout.to_vector(CART | SIZES)
    lower, upper = box(layout.priors)
    steps, coarse = 1e-3 * layout.scale(phi), problem.coarse.physics.simulator

    def both(engine: PartedSimulator) -> Callable[[], float]:
        """The time of values and derivatives, the latter through an engine."""

        def run() -> None:
            problem.robust(phi, sigma)
            differentiate(lambda at: problem.robust(at, sigma, engine), phi, steps, lower, upper)

        return timed(run)

    value = timed(lambda: problem.robust(phi, sigma))
    what = f"residual of the demo's {history.n_transitions} transitions with its derivatives by"
    return [
        Row("jacobian_over_value", f"{what} {layout.size} parameters / the residual alone",
            "<= 10", both(problem.physics.simulator), value),
        Row("coarse_jacobian_over_value", "the same, derivatives with few engine steps, as in the"
            " search for modes", "", both(coarse), value),
    ]  # fmt: skip


def rows() -> list[Row]:
    """Return all ratios."""
    scene = cart_scene()
    layout = build_layout(scene)
    phi = layout.to_vector(CART)
    start, actions = cart_data(TRANSITIONS)
    many = cart_data(MANY)
    plain = Simulator(Physics(scene, extrapolate=False))
    usual = Simulator(Physics(scene))
    two = Simulator(Physics(scene, threads=2))
    np.testing.assert_allclose(
        plain(phi, start, actions), naive(start, actions), rtol=1e-9, atol=1e-9
    )
    proposals = phi * (1 + 0.01 * np.arange(30))[:, None]

    both = [bare(plain, phi, many[0]) for _ in range(2)]
    pool = ThreadPoolExecutor(2)

    apartment = Scene.load(APARTMENT)
    rooms = Simulator(Physics(apartment, extrapolate=False))
    furniture = apartment_data(apartment, TRANSITIONS)
    bodies = len(apartment.dynamic)

    return [
        Row("naive_over_ours",
            "Python loop, a new Space per transition / ours, with the same results", ">= 11",
            timed(lambda: naive(start, actions)),
            timed(lambda: plain(phi, start, actions))),
        Row("naive_over_default", "the same / ours with extrapolation, the default",
            "", timed(lambda: naive(start, actions)), timed(lambda: usual(phi, start, actions))),
        Row("ours_over_c", "ours / bare C stepping of the same world from the same states",
            "<= 1.7", timed(lambda: plain(phi, start, actions)), timed(bare(plain, phi, start))),
        *free_rows(),
        *jacobian_rows(),
        Row("two_threads", "two threads / one thread, throughput, 10,000 transitions",
            ">= 1.7", timed(lambda: usual(phi, *many)), timed(lambda: two(phi, *many))),
        Row("two_threads_c", "the same of the bare C stepping: the machine's limit", "",
            lambda: seconds(lambda: [run() for run in both]),
            lambda: seconds(lambda: list(pool.map(lambda run: run(), both)))),
        Row("linear", "10,000 transitions / 100 transitions",
            "<= 105", timed(lambda: usual(phi, *many)), timed(lambda: usual(phi, start, actions))),
        Row("apartment_per_body",
            f"{bodies}-body apartment, time per transition and body / single body", "<= 2",
            lambda: seconds(lambda: rooms(*furniture)) / bodies,
            timed(lambda: plain(phi, start, actions))),
        Row("chain_lane_over_engine", "3600 transitions of a double pendulum: fast path / engine",
            "<= 0.1", *arms_sides(3600)),
        Row("proposals_30", "30 proposals in one call / 30 calls",
            "<= 1.0", timed(lambda: usual(proposals, start, actions)),
            timed(lambda: [usual(proposal, start, actions) for proposal in proposals])),
        Row("op_overhead", "the Op / the rollout it wraps, minus one",
            "<= 5 %", *op_sides(scene, layout, phi, start, actions), offset=-1.0),
    ]  # fmt: skip


def op_sides(
    scene: Scene, layout: Layout, phi: np.ndarray, start: np.ndarray, actions: np.ndarray
) -> tuple[Callable[[], float], Callable[[], float]]:
    """Return timers of a compiled function of the Op and of the Simulator, at changing phi."""
    op = SimulatorOp(Physics(scene))
    variable = pt.dvector("phi")
    function = pytensor.function([variable], op(variable, start, actions), trust_input=True)
    wiggle = np.random.default_rng(3)

    def moved() -> np.ndarray:
        return phi * (1.0 + 1e-6 * wiggle.random())

    return (
        timed(lambda: function(moved())),
        timed(lambda: op.physics.predict(moved(), start, actions)),
    )


def touching(scene: Scene) -> float:
    """Return the share of the apartment's transitions with possible contacts."""
    phi, start, actions = apartment_data(scene, TRANSITIONS)
    plain, extrapolated = (
        Simulator(Physics(scene, extrapolate=extrapolate))(phi, start, actions)
        for extrapolate in (0, 1)
    )
    return float((plain == extrapolated).all(axis=(1, 2, 3)).mean())


def machine() -> str:
    """Return a line on the machine and the versions."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if "model name" in line]
        model = lines[0].split(":")[1].strip() if lines else model
    return (
        f"{model}, {os.cpu_count()} cores; Python {platform.python_version()},"
        f" pymunk {pymunk.version}, numba {numba.__version__}, numpy {np.__version__},"
        f" pytensor {version('pytensor')}"
    )


def main() -> None:
    """Measure and print all ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    as_json = parser.parse_args().json
    measured = {row.key: (row, row.measure()) for row in rows()}
    if as_json:
        print(json.dumps({key: value for key, (_, value) in measured.items()}))
        return
    print(f"{machine()}\n")
    print("| what | bound | measured |\n|---|---|---|")
    for key, (row, value) in measured.items():
        shown = f"{100 * value:.1f} %" if row.bound.endswith("%") else f"{value:.3g}"
        print(f"| {row.what} [`{key}`] | {row.bound} | {shown} |")
    share = touching(Scene.load(APARTMENT))
    print(
        f"\n{TRANSITIONS} transitions x {SUBSTEPS} substeps, one wheeled body, one thread unless it"
        f" says\notherwise; medians of {ROUNDS}. In the apartment, shapes come close enough to"
        f" touch in {100 * share:.0f} %\nof the transitions."
    )


if __name__ == "__main__":
    main()
