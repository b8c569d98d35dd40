"""Make a history of one rigid body with Box2D, an engine that pbrl_ppl does not use.

    python make_history.py --effect angular_drag=1.2 --seed 5 --out recorded

Forces, floor friction and damping are applied here, not by the engine, so an agreement with
pbrl_ppl is no tautology. Vectors of the plane are complex numbers: ``a.real`` is along x, a turn
by an angle is a product with ``exp(1j * angle)``.
"""

import argparse
import cmath
import math
import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

with warnings.catch_warnings():  # Box2D's generated wrapper warns on import under newer Pythons
    warnings.simplefilter("ignore", DeprecationWarning)
    import Box2D

NORMAL_GRAVITY = 9.81  # m/s^2
SINGLE = 3e-6  # m, rad: more than the engine's rounding, less than what a contact moves
RING = 12  # points of a ring of contact
# Box2D's tolerances are compiled in (b2_linearSlop 0.005, b2_velocityThreshold 1 length unit per
# second, below which nothing bounces). With the centimetre as unit of length they are 0.05 mm and
# 1 cm/s, too small to matter here.
CM = 100.0


@dataclass(frozen=True)
class Wheel:
    """Anisotropic Coulomb friction at a point of the body (m, m, rad, 1, 1)."""

    x: float
    y: float
    theta: float
    mu_x: float
    mu_y: float


@dataclass(frozen=True)
class Setup:
    """A box, the world it is in, and how it is pushed and measured; SI units.

    A ``noise`` of NaN says that the state dimension is not measured.
    """

    name: str
    size: tuple[float, float]
    mass: float
    r: float = 0.0
    mu_c: float = 0.0
    wheel: Wheel | None = None
    hinge: complex | None = None  # body point that is pinned to the world's origin
    gravity: float = 0.0  # in the plane, downwards
    room: float | None = None  # walls at +-room
    time_step: float = 0.1
    step: float = 0.001  # of the engine
    n_train: int = 12
    n_test: int = 4
    n_intervals: int = 30
    hold: int = 3  # intervals that a random wrench is held for
    wrench_sd: tuple[float, float, float] = (12.0, 12.0, 2.0)
    start_range: tuple[float, float, float] = (3.0, 3.0, math.pi)  # x, y, theta are uniform in +-
    start_sd: tuple[float, float, float] = (1.2, 1.2, 0.8)  # vx, vy, omega are normal
    noise: tuple[float, ...] = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)

    @property
    def inertia(self) -> float:
        """Moment of inertia about the centre under uniform density, kg m^2."""
        return self.mass * (self.size[0] ** 2 + self.size[1] ** 2) / 12


