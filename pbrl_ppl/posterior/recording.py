"""The recording and the linearisation of whole trajectories, as a posterior file holds them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    Problem,
    Sensitivity,
    TrajectoryNoise,
    TransitionLikelihood,
    cells_of,
    linearised,
)
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Name of the smoothed states; a posterior of single transitions has none.
SMOOTHED = "smoothed"
#: Names of how the smoothed states follow the parameters.
_ORIGIN, _SENSITIVITY = "smoothed_at", "sensitivity"
#: Name of the correlation of lasting errors from row to row.
_MEMORY = "memory"
#: Variables of the recording have these before their names, and before their dimensions'.
_PREFIX = "recorded_"


def recording(problem: Problem) -> xr.Dataset:
    """What a problem of whole trajectories needs beside its segments; empty for other ones."""
    if isinstance(problem.likelihood, TransitionLikelihood):
        return xr.Dataset()
    noise = problem.trajectory_noise
    dataset = problem.data.history.dataset
    kept = dataset.rename(
        {name: f"{_PREFIX}{name}" for name in (*dataset.dims, *dataset.data_vars)}
    )
    kept = kept.drop_vars([name for name in kept.coords if name not in kept.dims])
    dims = (f"{_PREFIX}trajectory", f"{_PREFIX}time", f"{_PREFIX}body", f"{_PREFIX}state")
    kept[SMOOTHED] = (dims, problem.data.smoothed_states)
    kept["slope"] = (("transition", "cell_after", "cell_before"), noise.slope)
    if noise.cells.drifts:
        kept[_MEMORY] = noise.cells.memory
    kept["linearised_at"] = (("noise_parameter",), noise.sigma)
    if noise.sensitivity is not None:
        follow = noise.sensitivity
        kept[_ORIGIN] = (("transition", "parameter"), follow.phi)
        kept[_SENSITIVITY] = (("transition", "cell_before", "parameter"), follow.before)
    return kept.assign_attrs({})


def with_recording(problem: Problem, given: xr.Dataset, data_sha256: str) -> Problem:
    """A problem with the whole trajectories that a posterior's constant data hold, if they do."""
    if SMOOTHED not in given:
        return problem
    history = recorded(problem.scene, given, data_sha256)
    cells = cells_of(problem.scene, history)
    if _MEMORY in given:
        cells = cells.drifting(float(given[_MEMORY]))
    states = given[SMOOTHED].to_numpy()
    data = replace(problem.data, history=history, horizon=1, states=states, columns=cells.columns)
    noise: TrajectoryNoise = linearised(
        problem.on(data), cells, given["slope"].to_numpy(), given["linearised_at"].to_numpy()
    )
    if _SENSITIVITY in given:
        origin, before = given[_ORIGIN].to_numpy(), given[_SENSITIVITY].to_numpy()
        follow = Sensitivity(problem.scene, problem.layout, cells, noise.slope, origin, before)
        noise = replace(noise, sensitivity=follow)
    return problem.on(data).along(noise)


def recorded(scene: Scene, given: xr.Dataset, data_sha256: str = "") -> History:
    """The history that a posterior's constant data hold."""
    names = [str(name) for name in given.data_vars if str(name).startswith(_PREFIX)]
    back = {
        name: str(name).removeprefix(_PREFIX)
        for name in (*names, *given.dims)
        if str(name).startswith(_PREFIX)
    }
    dataset = given[names].rename(back)
    dataset = dataset.assign_coords(
        kinematic=("body", [body.kinematic for body in scene.moving])
    ).assign_attrs(time_step=scene.time_step, data_sha256=data_sha256)
    return History(dataset)


def both_recordings(held: xr.Dataset, new: xr.Dataset) -> xr.Dataset:
    """One recording after the other; empty where there are none."""
    if SMOOTHED not in new:
        return xr.Dataset()
    by_transition = ["slope"]
    if _SENSITIVITY in new:
        by_transition += [_ORIGIN, _SENSITIVITY]
        if _SENSITIVITY not in held:  # a file of an older version, whose states stay
            n, (_, cells, p) = held.sizes["transition"], new[_SENSITIVITY].shape
            none = {_ORIGIN: np.zeros((n, p)), _SENSITIVITY: np.zeros((n, cells, p))}
            held = held.assign({name: (new[name].dims, none[name]) for name in none})
    whole = [str(name) for name in new.data_vars if f"{_PREFIX}trajectory" in new[name].dims]
    result = xr.Dataset({"linearised_at": new["linearised_at"]})
    for names, dim in ((by_transition, "transition"), (whole, f"{_PREFIX}trajectory")):
        parts = [given[names].reset_coords(drop=True) for given in (held, new)]
        parts = [part.drop_vars([dim], errors="ignore") for part in parts]
        result = result.merge(xr.concat(parts, dim, join="outer"))
    result[SMOOTHED] = result[SMOOTHED].fillna(0.0)
    return result
