"""``pbrl-ppl check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from pbrl_ppl.cli.terminal import SceneFile, Velocities, interruptible, load_files

if TYPE_CHECKING:
    from pbrl_ppl.history import History
    from pbrl_ppl.scene import Scene


def check(
    scene: SceneFile,
    history: Annotated[
        Path, typer.Argument(metavar="HISTORY", help="Measured history (.csv, .parquet, .nc).")
    ],
    estimate_velocities: Velocities = False,
    prior: Annotated[
        bool, typer.Option(help="Whether to compare the data with draws from the prior.")
    ] = True,
) -> None:
    """Read a scene and a history: what is in them, what is missing, whether the prior fits."""
    with interruptible():
        declared, loaded = load_files(scene, history, estimate_velocities)
        import numpy as np

        from pbrl_ppl.history import derived_velocities
        from pbrl_ppl.physics import check_history
        from pbrl_ppl.state import STATE

        check_history(declared, loaded, loaded.segments(1))
        console = Console(highlight=False)
        console.print(_contents(declared, loaded))
        console.print(_cells(loaded))
        derived = derived_velocities(loaded)
        if derived.any():
            names = [STATE[d] for d in np.flatnonzero(derived.any(axis=0))]
            console.print(f"{', '.join(names)}: computed from positions, no measurements")
        if prior:
            from pbrl_ppl.criticism import prior_predictive_check, telling_horizon
            from pbrl_ppl.model import physics_model

            model = physics_model(declared, loaded, horizon=telling_horizon(loaded))
            checked = prior_predictive_check(model, draws=100)
            for sentence in checked.summary:
                console.print(f"prior: {sentence}", soft_wrap=True)


def _contents(scene: Scene, history: History) -> Table:
    rows = history.dataset["n_rows"].to_numpy()
    intervals = (
        f"{rows.min() - 1}" if rows.min() == rows.max() else f"{rows.min() - 1} to {rows.max() - 1}"
    )
    table = Table(show_header=False, box=None)
    for name, value in (
        ("moving bodies", ", ".join(body.name for body in scene.moving)),
        ("walls, joints", f"{len(scene.walls)}, {len(scene.joints)}"),
        ("trajectories", f"{history.n_trajectories}"),
        ("transitions", f"{history.n_transitions} ({intervals} in a trajectory)"),
        ("time step", f"{scene.time_step:g} s, {scene.substeps} engine steps"),
    ):
        table.add_row(name, value)
    return table


def _cells(history: History) -> Table:
    """Share of missing cells, by body and state dimension."""
    dataset = history.dataset
    # rows after a trajectory's end are padding, not missing measurements
    real = dataset["time"] < dataset["n_rows"]
    missing = dataset["observed"].isnull() & real
    table = Table(title="missing measurements", title_justify="left")
    table.add_column("body")
    for name in dataset["state"].to_numpy():
        table.add_column(str(name), justify="right")
    total = int(real.sum())
    for body in history.bodies:
        counts = missing.sel(body=body).sum(("trajectory", "time")).to_numpy()
        cells = ("none" if n == 0 else "all" if n == total else f"{n} of {total}" for n in counts)
        table.add_row(body, *cells)
    return table