@dataclass(frozen=True)
class Effects:
    """Physics that a scene does not declare; every default is the null value."""

    linear_drag: float = 0.0  # kg/s
    quadratic_drag: float = 0.0  # kg/m
    angular_drag: float = 0.0  # N m s
    gravity_tilt: float = 0.0  # rad
    constant_force: tuple[float, float] = (0.0, 0.0)  # N, world frame
    body_force: tuple[float, float] = (0.0, 0.0)  # N, body frame
    constant_torque: float = 0.0  # N m
    push_offset: tuple[float, float] = (0.0, 0.0)  # m, body frame
    actuator_rotation: float = 0.0  # rad
    inertia_scale: float = 1.0
    pivot_friction: float = 0.0  # N m, Coulomb torque in the hinge
    pivot_damping: float = 0.0  # N m s
    sliding_friction: tuple[float, float] = (0.0, 0.0)  # mu, radius of the ring of contact (m)
    wheel: tuple[float, ...] = (0.0,) * 5  # as Wheel has it, beside the setup's
    actuator_delay: float = 0.0  # share of the interval by which the command is late
    dead_zone: float = 0.0  # N, taken from the force; a weaker one is lost
    force_cutoff: float = 0.0  # N, a weaker force is lost, a stronger one acts whole
    mass_change: tuple[float, float, float] = (1.0, 0.0, 0.0)  # factor, from trajectory, from s
    hidden_obstacle: tuple[float, float, float] = (0.0, 0.0, 0.0)  # disc: x, y, radius (m)
    # a rod from a body point to a place, and its length (m); bodies begin where it lets them
    distance_joint: tuple[float, ...] = (0.0,) * 5
    sensor_bias: tuple[float, ...] = (0.0,) * 6  # m, m, rad, m/s, m/s, rad/s
    heavy_tails: float = 0.0  # reciprocal of the degrees of freedom of the noise
    sensor_scale: tuple[float, float] = (1.0, 1.0)  # of lengths and of angles
    frame_rotation: float = 0.0  # rad, of the measuring frame
    force_gain: float = 1.0
    torque_gain: float = 1.0
    anisotropic_gain: tuple[float, float] = (1.0, 1.0)  # of the force along the world's x and y
    saturation: float = math.inf  # N, the largest force that the actuator has
    magnus_force: float = 0.0  # kg, F = c omega x v
    spring: tuple[float, float, float] = (0.0, 0.0, 0.0)  # N/m, to an anchor x, y (m)
    torsion_spring: tuple[float, float] = (0.0, 0.0)  # N m/rad, to an angle (rad)
    point_attractor: tuple[float, ...] = (0.0, 0.0, 0.0, 0.2)  # N m^2, to x, y, at a depth (m)
    # Outside pbrl_ppl's catalogue:
    cubic_drag: float = 0.0  # kg s/m^2, F = -c v^2 v
    corrugation: tuple[float, float] = (0.0, 1.0)  # N along x, as the sine of x over a length (m)
    swirl_drag: float = 0.0  # N s, a torque against turning that grows with the speed
    stiction_patch: float = 0.0  # extra isotropic Coulomb friction of the floor where x > 0
    time_varying_gain: tuple[float, float] = (0.0, 1.0)  # force times 1 + a sin(2 pi t / period)
    actuator_lag: float = 0.0  # s, time constant of a first-order lag of the command
    stribeck: tuple[float, float] = (0.0, 1.0)  # N at rest, decaying over a speed (m/s) as Gauss

    def __post_init__(self) -> None:
        for f in fields(self):
            got, expected = np.shape(getattr(self, f.name)), np.shape(f.default)
            if got != expected:
                raise ValueError(f"effect {f.name}: expected shape {expected}, got {got}")


CART = Setup(
    name="cart",
    size=(0.9, 0.55),
    mass=6.5,
    r=0.2,
    mu_c=0.3,
    wheel=Wheel(x=-0.25, y=0.0, theta=0.0, mu_x=0.04, mu_y=0.45),
    room=12.0,
)
PENDULUM = Setup(
    name="arm",
    size=(0.03, 0.4),
    mass=0.5,
    hinge=0.18j,
    gravity=9.81,
    time_step=0.02,
    n_train=8,
    n_test=3,
    n_intervals=100,
    wrench_sd=(0.0, 0.0, 0.0),  # it swings freely
    start_range=(0.0, 0.0, 1.5),
    start_sd=(0.0, 0.0, 2.0),
    noise=(math.nan, math.nan, 0.001, math.nan, math.nan, 0.02),
)
SETUPS = {"cart": CART, "pendulum": PENDULUM}


def dot(a: complex, b: complex) -> float:
    """Scalar product of two plane vectors."""
    return (a.conjugate() * b).real


def cross(a: complex, b: complex) -> float:
    """Out-of-plane part of the vector product of two plane vectors."""
    return (a.conjugate() * b).imag


