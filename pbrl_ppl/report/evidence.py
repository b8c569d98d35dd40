"""Evidence for added effects, and residual forces against recorded quantities."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism import PRODUCTS, Findings
from pbrl_ppl.effects import Effect
from pbrl_ppl.model import Problem
from pbrl_ppl.posterior import group, problem_of
from pbrl_ppl.report.motion import likeliest
from pbrl_ppl.report.words import depends_on_records
from pbrl_ppl.state import INPUT, STATE

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

#: Bins of a quantity, each with as many transitions, and the fewest transitions that a bin has.
_BINS, _LEAST = 10, 8


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for what was added, cell by cell of the recording that was fitted.

    Parameters
    ----------
    nats : ndarray
        Log-likelihood that each measured number gains given those before it, shape (transition,
        cell), each model with its own noise, at its likeliest draw.
    bodies, dimensions : tuple of str
        Of each cell.
    body : str
        On which the first effect was added: that of ``speed`` and ``position``.
    speed : ndarray
        Of the body at the transition's start (m/s), shape (transition,).
    position : ndarray
        Of the body (m), shape (transition, 2).
    time : ndarray
        Since the trajectory's first row (s), shape (transition,).
    touching : ndarray of bool
        Whether bodies touch, shape (transition,).
    trajectory : ndarray of str
        Label of the trajectory, shape (transition,).
    wrench : ndarray
        Command on the body (N, N, N m), shape (transition, 3).
    """

    nats: Array
    bodies: tuple[str, ...]
    dimensions: tuple[str, ...]
    body: str
    speed: Array
    position: Array
    time: Array
    touching: NDArray[np.bool_]
    trajectory: NDArray[np.str_]
    wrench: Array

    @property
    def by_transition(self) -> Array:
        """Sum over the cells, shape (transition,)."""
        return np.asarray(self.nats.sum(axis=1))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cells: dimension and, of several bodies, body."""
        if len(set(self.bodies)) == 1:
            return self.dimensions
        return tuple(f"{d} of {body}" for d, body in zip(self.dimensions, self.bodies, strict=True))

    @property
    def by_cell(self) -> dict[str, float]:
        """Sum over the transitions, by cell, largest first."""
        sums = zip(self.names, self.nats.sum(axis=0).tolist(), strict=True)
        return dict(sorted(sums, key=lambda item: -item[1]))

    def in_words(self) -> str:
        """Say where the gain is largest, for a reader."""
        total, sums = float(self.nats.sum()), self.by_cell
        first = next(iter(sums))
        carriers = len(self.carriers())
        said = (
            f"The revised model makes the recording that was fitted {total:,.0f} nats likelier."
            f" The largest share is in {first} ({100 * sums[first] / total:.0f} %), and {carriers}"
            f" of {len(self.nats)} transitions hold 80 % of the gains."
        )
        return said if total > 0 else "The recording that was fitted is no likelier."

    def carriers(self, share: float = 0.8) -> Ints:
        """The fewest transitions that hold this share of the gains, largest first."""
        gains = self.by_transition
        order = np.argsort(-gains, kind="stable")
        total = np.cumsum(np.maximum(gains[order], 0.0))
        if total[-1] <= 0:
            return order[:0]
        return order[: int(np.searchsorted(total, share * total[-1])) + 1]


def find_evidence(findings: Findings, effects: Iterable[Effect]) -> Evidence | None:
    """Trace the gain of the revised model to the measured numbers that it comes from.

    None where nothing was added, or a posterior does not hold its recording.
    """
    if not findings.added or not recorded(findings.posterior_before, findings.posterior_after):
        return None
    effects = tuple(effects)
    after = problem_of(findings.posterior_after, effects)
    before = problem_of(findings.posterior_before, effects)
    nats = _log_density(after, findings.posterior_after)
    nats = nats - _log_density(before, findings.posterior_before)
    noise, segments = after.trajectory_noise, after.segments
    moving = [body.name for body in after.scene.moving]
    body = findings.added[0].body
    own = moving.index(body)
    states = segments.start[:, own]
    labels = after.data.history.dataset["trajectory"].to_numpy().astype(str)
    return Evidence(
        nats=nats,
        bodies=tuple(moving[place // len(STATE)] for place in noise.cells.places),
        dimensions=tuple(STATE[place % len(STATE)] for place in noise.cells.places),
        body=body,
        speed=np.hypot(states[:, 3], states[:, 4]),
        position=states[:, :2],
        time=np.asarray(segments.step * after.scene.time_step),
        touching=noise.touching,
        trajectory=labels[segments.trajectory],
        wrench=segments.actions[:, 0, own],
    )


def recorded(*posteriors: object) -> bool:
    """Whether posteriors hold what was recorded, of whole trajectories."""
    for posterior in posteriors:
        attrs = getattr(posterior, "attrs", {})
        if "scene" not in attrs or "smoothed" not in group(posterior, "constant_data"):
            return False
    return True


def _log_density(problem: Problem, posterior: Any) -> Array:
    """Log-likelihood of each measured number given those before it, shape (transition, cell)."""
    phi, sigma = likeliest(problem, posterior)
    noise = problem.trajectory_noise
    cells = -0.5 * problem.robust(phi, sigma) ** 2 - np.log(noise.scale(sigma))
    whole = problem.log_density(problem.residual(phi), sigma, phi)
    # the norm of the density, which is the same for all
    rest = (whole - np.where(noise.seen, cells, 0.0).sum(axis=1))[:, None]
    rest = rest / np.maximum(noise.seen.sum(axis=1, keepdims=True), 1)
    return np.where(noise.seen, cells + rest, 0.0)


def binned(x: Array) -> tuple[Ints, int]:
    """Bin of each value, of about as many values each, and how many bins there are."""
    wanted = int(np.clip(len(x) // _LEAST, 1, _BINS))
    edges = np.unique(np.quantile(x, np.linspace(0, 1, wanted + 1)[1:-1]))
    # equal values share a bin, so that some may be empty
    _, which = np.unique(np.searchsorted(edges, x, side="left"), return_inverse=True)
    return which, int(which.max()) + 1


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


def find_laws(findings: Findings, effects: Iterable[Effect], most: int = 3) -> list[Law]:
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
