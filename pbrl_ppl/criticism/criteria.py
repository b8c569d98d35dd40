"""Thresholds of the loop's decisions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Criteria:
    """Thresholds of the loop's decisions, none of them taken from a data set.

    Parameters
    ----------
    negligible : float
        Share of the bodies' acceleration, of what a step changes, or of an error, below which
        nothing is called missing: two engines differ by 0.3 to 0.6 %. No test is sharper.
    false_alarm : float
        Probability that a test of a single quantity fails without cause.
    try_p : float
        A candidate is refitted if its p-value, corrected for all candidates, is below this.
    min_elpd, min_elpd_se : float
        Gain in cross-validated log predictive density that an effect needs, in nats and in standard
        errors; the latter are widened to Student's t for few folds. A signed-rank test of the folds
        at the same level does, too.
    min_evidence : float
        Gain in log-evidence (nats) that an effect needs instead, where trajectories are too few for
        cross-validation over them.
    far_out : float
        Prior scales from the prior's centre beyond which an effect's size is not accepted.
    engines : float
        An acceleration is the engine's own error below this many times what doubling the substeps
        changes; that change is about half of the error, and the data's maker has one, too.
    worse_forecast : float
        Forecasts may have this many times the error that noise and a negligible acceleration make.
    most_added : int
        Effects added at most.
    large_remainder, large_if_small : float
        Share of the square of the unexplained acceleration that may remain beside a name; and where
        what remains is negligible.
    most_predictable : float
        A larger remainder may stay where less than this share of what could be predicted of the
        innovations still can be: what remains is then random.
    worst_rhat, least_ess : float
        Chains with a larger R-hat or a smaller effective sample size give no verdict.
    """

    negligible: float = 0.01
    false_alarm: float = 1e-3
    try_p: float = 0.01
    min_elpd: float = 4.0
    min_elpd_se: float = 2.0
    min_evidence: float = 4.0
    far_out: float = 6.0
    engines: float = 3.0
    worse_forecast: float = 1.5
    most_added: int = 5
    large_remainder: float = 0.2
    large_if_small: float = 0.5
    most_predictable: float = 0.1
    worst_rhat: float = 1.05
    least_ess: float = 100.0


#: Those that the loop decides by unless it is given others.
DEFAULT = Criteria()
