"""``pbrl-ppl simulate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.options import command
from pbrl_ppl.cli.terminal import Progress, Result, check_file
from pbrl_ppl.errors import ParameterError, PosteriorError
from pbrl_ppl.state import STATE, Floats

if TYPE_CHECKING:
    from pbrl_ppl.effects import Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.parameters import Layout
    from pbrl_ppl.physics import Physics


@command("simulate", 11, "pbrl-ppl simulate cart.nc plan.csv -o predicted.csv --draws 20")
def simulate(
    source: Path,
    history: Path,
    output: options.OutputFile,
    reading: options.PosteriorReading,
    progress: Progress,
    given: Annotated[list[str] | None, typer.Option("--set")] = None,
    draws: options.Count | None = None,
    noise: list[str] | None = None,
    seed: options.Seed = 1,
    overwrite: bool = False,
) -> Result:
    """Simulate a recording: its initial states and wrenches, under parameters that are given.

    Each trajectory is followed from its first complete state to its end. With --noise, measurement
    noise is added; without, the states are the engine's.

    Parameters
    ----------
    source : SOURCE
        Posterior file (.nc), or scene (.toml) with --set.
    output
        The history (.csv, .parquet, .nc).
    given : NAME=VALUE
        A parameter (SI units): mass=8 for all bodies, or 'mass[cart]=8'; repeat.
    draws
        Posterior draws, a copy of each trajectory for each; else MAP.
    """
    check_file(output, (".csv", ".parquet", ".nc"), overwrite)
    values = options.pairs(given, "--set", "mass=8", float)
    errors = options.noise_of(noise)
    progress("reading the parameters and the history")
    catalogue = reading.catalogue()
    physics, phi = _parameters(source, values, draws, seed, catalogue)
    scene = physics.scene
    scene.replace(noise=errors)  # raises where the noise is invalid
    recorded = reading.recording(history, scene, resample=reading.resample)
    progress("simulating")
    from pbrl_ppl.physics import simulated_recording

    simulated = simulated_recording(physics, phi, recorded)
    result = _history(recorded, simulated, errors, seed, labelled=draws is not None)
    result.save(output)
    contents = {
        "history": output,
        "trajectories": result.n_trajectories,
        "transitions": result.n_transitions,
        "parameters": dict(zip(physics.layout.labels, phi.T, strict=True)),
    }
    return Result(contents, [f"history: {output} ({result.n_trajectories} trajectories)"])


def _parameters(
    source: Path,
    values: Mapping[str, float],
    draws: int | None,
    seed: int,
    catalogue: Sequence[Effect],
) -> tuple[Physics, Floats]:
    """Return the physics, and parameter vectors, shape (draw, p), from a posterior or options."""
    from pbrl_ppl.effects import attach
    from pbrl_ppl.physics import Physics

    if source.suffix == ".nc":
        from pbrl_ppl.planning import Dynamics
        from pbrl_ppl.posterior import PosteriorRecord, load_posterior

        idata = load_posterior(source)
        dynamics = Dynamics.of(idata, draws, seed=seed, effects=catalogue)
        scene, substeps = dynamics.scene, PosteriorRecord.of(idata).substeps
    elif draws is not None:
        raise PosteriorError(f"--draws: {source} is no posterior file (.nc), and has no draws")
    else:
        from pbrl_ppl.scene import Scene

        scene, dynamics = Scene.load(source), None
        substeps = scene.substeps
    physics = Physics(scene, attach(scene, (), catalogue), substeps, threads=2)
    phi = dynamics.phi.copy() if dynamics else np.full((1, physics.layout.size), np.nan)
    _set(physics.layout, phi, values)
    return physics, phi


def _set(layout: Layout, phi: Floats, values: Mapping[str, float]) -> None:
    """Set values in parameter vectors, in place: by label, or by name for all bodies."""
    from pbrl_ppl.scene import nearest

    labels = np.array(layout.labels)
    names = np.array([label.partition("[")[0] for label in layout.labels])
    for name, value in values.items():
        places = (labels == name) | (names == name)
        if not places.any():
            known = [*dict.fromkeys(names.tolist()), *layout.labels]
            raise ParameterError(f'--set: there is no parameter "{name}"{nearest(name, known)}')
        phi[:, places] = value
    missing = labels[np.isnan(phi).any(axis=0)]
    if len(missing):
        raise ParameterError(
            f"--set: no value for {', '.join(missing)}; give one, such as"
            f" --set '{missing[0]}=...', or in the scene (known = ...)"
        )


def _history(
    recorded: History, states: list[Floats], errors: Mapping[str, float], seed: int, labelled: bool
) -> History:
    """Return a history of simulated states with measurement noise; labels may name the draw."""
    import xarray as xr

    from pbrl_ppl.history import History

    spread = np.array([errors.get(name, 0.0) for name in STATE])
    free = ~recorded.dataset["kinematic"].to_numpy()[:, None]
    simulated = np.concatenate(states)
    noise = np.random.default_rng(seed).standard_normal(simulated.shape)
    copies = xr.concat([recorded.dataset] * len(states), dim="trajectory")
    copies["observed"] = copies["observed"].copy(data=simulated + free * spread * noise)
    if labelled:
        names = recorded.dataset["trajectory"].to_numpy()
        labels = [f"{name}/draw {draw}" for draw in range(len(states)) for name in names]
        copies = copies.assign_coords(trajectory=labels)
    return History(copies)
