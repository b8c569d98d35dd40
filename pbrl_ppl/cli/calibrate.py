"""``pbrl-ppl calibrate``."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pbrl_ppl.cli import options
from pbrl_ppl.cli.options import command
from pbrl_ppl.cli.terminal import FAILED, Result, check_can_make
from pbrl_ppl.errors import FitError, PbrlError

if TYPE_CHECKING:
    from pbrl_ppl.sampling import Calibration


@command(
    "calibrate", 12, "pbrl-ppl calibrate scene.toml train.csv -o ranks/ --jobs 4",
    kept="finished replications are in {output}; the same command goes on",
)  # fmt: skip
def calibrate(
    scene: Path,
    history: Path,
    output: options.OutputFolder,
    reading: options.SceneReading,
    quiet: bool,
    likelihood: str = "transitions",
    colour: Annotated[float, typer.Option(min=0.0)] = 0.0,
    replications: Annotated[int, typer.Option(min=2)] = 200,
    seed: options.Seed = 1,
    jobs: options.Count = 1,
    draws: Annotated[int, typer.Option(min=100)] = 1500,
) -> Result:
    """Simulate from the prior, fit, and test whether the true values' ranks are uniform.

    Parameters
    ----------
    history : HISTORY
        History whose design is kept (.csv, ...).
    output
        Folder for results; goes on there.
    likelihood : NAME
        transitions (single ones from exact states, the paper's Eq. 11), trajectories (whole ones
        with process noise, as of close-loop; it takes several times as long) or simulation
        (trajectories without process noise, as of criticise --simulate).
    colour
        Correlation of neighbouring rows' errors, with --likelihood simulation.
    replications
        Simulated histories.
    jobs
        Processes.
    draws
        Posterior draws of each chain.
    """
    check_can_make(output)
    declared, (design,) = reading.read(scene, [history])
    declared, effects = reading.with_effects(declared)
    import pbrl_ppl.reporting as report
    from pbrl_ppl.files import write_atomically
    from pbrl_ppl.sampling import calibration

    # fresh processes: PyMC's threads do not survive a fork
    with ProcessPoolExecutor(jobs, get_context("spawn")) if jobs > 1 else nullcontext() as pool:
        try:
            result = calibration.calibrate(
                declared, design, effects=effects, likelihood=likelihood, colour=colour,
                seed=seed, draws=draws, replications=replications, folder=output,
                executor=pool, progress=not quiet,
            )  # fmt: skip
        except PbrlError:
            raise
        except ValueError as error:  # an option that calibrate refuses
            raise FitError(f"calibrate: {error}") from None
    result.save(output / "ranks.nc")
    write_atomically(output / "table.csv", result.table().to_csv)
    picture = report.png(report.plot_calibration(result))
    write_atomically(output / "ranks.png", lambda to: to.write_bytes(picture))
    table, page = result.table().to_dict("index"), output / "ranks.png"
    contents = {"passed": result.passed, "parameters": table, "picture": page}
    verdict = f"{'passed' if result.passed else 'failed'}: {page}"
    return Result(contents, [_calibrated(result), verdict], 0 if result.passed else FAILED)


def _calibrated(calibration: Calibration) -> str:
    """Return the columns of the table that matter, and what they should be."""
    rows, data = calibration.table(), calibration.dataset
    head = rows.iloc[0]
    columns = ["p_holm", "coverage_50", "coverage_90", "ess", "r_hat", "passed"]
    short = int((data["size"] < data["size"].max()).any("parameter").sum())
    apart = ", ".join(rows.index[~rows["judged"]])
    ranges = (f"{head[f'low_{level}']:.3g} to {head[f'high_{level}']:.3g}" for level in (50, 90))
    return (
        rows[columns].to_string(float_format="{:.4g}".format, index_names=False)
        + f"\n{data.sizes['replication']} replications, {short} with too few effective draws;"
        " expected of a right sampler: p_holm at least 0.01, coverages in "
        + ", ".join(ranges)
        + (f"\nnot judged, for errors are coloured: {apart}" if apart else "")
    )
