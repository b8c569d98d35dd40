"""Name each law of actuators, friction and shape, recorded with a Runge-Kutta step of its own.

    python analysis/benchmarks/laws.py [NAME...] [--outside]
    python analysis/benchmarks/laws.py --clean FIRST LAST

Each case is an arm on a hinge or a puck on a table with one such law, pushed at random for eight
trajectories of five seconds; dry friction is smooth below 1 mm/s or mrad/s. ``pp.attribute`` names
laws with the whole catalogue. With ``--outside`` the loop is closed without the law's family, with
``--clean`` on recordings of these seeds that lack nothing.
"""

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import pbrl_ppl as pp
from pbrl_ppl.state import Floats

N, ROWS, STEP, FINE = 8, 101, 0.05, 100
MASS, LENGTH, G = 0.5, 0.3, 9.81
ARM = pp.Shape.box(0.04, LENGTH)
DISC = pp.Shape.circle(0.1)
#: Viscous friction of the hinge (N m s) and drag of the puck (kg/s), which are declared.
DAMPING, DRAG_COEFFICIENT = 0.03, 0.5
#: Moments of inertia about the hinge, and about the puck's centre (kg m^2).
HINGED = MASS * (ARM.unit_moment + (LENGTH / 2) ** 2)
CENTRAL = MASS * DISC.unit_moment


def sign(v: Floats) -> Floats:
    """Return a smooth sign."""
    return np.tanh(v / 1e-3)


@dataclass(frozen=True)
class Case:
    """A law in a rig.

    Parameters
    ----------
    torque : callable
        ``torque(z, u, t)``: what the law adds for states z (trajectory, 2 or 6), commands u, time.
    command : callable
        ``command(u, memory, dt)``: what the actuator does of the command, and its memory after.
    family : tuple of str
        Names that are left out with it.
    """

    rig: str = "arm"
    torque: Callable[[Floats, Floats, float], Floats] = lambda z, u, t: 0.0
    command: Callable[[Floats, Floats, float], Floats] | None = None
    measure: Callable[[Floats], Floats] = lambda z: z
    late: float = 0.0
    also: tuple[str, ...] = ()
    family: tuple[str, ...] = field(default=())


def along(z: Floats, u: Floats) -> Floats:
    """Return the speed along a push, (trajectory, 1)."""
    size = np.linalg.norm(u[:, :2], axis=1, keepdims=True)
    return (z[:, 3:5] * u[:, :2]).sum(1, keepdims=True) / np.maximum(size, 1e-12)


def pushes(x: Floats, y: Floats, torque: Floats | float = 0.0) -> Floats:
    """Return wrenches (trajectory, 3)."""
    return np.stack(np.broadcast_arrays(x, y, torque), axis=1)


def polar(z: Floats, along_x: float, along_y: float, power: int) -> Floats:
    """Return drag in the body's frame."""
    c, s = np.cos(z[:, 2]), np.sin(z[:, 2])
    a, b = c * z[:, 3] + s * z[:, 4], c * z[:, 4] - s * z[:, 3]
    a, b = -along_x * np.abs(a) ** (power - 1) * a, -along_y * np.abs(b) ** (power - 1) * b
    return pushes(c * a - s * b, s * a + c * b)


LATE = (
    "actuator_delay",
    "first_order_lag",
    "rate_limit",
    "torque_rate_limit",
    "actuator_backlash",
    "torque_backlash",
)
SHAPE = (
    "dead_zone",
    "torque_dead_zone",
    "torque_saturation",
    "saturation",
    "force_cutoff",
)
DRY = (
    "pivot_friction",
    "pivot_load_friction",
    "pivot_stribeck",
    "pivot_hysteresis",
)
ANGLE = (
    "torsion_spring",
    "upper_stop",
    "lower_stop",
    "cogging",
    "encoder_eccentricity",
)
DRAG = (
    "linear_drag",
    "quadratic_drag",
    "drag_by_axis",
    "quadratic_drag_by_axis",
    "wind",
)


def _lagged(u: Floats, f: Floats, dt: float) -> Floats:
    return u + (f - u) * np.exp(-dt / 0.15)


def _limited(most: float) -> Callable[[Floats, Floats, float], Floats]:
    def step(u: Floats, f: Floats, dt: float) -> Floats:
        off = u - f
        size = np.linalg.norm(off, axis=1, keepdims=True)
        return f + off * np.minimum(1.0, most * dt / np.maximum(size, 1e-12))

    return step


def _played(width: float) -> Callable[[Floats, Floats, float], Floats]:
    return lambda u, f, dt: np.minimum(np.maximum(f, u - width), u + width)


