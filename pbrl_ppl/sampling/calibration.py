"""Simulation-based calibration of the whole pipeline (Talts et al., 2018; Modrák et al., 2023).

Parameters are drawn from the model's prior, measurements are simulated with them from the history's
initial states (Eq. 13 of single transitions), and the whole fit is run on these. If prior, engine,
likelihood and sampler belong together, the true values' ranks among the posterior draws are
uniform.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import track
from scipy.signal import lfilter

from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.errors import FitError, OutputError, PbrlWarning, warn
from pbrl_ppl.files import is_empty, write_text
from pbrl_ppl.history import History, from_segments, with_units
from pbrl_ppl.likelihood import (
    OutputErrorLikelihood,
    Problem,
    TransitionLikelihood,
    declared_problem,
    is_filtered,
    is_independent,
    simulated_trajectories,
    with_measurements,
)
from pbrl_ppl.parameters import by_prior
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import (
    PosteriorRecord,
    convergence,
    from_groups,
    group,
    parameter_draws,
    problem_of,
    versions,
)
from pbrl_ppl.sampling.fitting import joined_at, sample
from pbrl_ppl.sampling.ranks import MOST_DRAWS, Calibration, rank
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, Floats
from pbrl_ppl.threads import as_ended

#: File of all that the replications in a folder depend on.
_DESIGN = "design.json"
#: One replication's numbers, by name, each a list over the parameters.
Record = dict[str, list[float]]


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
    _check_colour(colour, likelihood)
    noise = TransitionLikelihood.declare(sigma, nu)
    physics = Physics.declare(with_units(scene, history), effects, substeps=substeps)
    design = _design(
        declared_problem(physics, history, horizon=horizon, likelihood=noise, kind=likelihood)
    )
    settings = {"draws": draws, "tune": tune, "chains": chains, **options}
    # of the declared scene: its natural units follow from the history
    about = _about(design, seed, settings) | {"scene": scene.to_toml(), "colour": colour}
    files = [] if folder is None else _opened(Path(folder), about, replications)
    truths, redrawn = draw_truths(design, replications, seed, colour)
    done = {i: _read(path) for i, path in enumerate(files) if path.is_file()}
    tasks = {
        i: partial(replicate, design, truth, _seed(seed, i), settings)
        for i, truth in enumerate(truths)
        if i not in done
    }
    failed = _run(tasks, done, files, executor, progress)
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


def _check_colour(colour: float, likelihood: str) -> None:
    """Refuse a correlation of errors that is none, or is not for the likelihood."""
    if not 0.0 <= colour < 1.0:
        raise ValueError(f"colour is {colour}, expected a correlation of at least 0 and below 1")
    if colour and likelihood != OutputErrorLikelihood.name:
        raise ValueError(
            f"colour is {colour} with likelihood {likelihood!r}, expected 0: coloured errors are"
            f" for {OutputErrorLikelihood.name!r}"
        )


def _design(problem: Problem) -> Problem:
    """Return the problem with its noise prior fixed.

    Taken from simulated data, it would not be the prior that they were drawn from.
    """
    if problem.layout.discrete.any():
        raise FitError(
            "calibrate: which bodies a joint joins is unknown, and ranks are for parameters that"
            " are not whole numbers; name the bodies in the scene"
        )
    median, spread = problem.noise_prior
    return problem.with_likelihood(prior=(tuple(median.tolist()), spread))


def _run(
    tasks: Mapping[int, Callable[[], Record]],
    done: dict[int, Record],
    files: Sequence[Path],
    executor: Executor | None,
    progress: bool,
) -> tuple[str, ...]:
    """Run replications; return a text for each that failed, in their order.

    Each result is entered in ``done`` and in its file, if there are files, as soon as it is there.
    """
    failures: dict[int, str] = {}
    label = f"calibrating, {len(done)} of {len(done) + len(tasks)} done before"
    console = Console(stderr=True)
    with closing(as_ended(tasks, executor)) as results:
        for i, result in track(results, label, len(tasks), console=console, disable=not progress):
            try:
                done[i] = result()
            except Exception as error:  # whatever it was, the other replications go on
                failures[i] = f"replication {i}: {type(error).__name__}: {error}"
                continue
            if files:
                write_text(files[i], json.dumps(done[i]) + "\n")
    return tuple(failures[i] for i in sorted(failures))


def _seed(seed: int, number: int) -> int:
    """Return the seed of a replication's fit."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _about(design: Problem, seed: int, settings: Mapping[str, object]) -> dict[str, object]:
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


