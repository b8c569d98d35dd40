"""Thresholds of the loop's decisions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EngineCriteria:
    """When the engine's numerical error is small enough.

    Parameters
    ----------
    error_factor : float
        An acceleration is the engine's error below this many times what doubling the substeps
        changes; that change is about half of the error, and the data's maker has one, too.
    small_shift : float
        A doubling of the substeps may move innovations by this share of their noise.
    most_substeps : int
        Substeps of an interval, at most.
    """

    error_factor: float = 3.0
    small_shift: float = 0.1
    most_substeps: int = 640


@dataclass(frozen=True)
class SearchCriteria:
    """Which laws the simulation error names.

    Parameters
    ----------
    least_nats : float
        Net log-evidence that laws need (nats); effects within this of the best are confounded.
    least_share : float
        Share of the simulation error that laws take away, at least, on the pieces that show them.
    main_share : float
        The same of a main law on the longest pieces: smaller ones are not added.
    alone : float
        The same in a recording of one trajectory, which a lasting random force or error follows as
        well: more than what remains.
    rows, pieces : int
        Transitions that are searched, at most, and pieces in which they are drawn, at least; the
        laws found are refitted to all.
    refits, singles : int
        Best subsets that are refitted in a round, and single laws beside them.
    promise : float
        Unusual laws are tried where one of them takes this share of what common ones leave beyond
        the noise off, to first order.
    complete : float
        They are added where they leave less than this many times the error on the shortest pieces,
        on the longest ones, and common laws more.
    incomplete : float
        Or less than this share of the error that common laws leave.
    """

    least_nats: float = 3.0
    least_share: float = 0.1
    main_share: float = 0.2
    alone: float = 0.5
    rows: int = 1000
    pieces: int = 4
    refits: int = 4
    singles: int = 2
    promise: float = 0.3
    complete: float = 1.15
    incomplete: float = 1 / 3


@dataclass(frozen=True)
class ResidualCriteria:
    """When a test of the residual can fail, and what it ignores.

    Parameters
    ----------
    dependence_p : float
        Significance of the permutation test: chance of calling clean data unexplained.
    dependence_share : float
        A smaller share of a residual's variance that recorded quantities predict is negligible.
    correlation_share : float
        A smaller squared correlation of innovations is negligible.
    detection_p, detection_power : float
        P-value of a detection limit, and the probability that an effect there reaches it.
    """

    dependence_p: float = 0.01
    dependence_share: float = 0.02
    correlation_share: float = 0.02
    detection_p: float = 0.01
    detection_power: float = 0.9


@dataclass(frozen=True)
class PriorCriteria:
    """When the declared prior could not have made the data.

    Parameters
    ----------
    most_beyond : float
        Share of measurements beyond all draws from the prior. Measured with 400 draws, 8 seeds
        each: at most 0.075 on five sound problems, at least 0.16 with a mass 100 times too large.
    chance : float
        That share must also be less likely than this under the prior: few measurements vary.
    """

    most_beyond: float = 0.11
    chance: float = 1e-3


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
        A candidate whose p-value, corrected for all candidates, is below this is significant.
    far_out : float
        Prior scales from the prior's centre beyond which an effect's size is not accepted.
    worse_forecast : float
        Forecasts may have this many times the error that noise and a negligible acceleration make.
    worst_simulation : float
        Whole held-out trajectories, simulated from initial states that are fitted to them, are off
        by at most this many times the measurement noise, or something is unexplained: errors of a
        sensor may be correlated.
    outlier_deviations : float
        A single measurement is left out if its residual exceeds this many robust standard
        deviations: 1 of 10^14 of Gaussian noise.
    worst_rhat : float
        Chains with a larger R-hat give no verdict.
    least_ess : float
        Chains with a smaller effective sample size give no verdict.
    engine, search, residual, prior
        Thresholds of single stages.

    Examples
    --------
    ::

        strict = pp.Criteria(false_alarm=1e-4, negligible=0.02)
        pp.close_loop(scene, train, test, criteria=strict)
    """

    negligible: float = 0.01
    false_alarm: float = 1e-3
    try_p: float = 0.01
    far_out: float = 6.0
    worse_forecast: float = 1.5
    worst_simulation: float = 3.0
    outlier_deviations: float = 8.0
    worst_rhat: float = 1.05
    least_ess: float = 100.0
    engine: EngineCriteria = EngineCriteria()
    search: SearchCriteria = SearchCriteria()
    residual: ResidualCriteria = ResidualCriteria()
    prior: PriorCriteria = PriorCriteria()


#: The defaults of :class:`Criteria`.
DEFAULT = Criteria()
