"""Residuals traced to missing effects: score statistics with signatures from the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pbrl_ppl.criticism.findings import Candidate
from pbrl_ppl.effects import Attached
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import Mode, posterior_steps
from pbrl_ppl.parameters import prior_residual

Array = NDArray[np.float64]

#: Signatures whose directions agree more than this cannot be told apart.
PARALLEL = 0.95
#: ... and more than this, they are the same.
SAME = 0.9999
#: A difference of score statistics beyond this tells even nearly parallel signatures apart.
DECISIVE = 10.0
#: Less than this share of a signature left means that the declared parameters absorb it.
ABSORBED = 1e-3


@dataclass(frozen=True, eq=False)
class Signature:
    """What a candidate effect would do to the residual, and how much of that is seen in it.

    Parameters
    ----------
    attached : Attached
        The candidate.
    candidate : Candidate
        Its statistic, for the report.
    log_p : float
        Natural logarithm of the uncorrected p-value: the ranking.
    basis : ndarray
        Orthonormal basis of the projected signature, shape (n, q).
    direction : ndarray
        Unit vector of the fitted signature, shape (n,); zero if there is none.
    """

    attached: Attached
    candidate: Candidate
    log_p: float
    basis: Array
    direction: Array


def rank_candidates(mode: Mode, candidates: Sequence[Attached]) -> list[Signature]:
    """Score every candidate effect at the mode of the model that lacks it, best first.

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

    Returns
    -------
    list of Signature
        Smallest p-value first; of equal ones, the earlier in the catalogue.
    """
    if not candidates:
        return []
    residual, jacobian, signatures = _signatures(mode, candidates)
    q, r = np.linalg.qr(jacobian)
    # a parameter that the data and the prior say nothing about has no direction
    q = q[:, np.abs(np.diag(r)) > 1e-10 * np.abs(np.diag(r)).max(initial=0.0)]
    left = residual - q @ (q.T @ residual)
    scored = []
    for one, signature in zip(candidates, signatures, strict=True):
        projected = signature - q @ (q.T @ signature)
        scored.append(_score(one, signature, projected, left, len(candidates)))
    return sorted(scored, key=lambda each: each.log_p)


def _signatures(mode: Mode, candidates: Sequence[Attached]) -> tuple[Array, Array, list[Array]]:
    """Residual, Jacobian and every candidate's signature, with the prior as further rows.

    Returns
    -------
    residual : ndarray
        Shape (n + p,), whitened, with the sign of measured minus predicted.
    jacobian : ndarray
        Derivative of the prediction by the declared parameters, shape (n + p, p).
    signatures : list of ndarray
        Derivative of the prediction by each candidate's parameters, shape (n + p, q) each.
    """
    problem, p = mode.problem, len(mode.phi)
    priors = problem.layout.priors
    wide = problem.with_physics(effects=(*problem.physics.effects, *candidates))
    # declared parameters come first in both layouts, block by block, so look each one up
    labels = wide.layout.labels
    declared = [labels.index(label) for label in problem.layout.labels]
    null = np.zeros(wide.layout.size)
    null[declared] = mode.phi
    columns: list[list[int]] = []
    for one in candidates:
        places = []
        for parameter in one.effect.parameters:
            place = labels.index(f"{one.effect.variable(parameter)}[{one.body}]")
            null[place] = parameter.null
            places.append(place)
        columns.append(places)
    new = [place for places in columns for place in places]
    lower, upper = (bound[new] for bound in wide.layout.bounds)
    begin = np.array([1e-3 * min(wide.layout.priors[place].sigma, 1.0) for place in new])

    def predict(points: Array) -> Array:
        phi = np.tile(null, (len(points), 1))
        phi[:, new] = points
        return -np.nan_to_num(wide.whitened(phi, mode.sigma)).reshape(len(points), -1)

    derivative, _ = posterior_steps(predict, null[new], lower, upper, begin)
    derivative = np.vstack([derivative, np.zeros((p, len(new)))])
    residual = np.concatenate([mode.whitened_residual().ravel(), -prior_residual(priors, mode.phi)])
    slopes = _prior_slopes(problem, mode.phi)
    jacobian = np.vstack([-mode.jacobian, np.diag(slopes)])
    edges = np.cumsum([0, *map(len, columns)])
    split = [derivative[:, a:b] for a, b in pairwise(edges)]
    return residual, jacobian, split


def _prior_slopes(problem: Problem, phi: Array) -> Array:
    """Derivative of each prior's residual, shape (p,)."""
    step = 1e-6 * np.maximum(np.abs(phi), 1e-3)
    priors = problem.layout.priors
    return (prior_residual(priors, phi + step) - prior_residual(priors, phi - step)) / (2 * step)


