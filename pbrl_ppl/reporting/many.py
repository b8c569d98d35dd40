"""Close the loop on many logs, over any executor, and write a page of all."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pandas as pd

from pbrl_ppl.criticism import ADEQUATE, EFFECTS_ADDED
from pbrl_ppl.effects import Effect
from pbrl_ppl.errors import OutputError, PbrlError
from pbrl_ppl.files import check_folder, write_text
from pbrl_ppl.history import MOST_TRANSITIONS
from pbrl_ppl.posterior import load_posterior
from pbrl_ppl.reporting import many_page
from pbrl_ppl.reporting.logs import (
    DONE,
    FAILED,
    Log,
    Row,
    Run,
    Settings,
    close_log,
    failed,
    inputs_sha256,
    read_manifest,
    row_of,
    settle,
)
from pbrl_ppl.reporting.page import Source
from pbrl_ppl.sampling import Pooled, pool
from pbrl_ppl.threads import as_ended

#: Marks the summary of many logs, and with it their folder.
_KIND = "pbrl_ppl logs 1"
#: Pause between two writings of the page, as a multiple of what one takes.
_PAUSE = 10.0


@dataclass(frozen=True, eq=False)
class ManyLoops:
    """Results of closing the loop on many logs.

    Parameters
    ----------
    folder : Path
        Has ``index.html``, ``summary.csv``, ``effects.csv``, ``summary.json``, and each log's
        folder.
    rows : tuple of dict
        One a log, in the manifest's order: its status (``done``, ``failed``, ``waiting``), verdict
        and effects, or what went wrong.
    pooled : mapping of str to Pooled
        By kind, hyper-parameters that its robots share, and each robot's parameters given these.
    not_pooled : mapping of str to str
        Why a kind's robots were not pooled.
    """

    folder: Path
    rows: tuple[Row, ...]
    pooled: Mapping[str, Pooled]
    not_pooled: Mapping[str, str]

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the logs that failed."""
        return tuple(row["name"] for row in self.rows if row["status"] == "failed")

    def table(self) -> pd.DataFrame:
        """Return one row a log: status, verdict, effects, errors, message, folder."""
        return many_page.summary_table(self.rows)

    def effects(self) -> pd.DataFrame:
        """Return one row an effect and log that it was found in, with its estimate."""
        return many_page.effect_table(self.rows)

    def __repr__(self) -> str:
        return f"ManyLoops({many_page.in_words(self.rows)})"


def close_loop_many(
    manifest: str | Path | Iterable[Log],
    folder: str | Path,
    *,
    executor: Executor | None = None,
    seed: int = 0,
    substeps: int | None = None,
    draws: int | None = None,
    method: str = "importance",
    most_transitions: int = MOST_TRANSITIONS,
    catalogue: Iterable[Effect] | None = None,
    noise: Mapping[str, float] | None = None,
    estimate_velocities: bool = False,
    columns: Mapping[str, str | float] | None = None,
    units: Mapping[str, str] | None = None,
    time_step: float | None = None,
    trim: bool = False,
    again: bool = False,
    run: Run = close_log,
    progress: Callable[[str], None] | None = None,
    source: Source | None = None,
) -> ManyLoops:
    """Close the loop on each log of a manifest, and write a page of which effects are where.

    Each log gets a folder with what :meth:`Loop.save` writes. A log whose folder has a
    report of the same files and settings is not run again, so the same call goes on after an
    interrupt; one that fails leaves ``error.json`` there, does not stop the rest, and is tried
    again by the next call.

    Parameters
    ----------
    manifest : str, Path or iterable of Log
        As of :func:`read_manifest`.
    folder : str or Path
        Of all results; made if missing.
    executor : concurrent.futures.Executor, optional
        Where the loops are closed; by default here, one after another. ``client.get_executor()`` of
        Dask is one, whose workers must see the files by the same paths. A process works on one log
        at a time.
    seed, substeps, draws, method, most_transitions, catalogue : optional
        As of :func:`pbrl_ppl.close_loop`; each log is what that gives with this seed.
    noise : mapping of str to float, optional
        Known errors of measuring, ``{"x": 0.002}``; they replace those of the scenes.
    estimate_velocities, columns, units, trim : optional
        As of :meth:`History.load`, and of the scene's ``[recording]``.
    time_step : float, optional
        In place of the scenes' (s); uneven samples are interpolated to it.
    again : bool
        Whether finished logs are run again too.
    run : callable
        What closes the loop on a log, if not the package.
    progress : callable, optional
        Told of each log that is finished.
    source : Source, optional
        The command that makes the page again.

    Returns
    -------
    ManyLoops
        Rows, and for each kind of the manifest the robots' shared hyper-parameters. Logs without
        an adequate model at the end (``unexplained``, ``not-converged``) take no part in those.

    Raises
    ------
    ManifestError
        If the manifest cannot be used.
    OutputError
        If the folder cannot be written, or has files of another kind.

    Examples
    --------
    ::

        with distributed.Client("tcp://scheduler:8786") as client:
            loops = pp.close_loop_many("logs.csv", "out", executor=client.get_executor())
        loops.effects()
        loops.pooled["cart"].scene  # the next cart's, with what is known of carts
    """
    if source is None:
        where = repr(str(manifest)) if isinstance(manifest, str | Path) else "logs"
        source = Source(command=f"pp.close_loop_many({where}, {str(folder)!r}, seed={seed}, ...)")
    logs = read_manifest(manifest) if isinstance(manifest, str | Path) else tuple(manifest)
    folder = _opened(Path(folder))
    settings = Settings(
        {"noise": dict(noise or {}), "substeps": substeps, "time_step": time_step},
        {"estimate_velocities": estimate_velocities, "columns": dict(columns or {}),
         "units": dict(units or {}), "trim": trim},
        {"seed": seed, "draws": draws, "method": method, "most_transitions": most_transitions}
        | ({} if catalogue is None else {"catalogue": tuple(catalogue)}),
    )  # fmt: skip
    tell = progress or (lambda _: None)
    inputs = {log.name: inputs_sha256(log, settings) for log in logs}
    rows: dict[str, Row] = {
        log.name: {"name": log.name, "kind": log.kind, "status": "waiting"} for log in logs
    }
    for log in logs:
        if again:
            (folder / log.name / DONE).unlink(missing_ok=True)
        elif row := row_of(log, folder, inputs[log.name]):
            rows[log.name] = row
            (folder / log.name / FAILED).unlink(missing_ok=True)
    left = [log for log in logs if rows[log.name]["status"] == "waiting"]
    finished = len(logs) - len(left)
    if finished:
        tell(f"{finished} of {len(logs)} logs are in {folder}")
    tasks = {log: partial(settle, log, folder, settings, inputs[log.name], run) for log in left}
    written = loops = _written(ManyLoops(folder, tuple(rows.values()), {}, {}), source)
    due = time.monotonic()
    try:
        with closing(as_ended(tasks, executor)) as results:
            for count, (log, result) in enumerate(results, finished + 1):
                try:
                    rows[log.name] = result()
                except Exception as error:  # its worker died, or it could not be sent there
                    rows[log.name] = failed(log, folder, error)
                loops = replace(loops, rows=tuple(rows.values()))
                tell(f"{count}/{len(logs)} {_row_in_words(rows[log.name])}")
                begin = time.monotonic()
                if begin >= due:  # of a thousand logs the page takes longer than a log
                    written = _written(loops, source)
                    due = time.monotonic() + _PAUSE * (time.monotonic() - begin)
    except KeyboardInterrupt:
        if loops is not written:
            _written(loops, source)
        raise
    pooled, not_pooled = _pooled(logs, rows, folder)
    return _written(replace(loops, pooled=pooled, not_pooled=not_pooled), source)


