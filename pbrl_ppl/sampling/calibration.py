"""Simulation-based calibration of the whole pipeline (Talts et al., 2018; Modrák et al., 2023).

Parameters are drawn from the model's prior, measurements are simulated with them from the history's
initial states (Eq. 13 of single transitions), and the whole fit is run on these. If prior, engine,
likelihood and sampler belong together, the true values' ranks among the posterior draws are
uniform.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.errors import FitError, OutputError, warn
from pbrl_ppl.files import write_text
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import (
    OutputErrorLikelihood,
    Problem,
    TransitionLikelihood,
    declared_problem,
)
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import versions
from pbrl_ppl.sampling.ranks import Calibration
from pbrl_ppl.sampling.replication import Record, draw_truths, labels, replicate
from pbrl_ppl.scene import Scene
from pbrl_ppl.threads import as_ended

#: File of all that the replications in a folder depend on.
_DESIGN = "design.json"


def calibrate(
    scene: Scene,
    history: History,
    *,
    effects: Iterable[Effect | Attached] = (),
    replications: int = 200,
    seed: int = 1,
    folder: str | Path | None = None,
    executor: Executor | None = None,
    likelihood: str = TransitionLikelihood.name,
    colour: float = 0.0,
    horizon: int = 1,
    sigma: str = "per_dimension",
    nu: float | None = None,
    substeps: int | None = None,
    draws: int = 1500,
    tune: int = 500,
    chains: int = 4,
    progress: bool = True,
    **options: Any,
) -> Calibration:
    """Check prior, engine, likelihood and sampler against each other on simulated data.

    Initial states, actions and which cells are measured are the history's; what was measured counts
    only for the prior of sigma, which stays that of the history. An initial state is exact, as
    in Eq. 11, or measured with an error, of the other likelihoods. A wheel's equal descriptions are
    folded into one, of truth and draws alike. The log-likelihood is ranked too: the parameters'
    ranks alone cannot see a fit that ignores its data.

    With coloured errors, :attr:`Calibration.passed` judges the parameters alone: the log-likelihood
    of ``simulation`` is divided by the errors' autocorrelation time, so that the ranks of sigma and
    of the log-likelihood need not be uniform.

    Parameters
    ----------
    scene : Scene
        Known geometry, and the prior.
    history : History
        The design.
    effects : iterable of Effect or Attached
        Effects beside those that the scene declares.
    replications : int
        Simulated histories; fewer than 100 find gross faults alone.
    seed : int
        The same seed gives the same answer, whatever the executor.
    folder : str or Path, optional
        Where each finished replication is kept; a later call with the same arguments goes on from
        there, with more replications if more are asked for. Made if missing.
    executor : concurrent.futures.Executor, optional
        Where replications are run; by default here, one after another.
    likelihood : str
        ``transitions``, ``trajectories`` or ``simulation``, as of :func:`pbrl_ppl.physics_model`.
        Simulations have errors of measurement, and no process noise.
    colour : float
        Correlation of neighbouring rows' errors, with ``likelihood="simulation"``; at least 0 and
        below 1. Errors are autoregressive, AR(1), with the standard deviation sigma.
    horizon, sigma, nu, substeps : optional
        As of :func:`pbrl_ppl.physics_model`.
    draws, tune, chains : int
        As of :func:`pbrl_ppl.fit`. A fit with fewer than 99 effective draws is done again with four
        times the draws, at most twice.
    progress : bool
        Whether to show progress on stderr.
    **options
        Passed to :func:`pbrl_ppl.fit`.

    Returns
    -------
    Calibration
        Its ``dataset.attrs["redrawn"]`` counts the draws from the prior that the engine could not
        simulate; they were drawn again, for the posterior excludes them too.

    Raises
    ------
    FitError
        If a joint's bodies are unknown, (almost) no draw from the prior can be simulated, or all
        replications failed.
    OutputError
        If the folder holds another calibration, or cannot be written.
    ValueError
        If ``replications`` is below 2, ``colour`` is not at least 0 and below 1 or not for the
        likelihood, or :func:`pbrl_ppl.physics_model` refuses an option.

    Warns
    -----
    UserWarning
        If a replication failed.

    Examples
    --------
    ::

        result = calibrate(scene, history, folder="calibration", draws=250)
        result.table()[["p_holm", "coverage_50", "coverage_90"]]
        result.passed
    """
    if replications < 2:
        raise ValueError(f"replications is {replications}, expected at least 2, better 200")
    if not 0.0 <= colour < 1.0:
        raise ValueError(f"colour is {colour}, expected a correlation of at least 0 and below 1")
    if colour and likelihood != OutputErrorLikelihood.name:
        raise ValueError(
            f"colour is {colour} with likelihood {likelihood!r}, expected 0: coloured errors are"
            f" for {OutputErrorLikelihood.name!r}"
        )
    noise = TransitionLikelihood.declare(sigma, nu)
    physics = Physics.declare(with_units(scene, history), effects, substeps=substeps)
    design = declared_problem(physics, history, horizon=horizon, likelihood=noise, kind=likelihood)
    if design.layout.discrete.any():
        raise FitError(
            "calibrate: which bodies a joint joins is unknown, and ranks are for parameters that"
            " are not whole numbers; name the bodies in the scene"
        )
    # fixed here: taken from simulated data, it would not be the prior that they were drawn from
    median, spread = design.noise_prior
    design = design.with_likelihood(prior=(tuple(median.tolist()), spread))
    settings = {"draws": draws, "tune": tune, "chains": chains, **options}
    # of the declared scene: its natural units follow from the history
    about = _about(design, seed, settings) | {"scene": scene.to_toml(), "colour": colour}
    files = [] if folder is None else _opened(Path(folder), about, replications)
    truths, redrawn = draw_truths(design, replications, seed, colour)
    done = {i: _read(path) for i, path in enumerate(files) if path.is_file()}
    failures: dict[int, str] = {}
    tasks = {
        i: partial(replicate, design, truth, _seed(seed, i), settings)
        for i, truth in enumerate(truths)
        if i not in done
    }
    label = f"calibrating, {len(done)} of {replications} done before"
    shown: dict[str, Any] = {"console": Console(stderr=True), "disable": not progress}
    with closing(as_ended(tasks, executor)) as results:
        for i, result in track(results, label, len(tasks), **shown):
            try:
                done[i] = result()
            except Exception as error:  # whatever it was, the other replications go on
                failures[i] = f"replication {i}: {type(error).__name__}: {error}"
                continue
            if files:
                write_text(files[i], json.dumps(done[i]) + "\n")
    failed = tuple(failures[i] for i in sorted(failures))
    if not done:
        raise FitError(f"calibrate: all {replications} replications failed; {failed[0]}")
    if failed:
        warn(f"{len(failed)} of {replications} replications failed; {failed[0]}", UserWarning)
    numbers = sorted(done)
    columns = {name: np.array([done[i][name] for i in numbers]) for name in done[numbers[0]]}
    return Calibration.of(
        parameters=list(labels(design)),
        judged=design.layout.labels if colour else None,
        replication=np.array(numbers),
        failures=failed,
        attrs={key: json.dumps(value) for key, value in about.items()} | {"redrawn": redrawn},
        **columns,
    )


def _seed(seed: int, number: int) -> int:
    """Return the seed of a replication's fit."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _about(design: Problem, seed: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a calibration: all that its numbers depend on, as JSON values."""
    about = {
        "history": design.data.history.data_sha256,
        "effects": [[attached.effect.name, attached.body, repr(attached.effect.parameters)]
                    for attached in design.physics.effects],
        "horizon": design.data.horizon,
        "substeps": design.physics.substeps,
        "scalar_sigma": design.likelihood.scalar,
        "nu": design.likelihood.nu,
        "likelihood": design.likelihood.name,
        "sigma_prior": design.likelihood.prior,
        "seed": seed,
        "settings": dict(settings),
        "versions": versions(),
    }  # fmt: skip
    return dict(json.loads(json.dumps(about)))


def _opened(folder: Path, about: Mapping[str, Any], n: int) -> list[Path]:
    """Make the folder of a calibration, or check it; return the files of n replications."""
    path = folder / _DESIGN
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if any(folder.iterdir()):
                raise OutputError(f"{folder}: holds other files; choose a new or an empty folder")
            write_text(path, json.dumps(about, indent=1) + "\n")
        stored = json.loads(path.read_text(encoding="utf-8"))
    except OutputError:
        raise
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be made or read: {error}") from error
    changed = [key for key, value in about.items() if stored.get(key) != value]
    if changed:
        raise OutputError(
            f"{folder}: holds a calibration with another {', '.join(changed)}"
            f" ({changed[0]}: {stored.get(changed[0])!r:.80}, expected {about[changed[0]]!r:.80});"
            " choose another folder, or the arguments it was begun with"
        )
    return [folder / f"replication-{number:05d}.json" for number in range(n)]


def _read(path: Path) -> Record:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be read: {error}; delete it to run it again") from error
