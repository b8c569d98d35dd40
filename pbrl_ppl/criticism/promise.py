"""Size of an effect on predictions, and what a candidate's score promises without a refit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbrl_ppl.criticism.forecast import Forecast, forecast, longest_forecast
from pbrl_ppl.criticism.score import Signature
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.state import Floats


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
    within = problem.with_physics(effects=(*problem.physics.effects, attached)).rough
    layout = within.layout
    phi = layout.from_layout(problem.layout, mode.phi + signature.absorbed)
    places = [layout.labels.index(label) for label in attached.labels]
    phi[places] = list(signature.candidate.estimate.values())
    changed = replace(mode, problem=within, phi=inside(layout.priors, phi))
    before = replace(mode, problem=problem.rough)
    worse, better = _forecasts(before, changed)
    errors = _squares(worse.error)
    seen = errors > 0
    if not seen.any():
        return signature.fall
    falls = 1.0 - _squares(better.error)[seen] / errors[seen]
    return max(signature.fall, min(0.5 * float(falls.mean()), _change(worse, better)))


def forecast_change(before: Mode, after: Mode) -> float:
    """Return the change of long forecasts over the motion in that time, of the worst coordinate.

    Near the noise any share of an error is small beside the motion.
    """
    return _change(*_forecasts(before, after))


def _change(worse: Forecast, better: Forecast) -> float:
    """Return the change of forecasts over the motion, of the worst coordinate; 0 without any."""
    if not len(worse.error):
        return 0.0
    change = _squares(worse.error - better.error)
    motion = _squares(np.where(np.isnan(worse.error), np.nan, worse.motion))
    return float(np.sqrt((change / np.maximum(motion, 1e-300)).max()))


def _forecasts(before: Mode, after: Mode) -> tuple[Forecast, Forecast]:
    """Return the longest forecasts of both models; errors are NaN where one diverges."""
    intervals = longest_forecast(after.problem)
    worse, better = (
        forecast(each.problem, each.phi, each.sigma, intervals) for each in (before, after)
    )
    both = np.isfinite(worse.error) & np.isfinite(better.error)
    worse, better = (
        replace(each, error=np.where(both, each.error, np.nan)) for each in (worse, better)
    )
    return worse, better


def _squares(values: Floats) -> Floats:
    """Return sums of squares, shape (coordinate,), of values (start, coordinate) or NaN."""
    return np.asarray(np.nansum(values**2, axis=0))
