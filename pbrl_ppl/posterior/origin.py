"""Origin of a posterior: the attributes that say what was fitted, and the problem made of them."""

from __future__ import annotations

import importlib.metadata
import json
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import (
    LEARNED_REMAINDER,
    Effect,
    LearnedRemainder,
    attach,
    catalogue,
)
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.history import History, Segments, from_segments
from pbrl_ppl.likelihood import (
    Observations,
    Problem,
    TrajectoryLikelihood,
    TransitionLikelihood,
    along_trajectories,
    sigma_prior,
    with_sensitivity,
)
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.posterior.known_effects import known_effects
from pbrl_ppl.posterior.recording import SMOOTHED, with_recording
from pbrl_ppl.posterior.store import (
    attributes,
    draws,
    group,
    has_one_sigma,
    likeliest_draw,
    scene_of,
)
from pbrl_ppl.state import INPUT, STATE

PACKAGES = ("pbrl_ppl", "pymc", "pytensor", "arviz", "pymunk", "numpy", "numba", "xarray")


def origin(problem: Problem, seed: int) -> dict[str, Any]:
    """Attributes of a posterior: scene, effects, settings, data and versions."""
    scene = problem.scene
    median, spread = problem.noise_prior
    for body in scene.dynamic:
        new = [
            attached.effect.name
            for attached in problem.physics.effects
            if attached.body == body.name and attached.effect.name not in body.effects
        ]
        scene = scene.with_effects(body.name, *new)
    return attributes(
        scene,
        effects=[[attached.effect.name, attached.body] for attached in problem.physics.effects],
        seed=seed,
        horizon=problem.data.horizon,
        **({} if problem.likelihood.nu is None else {"nu": problem.likelihood.nu}),
        **({} if problem.library is None else {"library": problem.library.to_json()}),
        **dict(
            (LEARNED_REMAINDER, attached.effect.table)
            for attached in problem.physics.effects
            if isinstance(attached.effect, LearnedRemainder)
        ),
        substeps=problem.physics.substeps,
        together=list(problem.physics.together),
        sigma_prior=[[float(value) for value in median], float(spread)],
        data_sha256=problem.data.history.data_sha256,
        versions=versions(),
    )


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a posterior depends on."""
    found = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def linearised_as(problem: Problem, idata: Any) -> Problem:
    """The problem, its trajectories linearised where those of a posterior of the same data are.

    Parameters
    ----------
    problem : Problem
        Of the posterior's scene, effects and data; itself if it is one of single transitions.
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.

    Raises
    ------
    PosteriorError
        If one is of whole trajectories and the other of single transitions, or the data or the
        parameters are others.
    """
    given, posterior = group(idata, "constant_data"), group(idata, "posterior")
    of = {True: "whole trajectories", False: "single transitions"}
    whole = isinstance(problem.likelihood, TrajectoryLikelihood)
    if (SMOOTHED in given) != whole:
        raise PosteriorError(
            f"posterior: it is of {of[not whole]}, expected {of[whole]} as the model; make"
            f" that with trajectories={not whole}"
        )
    measured: NDArray[np.float64] = (
        group(idata, "observed_data")["next_state"]
        .transpose("transition", "step", "body", "state")
        .to_numpy()
    )
    if not np.array_equal(measured, problem.measured, equal_nan=True):
        raise PosteriorError(
            f"posterior: it is of {len(measured)} transitions that are not the model's"
            f" {len(problem.measured)}; pass the history that it was fitted to"
        )
    names = [*(block.name for block in problem.layout.blocks), *problem.noise_variables]
    missing = [name for name in names if name not in posterior]
    if missing:
        raise PosteriorError(f"posterior: it has no {', '.join(missing)}; of another model?")
    if not whole:
        return problem
    median, spread = json.loads(str(idata.attrs["sigma_prior"]))
    problem = with_recording(problem, given, problem.data.history.data_sha256)
    return problem.with_likelihood(prior=(tuple(map(float, median)), float(spread)))


def problem_of(
    idata: Any, effects: Iterable[Effect] = catalogue, history: History | None = None
) -> Problem:
    """The problem that a posterior was fitted to, from what the posterior holds.

    A user's own effects are not in it.

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
        If it holds no scene or lacks a group.
    EffectError
        If an effect is not among ``effects``.
    """
    attrs, scene = idata.attrs, scene_of(idata)
    given, measured = group(idata, "constant_data"), group(idata, "observed_data")["next_state"]
    values = measured.transpose("transition", "step", "body", "state").to_numpy()
    columns = tuple(STATE.index(str(name)) for name in measured["state"].values)
    start, actions = given["start"].to_numpy(), given["actions"].to_numpy()
    observed = np.full((*values.shape[:3], len(STATE)), np.nan)
    observed[..., columns] = values
    if "sigma_prior" in attrs:
        median, spread = json.loads(str(attrs["sigma_prior"]))
    else:  # a file of an older version
        none = np.zeros(len(start), dtype=np.int64)
        segments = Segments(start, actions, observed, none, none, actions)
        median, spread = sigma_prior(Observations(values, columns), segments)
    likelihood = TransitionLikelihood(
        scalar=has_one_sigma(idata),
        nu=float(attrs["nu"]) if "nu" in attrs else None,
        prior=(tuple(float(value) for value in median), float(spread)),
    )
    other = history is not None
    if history is None:
        history = from_segments(scene, start, actions, observed)
    elif actions.shape[-1] == len(INPUT):  # recorded since
        # after a trajectory's end there is none: of the first interval alone
        history = history.numbered(float(actions[:, 0, :, INPUT.index("trajectory")].max()) + 1.0)
    problem = Problem.of(
        scene,
        history,
        attach(scene, (), known_effects(idata, effects)),
        horizon=int(attrs["horizon"]),
        substeps=int(attrs["substeps"]),
        columns=columns,
        likelihood=likelihood,
        library=ParameterLibrary.from_json(str(attrs["library"])) if "library" in attrs else None,
        together=tuple(json.loads(str(attrs.get("together", "[]")))),
    )
    recorded = with_recording(problem, given, str(attrs["data_sha256"]))
    if not other or isinstance(recorded.likelihood, TransitionLikelihood):
        return recorded
    # linearised where the posterior is
    named = draws(idata)
    phi = problem.layout.to_vectors(named, len(next(iter(named.values()))))
    sigma = np.hstack([named[name].reshape(len(phi), -1) for name in recorded.noise_variables])
    best = likeliest_draw(idata)
    problem = along_trajectories(problem, phi[best], sigma[best], recorded.trajectory_noise.cells)
    return with_sensitivity(problem, phi[best], sigma[best])
