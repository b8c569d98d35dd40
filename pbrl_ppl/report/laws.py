"""Residual forces against the recorded quantities that they depend on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism import PRODUCTS, Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.model import Problem
from pbrl_ppl.posterior import problem_of
from pbrl_ppl.report.evidence import binned, recorded
from pbrl_ppl.report.motion import likeliest
from pbrl_ppl.report.words import depends_on_records
from pbrl_ppl.state import INPUT, STATE

Array = NDArray[np.float64]

#: Further quantities whose bins explain less than this share of the residual are left out.
_SMALLEST_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class Law:
    """Residual force or torque of a body against a quantity that it depends on.

    Parameters
    ----------
    body, dimension, quantity : str
        The velocity that is off, and what it is off with.
    x, y : ndarray
        The quantity, and the residual force (or acceleration) of each transition, 1-d.
    x_unit, y_unit, y_name : str
        Units, and what ``y`` is.
    centre, mean, error : ndarray
        Of each bin: median of x, mean of y and its standard error.
    share : float
        Share of the variance of y that the bins' means explain, less what chance gives.
    form : str
        The simplest curve that follows the means.
    curve : ndarray
        That curve at the sorted x.
    curve_share : float
        Share of the variance of y that the curve explains.
    """

    body: str
    dimension: str
    quantity: str
    x: Array
    y: Array
    x_unit: str
    y_unit: str
    y_name: str
    centre: Array
    mean: Array
    error: Array
    share: float
    form: str
    curve: Array
    curve_share: float


def find_laws(findings: Loop, effects: Iterable[Effect], most: int = 3) -> list[Law]:
    """Return residual forces against the quantity that they depend on, and others like it.

    The residual force is what each step adds to the smoothed states beyond the model, over the time
    step, times the body's posterior mean mass or moment.

    Empty where the test of dependence passed, no body is named, or the posterior does not hold
    its recording.
    """
    left = findings.unexplained
    if left is None or not left.body or not depends_on_records(findings):
        return []
    if not recorded(findings.posterior_after):
        return []
    problem = problem_of(findings.posterior_after, tuple(effects))
    phi, _ = likeliest(problem, findings.posterior_after)
    names = [body.name for body in problem.scene.moving]
    body = names.index(left.body)
    found = _residual(problem, phi, body, left.dimension)
    if found is None:
        return []
    name, acceleration = found
    scale, y_name, y_unit = _inertia(problem, phi, body, name)
    y = scale * acceleration
    laws = [
        _law(left.body, name, quantity, x, y, unit, y_name, y_unit)
        for quantity, (x, unit) in _quantities(problem, body).items()
        if np.ptp(x) > 1e-9
    ]
    laws.sort(key=lambda law: (law.quantity != left.depends_on, -law.curve_share))
    if not laws or laws[0].quantity != left.depends_on:
        return []
    return [laws[0], *(law for law in laws[1:most] if law.share > _SMALLEST_SHARE)]


def _residual(problem: Problem, phi: Array, body: int, dimension: str) -> tuple[str, Array] | None:
    """What steps add to a velocity of a body, over the time step, shape (transition,)."""
    cells = problem.trajectory_noise.cells
    added = cells.of_residual(problem.residual(phi)) / problem.scene.time_step
    column = {int(place): i for i, place in enumerate(cells.places)}

    def of(name: str) -> Array | None:
        place = body * len(STATE) + STATE.index(name)
        return added[:, column[place]] if place in column else None

    if dimension in ("forward speed", "sideways speed"):
        x, y, theta = of("vx"), of("vy"), problem.segments.start[:, body, 2]
        if x is None or y is None:
            return None
        c, s = np.cos(theta), np.sin(theta)
        return dimension, c * x + s * y if dimension == "forward speed" else c * y - s * x
    velocity = {"x": "vx", "y": "vy", "theta": "omega"}.get(dimension, dimension)
    values = of(velocity) if velocity in STATE else None
    return None if values is None else (velocity, values)


def _inertia(problem: Problem, phi: Array, body: int, name: str) -> tuple[float, str, str]:
    """What an acceleration is to be multiplied with to be a force or torque, if that is known."""
    moving = problem.scene.moving[body]
    known = dict(moving.known)
    values = dict(zip(problem.layout.labels, phi.tolist(), strict=True))
    mass = known.get("mass", values.get(f"mass[{moving.owner}]"))
    if mass is None:
        unit = "rad/s²" if name == "omega" else "m/s²"
        return 1.0, "residual acceleration", unit
    if name == "omega":
        return float(mass) * moving.shape.unit_moment, "residual torque", "N m"
    return float(mass), "residual force", "N"


def _quantities(problem: Problem, body: int) -> dict[str, tuple[Array, str]]:
    """What a law may follow, with units, under the names that findings have for them."""
    segments = problem.segments
    x, y, theta, vx, vy, omega = segments.start[:, body].T
    fx, fy, torque = segments.actions[:, 0, body].T
    place = INPUT.index("previous_force_x")
    gx, gy, torque_before = segments.inputs[:, 0, body, place : place + 3].T
    c, s = np.cos(theta), np.sin(theta)
    single = {
        "position x": (x, "m"),
        "position y": (y, "m"),
        "velocity x": (vx, "m/s"),
        "velocity y": (vy, "m/s"),
        "commanded force x": (fx, "N"),
        "commanded force y": (fy, "N"),
        "orientation (cosine)": (c, "1"),
        "orientation (sine)": (s, "1"),
        "forward speed": (c * vx + s * vy, "m/s"),
        "sideways speed": (c * vy - s * vx, "m/s"),
        "angular speed": (omega, "rad/s"),
        "speed": (np.hypot(vx, vy), "m/s"),
        "commanded forward force": (c * fx + s * fy, "N"),
        "commanded sideways force": (c * fy - s * fx, "N"),
        "commanded torque": (torque, "N m"),
        "forward force commanded before": (c * gx + s * gy, "N"),
        "sideways force commanded before": (c * gy - s * gx, "N"),
        "torque commanded before": (torque_before, "N m"),
        "time": (segments.step * problem.scene.time_step, "s"),
    }
    products = {
        name: (single[a][0] * single[b][0], f"{single[a][1]} {single[b][1]}")
        for name, (a, b) in PRODUCTS.items()
    }
    return single | products


def _law(
    body: str, name: str, quantity: str, x: Array, y: Array, x_unit: str, y_name: str, y_unit: str
) -> Law:
    """Means in bins of a quantity, and the simplest curve that follows them."""
    which, bins = binned(x)
    centre, mean, error = np.empty(bins), np.empty(bins), np.empty(bins)
    for i in range(bins):
        own = y[which == i]
        centre[i], mean[i] = np.median(x[which == i]), own.mean()
        error[i] = own.std(ddof=1) / np.sqrt(len(own)) if len(own) > 1 else np.nan
    total = float(((y - y.mean()) ** 2).sum())
    inside = float(((y - mean[which]) ** 2).sum())
    spare = max(len(y) - bins, 1)
    share = 1.0 - (inside / spare) / (total / max(len(y) - 1, 1)) if total > 0 else 0.0
    form, curve, curve_share = _simplest(x, y)
    return Law(
        body, name, quantity, x, y, x_unit, y_unit, y_name, centre, mean, error, share, form,
        curve, curve_share,
    )  # fmt: skip


def _simplest(x: Array, y: Array) -> tuple[str, Array, float]:
    """The curve of a few that explains most for its terms (BIC), at the sorted x."""
    one, order = np.ones_like(x), np.argsort(x)
    forms = {
        "{0:.3g}": (one,),
        "{0:.3g} {1:+.3g} q": (one, x),
        "{0:.3g} {1:+.3g} sign(q)": (one, np.sign(x)),
        "{0:.3g} {1:+.3g} q |q|": (one, x * np.abs(x)),
        "{0:.3g} {1:+.3g} q²": (one, x**2),
        "{0:.3g} {1:+.3g} q {2:+.3g} q |q|": (one, x, x * np.abs(x)),
    }
    total = max(float(((y - y.mean()) ** 2).sum()), 1e-300)
    best, result = np.inf, ("", np.zeros_like(x), 0.0)
    for form, terms in forms.items():
        columns = np.stack(terms, axis=1)
        sizes, _, rank, _ = np.linalg.lstsq(columns, y, rcond=None)
        if rank < len(terms):
            continue
        left = max(float(((y - columns @ sizes) ** 2).sum()), 1e-300)
        bic = len(y) * np.log(left) + len(terms) * np.log(len(y))
        if bic < best:
            text = form.format(*sizes).replace("-", "−").replace(" +", " + ").replace(" −", " − ")
            best, result = bic, (text, (columns @ sizes)[order], 1.0 - left / total)
    return result