def _opened(folder: Path, about: Mapping[str, object], n: int) -> list[Path]:
    """Make the folder of a calibration, or check it; return the files of n replications."""
    path = folder / _DESIGN
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if not is_empty(folder):
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


class Truth(NamedTuple):
    """True parameters of a replication, and what was simulated with them.

    Attributes
    ----------
    phi : ndarray
        Shape (p,), SI units.
    sigma : ndarray
        Shape (state,).
    values : ndarray
        Next states, shape (transition, H, body, state); measured states of trajectories, shape
        (trajectory, time, body, 6).
    """

    phi: Floats
    sigma: Floats
    values: Floats


def draw_truths(
    design: Problem, n: int, seed: int, colour: float = 0.0, *, most_redrawn: int = 50
) -> tuple[list[Truth], int]:
    """Draw parameters from the model's prior with PyMC, and what is measured with them.

    Next states are drawn by Eq. 13, and whole trajectories with process noise; simulations from the
    design's initial states have errors of measurement alone.

    Parameters
    ----------
    design : Problem
        Says the prior, initial states and actions.
    n : int
        How many; the first of more are the same.
    seed : int
        Of the draws.
    colour : float
        Correlation of neighbouring rows' errors, of simulations.
    most_redrawn : int
        Most draws from the prior for each one that the engine can simulate.

    Returns
    -------
    truths : list of Truth
        Such as the engine can simulate.
    redrawn : int
        How many others came up between them.

    Raises
    ------
    FitError
        If too few draws can be simulated.
    """
    from pbrl_ppl.model import build_model, prior_predictive_draws  # PyMC takes seconds to load

    model = build_model(design)
    whole = not is_independent(design)
    names = [*(block.name for block in design.layout.blocks), *design.noise_variables]
    names += [] if whole else ["next_state"]
    total = n
    while total <= most_redrawn * n:
        drawn = prior_predictive_draws(model, names, total, seed)
        phi = design.layout.to_vectors(drawn, total)
        sigma = np.hstack([drawn[name].reshape(total, -1) for name in design.noise_variables])
        sigma = np.broadcast_to(sigma, (total, len(design.noise_prior[0])))
        values = _trajectories(design, phi, sigma, seed, colour) if whole else drawn["next_state"]
        possible = np.asarray(np.isfinite(values).reshape(total, -1).all(axis=1))
        chosen = np.flatnonzero(possible)[:n]
        if len(chosen) == n:
            truths = [Truth(phi[i], sigma[i], values[i]) for i in chosen]
            return truths, int(chosen[-1]) + 1 - n
        total *= 2
    raise FitError(
        f"calibrate: {possible.sum()} of {len(possible)} draws from the prior can be simulated,"
        f" expected at least 1 in {most_redrawn}; make the scene's prior narrower"
    )


def _trajectories(design: Problem, phi: Floats, sigma: Floats, seed: int, colour: float) -> Floats:
    """Return measured states of whole trajectories, one set a draw; 0 where nothing is measured."""
    rngs = [np.random.default_rng([seed, i]) for i in range(len(phi))]
    if is_filtered(design):
        drawn = zip(phi, sigma, rngs, strict=True)
        every = np.array([simulated_trajectories(design, *draw) for draw in drawn])
    else:
        every = np.repeat(design.data.smoothed_states[None], len(phi), axis=0)
        # without process noise; each piece of the design is a whole trajectory
        simulated_states = design.physics.one_world(phi, design.segments.start, design.inputs)
        every[:, design.segments.trajectory, 1:] = simulated_states
        columns = list(design.observations.columns)
        for states, noise, rng in zip(every, sigma, rngs, strict=True):
            states[..., columns] += noise * coloured((*states.shape[:3], len(columns)), colour, rng)
    measured = np.isfinite(design.data.history.dataset["observed"].to_numpy())
    return np.where(measured, every, 0.0)


def coloured(shape: tuple[int, ...], colour: float, rng: np.random.Generator) -> Floats:
    """Return standard normal errors that are autoregressive along the second axis, AR(1).

    Parameters
    ----------
    shape : tuple of int
        Of the errors: (trajectory, time, ...).
    colour : float
        Correlation of neighbouring rows' errors, at least 0 and below 1.
    rng : Generator
        Of the errors.
    """
    errors = rng.standard_normal(shape)
    errors[:, 1:] *= np.sqrt(1.0 - colour**2)
    return np.asarray(lfilter([1.0], [1.0, -colour], errors, axis=1))