def _score(
    one: Attached, signature: Array, projected: Array, residual: Array, n_candidates: int
) -> Signature:
    effect = one.effect
    dof = len(effect.parameters)
    size = (signature**2).sum()
    share = float((projected**2).sum() / size) if size > 0 else 0.0
    estimate, statistic, log_p = np.zeros(dof), 0.0, 0.0
    basis, direction = np.zeros((len(residual), 0)), np.zeros(len(residual))
    if share > ABSORBED:
        u, s, vt = np.linalg.svd(projected, full_matrices=False)
        keep = s > 1e-6 * s.max()
        basis = u[:, keep]
        coordinates = basis.T @ residual
        estimate = vt[keep].T @ (coordinates / s[keep])
        statistic = float(coordinates @ coordinates)
        log_p = float(chi2.logsf(statistic, int(keep.sum())))
        if dof == 1:
            lower, upper = effect.parameters[0].prior.support
            if effect.parameters[0].null in (lower, upper):
                # it can only be on one side of nothing: half the chance, and none on the other side
                allowed = (estimate[0] > 0) == (effect.parameters[0].null == lower)
                statistic = statistic if allowed else 0.0
                log_p = log_p + np.log(0.5) if allowed else 0.0
        if statistic > 0:
            direction = basis @ coordinates / np.sqrt(statistic)
    names = [parameter.name for parameter in effect.parameters]
    values = np.array(effect.null) + estimate
    candidate = Candidate(
        effect=effect.name,
        body=one.body,
        sentence=effect.sentence,
        statistic=statistic,
        dof=dof,
        p_value=float(min(1.0, np.exp(log_p) * n_candidates)),
        estimate=dict(zip(names, values.tolist(), strict=True)),
        units={parameter.name: parameter.unit for parameter in effect.parameters},
        identifiable=share,
    )
    return Signature(one, candidate, log_p, basis, direction)


def twins(one: Signature, other: Signature) -> bool:
    """Whether two candidates are the same physics here, such as drags on a single pendulum."""
    if one.basis.shape != other.basis.shape or one.candidate.dof != other.candidate.dof:
        return False
    overlap = np.linalg.svd(one.basis.T @ other.basis, compute_uv=False)
    return bool(overlap.size and overlap.min() > SAME)


def inseparable(leader: Signature, others: Sequence[Signature]) -> tuple[str, ...]:
    """Names of effects that explain the residual as the leader does, as far as the data can tell.

    Parameters
    ----------
    leader : Signature
        The effect to be added.
    others : sequence of Signature
        All ranked candidates.
    """
    names = []
    for other in others:
        if other is leader or other.basis.shape[1] == 0:
            continue
        cosine = float(np.linalg.norm(other.basis.T @ leader.direction))
        behind = leader.candidate.statistic - other.candidate.statistic
        if cosine > PARALLEL and behind < DECISIVE:
            same_body = other.attached.body == leader.attached.body
            name = other.attached.effect.name
            names.append(name if same_body else f"{name} on {other.attached.body}")
    return tuple(names)
