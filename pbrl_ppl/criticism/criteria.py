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
    better_mode : float
        A mode is replaced by one smoothed anew whose log-posterior is higher by this (nats).
    large : float
        An unexplained acceleration above this share of the bodies' is no numerical error.
    still : float
        One that a doubling of the substeps moves by a smaller share is no numerical error either.
    """

    error_factor: float = 3.0
    small_shift: float = 0.1
    most_substeps: int = 640
    better_mode: float = 5.0
    large: float = 0.1
    still: float = 0.1


@dataclass(frozen=True)
class ScoreCriteria:
    """When a signature is absorbed, and when two signatures are the same.

    Parameters
    ----------
    absorbed : float
        Where the declared parameters leave less than this share of a signature they absorb it.
    visible : float
        A change below this, in units of noise, is the engine's rounding.
    parallel : float
        Effects whose projected signatures have a larger cosine are not separable.
    decisive : float
        Effects whose score statistics differ by this are separable all the same.
    same : float
        Signatures with a larger cosine than this are the same physics.
    detection_p : float
        P-value of a detection limit.
    detection_power : float
        Probability that an effect at the detection limit reaches that p-value.
    """

    absorbed: float = 1e-3
    visible: float = 1e-3
    parallel: float = 0.95
    decisive: float = 10.0
    same: float = 0.9999
    detection_p: float = 0.01
    detection_power: float = 0.9


@dataclass(frozen=True)
class SelectionCriteria:
    """Which candidates are refitted, and how refits compare.

    Parameters
    ----------
    refits : int
        Candidates that are refitted in a round, at most.
    worth_a_refit : float
        A candidate with less than this share of the leader's statistic is refitted only once the
        leader has failed.
    informed : float
        The data inform a parameter whose posterior is narrower than this share of its prior.
    tie : float
        Log-likelihoods that differ by less (nats) do not choose between effects: the order of the
        catalogue does.
    least_trajectories : int
        With fewer trajectories, cross-validation leaves out runs of them.
    """

    refits: int = 4
    worth_a_refit: float = 0.5
    informed: float = 0.7
    tie: float = 1.0
    least_trajectories: int = 8


@dataclass(frozen=True)
class SimulationCriteria:
    """Which effects the simulation error of whole trajectories names.

    Parameters
    ----------
    least_share : float
        Share of the simulation error that an effect takes away, at least; those that take less are
        left to the search by innovations.
    least_share_alone : float
        The same share in a recording of one trajectory, which a lasting random force or error
        follows as well: more than what remains.
    least_nats : float
        Net log-evidence that it needs (nats); effects within this of the best are confounded.
    least_score : float
        Share of the squared error that a candidate must take away to first order to be refitted.
    leaders : int
        Candidates that are refitted for each length of pieces, at most.
    worth_refining : float
        Candidates with at least this share of the leader's evidence are fitted until they gain no
        more.
    paired : int
        Leading candidates of which pairs are tried.
    white : float
        A residual with a shorter integrated autocorrelation time (rows) hides no such effect.
    long : int
        Intervals of pieces from which on this is tested.
    restarts : int
        Times that a model may turn out not to have been at its optimum.
    """

    least_share: float = 0.2
    least_share_alone: float = 0.5
    least_nats: float = 3.0
    least_score: float = 0.1
    leaders: int = 3
    worth_refining: float = 0.8
    paired: int = 4
    white: float = 1.5
    long: int = 16
    restarts: int = 3


@dataclass(frozen=True)
class ResidualCriteria:
    """When a test of the residual can fail, and what it ignores.

    Parameters
    ----------
    dependence_p : float
        Significance of the permutation test: chance of calling clean data unexplained.
    dependence_share : float
        A smaller share of a residual's variance that recorded quantities predict is negligible.
    least_transitions : int
        Transitions that the permutation test needs.
    correlation_share : float
        A smaller squared correlation of innovations is negligible.
    least_pairs : int
        A correlation counts if it is taken over more pairs than this.
    lags : int
        Intervals up to which innovations are correlated with earlier ones and with commands.
    most_error : float
        A forecast's error counts for no more than this many times its expected size: a single one
        that a bad frame or a grazing contact spoils is no misfit.
    """

    dependence_p: float = 0.01
    dependence_share: float = 0.02
    least_transitions: int = 20
    correlation_share: float = 0.02
    least_pairs: int = 10
    lags: int = 5
    most_error: float = 3.0


@dataclass(frozen=True)
class OutlierCriteria:
    """When a single measurement is left out; it must meet the first three.

    Parameters
    ----------
    deviations : float
        Its residual exceeds this many robust standard deviations: 1 of 10^14 of Gaussian noise.
    errors : float
        It is this many measurement errors from the smoothed state, which it attracts.
    neighbours : float
        It is this many times as far off as its neighbours, which an event that lasts moves, too.
    most : float
        If a larger share of a coordinate's measurements is far off, none is left out.
    least_measurements : int
        Measurements of a coordinate that are needed to call one far off.
    """

    deviations: float = 8.0
    errors: float = 4.0
    neighbours: float = 2.0
    most: float = 0.05
    least_measurements: int = 12


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
    slack : float
        Share of the usual change by which draws may miss where velocities were not measured.
    least_draws : int
        Draws from the prior that the check needs.
    signal : float
        A horizon is long enough if changes are this many times the measurement errors.
    unit_factor : float
        A factor of wrong units may lie this far beyond the range of the prior's factors.
    """

    most_beyond: float = 0.11
    chance: float = 1e-3
    slack: float = 0.25
    least_draws: int = 50
    signal: float = 5.0
    unit_factor: float = 1.5


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
    min_elpd : float
        Gain in cross-validated log predictive density (nats) that an effect needs.
    min_elpd_se : float
        Standard errors that this gain needs, widened to Student's t for few folds. A signed-rank
        test of the folds at the same level is enough, too.
    min_evidence : float
        Gain in log-evidence (nats) that correlated measurement errors need.
    far_out : float
        Prior scales from the prior's centre beyond which an effect's size is not accepted.
    worse_forecast : float
        Forecasts may have this many times the error that noise and a negligible acceleration make.
    most_added : int
        Effects added at most.
    noise_rounds : int
        Times that the noise model is corrected and the search for effects begins again, at most.
    min_remainder : float
        Log marginal likelihood (nats) that a learned force must gain over noise alone.
    worst_rhat : float
        Chains with a larger R-hat give no verdict.
    least_ess : float
        Chains with a smaller effective sample size give no verdict.
    engine, score, selection, simulation, residual, outliers, prior
        Thresholds of single stages.

    Examples
    --------
    ::

        strict = pp.Criteria(try_p=1e-3, most_added=2)
        pp.close_loop(scene, train, test, criteria=strict)
    """

    negligible: float = 0.01
    false_alarm: float = 1e-3
    try_p: float = 0.01
    min_elpd: float = 4.0
    min_elpd_se: float = 2.0
    min_evidence: float = 4.0
    far_out: float = 6.0
    worse_forecast: float = 1.5
    most_added: int = 5
    noise_rounds: int = 4
    min_remainder: float = 6.0
    worst_rhat: float = 1.05
    least_ess: float = 100.0
    engine: EngineCriteria = EngineCriteria()
    score: ScoreCriteria = ScoreCriteria()
    selection: SelectionCriteria = SelectionCriteria()
    simulation: SimulationCriteria = SimulationCriteria()
    residual: ResidualCriteria = ResidualCriteria()
    outliers: OutlierCriteria = OutlierCriteria()
    prior: PriorCriteria = PriorCriteria()


#: The defaults of :class:`Criteria`.
DEFAULT = Criteria()
#: Candidates that are refitted in a round, at most, which other subpackages use.
TRIED = DEFAULT.selection.refits
