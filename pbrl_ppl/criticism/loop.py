"""Findings of the loop as plain results, and the JSON contract they are written in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism.results import (
    Acceleration,
    Added,
    Candidate,
    Correlations,
    Errors,
    Growth,
    Numerical,
    ResidualTest,
    Rollout,
    Unexplained,
)
from pbrl_ppl.history import UnusedVelocity
from pbrl_ppl.posterior import Comparison, Identifiability
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: The verdicts; the last is none, for the chains do not agree.
ADEQUATE, EFFECTS_ADDED, UNEXPLAINED = "adequate", "effects-added", "unexplained"
NOT_CONVERGED = "not-converged"


@dataclass(frozen=True, eq=False)
class Findings:
    """Findings of the closed loop.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    verdict : str
        ``adequate``, ``effects-added``, ``unexplained``, or ``not-converged``.
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
    rollout_horizon : int
        Intervals of ``rollout_rmse``.
    provenance : dict
        Seed, versions, hash of the data, number of transitions, horizons.
    tests : tuple of ResidualTest
        Tests of what the model after revision leaves.
    acceleration : Acceleration
        What a step adds beyond the model, before and after.
    correlations : Correlations
        Of the innovations of the model after revision.
    growth : Growth
        Of the errors of its forecasts.
    small : tuple of Candidate
        Effects that are certain, and change predictions by less than 1 %; they were not added.
    identifiability : Identifiability or None
        Which parameters of the model after revision the data inform.
    loo : Comparison or None
        Leave-one-out cross-validation of both models on the data they were fitted to.
    velocities_not_used : tuple of UnusedVelocity
        Velocity columns that were computed from positions or lag them.
    bad_frames : tuple of str
        A sentence for each single bad frame that was left out, of either history.
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
    rollout_horizon: int
    provenance: Mapping[str, Any]
    tests: tuple[ResidualTest, ...]
    acceleration: Acceleration
    correlations: Correlations
    growth: Growth
    small: tuple[Candidate, ...] = ()
    identifiability: Identifiability | None = None
    loo: Comparison | None = None
    velocities_not_used: tuple[UnusedVelocity, ...] = ()
    bad_frames: tuple[str, ...] = ()

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
                        "detectable": candidate.detectable,
                        "caps": candidate.caps,
                        "why": candidate.why,
                    }
                    for candidate in self.candidates
                ],
                "small": [[candidate.effect, candidate.body] for candidate in self.small],
                "tests": [vars(test) for test in self.tests],
                "unexplained_acceleration": vars(self.acceleration),
                "unexplained": None if self.unexplained is None else vars(self.unexplained),
                "error": {
                    "before": vars(self.before),
                    "after": vars(self.after),
                    "noise_floor": vars(self.noise_floor),
                },
                "identifiability": self.identifiability and self.identifiability.to_dict(),
                "loo": self.loo and self.loo.to_dict(),
                "velocities_not_used": [vars(each) for each in self.velocities_not_used],
                "bad_frames": self.bad_frames,
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
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    return value
