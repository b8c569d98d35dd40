"""Permutation test, by kernel regression, of innovations against recorded quantities."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import rankdata

from pbrl_ppl.criticism.criteria import Criteria
from pbrl_ppl.criticism.results import KindOfTest, ResidualTest, Unexplained
from pbrl_ppl.criticism.unexplained import innovations_over_steps
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import FilteredMode
from pbrl_ppl.state import STATE, Floats, Ints

#: Ridge of the regression, over the kernel's variance of each term.
_RIDGE = 1.0
#: Recorded quantities that a residual may depend on, with their units.
FEATURES = {
    "position x": "m",
    "position y": "m",
    "velocity x": "m/s",
    "velocity y": "m/s",
    "commanded force x": "N",
    "commanded force y": "N",
    "orientation (cosine)": "1",
    "orientation (sine)": "1",
    "forward speed": "m/s",
    "sideways speed": "m/s",
    "angular speed": "rad/s",
    "speed": "m/s",
    "commanded forward force": "N",
    "commanded sideways force": "N",
    "commanded torque": "N m",
    "forward force commanded before": "N",
    "sideways force commanded before": "N",
    "torque commanded before": "N m",
    "time": "s",
}
#: Forces that depend on two quantities together: a spinning body's lift, a force that fades with
#: speed, an actuator with memory, a floor that is rough in places.
PRODUCTS = {
    " × ".join(pair): pair
    for pair in (
        ("angular speed", "forward speed"),
        ("angular speed", "sideways speed"),
        ("commanded forward force", "forward speed"),
        ("commanded sideways force", "sideways speed"),
        ("commanded torque", "angular speed"),
        ("commanded forward force", "forward force commanded before"),
        ("commanded sideways force", "sideways force commanded before"),
        ("commanded torque", "torque commanded before"),
        ("position x", "velocity x"),
        ("position y", "velocity y"),
    )
}
#: All of these with their units, in the order of the columns of :func:`recorded_quantities`.
QUANTITIES = FEATURES | {name: f"{FEATURES[a]} {FEATURES[b]}" for name, (a, b) in PRODUCTS.items()}


def folds(mode: FilteredMode, least: int = 8) -> Ints:
    """Return the fold of each transition, shape (transition,): its trajectory, or a run of it.

    Given the measurements before, innovations of different runs are independent. There are at
    ``least`` so many.
    """
    segments = mode.problem.segments
    trajectory, step = segments.trajectory, segments.step
    count = len(np.unique(trajectory))
    if count >= least:
        return np.unique(trajectory, return_inverse=True)[1].astype(np.intp)
    runs = -(-least // count)
    length = np.array([(trajectory == t).sum() for t in trajectory])
    run = np.minimum(step * runs // np.maximum(length, 1), runs - 1)
    return np.unique(trajectory * runs + run, return_inverse=True)[1].astype(np.intp)


def find_dependence(
    mode: FilteredMode,
    criteria: Criteria,
    *,
    seed: int = 0,
    permutations_a_body: int = 500,
    least_transitions: int = 20,
    most_transitions: int = 1500,
) -> tuple[ResidualTest, Unexplained | None]:
    """Test whether the innovations of a fitted model depend on state, action or time.

    A kernel ridge regression with one smooth term a quantity, or product of two, predicts the
    residual of trajectories that it was not trained on, or of runs within few trajectories; the
    null distribution comes from shuffling the transitions.

    Parameters
    ----------
    mode : FilteredMode
        A fitted model.
    criteria : Criteria
        Thresholds of significant and of negligible.
    seed : int
        Seed of the permutations and the folds.
    permutations_a_body : int
        By default the smallest p-value is a fifth of the significance.
    least_transitions : int
        Transitions that the test needs.
    most_transitions : int
        Transitions of the test, at most: more take long and change nothing.

    Returns
    -------
    test : ResidualTest
        Untested with too few transitions.
    dependence : Unexplained or None
        The strongest dependence; None if none is significant.
    """
    rng = np.random.default_rng(seed)
    problem = mode.problem
    n, limits = problem.segments.n, criteria.residual
    if n < least_transitions:
        return ResidualTest.untested(KindOfTest.DEPENDENCE, "too few transitions"), None
    tests = len(problem.scene.dynamic)
    permutations = permutations_a_body * tests - 1
    chosen = np.sort(rng.permutation(n)[:most_transitions])
    places = mode.problem.likelihood.noise.coordinates.places
    innovations = mode.whitened_residual[chosen]
    groups = folds(mode)[chosen]
    relative = innovations_over_steps(mode)
    best: Unexplained | None = None
    for i, body in enumerate(problem.scene.moving):
        if body.kinematic:
            continue
        features = recorded_quantities(problem, i)[chosen]
        of_body = np.flatnonzero(places // len(STATE) == i)
        y, names, of = _in_both_frames(
            innovations[:, of_body], places[of_body] % len(STATE), features
        )
        y = y - y.mean(axis=0)
        smoother = _cross_validated(_summed(features), groups, rng)
        shares = _explained(smoother, y)
        null = np.array(
            [_explained(smoother, y[rng.permutation(len(y))]).max() for _ in range(permutations)]
        )
        at = int(np.argmax(shares))
        size = np.sqrt(max(float(shares[at]), 0.0)) * relative[of_body[of[at]]]
        p_value = float((1 + (null >= shares[at]).sum()) / (1 + permutations)) * tests
        small = shares[at] < limits.dependence_share or size < criteria.negligible
        if p_value > limits.dependence_p or small:
            continue
        if best is None or shares[at] > best.share:
            best = _describe(body.name, names[at], features, y[:, at], shares[at], p_value)
    if best is None:
        sentence = "the innovations depend on no recorded quantity"
        return ResidualTest(KindOfTest.DEPENDENCE, 1.0, 0.0, True, sentence), None
    test = ResidualTest(
        KindOfTest.DEPENDENCE, best.p_value, best.share, False, best.sentence,
        best.body, best.dimension,
    )  # fmt: skip
    return test, best


def _in_both_frames(
    y: Floats, dimension: Ints, features: Floats
) -> tuple[Floats, list[str], list[int]]:
    """Return innovations in the world frame and velocities' in the body's, names and columns."""
    names, of = [STATE[d] for d in dimension], list(range(len(dimension)))
    velocities = [names.index(name) for name in ("vx", "vy") if name in names]
    if len(velocities) < 2:
        return y, names, of
    columns = list(FEATURES)
    c, s = (features[:, columns.index(f"orientation ({part})")] for part in ("cosine", "sine"))
    x, y_ = y[:, velocities].T
    turned = np.stack([c * x + s * y_, c * y_ - s * x], axis=1)
    return np.hstack([y, turned]), [*names, "forward speed", "sideways speed"], [*of, *velocities]


def recorded_quantities(problem: Problem, body: int) -> Floats:
    """Return ``QUANTITIES`` at the start of each transition, shape (transition, quantity)."""
    segments = problem.segments
    x, y, theta, vx, vy, omega = segments.start[:, body].T
    fx, fy, torque = segments.actions[:, :, body].mean(axis=1).T
    gx, gy, torque_before = segments.inputs[:, 0, body, 3:6].T
    c, s = np.cos(theta), np.sin(theta)
    time = segments.step * problem.scene.time_step
    single = np.stack(
        [
            x, y, vx, vy, fx, fy, c, s, c * vx + s * vy, c * vy - s * vx, omega, np.hypot(vx, vy),
            c * fx + s * fy, c * fy - s * fx, torque,
            c * gx + s * gy, c * gy - s * gx, torque_before, time,
        ],
        axis=1,
    )  # fmt: skip
    columns = list(FEATURES)
    pairs = np.array([[columns.index(name) for name in pair] for pair in PRODUCTS.values()])
    return np.hstack([single, single[:, pairs].prod(axis=2)])


def _kernels(features: Floats) -> Iterator[Floats]:
    """Yield a Gaussian kernel of each quantity's ranks, scaled to unit range, shape (n, n)."""
    ranks = (rankdata(features, axis=0) - 1) / max(len(features) - 1, 1)  # equal ones share theirs
    varies = np.ptp(features, axis=0) > 1e-9 * np.abs(features).max(axis=0, initial=0.0)
    for rank, moves in zip(ranks.T, varies, strict=True):
        difference = rank[:, None] - rank
        yield np.exp(-0.5 * (difference / 0.2) ** 2) * moves / max(int(varies.sum()), 1)


