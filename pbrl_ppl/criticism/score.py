"""Score tests of candidate effects, with signatures from the simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import chi2, norm

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.results import Candidate
from pbrl_ppl.criticism.scan import (
    GridPoint,
    detection_limits,
    each_grid_point,
    is_upper_limit,
)
from pbrl_ppl.effects import Attached, Noise
from pbrl_ppl.likelihood import Problem, is_filtered
from pbrl_ppl.modes import Mode, posterior_slopes
from pbrl_ppl.parameters import box, prior_residual, prior_slopes
from pbrl_ppl.state import Floats, Ints
from pbrl_ppl.threads import in_parallel

#: Where the declared parameters leave less than this share of a signature they absorb it.
ABSORBED = 1e-3
#: A change below this, in units of noise, is the engine's rounding.
VISIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class Signature:
    """Signature of a candidate effect, and its score test.

    Parameters
    ----------
    attached : Attached
        The candidate.
    candidate : Candidate
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
    candidate: Candidate
    log_p: float
    basis: Floats
    direction: Floats
    linear: tuple[Linearisation, ...]

    def without_bases(self) -> Signature:
        """Return the test with its direction, without arrays of several values a row."""
        return replace(self, basis=self.basis[:0].copy(), linear=())

    def test_alone(self) -> Signature:
        """Return the test without arrays of n values."""
        return replace(self.without_bases(), direction=self.direction[:0].copy())


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Predictions of a candidate near one point, to first order.

    Parameters
    ----------
    values : ndarray
        The effect's parameters there, shape (q,).
    columns : tuple of int
        Parameters by which it is linear; none for a whole change, as by a threshold.
    basis : ndarray
        Orthonormal basis of the change of whitened predictions, without what declared parameters
        absorb, shape (n, direction).
    back : ndarray
        From coordinates in the basis to sizes of the columns (or of the whole change, which is 1),
        shape (column, direction).
    """

    values: Floats
    columns: tuple[int, ...]
    basis: Floats
    back: Floats

    def sizes(self, coordinates: Floats) -> Floats:
        """Return the effect's parameters, shape (q,), at coordinates in the basis."""
        values = self.values.copy()
        values[list(self.columns)] += (self.back @ coordinates)[: len(self.columns)]
        return values


def _whole(signature: Signature) -> Signature:
    return signature


def rank_candidates(
    mode: Mode,
    candidates: Sequence[Attached],
    criteria: Criteria = DEFAULT,
    kept: Callable[[Signature], Signature] = _whole,
) -> list[Signature]:
    """Score every candidate effect at the mode of the model that lacks it, best first.

    See :func:`score_candidates`.
    """
    return score_candidates(mode, candidates, criteria, kept)[1]


def score_candidates(
    mode: Mode,
    candidates: Sequence[Attached],
    criteria: Criteria = DEFAULT,
    kept: Callable[[Signature], Signature] = _whole,
) -> tuple[Floats, list[Signature]]:
    """Return the whitened residual without what parameters absorb, and candidates, best first.

    With whitened residual r, Jacobian J of the declared parameters and signature D of a candidate
    (its derivative at the value where it vanishes), both r and D are projected off J: what the
    declared parameters can absorb is no evidence. ``S = r' D (D' D)^-1 D' r`` is the score
    statistic (C. R. Rao, 1948), chi-squared with q degrees of freedom if nothing is missing.

    Parameters
    ----------
    mode : Mode
        Mode of the declared model.
    candidates : sequence of Attached
        Effects that it lacks.
    criteria : Criteria
        Which signatures are absorbed.
    kept : callable
        Returns what of each signature is kept, such as :meth:`Signature.without_bases`.

    Returns
    -------
    residual : ndarray
        Shape (n,).
    list of Signature
        Smallest p-value first; ties in the catalogue's order. Effects of the noise
        stage come last.
    """
    test = _score_test(mode, len(candidates), criteria)

    def score(attached: Attached) -> Signature:
        best = _tail_score if _of_noise(attached) else _best_grid_point
        return kept(best(mode, attached, test))

    # the noise's shape comes last: any missing effect makes tails heavy; p-values of the same
    # physics differ by rounding
    def order(signature: Signature) -> tuple[bool, float]:
        return _of_noise(signature.attached), round(signature.log_p, 3)

    return test.residual, sorted(in_parallel(score, candidates), key=order)


