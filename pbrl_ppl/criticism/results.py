"""Stages of a closed loop and parts of its result: laws, tests, errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from pbrl_ppl.state import Floats

#: What to know of effects that a recording of one trajectory shows.
ONE_TRAJECTORY = (
    "a single trajectory cannot tell a law from a lasting random force: record a second one"
)


#: Keys of a law in JSON that are not the names of its fields.
_KEYS = {
    "looks": "n_grid_points", "caps": "is_upper_limit",
    "nats": "simulated_nats", "share": "simulated_share", "confounded": "not_separable_from",
}  # fmt: skip
#: Keys of a candidate in JSON.
CANDIDATE = (
    "effect", "body", "sentence", "statistic", "dof", "p_value", "estimate", "units",
    "identifiable", "looks", "detectable", "caps", "why", "simulated_nats", "simulated_share",
)  # fmt: skip
#: Keys of an added law in JSON.
ADDED = (
    "effect", "body", "statistic", "p_value", "parameters", "not_separable_from",
    "elpd_difference", "elpd_difference_se", "simulated_nats", "simulated_share",
)  # fmt: skip
#: Keys of a law of the search in JSON, and of one that it does not add.
NAMED = ("effect", "body", "sentence", "estimate", "sd", "units", "nats", "share", "confounded")
ASIDE = ("effect", "body", "share")


@dataclass(frozen=True)
class Law:
    """A law that the declared model may lack: what each stage of the loop found out about it.

    A candidate has a score test. Simulations give it evidence, alone and to first order or, if the
    search names it, beside the other laws; the posterior of the revised model gives its parameters.
    What is not known has its default.

    Parameters
    ----------
    effect, body, sentence : str
        Names of the effect and of the body, and the effect in words.
    statistic : float
        Score statistic S; chi-squared with ``dof`` degrees of freedom if the effect is absent.
    dof : int
        Number of the signature's columns: the effect's parameters, less those that are scanned, and
        one where all are.
    p_value : float
        P-value of the statistic, corrected for the number of candidates.
    estimate : dict of str to float
        Estimate of each parameter: from the signature alone, or the most probable value by
        simulations.
    units : dict of str to str
        Unit of each parameter.
    identifiable : float
        Share of the signature (0 to 1) that the declared parameters cannot absorb.
    n_grid_points : int
        Number of grid points (places, thresholds or times); the p-value is corrected for them.
    detectable : dict of str to float
        Detection limit of each parameter, the others at their null values: the smallest size that
        reaches a p-value of 0.01 with probability 0.9; infinite where none does. For a scan, at the
        best grid point; empty where there is no size without a place.
    is_upper_limit : bool
        Whether smaller is stronger, as for a limit: larger ones than ``detectable`` are not seen.
    why : str
        Why the loop added it or did not; empty if it did not decide.
    simulated_nats : float or None
        Log-evidence of simulations for it, less its price (nats): of a law that is named what is
        lost without it, summed over lengths of pieces; of a candidate alone, to first order, on the
        shortest pieces; None if it is not among the leading ones.
    simulated_share : float or None
        Share of the simulation error (root mean square) that it takes off, on the longest pieces
        or, of a candidate, on the shortest.
    sd : dict of str to float
        Standard deviation of each estimate by simulations, which allows for the residual's
        correlation.
    not_separable_from : tuple of str
        Effects that explain these data as well.
    parameters : dict of str to Estimate
        Posterior of each parameter in the revised model.
    elpd_difference, elpd_difference_se : float
        Gain of expected log predictive density over the model without it, and its standard error
        (nats).
    """

    effect: str
    body: str
    sentence: str = ""
    statistic: float = math.nan
    dof: int = 0
    p_value: float = math.nan
    estimate: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    identifiable: float = math.nan
    n_grid_points: int = 1
    detectable: Mapping[str, float] = field(default_factory=dict)
    is_upper_limit: bool = False
    why: str = ""
    simulated_nats: float | None = None
    simulated_share: float | None = None
    sd: Mapping[str, float] = field(default_factory=dict)
    not_separable_from: tuple[str, ...] = ()
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    elpd_difference: float = math.nan
    elpd_difference_se: float = math.nan

    @property
    def chance(self) -> float:
        """The smaller of the p-value and, by simulations, the odds against the effect."""
        return min(self.p_value, float(np.exp(-(self.simulated_nats or 0.0))))

    def in_json(self, keys: Iterable[str]) -> dict[str, object]:
        """Return the fields with these keys in JSON."""
        return {key: getattr(self, _KEYS.get(key, key)) for key in keys}


@dataclass(frozen=True)
class SearchLength:
    """A search on pieces of one length.

    Parameters
    ----------
    rows : int
        Intervals of a piece.
    seconds : float
        Its length (s).
    error : dict of str to float
        Simulation error (root mean square) of the model before, by dimension, SI units.
    accepted, dropped : tuple of str
        Laws that were added, and those found needless beside them.
    correlated : dict of str to float
        Integrated autocorrelation time of the last residual, in rows: 1 if it is white.
    """

    rows: int
    seconds: float
    error: Mapping[str, float]
    accepted: tuple[str, ...]
    dropped: tuple[str, ...]
    correlated: Mapping[str, float]


class KindOfTest(StrEnum):
    """A test of a model's residual: a name for programs, and one for people."""

    ACCELERATION = "unexplained acceleration"
    WHITENESS = "whiteness"
    COMMANDS = "correlation with commands"
    FORECASTS = "forecasts"
    DEPENDENCE = "dependence on state, command and time"
    PRIOR = "prior"
    HELD_OUT = "held-out forecasts"
    SIMULATION = "held-out simulation"
    CANDIDATES = "effects of the catalogue"


