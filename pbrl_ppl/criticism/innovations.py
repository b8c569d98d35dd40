"""Tests of innovations: unexplained acceleration, correlations, dependence on what was recorded.

Correlations are the residual tests of L. Ljung, System Identification (1999), chapter 16. An
innovation's variance is one, so that of a correlation over n pairs is 1 / n if nothing is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, rankdata

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import KindOfTest, ResidualTest, Unexplained
from pbrl_ppl.likelihood import Problem, bodies_acceleration
from pbrl_ppl.modes import NOTHING, FilteredMode, profile_sigma
from pbrl_ppl.state import STATE, WRENCH, Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class UnexplainedAcceleration:
    """Unexplained acceleration of a model, shape (velocity,) each.

    Parameters
    ----------
    names : tuple of str
        Names of the velocities.
    size : ndarray
        Standard deviation, m/s^2 and rad/s^2.
    relative : ndarray
        The same over the root mean square acceleration of the bodies.
    p_value : ndarray
        P-value of the likelihood ratio against none.
    numerical : ndarray
        Root mean square change of the bodies' accelerations if the substeps are doubled, in the
        units of size.
    criteria : Criteria
        Thresholds of significant and of negligible.
    """

    names: tuple[str, ...]
    size: Floats
    relative: Floats
    p_value: Floats
    numerical: Floats
    criteria: Criteria = DEFAULT

    def by_name(self, values: Floats) -> dict[str, float]:
        """Return values of the velocities, shape (velocity,), by name."""
        return dict(zip(self.names, values.tolist(), strict=True))

    @property
    def certain(self) -> Bools:
        """Return which are significant."""
        return np.asarray(self.p_value * len(self.names) < self.criteria.false_alarm)

    @property
    def beyond_engine(self) -> Bools:
        """Return which are larger than the engine's numerical error."""
        return np.asarray(self.size > self.criteria.engine.error_factor * self.numerical)

    @property
    def matters(self) -> Bools:
        """Return which are significant, beyond the engine's error, and not negligible."""
        large = self.relative >= self.criteria.negligible
        return np.asarray(self.certain & self.beyond_engine & large)

    @property
    def largest(self) -> int:
        """Return the place of the largest relative one: of those that matter, or are significant.

        Of all where none is significant.
        """
        chosen = next((one for one in (self.matters, self.certain) if one.any()), self.size >= 0)
        return int(np.argmax(np.where(chosen, self.relative, -1.0)))

    @property
    def worst(self) -> float:
        """Return the largest relative one among those that are significant; 0 without any."""
        return float(np.where(self.certain, self.relative, 0.0).max(initial=0.0))


def unexplained_acceleration(
    mode: FilteredMode, criteria: Criteria = DEFAULT
) -> UnexplainedAcceleration:
    """Return the acceleration that a fitted model leaves unexplained."""
    coordinates = mode.problem.likelihood.noise.coordinates
    size = mode.sigma[coordinates.accelerations]
    relative = size / np.maximum(bodies_acceleration(mode.problem), 1e-300)
    names = tuple(STATE[d] for d in coordinates.rates)
    return UnexplainedAcceleration(
        names, size, relative, _p_values(mode), _numerical(mode), criteria
    )


def noise_alone(mode: FilteredMode, excess: UnexplainedAcceleration) -> Floats:
    """Return noise parameters without accelerations that are not significant, shape (parameter,).

    Few data do not tell measurement noise from process noise: the mode gives all to one of them.
    """
    places = np.array(mode.problem.likelihood.noise.coordinates.accelerations)
    return _without(mode, places[~excess.certain], mode.problem.residual(mode.phi))


def noise_without_unexplained(mode: FilteredMode, excess: UnexplainedAcceleration) -> Floats:
    """Return the noise parameters without accelerations that matter, shape (parameter,)."""
    sigma = mode.sigma.copy()
    places = np.array(mode.problem.likelihood.noise.coordinates.accelerations)
    sigma[places[excess.matters]] = NOTHING
    return sigma


def without_acceleration(mode: FilteredMode) -> FilteredMode:
    """Return the mode with the noise parameters that it has without unexplained acceleration.

    A random force follows smooth effects: their scores are small beside it.
    """
    places = mode.problem.likelihood.noise.coordinates.accelerations
    return replace(mode, sigma=_without(mode, places, mode.problem.residual(mode.phi)))