def linearised(
    mode: Mode, candidates: Sequence[Attached], criteria: Criteria = DEFAULT
) -> tuple[ScoreTest, dict[Attached, tuple[Linearisation, ...]]]:
    """Return the score tests at a mode, and candidates linearised at every grid point.

    Those without a scan are linearised at the null value, those of the noise not at all. Candidates
    that the declared parameters absorb have no linearisation.
    """
    test = _score_test(mode, len(candidates), criteria)

    def every(attached: Attached) -> tuple[Linearisation, ...]:
        tried = [] if _of_noise(attached) else _points(mode, attached)
        seen = [test.at(point, attached).about(point) for point in tried]
        return tuple(one for one in seen if one.basis.shape[1])

    return test, dict(zip(candidates, in_parallel(every, candidates), strict=True))


def _score_test(mode: Mode, candidates: int, criteria: Criteria) -> ScoreTest:
    """Return the score tests at a mode, with the prior as further rows of the residual."""
    priors = mode.problem.layout.priors
    residual = np.concatenate([mode.whitened_residual.ravel(), -prior_residual(priors, mode.phi)])
    jacobian = np.vstack([_slopes(mode), np.diag(prior_slopes(priors, mode.phi))])
    scale = 1.0 / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    q, r = np.linalg.qr(jacobian * scale)
    # a parameter that neither the data nor the prior inform has no direction
    informed = np.abs(np.diag(r)) > 1e-10 * np.abs(np.diag(r)).max(initial=0.0)
    q = q[:, informed]
    return ScoreTest(q, residual - q @ (q.T @ residual), candidates, criteria)


def _points(mode: Mode, attached: Attached) -> Iterable[GridPoint]:
    """Return a candidate at every grid point of its scan, or else at its null value."""
    if attached.effect.scan is not None:
        return each_grid_point(mode, attached)
    null = np.array(attached.effect.null, dtype=float)
    return [GridPoint(null, _slopes(mode, attached), tuple(range(len(null))))]


def _slopes(mode: Mode, attached: Attached | None = None) -> Floats:
    """Return the derivative of whitened predictions, shape (n, columns).

    By the parameters of a candidate at its null value, or else by the declared ones. Each candidate
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

    def predict(points: Floats, problem: Problem = enlarged) -> Floats:
        phi = np.tile(null, (len(points), 1))
        phi[:, new] = points
        return -np.nan_to_num(problem.whitened(phi, mode.sigma)).reshape(len(points), -1)

    coarse = partial(predict, problem=enlarged.coarse)
    return posterior_slopes(predict, null[new], lower, upper, begin, coarse)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Result of the score test of a signature's columns."""

    statistic: float
    log_p: float
    share: float
    size: Floats
    basis: Floats
    direction: Floats
    unit: Floats
    back: Floats

    def test_alone(self) -> _Evidence:
        """Return the evidence without arrays of n values."""
        return replace(self, basis=self.basis[:0].copy(), direction=self.direction[:0].copy())

    def about(self, point: GridPoint) -> Linearisation:
        """Return the linearisation of the signature of a grid point."""
        return Linearisation(point.values, point.columns, self.basis, self.back)


