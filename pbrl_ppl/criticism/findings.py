"""Findings of the loop as plain results, and the JSON contract they are written in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.posterior import Comparison, Identifiability
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: The three verdicts.
ADEQUATE, EFFECTS_ADDED, UNEXPLAINED = "adequate", "effects-added", "unexplained"


@dataclass(frozen=True)
class Candidate:
    """An effect that the model lacks, and how strongly the residual asks for it.

    Parameters
    ----------
    effect, body : str
        What, and on which body.
    sentence : str
        What it means in words.
    statistic : float
        Score statistic S; chi-squared with ``dof`` degrees of freedom if the effect is absent.
    dof : int
        Number of the signature's columns: the effect's parameters, less those that are scanned, and
        one where all are.
    p_value : float
        Probability of a statistic at least as large by chance, corrected for the number of
        candidates.
    estimate : dict of str to float
        First estimate of each parameter, from the signature alone.
    units : dict of str to str
        Unit of each parameter.
    identifiable : float
        Share of the signature (0 to 1) that the declared parameters cannot absorb.
    looks : int
        At how many places, thresholds or times it was tried; the p-value pays for them.
    """

    effect: str
    body: str
    sentence: str
    statistic: float
    dof: int
    p_value: float
    estimate: Mapping[str, float]
    units: Mapping[str, str]
    identifiable: float
    looks: int = 1


@dataclass(frozen=True)
class Estimate:
    """Posterior summary of one parameter: mean, sd and 94 % highest-density interval."""

    mean: float
    sd: float
    hdi: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Added:
    """An effect that was added to the model, with its posterior and what it gained.

    Parameters
    ----------
    effect, body, sentence : str
        What, on which body, and what it means in words.
    statistic, p_value : float
        Of the round in which it was found.
    parameters : dict of str to Estimate
        Posterior of each of its parameters.
    not_separable_from : tuple of str
        Effects that would explain these data as well.
    elpd_difference, elpd_difference_se : float
        Gain of log predictive density on held-out transitions, and its standard error.
    """

    effect: str
    body: str
    sentence: str
    statistic: float
    p_value: float
    parameters: Mapping[str, Estimate]
    not_separable_from: tuple[str, ...]
    elpd_difference: float
    elpd_difference_se: float


@dataclass(frozen=True)
class Numerical:
    """Engine substeps declared and used, and how far doubling the declared ones moves results."""

    substeps_declared: int
    substeps_used: int
    shift_in_noise_units: float


@dataclass(frozen=True)
class Errors:
    """Errors on held-out data.

    Parameters
    ----------
    one_step_rmse : dict of str to float
        Root mean square error one interval ahead, per state dimension, in its unit.
    rollout_rmse : dict of str to float
        The same at the end of a rollout of several intervals.
    normalised_rmse : float
        Root mean square of the residual in units of the noise: 1 is as good as can be.
    elpd : float
        Log predictive density, summed over held-out transitions.
    """

    one_step_rmse: Mapping[str, float]
    rollout_rmse: Mapping[str, float]
    normalised_rmse: float
    elpd: float


@dataclass(frozen=True)
class Rollout:
    """One held-out trajectory: measured, and predicted from its first state.

    Parameters
    ----------
    body : str
        The body shown.
    time : ndarray
        Seconds since the start, shape (time,).
    names, units : tuple of str
        State dimensions shown, and their units.
    measured, before, after : ndarray
        Shape (time, state); measured is NaN where missing.
    """

    body: str
    time: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    measured: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class Unexplained:
    """Structure that remains in the residual after all that the catalogue explains.

    Parameters
    ----------
    body, dimension : str
        Where it is strongest.
    depends_on : str
        The quantity it depends on most.
    share : float
        Share of that residual's variance that a flexible regression predicts (0 to 1).
    p_value : float
        Of a permutation test.
    sentence : str
        The same in words.
    """

    body: str
    dimension: str
    depends_on: str
    share: float
    p_value: float
    sentence: str


@dataclass(frozen=True, eq=False)
class Findings:
    """Findings of the closed loop.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    verdict : str
        ``adequate``, ``effects-added`` or ``unexplained``.
    numerical : Numerical
        Whether the engine's own error is small enough.
    candidates : tuple of Candidate
        All candidates of the first round, best first.
    added : tuple of Added
        Effects added, in order.
    unexplained : Unexplained or None
        What remains.
    before, after, noise_floor : Errors
        On held-out data, of the declared model, the revised one, and a perfect one.
    posterior_before, posterior_after : InferenceData or DataTree
        What ArviZ's functions take; the same object twice if nothing was added.
    residuals_before, residuals_after : dict of str to ndarray
        Held-out residuals in units of noise per state dimension, 1-d arrays.
    rollout : Rollout
        One held-out trajectory.
    horizon : int
        Intervals predicted from one measured state in the fits.
    rollout_horizon : int
        Intervals of ``rollout_rmse``.
    provenance : dict
        Seed, versions, hash of the data, number of transitions, horizons.
    identifiability : Identifiability or None
        Which parameters of the model after revision the data inform.
    loo : Comparison or None
        Leave-one-out cross-validation of both models on the data they were fitted to.
    """

    scene: Scene
    verdict: str
    numerical: Numerical
    candidates: tuple[Candidate, ...]
    added: tuple[Added, ...]
    unexplained: Unexplained | None
    before: Errors
    after: Errors
    noise_floor: Errors
    posterior_before: Any
    posterior_after: Any
    residuals_before: Mapping[str, Array]
    residuals_after: Mapping[str, Array]
    rollout: Rollout
    horizon: int
    rollout_horizon: int
    provenance: Mapping[str, Any]
    identifiability: Identifiability | None = None
    loo: Comparison | None = None

    def to_dict(self) -> dict[str, Any]:
        """The contents of ``report.json``; numbers that are not finite become null."""
        contents: dict[str, Any] = _clean(
            {
                "verdict": self.verdict,
                "numerical": vars(self.numerical),
                "added": [
                    {
                        "effect": added.effect,
                        "body": added.body,
                        "statistic": added.statistic,
                        "p_value": added.p_value,
                        "parameters": {name: vars(e) for name, e in added.parameters.items()},
                        "not_separable_from": added.not_separable_from,
                        "elpd_difference": added.elpd_difference,
                        "elpd_difference_se": added.elpd_difference_se,
                    }
                    for added in self.added
                ],
                "candidates": [
                    {
                        "effect": candidate.effect,
                        "body": candidate.body,
                        "statistic": candidate.statistic,
                        "dof": candidate.dof,
                        "p_value": candidate.p_value,
                        "estimate": candidate.estimate,
                        "identifiable": candidate.identifiable,
                        "looks": candidate.looks,
                    }
                    for candidate in self.candidates
                ],
                "unexplained": None if self.unexplained is None else vars(self.unexplained),
                "error": {
                    "before": vars(self.before),
                    "after": vars(self.after),
                    "noise_floor": vars(self.noise_floor),
                },
                "identifiability": self.identifiability and self.identifiability.to_dict(),
                "loo": self.loo and self.loo.to_dict(),
                "provenance": self.provenance,
            }
        )
        return contents


def _clean(value: Any) -> Any:
    """Plain JSON values."""
    if isinstance(value, Mapping):
        return {str(key): _clean(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_clean(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
