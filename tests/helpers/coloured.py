"""Falls, pendulums and sliders by a Runge-Kutta method, with errors that are not white."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from pbrl_ppl.effects import attach
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, first_states, in_pieces
from pbrl_ppl.modes import Mode, fit_pieces, with_robust_covariance
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE

#: Kinds of error: AR(0.9), an encoder step of 3 standard deviations, a ripple of 5 % of the force.
ERRORS = ("memory", "steps", "ripple")
_GRAVITY = 9.81
#: Steps of the Runge-Kutta method in an interval.
_STEPS = 40


@dataclass(frozen=True)
class Rig:
    """A body with a single degree of freedom and declared laws.

    ``acceleration`` takes position, speed and force, each of shape (trajectory,); ``truth`` has the
    laws' parameters in the order of the labels. ``force`` is what the ripple is a share of,
    ``drive`` and ``push`` the amplitude and the mean of the commands (N or N m), ``sd`` the error
    of measuring; ``begin`` and ``speed`` are the largest at the start, ``ripple`` is the
    angular frequency of the ripple (rad/s).
    """

    scene: Scene
    dimension: str
    command: str
    acceleration: Callable[..., np.ndarray]
    truth: tuple[float, ...]
    force: float
    drive: float
    push: float
    sd: float
    begin: float
    speed: float
    trajectories: int
    rows: int
    ripple: float = 12.0


def _fall(mass: float = 0.06, drag: float = 0.004) -> Rig:
    known = {"mass": mass, "r": 0.2, "mu_c": 0.2}
    ball = Body("body", Shape.circle(0.05), known=known, effects=("quadratic_drag",))
    return Rig(
        Scene(
            time_step=1 / 30, gravity=(0.0, -_GRAVITY), normal_gravity=0.0, bodies=(ball,),
            substeps=20,
        ),
        "y", "force_y", lambda q, v, f: (f - drag * abs(v) * v) / mass - _GRAVITY, (drag,),
        force=mass * _GRAVITY, drive=0.0, push=0.0, sd=0.005, begin=0.0, speed=2.0,
        trajectories=4, rows=45,
    )  # fmt: skip


def _pendulum(damping: float = 0.004, friction: float = 0.004) -> Rig:
    mass, width, length = 0.2, 0.03, 0.4
    inertia = mass * (width**2 + length**2) / 12 + mass * (length / 2) ** 2
    weight = mass * _GRAVITY * length / 2
    arm = Body(
        "body", Shape.box(width, length), pose=(0.0, -length / 2, 0.0),
        known={"mass": mass, "r": 0.2, "mu_c": 0.2}, effects=("pivot_damping", "pivot_friction"),
    )  # fmt: skip

    def acceleration(q: np.ndarray, v: np.ndarray, f: np.ndarray) -> np.ndarray:
        return (f - weight * np.sin(q) - damping * v - friction * np.tanh(v / 0.001)) / inertia

    joint = Joint("hinge", (WORLD, "body"), (0.0, 0.0), (0.0, length / 2))
    return Rig(
        Scene(
            time_step=1 / 30, gravity=(0.0, -_GRAVITY), normal_gravity=0.0, bodies=(arm,),
            joints=(joint,), substeps=20,
        ),
        "theta", "torque", acceleration, (damping, friction), force=weight,
        drive=0.0, push=0.0, sd=0.005, begin=1.2, speed=0.0, trajectories=4, rows=121,
    )  # fmt: skip


def _slider(drag: float = 1.5, mu: float = 0.05) -> Rig:
    mass = 2.0
    block = Body(
        "body", Shape.box(0.3, 0.2), known={"mass": mass, "r": 0.2, "mu_c": 0.2},
        effects=("linear_drag", "sliding_friction"),
    )  # fmt: skip

    def acceleration(q: np.ndarray, v: np.ndarray, f: np.ndarray) -> np.ndarray:
        return (f - drag * v - mu * mass * _GRAVITY * np.sign(v)) / mass

    return Rig(
        Scene(time_step=0.02, normal_gravity=_GRAVITY, bodies=(block,), substeps=20),
        "x", "force_x", acceleration, (drag, mu), force=5.0, drive=4.0, push=3.0, sd=5e-4,
        begin=0.0, speed=2.0, trajectories=6, rows=76,
    )  # fmt: skip


#: The last one's ripple has less than a cycle in a fall: only other falls show it.
RIGS: dict[str, Rig] = {
    "fall": _fall(), "pendulum": _pendulum(), "slider": _slider(),
    "falls": replace(_fall(), trajectories=8, ripple=3.0),
}  # fmt: skip


def recording(rig: Rig, error: str | None, seed: int) -> History:
    """Return a recording with one of :data:`ERRORS`, without error if None.

    AR(0.9) errors are twice as large as the others. The commands are sums of two sines, constant
    over an interval; the ripple goes on within it, with another phase in each trajectory.
    """
    rng, n = np.random.default_rng(seed), rig.trajectories
    dt, rows = rig.scene.time_step, rig.rows
    time = dt * np.arange(rows)
    rate, phase = rng.uniform(3, 9, (n, 2, 1)), rng.uniform(0, 6, (n, 2, 1))
    force = rig.push + rig.drive / 2 * np.sin(rate * time + phase).sum(axis=1)
    q = rig.begin * rng.uniform(0.7, 1.0, n)
    v = rig.speed * rng.uniform(0.5, 1, n)
    phases, shaking = rng.uniform(0, 2 * np.pi, n), 0.05 * rig.force * (error == "ripple")
    path, h = [q], dt / _STEPS

    def slope(t: float, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        shaken = u + shaking * np.sin(rig.ripple * t + phases)
        return np.array([s[1], rig.acceleration(s[0], s[1], shaken)])

    s = np.array([q, v])
    for k in range(rows - 1):
        for i in range(_STEPS):
            t, u = time[k] + i * h, force[:, k]
            a = slope(t, s, u)
            b = slope(t + h / 2, s + h / 2 * a, u)
            c = slope(t + h / 2, s + h / 2 * b, u)
            s = s + h / 6 * (a + 2 * b + 2 * c + slope(t + h, s + h * c, u))
        path.append(s[0])
    measured = np.array(path).T
    white = rng.standard_normal((n, rows + 200))
    if error == "memory":
        measured = measured + 2 * rig.sd * np.sqrt(0.19) * lfilter([1], [1, -0.9], white)[:, 200:]
    elif error:
        measured = measured + rig.sd * white[:, 200:]
    if error == "steps":
        measured = 3 * rig.sd * np.round(measured / (3 * rig.sd))
    frame = pd.DataFrame(
        {"trajectory": np.repeat(np.arange(n), rows), "step": np.tile(np.arange(rows), n)}
    )
    frame["time"], frame["body"] = (frame["step"] * dt).round(9), "body"
    frame[list(STATE)] = np.nan
    frame[rig.dimension] = measured.ravel()
    frame[["force_x", "force_y", "torque"]] = 0.0
    frame[rig.command] = force.ravel()
    frame.loc[frame["step"] == rows - 1, ["force_x", "force_y", "torque"]] = np.nan
    return History.from_dataframe(frame, rig.scene)


def fitted(rig: Rig, error: str | None, seed: int) -> Mode:
    """Return the mode of simulated whole trajectories, begun at the truth."""
    history = recording(rig, error, seed)
    problem = Problem.of(Physics(rig.scene, attach(rig.scene)), history)
    begin = np.zeros(len(problem.layout.labels))
    begin[: len(rig.truth)] = rig.truth
    problem = in_pieces(problem, rig.rows - 1, first_states(history))
    return with_robust_covariance(fit_pieces(problem, begin))


def standardised(rig: Rig, mode: Mode) -> np.ndarray:
    """Return errors of the laws' parameters over their standard deviations, shape (parameter,)."""
    n = len(rig.truth)
    return (mode.phi[:n] - rig.truth) / np.sqrt(np.diag(mode.covariance)[:n])