def rollout(
    setup: Setup,
    start: np.ndarray,
    wrenches: np.ndarray,
    effects: Effects | None = None,
    trajectory: int = 0,
) -> np.ndarray:
    """Return the states (n + 1, 6) at the samples, noise-free, from start (6,) and wrenches (n, 3).

    A hinged body takes only theta and omega from ``start``; the hinge gives the rest.
    """
    effects = Effects() if effects is None else effects
    if setup.hinge is None and (effects.pivot_friction or effects.pivot_damping):
        raise ValueError("pivot_friction and pivot_damping act in a hinge, and the setup has none")
    factor, loaded_from, loaded_at = effects.mass_change
    wheels = [
        wheel
        for wheel in (setup.wheel, Wheel(*effects.wheel))
        if wheel is not None and (wheel.mu_x or wheel.mu_y)
    ]

    # Box2D kicks, then drifts. With positions held half a step ahead of the velocities that is the
    # leapfrog, of second order; read without it, positions are half a step's way too far.
    step = setup.step
    ahead = step / 2
    x, y, theta, vx, vy, omega = drift(setup.hinge, ahead, *(float(v) for v in start))
    down = -1j * setup.gravity * cmath.exp(1j * effects.gravity_tilt) * CM
    gravity = (down.real, down.imag)
    world = Box2D.b2World(gravity=gravity, doSleep=False, continuousPhysics=False)
    ground = world.CreateStaticBody()
    if setup.room is not None:
        a = setup.room * CM
        corners = [(-a, -a), (a, -a), (a, a), (-a, a)]
        for i in range(4):
            # The engine mixes friction as sqrt(product) and restitution as the maximum, so the
            # pair has the body's values when the wall has the same friction and no restitution.
            ground.CreateEdgeFixture(
                vertices=[corners[i - 1], corners[i]], friction=setup.mu_c, restitution=0.0
            )
    disc_x, disc_y, disc_radius = effects.hidden_obstacle
    if disc_radius:
        disc = Box2D.b2CircleShape(pos=(disc_x * CM, disc_y * CM), radius=disc_radius * CM)
        ground.CreateFixture(shape=disc, friction=setup.mu_c, restitution=0.0)
    body = world.CreateDynamicBody(
        position=(x * CM, y * CM),
        angle=theta,
        linearVelocity=(vx * CM, vy * CM),
        angularVelocity=omega,
    )
    half = (setup.size[0] * CM / 2, setup.size[1] * CM / 2)
    body.CreatePolygonFixture(box=half, density=1.0, friction=setup.mu_c, restitution=setup.r)
    if setup.hinge is not None:
        world.CreateRevoluteJoint(
            bodyA=ground,
            bodyB=body,
            localAnchorA=(0, 0),
            localAnchorB=(setup.hinge.real * CM, setup.hinge.imag * CM),
            enableMotor=effects.pivot_friction > 0,
            motorSpeed=0.0,
            maxMotorTorque=effects.pivot_friction * CM**2,
        )

    at, angle = complex(x, y), theta

    def state() -> list[float]:
        p, v = body.position, body.linearVelocity
        if setup.hinge is None:
            return [at.real, at.imag, angle, v.x / CM, v.y / CM, body.angularVelocity]
        return [p.x / CM, p.y / CM, body.angle, v.x / CM, v.y / CM, body.angularVelocity]

    states = [drift(setup.hinge, -ahead, *state())]
    steps = round(setup.time_step / step)
    before = np.vstack([np.zeros(3), wrenches])
    reached = np.zeros(3)
    for i in range(len(wrenches)):
        for j in range(steps):
            loaded = trajectory >= loaded_from and (i * steps + j) * step >= loaded_at
            mass = setup.mass * (factor if loaded else 1.0)
            inertia = setup.inertia * effects.inertia_scale * mass / setup.mass
            body.massData = Box2D.b2MassData(mass=mass, center=(0, 0), I=inertia * CM**2)
            wrench = before[i if j < effects.actuator_delay * steps else i + 1]
            if effects.actuator_lag:
                half = math.exp(-0.5 * step / effects.actuator_lag)  # to the middle of the step
                wanted, wrench = wrench, wrench + half * (reached - wrench)
                reached = wanted + half * (wrench - wanted)
            x, y, theta, vx, vy, omega = state()
            v, turn = complex(vx, vy), cmath.exp(1j * theta)
            time = (i * steps + j) * step
            here = (effects, wrench, complex(x, y), turn)
            force, torque = total_wrench(*here, v, omega, time)
            middle = v + force / mass * ahead, omega + torque / inertia * ahead
            force, torque = total_wrench(*here, *middle, time + ahead)
            v += force / mass * step
            omega += torque / inertia * step
            if effects.stiction_patch and x > 0:
                v *= 1 - min(1.0, effects.stiction_patch * NORMAL_GRAVITY * step / (abs(v) or 1.0))
            if effects.stribeck[0]:
                size, scale = effects.stribeck
                slowed = size * math.exp(-((abs(v) / scale) ** 2)) * step / mass
                v *= 1 - min(1.0, slowed / (abs(v) or 1.0))
            if effects.sliding_friction[0]:
                v, omega = rub(*effects.sliding_friction, step, mass, inertia, v, omega)
            for wheel in wheels:
                v, omega = roll(wheel, step, mass, inertia, turn, v, omega)
            if effects.distance_joint[4]:
                here = (complex(x, y), theta)
                v, omega = pull(effects.distance_joint, step, mass, inertia, *here, v, omega)
            body.linearVelocity = (v.real * CM, v.imag * CM)
            body.angularVelocity = omega
            world.Step(step, 20, 10)
            if setup.hinge is None:
                # Added up in the engine's single precision, places drift by up to 0.3 mm/s.
                shown, speed = complex(*body.position) / CM, complex(*body.linearVelocity) / CM
                on, turned = at + step * speed, angle + step * body.angularVelocity
                pushed = max(abs(shown - on), abs(body.angle - turned)) > SINGLE
                at, angle = (shown, body.angle) if pushed else (on, turned)
                body.transform = ((at.real * CM, at.imag * CM), angle)
            else:
                # The step moves the centre along its tangent; the engine's next solve would project
                # the old velocity on the new tangent and so lose energy, 2.5 % a second at 5 rad/s.
                _, _, vx, vy = hang(setup.hinge, body.angle, body.angularVelocity)
                body.linearVelocity = (vx * CM, vy * CM)
        states.append(drift(setup.hinge, -ahead, *state()))
    return np.array(states)