def _none(n: int) -> _Evidence:
    """Return no evidence for one column, over n whitened residuals."""
    nothing = np.zeros(1), np.zeros((n, 0)), np.zeros(n), np.zeros(1)
    return _Evidence(0.0, 0.0, 0.0, *nothing, np.zeros((1, 0)))


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """Score tests of candidates at one mode.

    Parameters
    ----------
    q : ndarray
        Orthonormal directions that the declared parameters absorb, shape (n, direction).
    residual : ndarray
        Whitened residual without these directions, shape (n,).
    candidates : int
        Number of candidates, which p-values are corrected for.
    criteria : Criteria
        Which signatures are absorbed.
    """

    q: Floats
    residual: Floats
    candidates: int
    criteria: Criteria

    def left(self, rows: Floats) -> Floats:
        """Return whitened rows, shape (n, ...), without what the declared parameters absorb."""
        return np.asarray(rows - self.q @ (self.q.T @ rows))

    def at(self, point: GridPoint, attached: Attached) -> _Evidence:
        """Return the score test of a candidate at a grid point."""
        missing = len(self.residual) - len(point.signature)
        rows, columns = np.pad(point.signature, ((0, missing), (0, 0))), list(point.columns)
        sides = null_sides(attached)[columns] if columns else np.ones(1, dtype=np.intp)
        scales = _scales(attached)[columns] if columns else np.ones(1)
        return self.evidence(rows, sides, scales)

    def evidence(self, signature: Floats, sides: Ints, scales: Floats) -> _Evidence:
        """Return the score test of a signature.

        Parameters
        ----------
        signature : ndarray
            Shape (n, columns).
        sides : ndarray of int
            1 (or -1) where a column's size can only be positive (or negative), shape (columns,).
        scales : ndarray
            Typical sizes, shape (columns,): directions that are invisible at these are left out.
        """
        signature = signature * scales
        projected = self.left(signature)
        total = (signature**2).sum()
        share = float((projected**2).sum() / total) if total > 0 else 0.0
        n, columns = signature.shape
        size, statistic, log_p = np.zeros(columns), 0.0, 0.0
        unit = np.zeros(columns)
        basis, direction, back = np.zeros((n, 0)), np.zeros(n), np.zeros((columns, 0))
        if share > ABSORBED:
            u, s, vt = np.linalg.svd(projected, full_matrices=False)
            whole = np.linalg.norm(signature @ vt.T, axis=0)  # before the projection
            keep = (s > 1e-6 * s.max()) & (s >= min(VISIBLE, s.max()))
            keep &= s**2 > ABSORBED * whole**2
            basis = u[:, keep]
            unit = np.sqrt((projected**2).sum(axis=0)) / scales
            coordinates = basis.T @ self.residual
            back = scales[:, None] * vt[keep].T / s[keep]
            size = back @ coordinates
            statistic = float(coordinates @ coordinates)
            log_p = float(chi2.logsf(statistic, max(1, int(keep.sum()))))
            seen = int(np.argmax(np.abs(vt[0])))
            if sides[seen] and keep.sum() == 1 and np.abs(vt[0, seen]) > 1 - 1e-6:
                # it can only have one sign: half the p-value, and no evidence for the other sign
                allowed = sides[seen] * size[seen] > 0
                statistic = statistic if allowed else 0.0
                log_p = log_p + np.log(0.5) if allowed else 0.0
            if statistic > 0:
                direction = basis @ coordinates / np.sqrt(statistic)
        return _Evidence(statistic, log_p, share, size, basis, direction, unit, back)


def null_sides(attached: Attached) -> Ints:
    """Return the side of its null value on which each parameter must be; 0 if on any."""
    supports = [(p.null, *p.prior.support) for p in attached.effect.parameters]
    return np.array([int(null == low) - int(null == high) for null, low, high in supports])


def _scales(attached: Attached) -> Floats:
    """Return the typical sizes of an effect's parameters under their priors."""
    return np.array([parameter.prior.sigma for parameter in attached.effect.parameters])


