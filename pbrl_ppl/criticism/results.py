"""Result of a closed loop: what its stages found, and the files that it is saved in."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Self

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.effects import Effect
from pbrl_ppl.effects import catalogue as full_catalogue
from pbrl_ppl.errors import OutputError
from pbrl_ppl.history import History, UnusedVelocity
from pbrl_ppl.modes import FilteredMode
from pbrl_ppl.posterior import Comparison, Fit, Idata, Identifiability, save_posterior
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats
from pbrl_ppl.system.files import check_folder, json_values, temporary_folder

#: The verdicts. NOT_CONVERGED: chains disagree; no verdict.
ADEQUATE, EFFECTS_ADDED, UNEXPLAINED = "adequate", "effects-added", "unexplained"
NOT_CONVERGED = "not-converged"
#: Files of a saved loop and its report.
FILES = ("report.html", "report.json", "before.nc", "after.nc")
#: The file that is written last: where it is, the others belong to it.
DONE = "report.json"
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

    @classmethod
    def found_by(cls, test: ResidualTest) -> Self:
        """Return what a failed test found, which depends on no recorded quantity."""
        place = test.body, test.dimension
        return cls(*place, NOTHING_RECORDED, test.size, test.p_value, test.sentence)

    @classmethod
    def somewhere(cls, sentence: str) -> Self:
        """Return what a sentence says of no place."""
        return cls("", "", NOTHING_RECORDED, 0.0, math.nan, sentence)


@dataclass(frozen=True, eq=False)
class Misfit:
    """Tests of a model's residual, and where it has structure that no effect explains.

    Parameters
    ----------
    tests : tuple of ResidualTest
        In the order of the report.
    dependence : Unexplained or None
        The recorded quantity that the residual depends on; None if it depends on none.
    """

    tests: tuple[ResidualTest, ...]
    dependence: Unexplained | None

    @property
    def unexplained(self) -> Unexplained | None:
        """Return the dependence, or else what the first test found that failed; None if none."""
        failed = (Unexplained.found_by(test) for test in self.tests if not test.passed)
        return self.dependence or next(failed, None)

    def predicts(self, criteria: Criteria) -> bool:
        """Return whether forecasts and simulations are as good as noise lets them be.

        What remains is then small: significant one step ahead, and not over a forecast. Beside an
        unexplained acceleration forecasts must be near the noise; that none is known to be worse is
        not enough. A test that is missing is not passed.
        """
        tests = {test.name: test for test in self.tests}
        forecasts = (KindOfTest.FORECASTS, KindOfTest.HELD_OUT)
        whole = (*forecasts, KindOfTest.SIMULATION)
        if not all(kind in tests and tests[kind].passed for kind in whole):
            return False
        near = all(tests[kind].size < criteria.worse_forecast for kind in forecasts)
        return near or tests[KindOfTest.ACCELERATION].passed


class Stage(StrEnum):
    """A stage of closing the loop, in their order: a name for programs, a sentence for people."""

    CHECK_PRIOR = "comparing the data with the prior"
    FIT = "fitting the declared model"
    SIMULATE = "simulating whole trajectories with what the model might lack"
    TEST = "testing the residual"
    SAMPLE = "sampling the posteriors"
    COMPARE = "comparing errors on held-out data"


@dataclass(frozen=True, eq=False)
class Found:
    """What the search found.

    Parameters
    ----------
    candidates : tuple of Law
        All candidates, by their score tests at the declared model, best first.
    added : tuple of Law
        Effects added, in order.
    small : tuple of Law
        Effect that is significant in the innovations and was not added, if there is one.
    lesser : tuple of Law
        Laws that simulations show and that are no main ones: they are not added.
    hypotheses : tuple of Law
        Unusual laws that explain a part of what remains: they are not added.
    lengths : tuple of SearchLength
        What was found on pieces of each length.
    """

    candidates: tuple[Law, ...]
    added: tuple[Law, ...]
    small: tuple[Law, ...] = ()
    lesser: tuple[Law, ...] = ()
    hypotheses: tuple[Law, ...] = ()
    lengths: tuple[SearchLength, ...] = ()


@dataclass(frozen=True, eq=False)
class ComparedModel:
    """The declared or the revised model, fitted.

    Parameters
    ----------
    fit : Fit
        The model with its posterior.
    innovations : FilteredMode
        The model with whole trajectories filtered, which the tests are made with.
    errors : Errors
        Held-out errors.
    """

    fit: Fit
    innovations: FilteredMode
    errors: Errors


@dataclass(frozen=True, eq=False)
class Forecasts:
    """Held-out forecasts.

    Parameters
    ----------
    noise_floor : Errors
        Errors of the noise alone.
    rollout : Rollout
        One held-out trajectory.
    horizon : int
        Intervals of ``rollout_rmse``.
    """

    noise_floor: Errors
    rollout: Rollout
    horizon: int


@dataclass(frozen=True, eq=False)
class Recordings:
    """What was recorded, and what of it was not used.

    Parameters
    ----------
    provenance : dict
        Seed, versions, hash of the data, number of transitions, horizons.
    held_out : History, optional
        The held-out trajectories; reports animate them.
    velocities_not_used : tuple of UnusedVelocity
        Velocity columns that were computed from positions or lag them.
    bad_frames : tuple of str
        A sentence for each single bad frame that was left out, of either history.
    drawn : tuple of str
        A sentence on each history that was too long to be used as a whole.
    """

    provenance: Mapping[str, object] = field(default_factory=dict)
    held_out: History | None = None
    velocities_not_used: tuple[UnusedVelocity, ...] = ()
    bad_frames: tuple[str, ...] = ()
    drawn: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Loop:
    """Result of :func:`pbrl_ppl.close_loop`: the verdict, and what each stage found.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    verdict : str
        ``adequate``, ``effects-added``, ``unexplained``, or ``not-converged``.
    unexplained : Unexplained or None
        Structure that no effect in the catalogue explains.
    numerical : Numerical
        Engine substeps, and the numerical error that is left.
    data : Recordings
        What was recorded, and what of it was not used.
    found : Found
        What the search found: candidates and added effects.
    declared, revised : ComparedModel
        Both models with posteriors and held-out errors; they are equal if nothing was added.
    misfit : Misfit
        Tests of the revised model's residual.
    acceleration : Acceleration
        Unexplained acceleration of both models.
    forecasts : Forecasts
        Held-out forecasts beside the noise floor.
    identifiability : Identifiability or None
        Which parameters of the revised model the data inform.
    loo : Comparison or None
        Leave-one-out cross-validation of both models on the data they were fitted to.
    criteria : Criteria
        Thresholds of the decisions.
    catalogue : tuple of Effect
        Where the names of effects are looked up.
    """

    scene: Scene
    verdict: str
    unexplained: Unexplained | None
    numerical: Numerical
    data: Recordings
    found: Found
    declared: ComparedModel
    revised: ComparedModel
    misfit: Misfit
    acceleration: Acceleration
    forecasts: Forecasts
    identifiability: Identifiability | None = None
    loo: Comparison | None = None
    criteria: Criteria = DEFAULT
    catalogue: tuple[Effect, ...] = tuple(full_catalogue)

    def __repr__(self) -> str:
        added = [f"{one.effect} on {one.body}" for one in self.added]
        return f"Loop(verdict={self.verdict!r}, added={added})"

    @property
    def candidates(self) -> tuple[Law, ...]:
        """All candidates, by their score tests at the declared model, best first."""
        return self.found.candidates

    @property
    def added(self) -> tuple[Law, ...]:
        """Effects added, in order."""
        return self.found.added

    @property
    def before(self) -> Errors:
        """Held-out errors of the declared model."""
        return self.declared.errors

    @property
    def after(self) -> Errors:
        """Held-out errors of the revised model."""
        return self.revised.errors

    @property
    def noise_floor(self) -> Errors:
        """Held-out errors of the noise alone."""
        return self.forecasts.noise_floor

    @property
    def tests(self) -> tuple[ResidualTest, ...]:
        """Tests of the revised model's residual."""
        return self.misfit.tests

    @property
    def held_out(self) -> History | None:
        """The held-out trajectories."""
        return self.data.held_out

    @property
    def posterior_before(self) -> Idata:
        """Posterior of the declared model, an InferenceData or a DataTree."""
        return self.declared.fit.posterior

    @property
    def posterior_after(self) -> Idata:
        """Posterior of the revised model; that of the declared one if nothing was added."""
        return self.revised.fit.posterior

    @property
    def accepted(self) -> tuple[Law, ...]:
        """Return the added effects, or none without a verdict."""
        return () if self.verdict == NOT_CONVERGED else self.added

    @property
    def rejected(self) -> tuple[Law, ...]:
        """Return the significant candidates that were not added, best first."""
        tried = (one for one in self.candidates if one.why not in ("", "added"))
        return tuple(one for one in tried if one.p_value < self.criteria.try_p)

    @property
    def diverges(self) -> bool:
        """Return whether held-out forecasts of the revised model diverge."""
        return any(np.isposinf(far) for far in self.after.rollout_rmse.values())

    @property
    def forecasts_at_noise(self) -> bool:
        """Return whether all held-out errors are near those that noise alone makes."""
        most, floor = self.criteria.worse_forecast, self.noise_floor.rollout_rmse
        errors = self.after.rollout_rmse.items()
        near = all(error < most * floor.get(name, 0.0) for name, error in errors)
        return near and self.after.normalised_rmse < most

    @property
    def depends_on_records(self) -> bool:
        """Return whether the residual depends on a recorded quantity."""
        left = self.unexplained
        return left is not None and left.depends_on != NOTHING_RECORDED

    @property
    def rollout_seconds(self) -> float:
        """Return how far ahead rollouts predict (s)."""
        return self.forecasts.horizon * self.scene.time_step

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``report.json``; numbers that are not finite become null."""
        tested = [key for key in CANDIDATE if key not in ("sentence", "units")]
        errors = {"before": self.before, "after": self.after, "noise_floor": self.noise_floor}
        contents: dict[str, Any] = json_values(
            {
                "verdict": self.verdict,
                "numerical": self.numerical,
                "added": [law.in_json(ADDED) for law in self.added],
                "candidates": [law.in_json(tested) for law in self.candidates],
                "small": [[law.effect, law.body] for law in self.found.small],
                "lesser": [law.in_json(ASIDE) for law in self.found.lesser],
                "hypotheses": [law.in_json(ASIDE) for law in self.found.hypotheses],
                "search": self.found.lengths,
                "tests": self.tests,
                "unexplained_acceleration": self.acceleration,
                "unexplained": self.unexplained,
                "error": errors,
                "identifiability": self.identifiability and self.identifiability.to_dict(),
                "loo": self.loo and self.loo.to_dict(),
                "velocities_not_used": self.data.velocities_not_used,
                "bad_frames": self.data.bad_frames,
                "drawn": self.data.drawn,
                "provenance": self.data.provenance,
            }
        )
        return contents

    def save(self, folder: str | Path, overwrite: bool = False, *, page: str = "") -> Path:
        """Write report.json, before.nc and after.nc, all or nothing.

        Of an earlier result in the folder ``report.json`` is removed first, and the new one is
        written last: where it is, the files belong together, even if the process was killed.

        Parameters
        ----------
        folder : str or pathlib.Path
            Made if missing; other files in it are left alone.
        overwrite : bool
            Whether a folder that is not empty may be written to.
        page : str
            HTML of the report, written as report.html with the other files; none if empty.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        OutputError
            If the folder cannot be written, or is not empty and ``overwrite`` is false.

        Examples
        --------
        ::

            loop.save("out")
            pp.report(loop, "out/report.html")
        """
        folder = Path(folder)
        nearest = check_folder(folder, overwrite, FILES)
        try:
            # on the same file system as the folder, so that only a rename is left at the end
            with temporary_folder(nearest) as temporary:
                made = temporary / "result"
                made.mkdir()
                if page:
                    (made / "report.html").write_text(page, encoding="utf-8")
                save_posterior(self.posterior_before, made / "before.nc")
                save_posterior(self.posterior_after, made / "after.nc")
                text = json.dumps(self.to_dict(), indent=1, allow_nan=False)
                (made / DONE).write_text(text + "\n", encoding="utf-8")
                if nearest == folder:
                    # it may be a mount or a working directory: fill it, do not replace it
                    (folder / DONE).unlink(missing_ok=True)
                    for name in sorted((file.name for file in made.iterdir()), key=DONE.__eq__):
                        (made / name).replace(folder / name)
                else:
                    folder.parent.mkdir(parents=True, exist_ok=True)
                    made.rename(folder)
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error}") from error
        return folder