def drift(
    hinge: complex | None,
    time: float,
    x: float,
    y: float,
    theta: float,
    vx: float,
    vy: float,
    omega: float,
) -> list[float]:
    """Return the state after some time (s) without forces; a hinged body stays in its hinge."""
    theta += time * omega
    if hinge is not None:
        x, y, vx, vy = hang(hinge, theta, omega)
        return [x, y, theta, vx, vy, omega]
    return [x + time * vx, y + time * vy, theta, vx, vy, omega]


def hang(hinge: complex, theta: float, omega: float) -> tuple[float, float, float, float]:
    """Return where a hinged body's centre is (m) and how it moves (m/s)."""
    position = -hinge * cmath.exp(1j * theta)
    velocity = 1j * omega * position
    return position.real, position.imag, velocity.real, velocity.imag


def total_wrench(
    effects: Effects,
    wrench: np.ndarray,
    place: complex,
    turn: complex,
    v: complex,
    omega: float,
    time: float,
) -> tuple[complex, float]:
    """Return the force (N) and the torque (N m) on the body: the commanded ones and the effects."""
    amplitude, period = effects.time_varying_gain
    force = complex(wrench[0], wrench[1]) * cmath.exp(1j * effects.actuator_rotation)
    force *= max(0.0, 1 - effects.dead_zone / (abs(force) or 1.0))
    force *= abs(force) >= effects.force_cutoff
    force *= min(1.0, effects.saturation / (abs(force) or 1.0))
    force = complex(
        effects.anisotropic_gain[0] * force.real, effects.anisotropic_gain[1] * force.imag
    )
    force *= effects.force_gain * (1 + amplitude * math.sin(2 * math.pi * time / period))
    torque = float(wrench[2]) * effects.torque_gain
    torque += cross(turn * complex(*effects.push_offset), force)
    speed = abs(v)
    force -= (effects.linear_drag + effects.quadratic_drag * speed) * v
    force -= effects.cubic_drag * speed**2 * v
    wave, length = effects.corrugation
    force -= wave * math.sin(place.real / length)
    force += complex(*effects.constant_force) + turn * complex(*effects.body_force)
    force -= effects.spring[0] * (place - complex(*effects.spring[1:]))
    force += effects.magnus_force * omega * 1j * v
    strength, at_x, at_y, depth = effects.point_attractor
    if strength:
        way = complex(at_x, at_y) - place
        force += strength * way / (abs(way) ** 2 + depth**2) ** 1.5
    stiffness, rest = effects.torsion_spring
    torque -= effects.swirl_drag * speed * omega
    torque -= stiffness * cmath.phase(turn * cmath.exp(-1j * rest))
    torque += effects.constant_torque - (effects.angular_drag + effects.pivot_damping) * omega
    return force, torque


