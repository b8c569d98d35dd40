"""Score tests of candidate effects, with signatures from the simulator, and detection limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.stats import chi2, norm

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria, ResidualCriteria
from pbrl_ppl.criticism.results import Law
from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode, posterior_slopes
from pbrl_ppl.parameters import box, prior_residual, prior_slopes
from pbrl_ppl.state import Floats, Ints
from pbrl_ppl.system.threads import Say, in_parallel, silent


@dataclass(frozen=True, eq=False)
class GridPoint:
    """An effect at one grid point of its scan.

    Parameters
    ----------
    values : ndarray
        The effect's parameters, shape (q,), those that are not scanned at their null value.
    signature : ndarray
        Change of the whitened prediction, shape (n, columns): the derivative by each parameter that
        is not scanned, or the whole change where all are.
    columns : tuple of int
        The parameter of each column; empty for a whole change.
    """

    values: Floats
    signature: Floats
    columns: tuple[int, ...]

    @property
    def proposed(self) -> Floats:
        """Return the grid point as a scan proposes it, shape (q,), NaN for what is not scanned."""
        point = self.values.astype(float)
        point[list(self.columns)] = np.nan
        return point


def each_grid_point(
    mode: Mode, candidate: Attached, proposed: Floats | None = None, most_values: int = 4_000_000
) -> Iterator[GridPoint]:
    """Simulate a candidate at grid points, a few at a time, for each holds a value a measurement.

    Parameters
    ----------
    mode : Mode
        Mode of the model that lacks the effect.
    candidate : Attached
        An effect with a ``scan``.
    proposed : ndarray, optional
        The grid points, shape (point, q); by default all that its scan proposes, simulated with as
        few engine steps as tell them apart.
    most_values : int
        Measurements times grid points in one call, at most; it has at most 8 grid points.

    Yields
    ------
    GridPoint
        The grid points that change a prediction.
    """
    effect, problem = candidate.effect, mode.problem
    if effect.scan is None:
        return
    body = problem.scene.body(candidate.body)
    enlarged = problem.with_physics(effects=(*problem.physics.effects, candidate)).medium
    null = np.array(effect.null)
    steps = 1e-3 * np.array([parameter.prior.scale for parameter in effect.parameters])
    lower, upper = np.array([p.prior.support for p in effect.parameters]).T
    # one-sided where the null is the least that there can be
    ahead, behind = np.minimum(null + steps, upper) - null, np.maximum(null - steps, lower) - null
    if proposed is None:  # one side will do to choose from
        proposed, enlarged = effect.scan(problem.scene, problem.data.history, body), enlarged.coarse
        behind = np.where(ahead > 0.0, 0.0, behind)
    declared = enlarged.layout.places(problem.layout.labels)
    places = enlarged.layout.places(candidate.labels)

    def whitened(points: Floats) -> Floats:
        phi = np.zeros((len(points), enlarged.layout.size))
        phi[:, declared] = mode.phi
        phi[:, places] = points
        return -enlarged.whitened(phi, mode.sigma).reshape(len(points), -1)

    nothing = whitened(null[None])
    at_once = max(1, min(8, most_values // max(mode.whitened_residual.size, 1)))
    for begin in range(0, len(proposed), at_once):
        points, plan = _points(proposed[begin : begin + at_once], null, (ahead, behind))
        states = np.vstack([nothing, whitened(points)])
        for values, columns, rows in plan:
            if columns:
                ends = states[rows].reshape(len(columns), 2, -1)
                width = (ahead - behind)[list(columns)]
                signature = ((ends[:, 0] - ends[:, 1]) / width[:, None]).T
            else:
                signature = (states[rows] - states[0]).T
            signature = np.nan_to_num(signature, posinf=0.0, neginf=0.0)  # where it diverged
            if np.any(signature):
                yield GridPoint(values, signature, columns)


def _points(
    proposed: Floats, null: Floats, steps: tuple[Floats, Floats]
) -> tuple[Floats, list[tuple[Floats, tuple[int, ...], list[int]]]]:
    """Return points to simulate, and each grid point's values, free columns and rows of states.

    Row 0 is that at the null value, where no column has an effect.
    """
    points: list[Floats] = []
    plan = []
    for row in proposed:
        values = np.where(np.isnan(row), null, row)
        columns = tuple(np.flatnonzero(np.isnan(row)).tolist())
        rows = []
        for column in columns:
            for step in steps:
                moved = values.copy()
                moved[column] += step[column]
                if step[column] != 0.0:
                    points.append(moved)
                rows.append(len(points) if step[column] != 0.0 else 0)
        if not columns:
            points.append(values)
            rows = [len(points)]
        plan.append((values, columns, rows))
    return np.array(points), plan


def detection_limits(
    effect: Effect,
    points: Sequence[GridPoint],
    units: Sequence[Floats],
    candidates: int,
    criteria: ResidualCriteria,
) -> dict[str, float]:
    """Return the smallest detectable sizes of an effect, the other parameters at null values.

    Of a scanned one each is at its best grid point. For a whole change by a single parameter, as by
    a threshold, it is the detectable value nearest to the null value; a whole change by several,
    such as an obstacle's place, has no size.

    Parameters
    ----------
    effect : Effect
        The effect.
    points : sequence of GridPoint
        Its grid points.
    units : sequence of ndarray
        Change of the prediction by one unit of each column of a grid point, or all of a whole
        change, in units of noise.
    candidates : int
        Number of tests that the p-value is corrected for, beside the grid points.
    criteria : ResidualCriteria
        P-value and power of the limit.
    """
    tail = criteria.detection_p / 2 / max(candidates * len(points), 1)  # of a two-sided test
    needed = float(norm.isf(tail) + norm.ppf(criteria.detection_power))
    names = [parameter.name for parameter in effect.parameters]
    limits: dict[str, float] = {}
    whole = [
        (point.values, unit) for point, unit in zip(points, units, strict=True) if not point.columns
    ]
    if whole and len(names) == 1:
        null = effect.null[0]
        seen = [values[0] for values, unit in whole if unit[0] >= needed]
        limits[names[0]] = float(min(seen, key=lambda value: abs(value - null), default=np.inf))
    for point, unit in zip(points, units, strict=True):
        with np.errstate(divide="ignore"):
            sizes = needed / unit
        for column, size in zip(point.columns, sizes, strict=False):
            limits[names[column]] = min(limits.get(names[column], np.inf), float(size))
    return limits


def is_upper_limit(effect: Effect, points: Sequence[GridPoint]) -> bool:
    """Return whether smaller is stronger, as for a limit: grid points below the null value."""
    return bool(points) and all(
        not point.columns and point.values[0] < effect.null[0] for point in points
    )


@dataclass(frozen=True, eq=False)
class Signature:
    """Signature of a candidate effect, and its score test.

    Parameters
    ----------
    attached : Attached
        The candidate.
    candidate : Law
        Its test, for the report.
    log_p : float
        Natural logarithm of the p-value before the correction for the number of candidates.
    basis : ndarray
        Orthonormal basis of the projected signature, shape (n, q).
    direction : ndarray
        Unit vector of the fitted signature, shape (n,); zero if there is none.
    linear : tuple of Linearisation
        At the null value, or at the leading grid points of a scan, best first.
    """

    attached: Attached
    candidate: Law
    log_p: float
    basis: Floats
    direction: Floats
    linear: tuple[Linearisation, ...]


def rank_candidates(
    mode: Mode, candidates: Sequence[Attached], criteria: Criteria = DEFAULT, say: Say = silent
) -> list[Signature]:
    """Score every candidate effect at the mode of the model that lacks it, best first.

    See :class:`Library`; the tests are without arrays of several values a row.
    """
    library = Library(mode, criteria=criteria)

    def score(attached: Attached) -> Signature:
        signature = library.scored(attached, len(candidates))
        library.forget(attached)
        return replace(signature, basis=signature.basis[:0].copy(), linear=())

    # p-values of the same physics differ by rounding
    scored = in_parallel(score, candidates, f"scoring {len(candidates)} laws", say)
    return sorted(scored, key=lambda one: round(one.log_p, 3))


class Library:
    """Derivatives of a mode's predictions, by its parameters and by candidates, computed once.

    With whitened residual r, Jacobian J of the mode's parameters and signature D of a candidate
    (its derivative at the value where it vanishes), both r and D are projected off J: what the
    parameters can absorb is no evidence. ``S = r' D (D' D)^-1 D' r`` is the score statistic (C. R.
    Rao, 1948), chi-squared with q degrees of freedom if nothing is missing.

    Parameters
    ----------
    mode : Mode
        Of the model that lacks the candidates.
    laws : tuple of Attached
        Effects of the model in whose place candidates may come.
    criteria : Criteria
        How large an effect may be.
    """

    def __init__(
        self, mode: Mode, laws: tuple[Attached, ...] = (), criteria: Criteria = DEFAULT
    ) -> None:
        self.mode, self.laws, self.criteria = mode, laws, criteria
        self._tests: dict[tuple[Attached, ...], ScoreTest] = {}
        self._scans: dict[Attached, tuple[list[GridPoint], list[GridPoint], list[Floats]]] = {}

    @cached_property
    def slopes(self) -> Floats:
        """Derivative of predictions and priors by the mode's parameters, shape (n, p)."""
        priors = self.mode.problem.layout.priors
        return np.vstack([_slopes(self.mode), np.diag(prior_slopes(priors, self.mode.phi))])

    def test(self, without: tuple[Attached, ...] = ()) -> ScoreTest:
        """Return the score tests at the mode, or to first order at that without some laws."""
        if without not in self._tests:
            mode, layout = self.mode, self.mode.problem.layout
            phi, jacobian, places = mode.phi.copy(), self.slopes, list[int]()
            residual = mode.whitened_residual.ravel()
            for law in without:
                here = layout.places(law.labels)
                places += here
                if law.effect.scan is None:
                    change = phi[here] - law.effect.null
                    residual = residual + jacobian[: len(residual), here] @ change
                phi[here] = law.effect.null
            scanned = [place for law in without if law.effect.scan for place in law.labels]
            if scanned:  # a threshold is no slope
                at = mode.phi.copy()
                here = layout.places(scanned)
                at[here] = phi[here]
                change = mode.problem.whitened(at, mode.sigma) - mode.whitened_residual
                residual = residual + np.nan_to_num(change).ravel()
            residual = np.append(residual, -prior_residual(layout.priors, phi))
            jacobian = np.delete(jacobian, places, axis=1)
            scale = 1.0 / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
            q, r = np.linalg.qr(jacobian * scale)
            # a parameter that neither the data nor the prior inform has no direction
            seen = np.abs(np.diag(r)) > 1e-10 * np.abs(np.diag(r)).max(initial=0.0)
            q, back = q[:, seen], scale[:, None] * np.linalg.pinv(r[seen])
            absorbed = q.T @ residual
            left = residual - q @ absorbed
            phi = np.delete(phi, places) + back @ absorbed
            self._tests[without] = ScoreTest(q, left, self.criteria, phi, back)
        return self._tests[without]

    def scored(
        self, attached: Attached, candidates: int, without: tuple[Attached, ...] = ()
    ) -> Signature:
        """Return the score test of one of so many candidates; a whole change has one sign.

        Its p-value is corrected for grid points and candidates.
        """
        test, effect = self.test(without), attached.effect
        points, tried, units = self.points(attached)
        judged = sorted((test.at(point, attached) for point in points), key=lambda one: one.log_p)
        nowhere = GridPoint(np.array(effect.null, dtype=float), np.zeros((0, 1)), ())
        best = judged[0] if judged else test.nothing(nowhere)
        coordinates = best.basis.T @ test.residual
        values, direction = best.sizes(coordinates), np.zeros(len(test.residual))
        if best.statistic > 0:
            direction = best.basis @ coordinates / np.sqrt(best.statistic)
        names = [parameter.name for parameter in effect.parameters]
        log_p = min(0.0, best.log_p + np.log(max(1, len(tried))))
        candidate = Law(
            effect=effect.name,
            body=attached.body,
            sentence=effect.sentence,
            statistic=best.statistic,
            dof=best.basis.shape[1] or len(best.back),  # directions that are seen
            p_value=float(min(1.0, np.exp(log_p) * candidates)),
            estimate=dict(zip(names, values.tolist(), strict=True)),
            units={parameter.name: parameter.unit for parameter in effect.parameters},
            identifiable=best.share,
            n_grid_points=len(tried),
            detectable=detection_limits(effect, tried, units, candidates, self.criteria.residual),
            is_upper_limit=is_upper_limit(effect, tried),
        )
        linear = tuple(one for one in judged if one.statistic > 0 or effect.scan is None)
        return Signature(attached, candidate, log_p, best.basis, direction, linear)

    def forget(self, attached: Attached) -> None:
        """Let go of a candidate's derivatives, which take much memory in long recordings."""
        self._scans.pop(attached, None)

    def points(self, attached: Attached) -> tuple[list[GridPoint], list[GridPoint], list[Floats]]:
        """Return where a candidate is linearised, all grid points, and changes by a unit of each.

        Of a scan, the four leading ones beside the laws and in their place, simulated with
        more engine steps: with these a body may pass by.
        """
        if attached not in self._scans:
            mode, test = self.mode, self.test()
            if attached.effect.scan is None:
                null = np.array(attached.effect.null, dtype=float)
                columns = tuple(range(len(null)))
                if attached in self.laws:
                    here = mode.problem.layout.places(attached.labels)
                    slopes = self.slopes[: mode.whitened_residual.size, here]
                else:
                    slopes = _slopes(mode, attached)
                point = GridPoint(null, slopes, columns)
                self._scans[attached] = [point], [point], [test.at(point, attached).unit]
            else:
                tests, judged = [test, self.test(self.laws)][: 1 + bool(self.laws)], []
                for point in each_grid_point(mode, attached):
                    scores = [one.at(point, attached) for one in tests]
                    place = replace(point, signature=point.signature[:0].copy())
                    judged.append(([one.log_p for one in scores], place, scores[0].unit))
                leading: dict[int, Floats] = {}
                for i in range(len(tests)):
                    for one in sorted(judged, key=lambda one: one[0][i])[:4]:
                        leading |= {id(one[1]): one[1].proposed} if one[0][i] < 0.0 else {}
                proposed = np.array([*leading.values()])
                finer = list(each_grid_point(mode, attached, proposed)) if leading else []
                self._scans[attached] = finer, [j[1] for j in judged], [j[2] for j in judged]
        return self._scans[attached]