@dataclass(frozen=True)
class ResidualTest:
    """Result of a test of a model's residual.

    Parameters
    ----------
    name : KindOfTest
        Which test.
    p_value : float
        P-value of the result if nothing is missing.
    size : float
        Size of the misfit, as in ``sentence``.
    passed : bool
        Whether there is no misfit, or a negligible one.
    sentence : str
        The result in words.
    tested : bool
        Whether the data could fail the test; one that they could not was not passed either.
    body, dimension : str
        Where the misfit is largest; empty where the test names no place.
    """

    name: KindOfTest
    p_value: float
    size: float
    passed: bool
    sentence: str
    tested: bool = field(default=True, kw_only=True)
    body: str = ""
    dimension: str = ""

    @classmethod
    def untested(cls, name: KindOfTest, why: str) -> ResidualTest:
        """Return the result of a test that the data cannot fail."""
        return cls(name, float("nan"), 0.0, True, f"not tested: {why}", tested=False)


@dataclass(frozen=True, eq=False)
class Correlations:
    """Correlations of innovations, for a plot.

    Parameters
    ----------
    cells : tuple of str
        Observed coordinates: state dimension and body.
    own : ndarray
        Correlation with innovations 1, 2, ... intervals before, shape (lag, cell).
    pairs : ndarray
        Number of pairs of each, shape (lag, cell).
    commands : tuple of str
        Commands that vary.
    driven : ndarray
        Correlation with commands 0, 1, ... intervals before, shape (lag, command, cell).
    """

    cells: tuple[str, ...]
    own: Floats
    pairs: Floats
    commands: tuple[str, ...]
    driven: Floats


@dataclass(frozen=True, eq=False)
class Growth:
    """Growth of forecasts' errors with their length, for a plot.

    Parameters
    ----------
    seconds : ndarray
        Lengths (s), shape (length,).
    error, floor : tuple of dict
        Root mean square error of each state dimension, and that of noise alone, one each length.
    """

    seconds: Floats
    error: tuple[Mapping[str, float], ...]
    floor: tuple[Mapping[str, float], ...]


@dataclass(frozen=True)
class Acceleration:
    """Unexplained acceleration of each velocity: standard deviation of the process noise.

    Parameters
    ----------
    before, after : dict of str to float
        Standard deviation under the declared and the revised model, m/s^2 and rad/s^2.
    relative_before, relative_after : dict of str to float
        The same over the root mean square acceleration of the bodies.
    certain_after : dict of str to bool
        Whether that of the revised model is significant.
    """

    before: Mapping[str, float]
    after: Mapping[str, float]
    relative_before: Mapping[str, float]
    relative_after: Mapping[str, float]
    certain_after: Mapping[str, bool]

    @property
    def remaining(self) -> str:
        """Return the velocity with the largest relative one that is significant; empty if none."""
        sure = [name for name, certain in self.certain_after.items() if certain]
        return max(sure, key=self.relative_after.__getitem__, default="")


@dataclass(frozen=True)
class Estimate:
    """Posterior summary of one parameter: mean, sd and 94 % highest-density interval."""

    mean: float
    sd: float
    hdi: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Numerical:
    """Engine substeps declared and used, and the shift of results if those used are doubled."""

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
        Root mean square innovation in units of what measurement noise alone makes.
    elpd : float
        Log predictive density, summed over held-out transitions.
    simulated_rmse : dict of str to float
        Root mean square error of whole trajectories, simulated from initial states that are fitted
        to them, per measured state dimension; empty where simulations magnify them.
    """

    one_step_rmse: Mapping[str, float]
    rollout_rmse: Mapping[str, float]
    normalised_rmse: float
    elpd: float
    simulated_rmse: Mapping[str, float] = field(default_factory=dict)


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
        Shape (time, state); measured is NaN where missing, predictions from where they diverge.
    """

    body: str
    time: Floats
    names: tuple[str, ...]
    units: tuple[str, ...]
    measured: Floats
    before: Floats
    after: Floats


def diverged_after(time: Floats, predicted: Floats) -> float | None:
    """Return how long (s) a prediction is finite; None if it does not diverge.

    Parameters
    ----------
    time : ndarray
        Seconds since the start, shape (time,).
    predicted : ndarray
        Predicted states, shape (time, ...): not finite from where they diverge.

    Examples
    --------
    >>> time = np.array([0.0, 0.1, 0.2])
    >>> diverged_after(time, np.array([1.0, 2.0, np.nan]))
    0.1
    >>> diverged_after(time, np.array([1.0, 2.0, 3.0]))
    """
    finite = np.isfinite(predicted).reshape(len(time), -1).all(axis=1)
    if finite.all():
        return None
    return float(time[max(int(np.argmin(finite)) - 1, 0)])


#: What an unexplained residual depends on where no quantity predicts it.
NOTHING_RECORDED = "nothing that was recorded"


@dataclass(frozen=True)
class Unexplained:
    """Structure of the residual that no effect in the catalogue explains.

    Parameters
    ----------
    body, dimension : str
        Where it is strongest.
    depends_on : str
        The quantity it depends on most.
    share : float
        Share of that residual's variance that a flexible regression predicts (0 to 1).
    p_value : float
        P-value of the test that found it.
    sentence : str
        The structure in words.
    """

    body: str
    dimension: str
    depends_on: str
    share: float
    p_value: float
    sentence: str


class Stage(StrEnum):
    """A stage of closing the loop, in their order: a name for programs, a sentence for people."""

    CHECK_PRIOR = "comparing the data with the prior"
    FIT = "fitting the declared model"
    SIMULATE = "simulating whole trajectories with what the model might lack"
    TEST = "testing the residual"
    SAMPLE = "sampling the posteriors"
    COMPARE = "comparing errors on held-out data"
