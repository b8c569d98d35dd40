"""Simulated recordings: ``pbrl-ppl simulate`` and ``pbrl-ppl rehearse``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.terminal import Progress, Result, sizes, table
from pbrl_ppl.errors import HistoryError, ParameterError, PosteriorError, RecordingWarning, warn
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import STATE, Floats

if TYPE_CHECKING:
    from pbrl_ppl.effects import Effect
    from pbrl_ppl.history import History
    from pbrl_ppl.physics import Physics
    from pbrl_ppl.planning.rehearsal import RehearsedLaw


@command("simulate", 11, "pbrl-ppl simulate cart.nc plan.csv -o predicted.csv --draws 20")
def simulate(
    source: Path,
    history: list[Path],
    to: options.RecordingOutput,
    reading: options.PosteriorReading,
    progress: Progress,
    given: Annotated[list[str] | None, typer.Option("--set")] = None,
    draws: options.Count | None = None,
    noise: list[str] | None = None,
    seed: options.Seed = 1,
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
    values = options.pairs(given, "--set", "mass=8", float)
    errors = options.noise_of(noise)
    progress("reading the parameters and the history")
    catalogue = reading.catalogue()
    physics, phi = _parameters(source, values, draws, seed, catalogue)
    scene = physics.scene
    scene.replace(noise=errors)  # raises where the noise is invalid
    recorded = _that_start(reading.recording(history, scene, resample=reading.resample))
    progress("simulating")
    from pbrl_ppl.physics import simulated_recording

    simulated = simulated_recording(physics, phi, recorded)
    result = _history(recorded, simulated, errors, seed, labelled=draws is not None)
    result.save(to.output)
    contents = {
        "history": to.output,
        "trajectories": result.n_trajectories,
        "transitions": result.n_transitions,
        "parameters": dict(zip(physics.layout.labels, phi.T, strict=True)),
    }
    return Result(contents, [f"history: {to.output} ({result.n_trajectories} trajectories)"])


def _that_start(recorded: History) -> History:
    """Return the trajectories with a complete state to start from; warn of others."""
    complete, rows = recorded.complete, recorded.dataset["n_rows"].to_numpy()
    starts = [i for i, n in enumerate(rows) if complete[i, : n - 1].any()]
    if not starts:
        raise HistoryError(
            "history: no trajectory has a complete state to start from; measure one, or pass"
            " --estimate-velocities"
        )
    lost = sorted({*range(len(rows))} - {*starts})
    if not lost:
        return recorded
    names = ", ".join(map(str, recorded.dataset["trajectory"].to_numpy()[lost]))
    warn(
        f"history: no complete state to start from in trajectory {names}: left out; measure one, or"
        " pass --estimate-velocities",
        RecordingWarning,
    )
    return recorded.select(starts)


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
        scene, dynamics = Scene.load(source), None
        substeps = scene.substeps
    physics = Physics(scene, attach(scene, (), catalogue), substeps, threads=2)
    phi = dynamics.phi.copy() if dynamics else np.full((1, physics.layout.size), np.nan)
    _set(physics, phi, values)
    return physics, phi


def _set(physics: Physics, phi: Floats, values: Mapping[str, float]) -> None:
    """Set values in parameter vectors, in place: by label, or by name for all bodies."""
    layout = physics.layout
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


@command("rehearse", 2, "pbrl-ppl rehearse scene.toml commands.csv --noise x=0.002,y=0.002")
def rehearse(
    scene: Path,
    to: options.Output,
    reading: options.SceneReading,
    progress: Progress,
    commands: Annotated[Path | None, typer.Argument()] = None,
    given: Annotated[list[str] | None, typer.Option("--set")] = None,
    seed: options.Seed = 0,
) -> Result:
    """Find out before a recording is made which laws it would name, and from which size on.

    The declared model is simulated with the commands and with measurement noise, and each law of
    the catalogue is added in turn.

    Parameters
    ----------
    commands : COMMANDS
        Initial states and wrenches (.csv, .parquet, .nc), as of simulate; proposed if not given.
    output
        The simulated recording with its commands (.csv, .parquet, .nc).
    given : NAME=VALUE
        A declared parameter (SI units): mass=8 for all bodies, or 'mass[cart]=8'; repeat. The
        prior's centre if not given.
    """
    values = options.pairs(given, "--set", "mass=8", float)
    progress("reading the scene and the commands")
    declared, histories = reading.read(scene, [] if commands is None else [[commands]])
    catalogue = reading.catalogue()
    progress("loading the model")
    from pbrl_ppl.planning import rehearsal
    from pbrl_ppl.posterior import versions

    found = rehearsal.rehearse(
        declared, *histories, parameters=values, catalogue=catalogue, seed=seed,
        progress=progress,
    )  # fmt: skip
    contents = {key: value for key, value in vars(found).items() if key != "history"}
    contents = {"versions": versions(), **contents}
    if to.output is not None:
        found.history.save(to.output)
    noise = ", ".join(f"{name} {sd:.2g}" for name, sd in found.noise.items())
    columns = {"law": "<", "body": "<", "named from": "<", "of typical": "", "named as": "<"}
    laws = table(
        f"laws that a recording would show; measurement noise (SI): {noise}",
        columns | {"confounded with": "<", "note": "<"},
        (_row(law) for law in found.laws if law.named),
    )
    unseen: dict[str, list[str]] = {}
    for law in found.laws:
        if not law.named:
            unseen.setdefault(law.note, []).append(f"{law.effect} on {law.body}")
    lines = [f"unseen, {why}: {', '.join(names)}" for why, names in unseen.items()]
    lines += [f"written: {to.output}"] if to.output is not None else []
    return Result(contents, [laws, *lines])


def _row(law: RehearsedLaw) -> list[str]:
    """Return a law's row of the table."""
    null = {name: f"{law.null[name]:g} ± " for name in law.sizes if law.null[name]}
    found = (*law.sizes.items(), *law.levels.items())
    numbers = ((name, f"{null.get(name, '')}{size:.3g}") for name, size in found)
    typical = f"{100 * law.share:.2g} %" if law.sizes else ""
    named = law.named if law.named != law.effect else ""
    return [
        law.effect, law.body, sizes(numbers, law.units), typical, named,
        ", ".join(law.confounded), law.note,
    ]  # fmt: skip