def simulated(design: Problem, values: Floats) -> Problem:
    """Return the problem with other measurements in place of the design's.

    Of single transitions its history has one trajectory a segment, so that each starts from the
    design's state.

    Parameters
    ----------
    design : Problem
        Initial states, actions and which cells are measured.
    values : ndarray
        Next states, shape (transition, H, body, state), SI units; of whole trajectories all
        measured states, shape (trajectory, time, body, 6).
    """
    if not is_independent(design):
        measured = np.isfinite(design.data.history.dataset["observed"].to_numpy())
        return with_measurements(design, np.where(measured, values, np.nan))
    segments, observations = design.segments, design.observations
    observed = np.full((*segments.actions.shape[:3], len(STATE)), np.nan)
    observed[..., list(observations.columns)] = np.where(observations.measured, values, np.nan)
    history = from_segments(design.scene, segments.start, segments.inputs, observed)
    return design.with_data(history=history)


def replicate(
    design: Problem,
    truth: Truth,
    seed: int,
    settings: Mapping[str, Any],
    *,
    most_repeats: int = 2,
    longer: int = 4,
) -> Record:
    """Fit what was simulated and rank the truth among the posterior draws.

    Parameters
    ----------
    design : Problem
        As for :func:`simulated`, with a prior of sigma.
    truth : Truth
        From :func:`draw_truths`.
    seed : int
        Of the fit.
    settings : mapping
        Arguments of :func:`pbrl_ppl.fit`.
    most_repeats : int
        Most repetitions of a fit with fewer than 99 effective draws.
    longer : int
        The factor of its draws.

    Returns
    -------
    dict of str to list
        ``rank``, ``size``, ``truth``, ``ess`` and ``r_hat``, over the parameters.
    """
    # bodies that met in the simulation are simulated in one world
    problem = joined_at(simulated(design, truth.values), truth.phi[None], truth.sigma[None])
    settings = {"cores": 1, **settings}
    for again in range(most_repeats + 1):
        with warnings.catch_warnings():
            # convergence is in the result; the other warnings are about simulated data
            warnings.simplefilter("ignore", PbrlWarning)
            idata = sample(problem, seed=seed, **settings).posterior
        if PosteriorRecord.of(idata).interrupted:
            raise KeyboardInterrupt
        sizes = group(idata, "posterior").sizes
        likelihood = group(idata, "log_likelihood")["next_state"].sum("transition").values
        drawn = quantities(problem, *parameter_draws(problem, idata), likelihood.ravel())
        columns = drawn.T.reshape(-1, sizes["chain"], sizes["draw"])
        data = xr.DataArray(columns, {"name": list(labels(problem))}, ("name", "chain", "draw"))
        # of folded draws: a change between equal descriptions of a wheel is no failure to mix
        r_hat, ess = convergence(from_groups({"posterior": data.to_dataset("name")}, {}))
        if min(ess.values()) >= MOST_DRAWS or again == most_repeats:
            break
        settings |= {key: longer * settings[key] for key in ("draws", "tune")}
    problem = problem_of(idata, {attached.effect for attached in problem.physics.effects})
    residual = problem.residual(truth.phi)
    of_truth = problem.log_density(residual, truth.sigma, truth.phi).sum(keepdims=True)
    true = quantities(problem, truth.phi[None], truth.sigma[None], of_truth)[0]
    ranks, counts = zip(*map(rank, drawn.T, true, ess.values()), strict=True)
    found = {"truth": true.tolist(), "ess": list(ess.values()), "r_hat": list(r_hat.values())}
    return {"rank": list(ranks), "size": list(counts), **found}


def quantities(problem: Problem, phi: Floats, sigma: Floats, likelihood: Floats) -> Floats:
    """Return the ranked quantities: folded phi, sigma, log-likelihood, shape (draw, quantity)."""
    sigma = problem.likelihood.free(sigma)
    return np.hstack([by_prior(problem.layout, phi, equal_alone=True), sigma, likelihood[:, None]])


def labels(problem: Problem) -> tuple[str, ...]:
    """Return the names of the ranked quantities, such as ``mass[cart]``."""
    return (*problem.layout.labels, *problem.noise_labels, "log_likelihood")