def _slopes(mode: Mode, attached: Attached | None = None) -> Floats:
    """Return the derivative of whitened predictions, shape (n, columns).

    By the parameters of a candidate at its null value, or else by those of the mode. Each candidate
    is simulated by itself, for every law costs time in every engine step.
    """
    effects = mode.problem.physics.effects + (() if attached is None else (attached,))
    enlarged = mode.problem.with_physics(effects=effects).medium
    layout = enlarged.layout
    null = layout.from_layout(mode.problem.layout, mode.phi)
    labels = mode.problem.layout.labels
    if attached is not None:
        labels = attached.labels
        null[layout.places(labels)] = attached.effect.null
    new = layout.places(labels)
    if not new:
        return np.zeros((mode.whitened_residual.size, 0))
    lower, upper = (bound[new] for bound in box(layout.priors))  # a mass of 0 is at the end
    begin = 1e-3 * np.array([layout.priors[place].scale for place in new])

    diverged = np.zeros(mode.whitened_residual.size, dtype=bool)

    def predict(points: Floats, problem: Problem = enlarged) -> Floats:
        phi = np.tile(null, (len(points), 1))
        phi[:, new] = points
        white = problem.whitened(phi, mode.sigma).reshape(len(points), -1)
        diverged[~np.isfinite(white).all(axis=0)] = True
        return -np.nan_to_num(white)

    coarse = partial(predict, problem=enlarged.coarse)
    # beyond the distance that supports keep from their ends, or both ends would be one
    slopes = posterior_slopes(predict, null[new], lower, upper, begin, coarse, least=1e-2)
    slopes[diverged] = 0.0
    return slopes


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Predictions of a candidate near one point, to first order, and their score test.

    Parameters
    ----------
    values : ndarray
        The effect's parameters there, shape (q,).
    columns : tuple of int
        Parameters by which it is linear; none for a whole change, as by a threshold.
    statistic, log_p : float
        Score statistic, and the natural logarithm of its p-value.
    share : float
        Share of the signature that declared parameters do not absorb.
    unit : ndarray
        Change of whitened predictions by one unit of each column, without what is absorbed.
    basis : ndarray
        Orthonormal basis of the change of whitened predictions, without what declared parameters
        absorb, shape (n, direction).
    back : ndarray
        From coordinates in the basis to sizes of the columns (or of the whole change, which is 1),
        shape (column, direction).
    absorbed : ndarray
        By how much declared parameters change with coordinates in the basis, shape (p, direction).
    """

    values: Floats
    columns: tuple[int, ...]
    statistic: float
    log_p: float
    share: float
    unit: Floats
    basis: Floats
    back: Floats
    absorbed: Floats

    def sizes(self, coordinates: Floats) -> Floats:
        """Return the effect's parameters, shape (q,), at coordinates in the basis."""
        values = self.values.copy()
        values[list(self.columns)] += (self.back @ coordinates)[: len(self.columns)]
        return values


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """Score tests of candidates at one mode.

    Parameters
    ----------
    q : ndarray
        Orthonormal directions that the declared parameters absorb, shape (n, direction).
    residual : ndarray
        Whitened residual without these directions, shape (n,).
    criteria : Criteria
        Which signatures are absorbed.
    phi : ndarray
        The declared parameters' optimum to first order, shape (p,).
    back : ndarray
        From coordinates in those directions to the parameters, shape (p, direction).
    """

    q: Floats
    residual: Floats
    criteria: Criteria
    phi: Floats
    back: Floats

    def left(self, rows: Floats) -> Floats:
        """Return whitened rows, shape (n, ...), without what the declared parameters absorb."""
        return np.asarray(rows - self.q @ (self.q.T @ rows))

    def nothing(self, point: GridPoint, share: float = 0.0) -> Linearisation:
        """Return no evidence at a grid point of whose signature this share is not absorbed."""
        count = point.signature.shape[1]
        sizes = len(self.residual), count, len(self.phi)
        basis, back, absorbed = (np.zeros((size, 0)) for size in sizes)
        return Linearisation(
            point.values, point.columns, 0.0, 0.0, share, np.zeros(count), basis, back, absorbed
        )

    def at(self, point: GridPoint, attached: Attached) -> Linearisation:
        """Return the score test of a candidate at a grid point.

        Directions that are invisible at typical sizes of the columns are left out.
        """
        absorbed_below = 1e-3  # share that declared parameters leave, or they absorb a signature
        columns, scales, sides = list(point.columns), np.ones(1), np.ones(1, dtype=np.intp)
        if columns:
            sides = null_sides(attached)[columns]
            scales = np.array([attached.effect.parameters[i].prior.sigma for i in columns])
        missing = len(self.residual) - len(point.signature)
        signature = np.pad(point.signature, ((0, missing), (0, 0))) * scales
        projected = self.left(signature)
        total = (signature**2).sum()
        share = float((projected**2).sum() / total) if total > 0 else 0.0
        if not share > absorbed_below:
            return self.nothing(point, share)
        u, s, vt = np.linalg.svd(projected, full_matrices=False)
        whole = np.linalg.norm(signature @ vt.T, axis=0)  # before the projection
        # a change of less than 1e-3 of the noise is the engine's rounding
        keep = (s > 1e-6 * s.max()) & (s >= min(1e-3, s.max()))
        keep &= s**2 > absorbed_below * whole**2
        basis = u[:, keep]
        unit = np.sqrt((projected**2).sum(axis=0)) / scales
        coordinates = basis.T @ self.residual
        along = vt[keep].T / s[keep]
        back, absorbed = scales[:, None] * along, self.back @ (self.q.T @ (signature @ along))
        statistic = float(coordinates @ coordinates)
        log_p = float(chi2.logsf(statistic, max(1, int(keep.sum()))))
        seen = int(np.argmax(np.abs(vt[0])))
        if sides[seen] and keep.sum() == 1 and np.abs(vt[0, seen]) > 1 - 1e-6:
            # it can only have one sign: half the p-value, and no evidence for the other sign
            allowed = sides[seen] * (back @ coordinates)[seen] > 0
            statistic = statistic if allowed else 0.0
            log_p = log_p + np.log(0.5) if allowed else 0.0
        return Linearisation(
            point.values, point.columns, statistic, log_p, share, unit, basis, back, absorbed
        )


def null_sides(attached: Attached) -> Ints:
    """Return the side of its null value on which each parameter must be; 0 if on any."""
    supports = [(p.null, *p.prior.support) for p in attached.effect.parameters]
    return np.array([int(null == low) - int(null == high) for null, low, high in supports])


def same_physics(first: Signature, second: Signature, cosine: float = 0.9999) -> bool:
    """Return whether two candidates are the same physics here, as two drags on one pendulum."""
    if first.basis.shape != second.basis.shape or first.candidate.dof != second.candidate.dof:
        return False
    overlap = np.linalg.svd(first.basis.T @ second.basis, compute_uv=False)
    return bool(overlap.size and overlap.min() > cosine)


def named_beside(attached: Attached, leader: Attached) -> str:
    """Return an effect's name, with its body if the leader acts on another."""
    name = attached.effect.name
    return name if attached.body == leader.body else f"{name} on {attached.body}"