def _signature(
    attached: Attached,
    evidence: _Evidence,
    values: Floats,
    test: ScoreTest,
    tried: Sequence[GridPoint],
    units: Sequence[Floats],
    linear: tuple[Linearisation, ...] = (),
) -> Signature:
    """Return a candidate's signature, its p-value corrected for grid points and candidates.

    ``units`` are the changes by one unit of each column of the grid points that were ``tried``.
    """
    effect = attached.effect
    names = [parameter.name for parameter in effect.parameters]
    log_p = min(0.0, evidence.log_p + np.log(max(1, len(tried))))
    candidate = Candidate(
        effect=effect.name,
        body=attached.body,
        sentence=effect.sentence,
        statistic=evidence.statistic,
        dof=evidence.basis.shape[1] or evidence.size.size,  # directions that are seen
        p_value=float(min(1.0, np.exp(log_p) * test.candidates)),
        estimate=dict(zip(names, values.tolist(), strict=True)),
        units={parameter.name: parameter.unit for parameter in effect.parameters},
        identifiable=evidence.share,
        n_grid_points=len(tried),
        detectable=detection_limits(effect, tried, units, test.candidates, test.criteria.residual),
        is_upper_limit=is_upper_limit(effect, tried),
    )
    return Signature(attached, candidate, log_p, evidence.basis, evidence.direction, linear)


def _best_grid_point(mode: Mode, attached: Attached, test: ScoreTest, again: int = 4) -> Signature:
    """Return the signature of the grid point that explains most; a whole change has one sign.

    The ``again`` leading ones of a scan are simulated again with more engine steps.
    """
    scanned = attached.effect.scan is not None
    judged = []
    for point in _points(mode, attached):
        score = test.at(point, attached)
        judged.append((score.test_alone(), point.place) if scanned else (score, point))
    tried, units = [point for _, point in judged], [score.unit for score, _ in judged]
    if scanned:  # with more engine steps a body may pass by
        leading = sorted(judged, key=lambda x: x[0].log_p)[:again]
        finer: list[GridPoint] = []
        if leading and leading[0][0].log_p < 0.0:
            proposed = np.array([point.proposed for _, point in leading])
            finer = list(each_grid_point(mode, attached, proposed))
        judged = sorted(
            ((test.at(point, attached), point) for point in finer), key=lambda x: x[0].log_p
        )
    best, values = _none(len(test.residual)), np.array(attached.effect.null)
    if judged:
        best, point = judged[0]
        values = point.values.copy()
        for column, size in zip(point.columns, best.size, strict=False):
            values[column] += size
    linear = tuple(
        one.about(point) for one, point in judged
        if one.statistic > 0 or attached.effect.scan is None
    )  # fmt: skip
    return _signature(attached, best, values, test, tried, units, linear)


def _of_noise(attached: Attached) -> bool:
    """Return whether an effect is of the noise's shape."""
    return isinstance(attached.effect.stage, Noise)


def _tail_score(mode: Mode, attached: Attached, test: ScoreTest) -> Signature:
    """Return the score test of the noise's tail: the kurtosis, with sigma's score projected out.

    The derivative of Student-t's log-density by the reciprocal of its degrees of freedom at zero is
    (z^4 - 2 z^2 - 1) / 4; without its projection on sigma's score it is the fourth Hermite
    polynomial over 4, of variance 3/2.
    """
    problem = mode.problem
    seen = problem.observations.measured
    if is_filtered(problem):
        seen = problem.likelihood.noise.seen
    whitened = test.residual[: seen.size].reshape(seen.shape)
    # coordinates that never move have no noise, and would make all others look heavy-tailed
    moving = seen & (np.abs(whitened).max(axis=0) > VISIBLE)
    z = whitened[moving] if problem.nu(mode.phi) is None else np.zeros(0)
    z = z / max(float(np.sqrt(np.mean(z**2))), 1e-300) if len(z) else z
    score, variance = float((z**4 - 6 * z**2 + 3).sum() / 4), 1.5 * max(len(z), 1)
    heavier = score > 0
    evidence = replace(
        _none(len(test.residual)),
        statistic=score**2 / variance if heavier else 0.0,
        log_p=float(norm.logsf(score / np.sqrt(variance))) if heavier else 0.0,
        share=1.0,
        unit=np.array([np.sqrt(variance) if len(z) else 0.0]),
    )
    values = np.array(attached.effect.null)
    point = GridPoint(values, np.zeros((0, 1)), (0,))
    if heavier and len(values) == 1:
        values = values + score / variance
    return _signature(attached, evidence, values, test, [point], [evidence.unit])


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