CASES = {
    "first_order_lag": Case(command=_lagged, family=LATE),
    "actuator_delay": Case(late=2.3, family=LATE),
    "torque_rate_limit": Case(command=_limited(2.0), family=LATE),
    "torque_backlash": Case(command=_played(0.08), family=LATE),
    "rate_limit": Case("puck", command=_limited(6.0), family=LATE),
    "actuator_backlash": Case("puck", command=_played(0.2), family=LATE),
    "pivot_stribeck": Case(
        torque=lambda z, u, t: -sign(z[:, 1:]) * (0.03 + 0.06 * np.exp(-((z[:, 1:] / 0.6) ** 2))),
        also=("pivot_friction",),
        family=DRY,
    ),
    "pivot_load_friction": Case(
        torque=lambda z, u, t: -sign(z[:, 1:]) * (0.2 * np.abs(u) + 0.1 * np.abs(_weight(z))),
        family=DRY,
    ),
    "quadratic_drag": Case(
        torque=lambda z, u, t: -0.004 * np.abs(z[:, 1:]) * z[:, 1:],
        family=(*DRAG, "quadratic_angular_drag"),
    ),
    "upper_stop": Case(torque=lambda z, u, t: -2.0 * np.maximum(z[:, :1] - 0.5, 0.0), family=ANGLE),
    "lower_stop": Case(torque=lambda z, u, t: 2.0 * np.maximum(-0.5 - z[:, :1], 0.0), family=ANGLE),
    "cogging": Case(torque=lambda z, u, t: 0.05 * np.sin(8 * z[:, :1]), family=ANGLE),
    "torque_saturation": Case(torque=lambda z, u, t: np.clip(u, -0.25, 0.25) - u, family=SHAPE),
    "torque_dead_zone": Case(torque=lambda z, u, t: -np.clip(u, -0.1, 0.1), family=SHAPE),
    "encoder_eccentricity": Case(measure=lambda z: z + 0.05 * np.sin(z), family=ANGLE),
    "drag_by_axis": Case("puck", lambda z, u, t: polar(z, 0.1, 0.6, 1), family=DRAG),
    "quadratic_drag_by_axis": Case("puck", lambda z, u, t: polar(z, 0.1, 0.5, 2), family=DRAG),
    "wind": Case("puck", lambda z, u, t: _blown(z), family=DRAG),
    "quadratic_angular_drag": Case(
        "puck",
        lambda z, u, t: pushes(0 * z[:, 0], 0 * z[:, 0], -3e-4 * np.abs(z[:, 5]) * z[:, 5]),
        family=("angular_drag", "quadratic_angular_drag"),
    ),
    "turning_friction": Case(
        "puck",
        lambda z, u, t: pushes(0 * z[:, 0], 0 * z[:, 0], -0.004 * sign(z[:, 5])),
        family=(
            "turning_friction",
            "sliding_friction",
            "angular_drag",
            "quadratic_angular_drag",
        ),
    ),
    "askew_camera": Case(
        "puck", measure=lambda z: _askew(z), family=("askew_camera", "sensor_scale")
    ),
}


def _weight(z: Floats) -> Floats:
    return -MASS * G * LENGTH / 2 * np.sin(z[:, :1])


def _blown(z: Floats) -> Floats:
    v = z[:, 3:5] - (1.0, -0.5)
    return pushes(*(-0.25 * np.linalg.norm(v, axis=1)[:, None] * v).T)


def _askew(z: Floats) -> Floats:
    seen = z.copy()
    seen[:, :2] /= 1.0 + 0.12 * z[:, :1] - 0.06 * z[:, 1:2]
    return seen


def scene(rig: str) -> pp.Scene:
    """Return the rig as a user would declare it."""
    known = {"mass": MASS, "r": 0.0, "mu_c": 0.0}
    if rig == "puck":
        puck = pp.Body("puck", DISC, known=known, effects=("linear_drag",))
        return pp.Scene(time_step=STEP, normal_gravity=G, bodies=(puck,))
    hinge = pp.Joint("hinge", ("arm", "world"), (0.0, LENGTH / 2), (0.0, 0.0))
    arm = pp.Body("arm", ARM, known=known, effects=("pivot_damping",))
    return pp.Scene(time_step=STEP, gravity=(0.0, -G), bodies=(arm,), joints=(hinge,))