def roll(
    wheel: Wheel,
    step: float,
    mass: float,
    inertia: float,
    turn: complex,
    v: complex,
    omega: float,
) -> tuple[complex, float]:
    """Return the velocities after the floor's friction on the wheel over one step.

    Along each axis the impulse that stops the wheel's point, at most mu m g dt. The axes are
    iterated with the clipping on the accumulated impulse, so their order does not matter. ``turn``
    is of the middle of the step; velocities are of its end, when the body has turned on.
    """
    on = cmath.exp(0.5j * step * omega)
    arm = turn * complex(wheel.x, wheel.y)
    along = turn * cmath.exp(1j * wheel.theta)
    axes = ((along, wheel.mu_x), (1j * along, wheel.mu_y))
    impulse = [0.0, 0.0]
    for _ in range(10):
        for k, (axis, mu) in enumerate(axes):
            lever = cross(arm, axis)
            effective_mass = 1 / (1 / mass + lever**2 / inertia)
            speed = dot(v, axis * on) + omega * lever
            limit = mu * mass * NORMAL_GRAVITY * step
            wanted = min(max(impulse[k] - effective_mass * speed, -limit), limit)
            v += (wanted - impulse[k]) / mass * axis
            omega += (wanted - impulse[k]) * lever / inertia
            impulse[k] = wanted
    return v, omega


def rub(
    mu: float, radius: float, step: float, mass: float, inertia: float, v: complex, omega: float
) -> tuple[complex, float]:
    """Return the velocities after dry friction on a ring about the centre over one step.

    Points of the ring share the weight. At each the impulse that stops it, at most its share of
    mu m g dt; solved as in `roll`.
    """
    arms = [radius * cmath.exp(2j * math.pi * k / RING) for k in range(RING)]
    effective_mass = 1 / (1 / mass + radius**2 / inertia)
    limit = mu * mass * NORMAL_GRAVITY * step / RING
    impulse = [0j] * RING
    for _ in range(10):
        for k, arm in enumerate(arms):
            wanted = impulse[k] - effective_mass * (v + 1j * omega * arm)
            wanted *= min(1.0, limit / (abs(wanted) or limit))
            v += (wanted - impulse[k]) / mass
            omega += cross(arm, wanted - impulse[k]) / inertia
            impulse[k] = wanted
    return v, omega


def pull(
    rod: tuple[float, ...],
    step: float,
    mass: float,
    inertia: float,
    place: complex,
    theta: float,
    v: complex,
    omega: float,
) -> tuple[complex, float]:
    """Return the velocities after a rod's pull, with which one step ends at its length (SHAKE)."""
    a, b, length = complex(*rod[:2]), complex(*rod[2:4]), rod[4]

    def end(place: complex, theta: float) -> tuple[float, complex, float]:
        arm = a * cmath.exp(1j * theta)
        way = place + arm - b
        return abs(way), way / abs(way), cross(arm, way / abs(way))

    _, along, lever = end(place, theta)
    for _ in range(4):
        distance, on, on_lever = end(place + step * v, theta + step * omega)
        impulse = (length - distance) / step / (dot(on, along) / mass + on_lever * lever / inertia)
        v += impulse / mass * along
        omega += impulse * lever / inertia
    return v, omega