def _without(mode: FilteredMode, places: Iterable[int], residual: Floats) -> Floats:
    """Return the noise parameters that are best if those at some places are next to nothing."""
    fixed = {place: NOTHING * mode.problem.noise_prior[0][place] for place in places}
    return profile_sigma(mode.problem, residual, mode.phi, fixed)


def innovations_over_steps(mode: FilteredMode) -> Floats:
    """Return the typical innovations over the change in a step, shape (coordinate,)."""
    noise, segments = mode.problem.likelihood.noise, mode.problem.segments
    coordinates, dt = noise.coordinates, mode.problem.scene.time_step
    change = segments.observed[:, 0] - segments.start
    body, dimension = np.divmod(coordinates.places, len(STATE))
    velocity = np.where(dimension < 3, dimension + 3, dimension)
    typical = np.sqrt(np.mean(change[:, body, velocity] ** 2, axis=0))
    step = np.where(dimension < 3, dt * typical, typical)
    return np.asarray(np.median(noise.scale(mode.sigma), axis=0) / np.maximum(step, 1e-300))


def _numerical(mode: FilteredMode) -> Floats:
    """Return the rms change of accelerations if the substeps are doubled, shape (velocity,)."""
    problem, coordinates = mode.problem, mode.problem.likelihood.noise.coordinates
    finer = problem.with_physics(substeps=2 * problem.physics.substeps)
    change = coordinates.of((finer.predict(mode.phi) - problem.predict(mode.phi))[:, 0])
    square = np.nanmean(change**2, axis=0) / problem.scene.time_step**2
    dimension = coordinates.places % len(STATE)
    return np.array([np.sqrt(square[dimension == d].mean()) for d in coordinates.rates])


def _p_values(mode: FilteredMode) -> Floats:
    """Return p-values of the likelihood ratio of each acceleration against none.

    The other noises are free. At the bound of a variance: half a chi-squared with one degree.
    """
    problem = mode.problem
    residual = problem.residual(mode.phi)

    def best(sigma: Floats) -> float:
        return float(problem.log_density(residual, sigma, mode.phi).sum())

    here = best(mode.sigma)
    places = problem.likelihood.noise.coordinates.accelerations
    gains = [here - best(_without(mode, [place], residual)) for place in places]
    return np.asarray([0.5 * chi2.sf(max(2 * gain, 0.0), 1) for gain in gains])


#: Largest lag of a correlation (intervals), and pairs that one has to be taken over.
_LAGS, _LEAST_PAIRS = 5, 10


def correlation_tests(mode: FilteredMode, criteria: Criteria) -> tuple[ResidualTest, ResidualTest]:
    """Test whiteness over lags, and correlation with present and past commands.

    Parameters
    ----------
    mode : FilteredMode
        Fitted to whole trajectories.
    criteria : Criteria
        Thresholds of significant and of negligible.

    Returns
    -------
    whiteness, commands : ResidualTest
        Untested where the data cannot fail.
    """
    noise = mode.problem.likelihood.noise
    white, seen = mode.whitened_residual, noise.seen
    number = np.cumsum(noise.first.astype(np.intp))
    own, pairs = _lagged(white, seen, number, range(1, _LAGS + 1), white[:, None], seen[:, None])
    few, enough = "too few pairs of intervals", pairs > _LEAST_PAIRS
    whiteness = ResidualTest.untested(KindOfTest.WHITENESS, few)
    if enough.any():  # the sum of squares is chi-squared if nothing is missing
        p_value = float(chi2.sf((pairs * own**2)[enough].sum(), int(enough.sum())))
        whiteness = _test(mode, own, enough, p_value, [], criteria)
    series, names = _commands(mode)
    commands = ResidualTest.untested(KindOfTest.COMMANDS, few if names else "no command varies")
    regressed = _regression_p_value(white, seen, number, series) if names else None
    if regressed is not None:
        known = np.ones((len(series), 1, 1), dtype=bool)
        driven, pairs = _lagged(white, seen, number, range(_LAGS + 1), series[..., None], known)
        commands = _test(mode, driven, pairs > _LEAST_PAIRS, regressed, names, criteria)
    return whiteness, commands