def recorded(case: Case, seed: int) -> pp.History:
    """Return a recording of a case."""
    rng, arm = np.random.default_rng(seed), case.rig == "arm"
    held = np.repeat(rng.normal(size=(N, 13, 1 if arm else 3)), 8, axis=1)[:, : ROWS - 1]
    u = held * (0.2 if arm else np.array([0.7, 0.7, 0.01]))
    z = (
        rng.normal(size=(N, 2)) * (0.5, 1.0)
        if arm
        else rng.normal(size=(N, 6)) * (0.3, 0.3, 1, 0.4, 0.4, 2.0)
    )
    rows, dt, memory = [z.copy()], STEP / FINE, np.zeros_like(u[:, 0])

    def slope(z: Floats, u: Floats, t: float) -> Floats:
        if arm:
            total = u + _weight(z) - DAMPING * z[:, 1:] + case.torque(z, u, t)
            return np.hstack([z[:, 1:], total / HINGED])
        drag = DRAG_COEFFICIENT * z[:, 3:] * (1, 1, 0)
        return np.hstack([z[:, 3:], (u - drag + case.torque(z, u, t)) / (MASS, MASS, CENTRAL)])

    for k in range((ROWS - 1) * FINE):
        t = k * dt
        late = int(np.floor((k + 0.5) / FINE - case.late))
        now = u[:, late] if late >= 0 else 0.0 * u[:, 0]
        if case.command is not None:
            now = memory = case.command(now, memory, dt)
        a = slope(z, now, t)
        b = slope(z + 0.5 * dt * a, now, t + 0.5 * dt)
        c = slope(z + 0.5 * dt * b, now, t + 0.5 * dt)
        z = z + dt / 6 * (a + 2 * b + 2 * c + slope(z + dt * c, now, t + dt))
        if (k + 1) % FINE == 0:
            rows.append(z.copy())
    path = np.stack(rows, axis=1)
    states, wrenches = np.full((N, ROWS, 1, 6), np.nan), np.zeros((N, ROWS - 1, 1, 3))
    for i in range(ROWS):
        poses = case.measure(path[:, i, : 1 if arm else 3])
        columns = [2] if arm else [0, 1, 2]
        states[:, i, 0, columns] = poses + rng.normal(size=poses.shape) * (
            1e-3 if arm else (5e-4, 5e-4, 1e-3)
        )
    wrenches[:, :, 0, 2 if arm else slice(0, 3)] = u[..., 0] if arm else u
    return pp.History.of_arrays(states, scene(case.rig), wrenches)


def looped(case: Case, seed: int, catalogue: tuple[pp.Effect, ...]) -> pp.Loop:
    """Return the loop on a recording of a case, and another one as the test."""
    histories = [recorded(case, number) for number in (seed, seed + 1000)]
    return pp.close_loop(
        scene(case.rig), *histories, catalogue=catalogue, method="laplace", seed=1
    )  # fmt: skip


def left_out(names: list[str]) -> None:
    """Print what is said where a law's family is not in the catalogue."""
    said = 0
    for name in names:
        case, begin = CASES[name], time.monotonic()
        declared = {law for body in scene(case.rig).bodies for law in body.effects}
        gone = {name, *case.family} - declared
        rest = tuple(law for law in pp.catalogue if law.name not in gone)
        found = looped(case, 1, rest)
        said += found.verdict == "unexplained"
        laws = ", ".join(law.effect for law in found.added) or "nothing"
        took = time.monotonic() - begin
        print(f"{name:24s} {found.verdict:14s} names {laws} {took:.0f} s", flush=True)
    print(f"something is said to remain in {said} of {len(names)}")


def clean(first: int, last: int) -> None:
    """Print the verdicts of recordings that have what is declared and no more."""
    alarms = 0
    for seed in range(first, last):
        begin, rig = time.monotonic(), ("arm", "puck")[seed % 2]
        found = looped(Case(rig), seed, pp.catalogue)
        alarms += found.verdict != "adequate"
        laws = ", ".join(law.effect for law in found.added) or "nothing"
        took = time.monotonic() - begin
        print(f"{seed:3d} {rig} {found.verdict:14s} names {laws} {took:.0f} s", flush=True)
    print(f"{alarms} false alarms in {last - first}")


def named(names: list[str]) -> None:
    """Print what is named in each case."""
    right = 0
    for name in names:
        case, begin = CASES[name], time.monotonic()
        found = pp.attribute(scene(case.rig), recorded(case, 1), seed=1)
        laws = {law.effect: law for law in found.laws}
        hit = name in laws or name in {one for law in found.laws for one in law.not_separable_from}
        right += hit
        sizes = {k: f"{v:.4g}" for k, v in laws[name].estimate.items()} if name in laws else {}
        beside = ", ".join(sorted(set(laws) - {name, *case.also})) or "nothing"
        said, took = "named" if hit else "NOT", time.monotonic() - begin
        print(f"{name:24s} {said:6s}{sizes} beside: {beside} {took:.0f} s", flush=True)
    print(f"{right} of {len(names)}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    asked = [name for name in sys.argv[1:] if not name.startswith("-")]
    if "--clean" in sys.argv:
        clean(*map(int, asked))
    else:
        (left_out if "--outside" in sys.argv else named)(asked or list(CASES))
