"""Data of a posterior file, the record of a problem, and the fit rebuilt from both."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import xarray as xr

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.history import History, Segments, from_segments
from pbrl_ppl.likelihood import (
    NEXT_STATE_DIMS,
    Problem,
    Sensitivity,
    TransitionLikelihood,
    along_trajectories,
    in_pieces,
    is_filtered,
    is_independent,
    is_simulated,
    linearised,
    linearised_pieces,
    observed_coordinates,
    with_sensitivity,
)
from pbrl_ppl.posterior.record import PosteriorRecord, vectors
from pbrl_ppl.posterior.store import Idata, best_draw, from_groups, group, groups
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import INPUT, STATE, Floats

PACKAGES = ("pbrl_ppl", "pymc", "pytensor", "arviz", "pymunk", "numpy", "numba", "xarray")
#: Name of the smoothed or simulated states; a posterior of single transitions has none.
SMOOTHED = "smoothed"
#: Names of the derivative of simulated states by their start, and of autocorrelation times.
_BY_START, _TAU = "by_start", "tau"
#: Names of the parameters that the states were smoothed at, and of the states' derivative by them.
_ORIGIN, _SENSITIVITY = "smoothed_at", "sensitivity"
#: Prefix of the recording's variables and dimensions.
_PREFIX = "recorded_"
#: Coordinates of the dimension ``transition`` beside its index.
PLACES = ("trajectory", "time")


def record_of(problem: Problem, seed: int, method: str) -> PosteriorRecord:
    """Return the record of a fit of a problem: scene, effects, settings, data and versions."""
    scene, attached, likelihood = problem.scene, problem.physics.effects, problem.likelihood
    for body in scene.dynamic:
        laws = (law.effect.name for law in attached if law.body == body.name)
        scene = scene.with_effects(body.name, *laws)
    median, spread = problem.noise_prior
    return PosteriorRecord(
        scene=scene,
        effects=tuple((law.effect.name, law.body) for law in attached),
        horizon=problem.data.horizon,
        substeps=problem.physics.substeps,
        tolerance=problem.physics.tolerance,
        together=tuple(problem.physics.together),
        measured=problem.observations.names,
        scalar_sigma=likelihood.scalar,
        sigma_prior=(tuple(float(value) for value in median), float(spread)),
        data_sha256=problem.data.history.data_sha256,
        seed=seed,
        versions=versions(),
        method=method,
        likelihood=likelihood.name,
        nu=likelihood.nu,
        library=problem.library,
        cells=problem.likelihood.noise.coordinates if is_filtered(problem) else None,
    )


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a posterior depends on."""
    numbers = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        try:
            numbers[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            numbers[name] = "not installed"
    return numbers


def problem_of(
    idata: Idata, effects: Iterable[Effect] = catalogue, history: History | None = None
) -> Problem:
    """Return the problem that a posterior was fitted to, from what the posterior holds.

    Pass effects of a user in ``effects``: the posterior holds their names alone.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.
    effects : iterable of Effect
        Where the names of its effects are looked up.
    history : History, optional
        Other data for the same problem, the noise's prior included.

    Raises
    ------
    PosteriorError
        If it has another schema version or lacks a group.
    EffectError
        If an effect is not among ``effects``.
    """
    record = PosteriorRecord.of(idata)
    constants, measured = group(idata, "constant_data"), group(idata, "observed_data")["next_state"]
    columns = tuple(STATE.index(name) for name in record.measured)
    start, actions = constants["start"].to_numpy(), constants["actions"].to_numpy()
    other = history is not None
    if history is None:
        values = measured.transpose(*NEXT_STATE_DIMS).to_numpy()
        observed = np.full((*values.shape[:3], len(STATE)), np.nan)
        observed[..., columns] = values
        history = from_segments(record.scene, start, actions, observed)
    elif actions.shape[-1] == len(INPUT):  # recorded since
        # of the first interval: there is no number after a trajectory's end
        history = history.numbered(float(actions[:, 0, :, INPUT.index("trajectory")].max()) + 1.0)
    law = TransitionLikelihood(scalar=record.scalar_sigma, nu=record.nu, prior=record.sigma_prior)
    problem = Problem.of(
        record.physics(effects), history, horizon=record.horizon, columns=columns, likelihood=law,
        library=record.library,
    )  # fmt: skip
    stored = with_recording(problem, constants, record.data_sha256)
    if not other:
        return stored
    if not is_filtered(stored):
        return problem
    # linearised at the posterior's best draw
    phi, sigma = Fit(stored, idata).best
    whole = along_trajectories(problem, phi, sigma, stored.likelihood.noise.coordinates)
    return with_sensitivity(whole, phi, sigma)


def parameter_draws(problem: Problem, trace: Idata) -> tuple[Floats, Floats]:
    """Return a problem's draws as vectors: phi, shape (draw, p), and sigma, shape (draw, state)."""
    return vectors(trace, problem.layout, problem.noise_variables)


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Parameters
    ----------
    problem : Problem
        What was sampled; trajectories are linearised as in the posterior.
    posterior : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.
    """

    problem: Problem
    posterior: Idata

    @classmethod
    def of(cls, posterior: Fit | Idata, effects: Iterable[Effect] = catalogue) -> Fit:
        """Return the fit that a posterior holds; one that is a fit already is returned itself.

        Parameters
        ----------
        posterior : InferenceData, DataTree or Fit
            As made by :func:`pbrl_ppl.fit`.
        effects : iterable of Effect
            Where the names of its effects are looked up.

        Raises
        ------
        PosteriorError
            If it has another schema version or lacks a group.
        EffectError
            If an effect is not among ``effects``.
        """
        if isinstance(posterior, Fit):
            return posterior
        return cls(problem_of(posterior, effects), posterior)

    @cached_property
    def record(self) -> PosteriorRecord:
        """The record of the fit: model, data, method and diagnostics."""
        return PosteriorRecord.of(self.posterior)

    @cached_property
    def draws(self) -> tuple[Floats, Floats]:
        """Posterior draws as vectors: phi, shape (draw, p), and sigma, shape (draw, parameter)."""
        return parameter_draws(self.problem, self.posterior)

    @cached_property
    def best(self) -> tuple[Floats, Floats]:
        """The draw of the highest density: phi, shape (p,), and sigma, shape (parameter,)."""
        phi, sigma = self.draws
        place = best_draw(self.posterior)
        return phi[place], sigma[place]


def linearised_as(problem: Problem, idata: Idata) -> Problem:
    """Return the problem with its trajectories linearised as in a posterior of the same data.

    Parameters
    ----------
    problem : Problem
        Of the posterior's scene, effects and data; returned itself if of single transitions.
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.

    Raises
    ------
    PosteriorError
        If the likelihood, the data or the parameters are others.
    """
    constants, posterior = group(idata, "constant_data"), group(idata, "posterior")
    record = PosteriorRecord.of(idata)
    stored, kind = record.likelihood_name, problem.likelihood.name
    if stored != kind:
        raise PosteriorError(
            f"posterior: its likelihood is of {stored}, the model's of {kind}; make the model with"
            f" the likelihood {stored!r}"
        )
    if is_simulated(problem):
        problem = in_pieces(problem, record.horizon, problem.data.smoothed_states)
    measured = group(idata, "observed_data")["next_state"].transpose(*NEXT_STATE_DIMS).to_numpy()
    if not np.array_equal(measured, problem.measured, equal_nan=True):
        raise PosteriorError(
            f"posterior: it is of {len(measured)} transitions that are not the model's"
            f" {len(problem.measured)}; pass the history that it was fitted to"
        )
    names = [*(block.name for block in problem.layout.blocks), *problem.noise_variables]
    if missing := [name for name in names if name not in posterior]:
        raise PosteriorError(f"posterior: it has no {', '.join(missing)}; of another model?")
    if SMOOTHED not in constants:
        return problem
    problem = with_recording(problem, constants, problem.data.history.data_sha256)
    return problem.with_likelihood(prior=record.sigma_prior)


def recording(problem: Problem) -> xr.Dataset:
    """Return the recording and linearisation of trajectories; empty for single transitions."""
    if is_independent(problem):
        return xr.Dataset()
    dataset = problem.data.history.dataset
    names = (*dataset.dims, *dataset.data_vars)
    kept = dataset.rename({name: f"{_PREFIX}{name}" for name in names})
    kept = kept.drop_vars([name for name in kept.coords if name not in kept.dims])
    dims = tuple(f"{_PREFIX}{name}" for name in ("trajectory", "time", "body", "state"))
    kept[SMOOTHED] = (dims, problem.data.smoothed_states)
    if is_simulated(problem):
        slope, tau = problem.likelihood.initial_states.slope, np.array(problem.likelihood.tau)
        kept[_BY_START] = ((*NEXT_STATE_DIMS, "cell_before"), slope)
        kept[_TAU] = (("state",), tau, {"units": "rows"})
    if is_filtered(problem):
        noise = problem.likelihood.noise
        kept["slope"] = (("transition", "cell_after", "cell_before"), noise.slope)
        kept["linearised_at"] = (("noise_parameter",), noise.sigma)
        if noise.sensitivity is not None:
            kept[_ORIGIN] = (("transition", "parameter"), noise.sensitivity.phi)
            dims = ("transition", "cell_before", "parameter")
            kept[_SENSITIVITY] = (dims, noise.sensitivity.before)
    return kept


def with_recording(problem: Problem, constants: xr.Dataset, data_sha256: str) -> Problem:
    """Return a problem with the trajectories of a posterior's constant data, if it has."""
    if SMOOTHED not in constants:
        return problem
    history = recorded(problem.scene, constants, data_sha256)
    stored = {str(name): values.to_numpy() for name, values in constants.data_vars.items()}
    states = stored[SMOOTHED]
    if _BY_START in stored:
        length, prior = constants[_BY_START].sizes["step"], problem.likelihood.prior
        pieces = in_pieces(problem.with_data(history=history), length, states)
        start, slope = pieces.segments.start, stored[_BY_START]
        return linearised_pieces(pieces, start, slope, stored[_TAU]).with_likelihood(prior=prior)
    coordinates = observed_coordinates(problem.scene, history)
    columns = coordinates.columns
    problem = problem.with_data(history=history, horizon=1, states=states, columns=columns)
    noise = linearised(problem, coordinates, stored["slope"], stored["linearised_at"])
    if _SENSITIVITY in stored:
        slopes = noise.slope, stored[_ORIGIN], stored[_SENSITIVITY]
        follow = Sensitivity(problem.scene, problem.layout, coordinates, *slopes)
        noise = replace(noise, sensitivity=follow)
    return problem.along(noise)


def recorded(scene: Scene, constants: xr.Dataset, data_sha256: str = "") -> History:
    """Return the history that a posterior's constant data hold."""
    dataset = constants[[name for name in constants.data_vars if str(name).startswith(_PREFIX)]]
    names = (*dataset.data_vars, *dataset.dims)
    dataset = dataset.rename({name: str(name).removeprefix(_PREFIX) for name in names})
    kinematic = ("body", [body.kinematic for body in scene.moving])
    dataset = dataset.assign_coords(kinematic=kinematic)
    return History(dataset.assign_attrs(time_step=scene.time_step, data_sha256=data_sha256))


def both_recordings(earlier: xr.Dataset, new: xr.Dataset) -> xr.Dataset:
    """Return one recording after the other; empty where there are none."""
    if SMOOTHED not in new:
        return xr.Dataset()
    by_transition = [name for name in ("slope", _ORIGIN, _SENSITIVITY) if name in new]
    whole = [str(name) for name in new.data_vars if f"{_PREFIX}trajectory" in new[name].dims]
    if f"{_PREFIX}began" not in earlier:  # of a file from before laws knew it
        began = xr.zeros_like(earlier[f"{_PREFIX}number"])
        earlier = earlier.assign({f"{_PREFIX}began": began})
    result = new[[name for name in ("linearised_at",) if name in new]]
    result = result.drop_vars([str(name) for name in result.coords])
    for names, dim in ((by_transition, "transition"), (whole, f"{_PREFIX}trajectory")):
        parts = [dataset[names].reset_coords(drop=True) for dataset in (earlier, new)]
        parts = [part.drop_vars([dim], errors="ignore") for part in parts]
        result = result.merge(xr.concat(parts, dim, join="outer"))
    result[SMOOTHED] = result[SMOOTHED].fillna(0.0)
    return result


def places(segments: Segments) -> dict[str, xr.Variable]:
    """Return the coordinates ``trajectory`` and ``time`` of segments, for a posterior's groups.

    The first is the trajectory's number in its recording, from 0, the second the clock of the row
    that the segment starts from (s).
    """
    first = segments.inputs[:, 0, 0]  # all bodies have the same clock
    number, begin = first[:, INPUT.index("trajectory")], first[:, INPUT.index("begin")]
    return {
        "trajectory": xr.Variable("transition", number.astype(np.int64)),
        "time": xr.Variable("transition", begin, {"units": "s"}),
    }


def both_places(earlier: xr.Dataset, segments: Segments) -> dict[str, xr.Variable]:
    """Return coordinates of a posterior's transitions and, after them, of new ones.

    Trajectories are numbered on, so that those of two recordings stay apart.
    """
    new = {name: variable.to_numpy() for name, variable in places(segments).items()}
    new["trajectory"] += int(earlier["trajectory"].max()) + 1 - new["trajectory"].min()
    both = {name: np.concatenate([earlier[name], values]) for name, values in new.items()}
    return {name: xr.Variable("transition", x, earlier[name].attrs) for name, x in both.items()}


def placed(idata: Idata, coords: xr.Coordinates | Mapping[str, xr.Variable]) -> Idata:
    """Return the posterior with the trajectory and time of these coordinates, and no others."""
    chosen = {name: coords[name] for name in PLACES}
    data = groups(idata)
    for name, dataset in data.items():
        if "transition" in dataset.dims:
            data[name] = dataset.drop_vars(PLACES, errors="ignore").assign_coords(chosen)
    return from_groups(data, idata.attrs)
