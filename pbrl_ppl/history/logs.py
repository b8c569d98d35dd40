"""Logs of a recording: one file, a folder of them, or several, as one history."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from pbrl_ppl.errors import HistoryError, printable
from pbrl_ppl.history.files import FOLDER, read_table, readers
from pbrl_ppl.history.rows import with_clean_names
from pbrl_ppl.scene import Recording
from pbrl_ppl.system.files import reason

#: A log, a folder of logs, or several.
Paths = str | Path | Sequence[str | Path]


def logs_in(paths: Paths, layout: Recording | None = None) -> list[Path]:
    """Return the logs of a recording, each once, in natural order of names: run2 before run10.

    Parameters
    ----------
    paths : str, Path or sequence of them
        Logs, and folders of logs: files with a suffix that is read, but those that are hidden or
        locks (``~$log.xlsx``), and ROS 2 bags, which are folders with metadata.yaml.
    layout : Recording, optional
        Its files of commands beside the logs of a folder are left out.

    Raises
    ------
    HistoryError
        If there is no such file, or a folder has no log or cannot be read.
    """
    logs: list[Path] = []
    for path in [paths] if isinstance(paths, str | Path) else paths:
        path = Path(path)
        try:
            if not path.exists():
                raise HistoryError(f"history {path}: there is no such file; check the path")
            logs += _logs_of(path, layout) if path.is_dir() and not _is_bag(path) else [path]
        except OSError as error:
            raise HistoryError(f"history {path}: cannot be read: {reason(error)}") from None
    return sorted(dict.fromkeys(logs), key=_natural)


def _logs_of(folder: Path, layout: Recording | None) -> list[Path]:
    """Return the files and bags in a folder that can be read."""
    endings = [suffix for suffix in readers() if suffix != FOLDER]
    seen = [path for path in folder.iterdir() if path.name[0] not in ".~"]
    logs = [path for path in seen if path.suffix.lower() in endings and path.is_file()]
    logs += filter(_is_bag, folder.iterdir())
    if layout is not None and layout.commands:
        beside = {_commands_of(path, layout) for path in logs}
        logs = [path for path in logs if path not in beside]
    if not logs:
        raise HistoryError(
            f"history {folder}: the folder has no log; expected files that end in"
            f" {', '.join(endings)}, or ROS 2 bags (folders with metadata.yaml)"
        )
    return logs


def _is_bag(path: Path) -> bool:
    return (path / "metadata.yaml").exists()


def _natural(path: Path) -> list[str | int]:
    """Return a key that sorts paths with the numbers in them as numbers."""
    parts = re.split(r"(\d+)", str(path).lower())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)]


def in_words(paths: Paths) -> str:
    """Return the name of a recording in messages: of its file, or of the first of several.

    Examples
    --------
    >>> in_words("train.csv"), in_words(["run1.csv", "run2.csv"])
    ('train.csv', 'run1.csv and 1 more')
    """
    first, *more = [paths] if isinstance(paths, str | Path) else paths
    return f"{first} and {len(more)} more" if more else str(first)


def log_name(log: Path) -> str:
    """Return the name of a log: of a file without its suffix."""
    return log.name if log.is_dir() else log.stem


def labels_in(logs: Sequence[Path], labels: Sequence[Sequence[int | str]]) -> list[int | str]:
    """Return a label of each trajectory of several logs, of whose trajectories each has labels.

    Those of one log are kept. Of several a label is the log's name, followed by the trajectory's
    where the log has more than one.

    Examples
    --------
    >>> labels_in([Path("a.csv"), Path("b.csv")], [[7], [0, 1]])
    ['a', 'b.0', 'b.1']
    """
    if len(logs) == 1:
        return list(labels[0])
    names = list(map(log_name, logs))
    names = names if len({*names}) == len(names) else list(map(str, logs))
    return [
        f"{printable(name)}.{label}" if len(its) > 1 else printable(name)
        for name, its in zip(names, labels, strict=True)
        for label in its
    ]


def read_tables(logs: Sequence[Path], layout: Recording) -> list[pd.DataFrame]:
    """Return the table of each log, as it is, with clean names of columns."""
    return [with_clean_names(read_table(log, layout), f"history {log}") for log in logs]


def joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of all tables; trajectories of several are different ones."""
    if len(tables) == 1:
        return tables[0]
    parts = list(tables)
    for i, table in enumerate(tables):
        if "trajectory" in table:
            parts[i] = table.assign(trajectory=f"{i}." + table["trajectory"].astype(str))
    frame: pd.DataFrame = pd.concat(parts, ignore_index=True)
    frame.attrs = tables[0].attrs
    return frame


def read_commands(path: Path, layout: Recording | None) -> pd.DataFrame | None:
    """Return the table of a layout's ``commands``, beside a recording; None without any."""
    if layout is None or not layout.commands:
        return None
    return read_table(_commands_of(path, layout), Recording(columns=layout.columns))


def _commands_of(path: Path, layout: Recording) -> Path:
    return path.parent / layout.commands.replace("{stem}", path.stem)