def _lagged(
    white: Floats, seen: Bools, number: Ints, lags: range, series: Floats, known: Bools
) -> tuple[Floats, Floats]:
    """Return correlations with series (transition, series, coordinate) some intervals before.

    And the numbers of pairs, shape (lag, series, coordinate) each.
    """
    values, pairs = [], []
    for lag in lags:
        end = max(len(number) - lag, 0)
        same = number[lag:] == number[:end]
        counts = seen[lag:][same][:, None] & known[:end][same]
        products = white[lag:][same][:, None] * series[:end][same] * counts
        n = np.broadcast_to(counts, products.shape).sum(axis=0)
        values.append(products.sum(axis=0) / np.maximum(n, 1))
        pairs.append(n)
    return np.array(values), np.array(pairs)


def _commands(mode: FilteredMode) -> tuple[Floats, list[str]]:
    """Return the commands that vary, standardised, shape (transition, series), and their names."""
    segments, scene = mode.problem.segments, mode.problem.scene
    columns, names = [], []
    for i, body in enumerate(scene.moving):
        for j, name in enumerate(WRENCH):
            values = segments.actions[:, 0, i, j]
            spread = values.std()
            if not body.kinematic and spread > 1e-9 * max(float(np.abs(values).max()), 1e-300):
                columns.append((values - values.mean()) / spread)
                names.append(f"{name} on {body.name}")
    return np.array(columns).reshape(len(columns), segments.n).T, names


def _regression_p_value(white: Floats, seen: Bools, number: Ints, commands: Floats) -> float | None:
    """Return the p-value of the regression on commands of several lags; None if data are too few.

    Commands that are held are correlated over lags, so their correlations with innovations are not
    independent of each other, but the sum of squares that regression on all explains is
    chi-squared.
    """
    lagged = []
    for lag in range(_LAGS + 1):
        before = np.roll(commands, lag, axis=0)
        before[:lag] = 0.0
        lagged.append(np.where((number == np.roll(number, lag))[:, None], before, 0.0))
    x = np.hstack(lagged)
    statistic, count = 0.0, 0
    for cell in range(white.shape[1]):
        rows = seen[:, cell]
        if rows.sum() <= _LEAST_PAIRS * x.shape[1] // 2:
            continue
        u, size, _ = np.linalg.svd(x[rows], full_matrices=False)
        u = u[:, size > 1e-6 * size.max(initial=0.0)]
        statistic += float(((u.T @ white[rows, cell]) ** 2).sum())
        count += u.shape[1]
    return float(chi2.sf(statistic, count)) if count else None


