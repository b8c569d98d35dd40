"""Posterior files: ``pbrl-ppl fit``, ``update`` and ``report``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from pbrl_ppl import errors
from pbrl_ppl.cli import options, terminal
from pbrl_ppl.cli.app import command
from pbrl_ppl.cli.terminal import Progress, Result, check_file
from pbrl_ppl.system.files import write_text

if TYPE_CHECKING:
    import pandas as pd

    from pbrl_ppl.posterior import Idata


@dataclass(frozen=True)
class Model:
    """Options of the model that is fitted.

    Parameters
    ----------
    likelihood : NAME
        trajectories (whole ones with process noise, as of close-loop), transitions (single ones
        from exact states, the paper's Eq. 11) or simulation (trajectories without process noise, as
        of criticise --simulate).
    horizon
        Intervals that are predicted, with --likelihood transitions.
    scalar
        One sigma for all, with --likelihood transitions.
    nu
        Degrees of freedom of Student-t noise; else Gaussian.
    """

    likelihood: str = "trajectories"
    horizon: options.Count = 1
    scalar: Annotated[bool, typer.Option("--scalar-sigma")] = False
    nu: Annotated[float | None, typer.Option(min=0.1)] = None

    def __post_init__(self) -> None:
        if self.likelihood != "transitions" and (self.horizon > 1 or self.scalar):
            raise errors.FitError(
                "--horizon and --scalar-sigma are of single transitions: --likelihood transitions"
            )


@dataclass(frozen=True)
class Sampler:
    """Options of the sampler, arguments of `sampling.fit`.

    Parameters
    ----------
    method
        importance, smc, metropolis, laplace or map.
    draws
        Posterior draws of each chain.
    tune
        Tuning draws of each chain.
    chains
        Chains.
    thin
        Steps a draw.
    """

    method: str = "importance"
    draws: Annotated[int | None, typer.Option(min=1, max=1_000_000)] = None
    tune: Annotated[int | None, typer.Option(min=0, max=1_000_000)] = None
    chains: Annotated[int | None, typer.Option(min=1, max=1000)] = None
    thin: Annotated[int | None, typer.Option(min=1, max=10_000)] = None
    seed: options.Seed = 1


@command("fit", 3, "pbrl-ppl fit scene.toml train.csv -o cart.nc")
def fit(
    scene: Path,
    history: list[Path],
    to: options.PosteriorOutput,
    reading: options.SceneReading,
    model: Model,
    sampler: Sampler,
    progress: Progress,
    interrupts: terminal.Interrupts,
    resume: Path | None = None,
) -> Result:
    """Fit the declared model to a history: a posterior file, and a table of it.

    Exits with 3 if chains have not converged or draws are too few, and with 130 if it was
    interrupted; the draws of chains so far are kept.

    Parameters
    ----------
    resume : FILE
        Go on with this posterior: its chains, or more draws.
    """
    progress("reading the scene and the history")
    declared, (loaded,) = reading.read(scene, [history])
    declared, effects = options.added_effects(declared, options.own_effects(reading.effect_file))
    progress("loading the sampler")
    import pbrl_ppl as pp
    from pbrl_ppl.physics import check_history
    from pbrl_ppl.posterior import load_posterior, save_posterior

    check_history(declared, loaded, loaded.segments(1))
    earlier = None if resume is None else load_posterior(resume)
    try:
        made = pp.physics_model(
            declared, loaded, effects, likelihood=model.likelihood, horizon=model.horizon,
            nu=model.nu, sigma="scalar" if model.scalar else "per_dimension",
        )  # fmt: skip
    except ValueError as error:  # an option that the model refuses
        raise errors.FitError(f"fit: {error}") from None
    if sampler.method == "metropolis":
        interrupts.keep()  # the draws of chains so far
    progress("looking for the mode, then sampling")
    with terminal.noted_warnings("was interrupted") as caught:
        idata = pp.fit(made, resume=earlier, progress=progress, **vars(sampler))
        save_posterior(idata, to.output)
    return _fitted(idata, to.output, {type(warning) for warning in caught}, interrupts.seen)


def _fitted(idata: Idata, output: Path, warned: set[type], interrupted: bool) -> Result:
    """Return what is printed of a posterior in a file, of which there were warnings."""
    from pbrl_ppl.posterior import PosteriorRecord, group

    record = PosteriorRecord.of(idata)
    undecided = errors.ConvergenceWarning in warned
    rows = _summary(idata)
    contents = {
        "posterior": output,
        "converged": None if record.max_rhat is None else not undecided,
        "max_rhat": record.max_rhat,
        "min_ess": record.min_ess,
        "parameters": rows.to_dict("index"),
        "warnings": list(record.warnings or ()),
    }
    formats = {"parameter": "<"} | dict.fromkeys(map(str, rows.columns), ".4g")
    formats |= {"ess": ".0f", "r_hat": ".3f"} if "r_hat" in formats else {}
    listed = terminal.table(None, formats, rows.itertuples(name=None))
    shown: list[str | Table] = [listed]
    if errors.LinearisationWarning in warned:
        shown += ["intervals: not to be trusted, the likelihood does not hold (warning above)"]
    shown += [f"posterior: {output}"]
    if not interrupted and record.interrupted is None:
        return Result(contents, shown, terminal.UNDECIDED if undecided else 0)
    kept = group(idata, "posterior").sizes
    warning = (
        f"interrupted; {kept['draw']} draws of each of {kept['chain']} chains are kept in"
        f" {output}; --resume {output} goes on"
    )
    return Result(contents, shown, terminal.INTERRUPTED, warning)


def _summary(idata: Idata) -> pd.DataFrame:
    """Return a row for each parameter; for a mode, its value alone."""
    from pbrl_ppl.posterior import PosteriorRecord, scalars
    from pbrl_ppl.reporting import summary

    if PosteriorRecord.of(idata).max_rhat is None:
        return scalars(idata).mean().to_array().to_series().to_frame("mean")
    rows = summary(idata)
    rows.insert(4, "ess", rows[["ess_bulk", "ess_tail"]].min(axis=1))
    return rows.drop(columns=["ess_bulk", "ess_tail"])


@command("update", 9, "pbrl-ppl update cart.nc since.csv -o new.nc")
def update(
    posterior: Path,
    history: list[Path],
    to: options.PosteriorOutput,
    reading: options.PosteriorReading,
    progress: Progress,
    seed: options.Seed = 1,
) -> Result:
    """Bring a posterior up to date with new transitions, without a fit from scratch.

    Exits with 3 if the new posterior has not converged.

    Parameters
    ----------
    posterior : POSTERIOR
        Posterior file (.nc); it has the scene.
    history : HISTORY
        What was recorded since (.csv, ...); several files, or a folder, are one history.
    output
        The new posterior file.
    """
    catalogue = reading.catalogue()
    progress("reading the posterior and the history")
    from pbrl_ppl import posterior as posteriors

    idata = posteriors.load_posterior(posterior)
    scene = posteriors.scene_of(idata)
    new = reading.recording(history, scene, resample=reading.resample)
    progress("updating")
    import pbrl_ppl as pp

    with terminal.noted_warnings() as caught:
        idata = pp.update(idata, new, effects=catalogue, seed=seed, progress=progress)
    record = posteriors.PosteriorRecord.of(idata)
    if record.interrupted is not None:  # half a posterior is no prior for the next update
        raise KeyboardInterrupt
    posteriors.save_posterior(idata, to.output)
    (*_, last) = record.updates or ()
    converged = errors.ConvergenceWarning not in map(type, caught)
    share = last["share"]
    worth = f", the weights worth {share:.0%} of the draws" if share is not None else ""
    return Result(
        {**last, "posterior": to.output, "converged": converged},
        [f"{last['did']}: {last['transitions']} transitions{worth}", f"posterior: {to.output}"],
        0 if converged else terminal.UNDECIDED,
    )


@command("report", 8, "pbrl-ppl report cart.nc")
def report(
    context: typer.Context,
    posterior: Path,
    progress: Progress,
    output: options.OutputFile | None = None,
    overwrite: bool = False,
) -> Result:
    """Diagnose a posterior on one self-contained page: chains, prior, predictions, LOO.

    Parameters
    ----------
    output
        The page; POSTERIOR with .html if not given.
    """
    page = posterior.with_suffix(".html") if output is None else output
    check_file(page, (".html",), overwrite)
    progress("reading the posterior")
    from pbrl_ppl.posterior import load_posterior
    from pbrl_ppl.reporting import Source, render_posterior

    idata = load_posterior(posterior)
    progress("computing and drawing")
    try:
        text = render_posterior(idata, source=Source(command=options.command_line(context)))
    except errors.PosteriorError as error:
        raise errors.PosteriorError(f"{posterior}: {error}") from error
    write_text(page, text)
    return Result({"report": page}, [f"report: {page}"])
