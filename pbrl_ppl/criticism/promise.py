"""Size of a candidate's effect on predictions, from its score and without a refit."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.criticism.forecast import forecast, longest_forecast
from pbrl_ppl.criticism.score import Signature
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import inside


def promised_share(mode: Mode, signature: Signature) -> float:
    """Return the share by which a candidate lowers innovations or long forecast errors.

    Innovations fall as the score statistic says; forecasts are made with few engine steps, with the
    effect of the estimated size and the declared parameters moved with it. No fit is made, so that
    forecast errors are those of the data themselves.

    Parameters
    ----------
    mode : Mode
        Mode of the model that lacks the effect.
    signature : Signature
        The candidate.
    """
    attached, problem = signature.attached, mode.problem
    square = float((mode.whitened_residual**2).sum())
    innovations = 0.5 * signature.candidate.statistic / max(square, 1e-300)
    without = problem.rough
    within = problem.with_physics(effects=(*problem.physics.effects, attached)).rough
    layout = within.layout
    moved = mode.phi + signature.absorbed
    phi = layout.from_layout(problem.layout, moved)
    places = [layout.labels.index(label) for label in attached.labels]
    phi[places] = list(signature.candidate.estimate.values())
    phi = inside(layout.priors, phi)
    intervals = longest_forecast(problem)
    worse, better = (
        forecast(model, at, mode.sigma, intervals).error
        for model, at in ((without, mode.phi), (within, phi))
    )
    if not len(worse):
        return innovations
    both = np.isfinite(worse) & np.isfinite(better)
    before, after = (np.where(both, each, 0.0) ** 2 for each in (worse, better))
    unit = before.sum(axis=0)
    seen = unit > 0
    if not seen.any():
        return innovations
    falls = 1.0 - after.sum(axis=0)[seen] / unit[seen]
    return max(innovations, 0.5 * float(falls.mean()))