def _test(
    mode: FilteredMode,
    values: Floats,
    enough: Bools,
    p_value: float,
    names: list[str],
    criteria: Criteria,
) -> ResidualTest:
    """Return the test of correlations with commands, or of whiteness if there are no names.

    It fails where they are significant, and one is large relative to the noise and to the motion.
    ``enough`` tells which were taken over enough pairs.
    """
    share = innovations_over_steps(mode)
    size = np.where(enough, np.abs(values), 0.0)
    large = (size**2 > criteria.residual.correlation_share) & (size * share > criteria.negligible)
    passed = p_value > criteria.false_alarm or not large.any()
    weighted = size if passed else size * share
    lag, series, cell = map(int, np.unravel_index(int(np.argmax(weighted)), size.shape))
    worst, body, dimension = float(values[lag, series, cell]), "", ""
    place = mode.problem.likelihood.noise.coordinates.places[cell]
    lag += not names
    intervals = f"{lag} interval{'s' * (lag > 1)}"
    if not names:
        sentence, other = "errors of successive intervals are not correlated", "itself"
        when = f"{intervals} later"
    else:
        sentence = "errors are not correlated with present and past commands"
        other = names[series].replace("_", " ")
        when = f"{intervals} before" if lag else "of the same interval"
    if not passed:
        body = mode.problem.scene.moving[place // len(STATE)].name
        dimension = STATE[place % len(STATE)]
        sentence = (
            f"the error of {dimension} of {body} is correlated with {other} {when} ({worst:.2f})"
        )
    name = KindOfTest.COMMANDS if names else KindOfTest.WHITENESS
    return ResidualTest(name, p_value, abs(worst), passed, sentence, body, dimension)


#: Recorded quantities that a residual may depend on, with their units.
FEATURES = {
    "position x": "m", "position y": "m", "velocity x": "m/s", "velocity y": "m/s",
    "commanded force x": "N", "commanded force y": "N",
    "orientation (cosine)": "1", "orientation (sine)": "1",
    "forward speed": "m/s", "sideways speed": "m/s", "angular speed": "rad/s", "speed": "m/s",
    "commanded forward force": "N", "commanded sideways force": "N", "commanded torque": "N m",
    "forward force commanded before": "N", "sideways force commanded before": "N",
    "torque commanded before": "N m", "time": "s",
}  # fmt: skip
#: Forces that depend on two quantities together: a spinning body's lift, a force that fades with
#: speed, an actuator with memory, a floor that is rough in places.
PRODUCTS = {
    " × ".join(pair): pair
    for pair in (
        ("angular speed", "forward speed"), ("angular speed", "sideways speed"),
        ("commanded forward force", "forward speed"),
        ("commanded sideways force", "sideways speed"), ("commanded torque", "angular speed"),
        ("commanded forward force", "forward force commanded before"),
        ("commanded sideways force", "sideways force commanded before"),
        ("commanded torque", "torque commanded before"),
        ("position x", "velocity x"), ("position y", "velocity y"),
    )
}  # fmt: skip
#: All of these with their units, in the order of the columns of :func:`recorded_quantities`.
QUANTITIES = FEATURES | {name: f"{FEATURES[a]} {FEATURES[b]}" for name, (a, b) in PRODUCTS.items()}


def folds(mode: FilteredMode, least: int = 8) -> Ints:
    """Return the fold of each transition, shape (transition,): its trajectory, or a run of it.

    Given the measurements before, innovations of different runs are independent. There are at
    ``least`` so many.
    """
    segments = mode.problem.segments
    trajectory, step = segments.trajectory, segments.step
    runs = -(-least // len(np.unique(trajectory)))
    length = np.array([(trajectory == t).sum() for t in trajectory])
    run = np.minimum(step * runs // np.maximum(length, 1), runs - 1)
    return np.unique(trajectory * runs + run, return_inverse=True)[1].astype(np.intp)


def find_dependence(
    mode: FilteredMode, criteria: Criteria, *, seed: int = 0
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
    if n < 20:
        return ResidualTest.untested(KindOfTest.DEPENDENCE, "too few transitions"), None
    tests = len(problem.scene.dynamic)
    permutations = 500 * tests - 1  # the smallest p-value is a fifth of the significance
    chosen = np.sort(rng.permutation(n)[:1500])  # more take long and change nothing
    places = mode.problem.likelihood.noise.coordinates.places
    groups = folds(mode)[chosen]
    relative = innovations_over_steps(mode)
    best: Unexplained | None = None
    for i, body in enumerate(problem.scene.moving):
        if body.kinematic:
            continue
        features = recorded_quantities(problem, i)[chosen]
        of_body = np.flatnonzero(places // len(STATE) == i)
        y, names, of = _in_both_frames(
            mode.whitened_residual[chosen][:, of_body], places[of_body] % len(STATE), features
        )
        y = y - y.mean(axis=0)
        smoother = _cross_validated(np.asarray(sum(_kernels(features))), groups, rng)
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
    kind = KindOfTest.DEPENDENCE
    if best is None:
        sentence = "the innovations depend on no recorded quantity"
        return ResidualTest(kind, 1.0, 0.0, True, sentence), None
    place = best.body, best.dimension
    return ResidualTest(kind, best.p_value, best.share, False, best.sentence, *place), best


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


def _cross_validated(kernel: Floats, groups: Ints, rng: np.random.Generator) -> Floats:
    """Return the matrix that predicts each transition from those of other groups.

    The ridge of the regression is 1, over the kernel's variance of each term; groups are left out
    in five parts.
    """
    smoother = np.zeros_like(kernel)
    names = rng.permutation(np.unique(groups))
    for left_out in np.array_split(names, min(5, len(names))):
        out = np.isin(groups, left_out)
        inner = kernel[np.ix_(~out, ~out)] + np.eye(int((~out).sum()))
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
    weights = np.linalg.solve(sum(_kernels(features)) + np.eye(len(y)), y)
    parts = [np.var(kernel @ weights) for kernel in _kernels(features)]
    name = list(QUANTITIES)[int(np.argmax(parts))]
    sentence = (
        f"the error of {dimension} of {body} depends on its {name}: a regression predicts"
        f" {share:.0%} of its variance, and no effect in the catalogue does"
    )
    return Unexplained(body, dimension, name, float(share), min(1.0, p_value), sentence)