def simulate(seed: int, setup: Setup = CART, **effects: Any) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return (train, test) in the history format; ``effects`` are the fields of `Effects`.

    The test trajectories are recorded after the training ones: a load from some trajectory on is
    on all of them.

    Examples
    --------
    >>> train, test = simulate(5, angular_drag=1.2)
    """
    rng = np.random.default_rng(seed)
    undeclared = Effects(**effects)
    train = [_trajectory(rng, setup, undeclared, k) for k in range(setup.n_train)]
    test = [_trajectory(rng, setup, undeclared, k, setup.n_train) for k in range(setup.n_test)]
    return pd.concat(train, ignore_index=True), pd.concat(test, ignore_index=True)


def _trajectory(
    rng: np.random.Generator, setup: Setup, effects: Effects, number: int, before: int = 0
) -> pd.DataFrame:
    """Return one trajectory, which was recorded after so many of another recording."""
    limit = np.array(setup.start_range)
    start = np.concatenate([rng.uniform(-limit, limit), rng.normal(0.0, setup.start_sd)])
    if effects.distance_joint[4]:
        start = tied(effects.distance_joint, start)
    n = setup.n_intervals
    held = rng.normal(0.0, setup.wrench_sd, size=(math.ceil(n / setup.hold), 3))
    wrenches = np.repeat(held, setup.hold, axis=0)[:n].round(6)
    states = rollout(setup, start, wrenches, effects, before + number)
    if effects.heavy_tails:
        noise = rng.standard_t(1 / effects.heavy_tails, states.shape)
    else:
        noise = rng.standard_normal(states.shape)
    measured = sensed(effects, states) + noise * np.array(setup.noise)
    frame = pd.DataFrame({"trajectory": number, "step": range(n + 1)})
    frame["time"] = (frame["step"] * setup.time_step).round(6)
    frame["body"] = setup.name
    frame[["x", "y", "theta", "vx", "vy", "omega"]] = measured.round(6)
    frame[["force_x", "force_y", "torque"]] = np.vstack([wrenches, np.full(3, np.nan)])
    return frame


def tied(rod: tuple[float, ...], start: np.ndarray) -> np.ndarray:
    """Return the initial state that is nearest along a rod, and does not stretch it."""
    x, y, theta, vx, vy, omega = start
    arm, place = complex(*rod[:2]) * cmath.exp(1j * theta), complex(*rod[2:4])
    way = complex(x, y) + arm - place
    along = way / abs(way)
    at = place + rod[4] * along - arm
    v = complex(vx, vy)
    v -= dot(v + 1j * omega * arm, along) * along
    return np.array([at.real, at.imag, theta, v.real, v.imag, omega])


def sensed(effects: Effects, states: np.ndarray) -> np.ndarray:
    """Return what sensors without noise show of states (n, 6)."""
    length, angle = effects.sensor_scale
    shown = states * (length, length, angle, length, length, angle) + effects.sensor_bias
    turn = cmath.exp(1j * effects.frame_rotation)
    for x, y in ((0, 1), (3, 4)):
        turned = turn * (shown[:, x] + 1j * shown[:, y])
        shown[:, x], shown[:, y] = turned.real, turned.imag
    shown[:, 2] += effects.frame_rotation
    return shown


def parse_effect(text: str) -> tuple[str, float | tuple[float, ...]]:
    """Return name and value of ``name=1.2`` or ``name=1.2,-0.6``."""
    known = [f.name for f in fields(Effects)]
    name, _, value = text.partition("=")
    if name not in known:
        raise argparse.ArgumentTypeError(f"unknown effect {name!r}; known: {', '.join(known)}")
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        message = f"{name}: expected a number, or two with a comma, got {value!r}"
        raise argparse.ArgumentTypeError(message) from None
    return name, numbers[0] if len(numbers) == 1 else numbers


def main(arguments: list[str] | None = None) -> None:
    """Write train.csv and test.csv."""
    parser = argparse.ArgumentParser(description="Make a history with Box2D.")
    parser.add_argument("--setup", choices=SETUPS, default="cart")
    parser.add_argument(
        "--effect", action="append", default=[], type=parse_effect, metavar="NAME=VALUE[,VALUE]"
    )
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder for train.csv and test.csv")
    options = parser.parse_args(arguments)
    train, test = simulate(options.seed, SETUPS[options.setup], **dict(options.effect))
    options.out.mkdir(parents=True, exist_ok=True)
    train.to_csv(options.out / "train.csv", index=False)
    test.to_csv(options.out / "test.csv", index=False)


if __name__ == "__main__":
    main()