def _row_in_words(row: Row) -> str:
    if row["status"] == "failed":
        return f"{row['name']}: failed: {row['message']}"
    names = ", ".join(map(many_page.effect_label, row["effects"]))
    return f"{row['name']}: {row['verdict']}{f' ({names})' if names else ''}, {row['seconds']:g} s"


def _opened(folder: Path) -> Path:
    """Make the folder of many logs, or check that it is one."""
    check_folder(folder, overwrite=True)
    summary = folder / "summary.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        ours = not any(folder.iterdir())
        if summary.is_file():
            ours = json.loads(summary.read_text("utf-8"))["contents"] == _KIND
    except (ValueError, KeyError, TypeError):
        ours = False
    except OSError as error:
        raise OutputError(
            f"output folder {folder}: it cannot be made or written ({error.strerror}); choose"
            " another path"
        ) from error
    if not ours:
        raise OutputError(
            f"output folder {folder}: it has files that are not of many logs; choose another"
        )
    return folder.absolute()


def _pooled(
    logs: Iterable[Log], rows: Mapping[str, Row], folder: Path
) -> tuple[dict[str, Pooled], dict[str, str]]:
    """Return the hyper-parameters of each kind with at least two adequate models."""
    kinds: dict[str, list[str]] = {log.kind: [] for log in logs if log.kind}
    for log in logs:
        if log.kind and rows[log.name].get("verdict") in (ADEQUATE, EFFECTS_ADDED):
            kinds[log.kind].append(log.name)
    pooled, reasons = {}, {}
    for kind, names in kinds.items():
        if len(names) < 2:
            reasons[kind] = f"{len(names)} adequate model(s), expected at least 2"
            continue
        posteriors = {name: folder / name / "after.nc" for name in names}
        try:
            pooled[kind] = pool({name: load_posterior(file) for name, file in posteriors.items()})
        except PbrlError as error:
            reasons[kind] = str(error)
    return pooled, reasons


def _written(loops: ManyLoops, source: Source) -> ManyLoops:
    """Write the files of all logs together, each whole or not at all, and return the results."""
    contents = {
        "contents": _KIND,
        "logs": loops.rows,
        "pooled": {kind: population.to_dict() for kind, population in loops.pooled.items()},
        "not_pooled": loops.not_pooled,
    }
    tables = {"summary.csv": loops.table(), "effects.csv": loops.effects()}
    texts = {
        "summary.json": json.dumps(contents, indent=1, default=dict) + "\n",
        "index.html": many_page.page(loops.rows, loops.pooled, loops.not_pooled, source),
    }
    for kind, population in loops.pooled.items():
        texts[f"kind-{kind}.toml"] = population.scene.to_toml()
        tables[f"kind-{kind}.csv"] = population.robots()
    for name, table in tables.items():
        texts[name] = table.to_csv(index=False, lineterminator="\n")
    for name, text in texts.items():
        write_text(loops.folder / name, text)
    return loops