def _summed(features: Floats) -> Floats:
    """Return the kernel of all quantities together, shape (n, n)."""
    kernel = np.zeros((len(features), len(features)))
    for term in _kernels(features):
        kernel += term
    return kernel


def _cross_validated(
    kernel: Floats, groups: Ints, rng: np.random.Generator, folds: int = 5
) -> Floats:
    """Return the matrix that predicts each transition from those of other groups."""
    smoother = np.zeros_like(kernel)
    names = rng.permutation(np.unique(groups))
    for left_out in np.array_split(names, min(folds, len(names))):
        out = np.isin(groups, left_out)
        inner = kernel[np.ix_(~out, ~out)] + _RIDGE * np.eye(int((~out).sum()))
        smoother[np.ix_(out, ~out)] = np.linalg.solve(inner, kernel[np.ix_(~out, out)]).T
    return smoother


def _explained(smoother: Floats, y: Floats) -> Floats:
    """Return the share of variance predicted, per column."""
    size = np.maximum((y**2).sum(axis=0), 1e-300)
    return np.asarray(1.0 - ((y - smoother @ y) ** 2).sum(axis=0) / size)


def _describe(
    body: str, dimension: str, features: Floats, y: Floats, share: float, p_value: float
) -> Unexplained:
    """Return the dependence with the quantity that contributes most to the regression."""
    weights = np.linalg.solve(_summed(features) + _RIDGE * np.eye(len(y)), y)
    parts = [np.var(kernel @ weights) for kernel in _kernels(features)]
    name = list(QUANTITIES)[int(np.argmax(parts))]
    return Unexplained(
        body=body,
        dimension=dimension,
        depends_on=name,
        share=float(share),
        p_value=min(1.0, p_value),
        sentence=(
            f"the error of {dimension} of {body} depends on its {name}: a regression predicts"
            f" {share:.0%} of its variance, and no effect in the catalogue does"
        ),
    )
