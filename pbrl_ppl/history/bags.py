"""Tables from ROS 1 bags, ROS 2 bags and MCAP files.

The library ``rosbags`` reads them, so that no ROS is needed: ``pip install 'pbrl_ppl[ros]'``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.clocks import Say
from pbrl_ppl.history.files import FOLDER, reads
from pbrl_ppl.history.guesses import with_derived
from pbrl_ppl.scene import Recording, nearest
from pbrl_ppl.system.files import reason

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

#: Suffixes of single files; a ROS 2 bag may also be a folder.
SUFFIXES = (".bag", ".db3", ".mcap")


def bag_topics(path: str | Path) -> dict[str, str]:
    """Return the topics of a bag with their message types.

    Parameters
    ----------
    path : str or Path
        As of :func:`read_bag`.

    Raises
    ------
    HistoryError
        If the bag is missing or cannot be read, or ``rosbags`` is not installed.

    Examples
    --------
    ::

        bag_topics("run.mcap")
        {'/odom': 'nav_msgs/msg/Odometry', '/wrench': 'geometry_msgs/msg/WrenchStamped'}
    """
    with _opened(Path(path)) as reader:
        return _types(reader)


def read_bag(path: str | Path, topics: Mapping[str, str | Sequence[str]]) -> pd.DataFrame:
    """Return the messages of a bag's topics as a table, with one row for each time and body.

    The rows are at the stamps of the first body's messages. Other bodies are interpolated to these
    stamps (angles unwrapped), within the time in which every body has messages; their cells are
    empty in gaps of more than three of their usual (median) intervals. If a body has
    several topics, the first has its stamps, and of the others the last message before a row
    counts: a command is held.

    Parameters
    ----------
    path : str or Path
        A ROS 1 bag (.bag), a ROS 2 bag (a folder with metadata.yaml, or .db3) or a file of MCAP.
    topics : mapping of str to str or sequence of str
        The topic, or topics, of each body by the body's name. The name ``""`` is for a scene with
        one body: the table then has no column ``body``.

    Returns
    -------
    DataFrame
        ``time`` (s, from the first row on), from the headers' stamps if all messages of a topic
        have one, else the times at which the bag received them; ``body``; each number of the
        message under its path (``pose.pose.position.x``); and ``yaw`` (rad, unwrapped) of the
        message's first quaternion, as of :func:`with_derived`. A number of a short array is
        ``position[shoulder]`` where the message names its elements, as a JointState does, else
        ``data[0]``. Text, flags, headers, lists of messages and
        arrays of more than eight numbers, such as a covariance, are left out. A column that an
        earlier topic of the body has too is followed by its topic: ``data (/right/command)``. Of
        messages with equal stamps the last is kept.

    Raises
    ------
    HistoryError
        If the bag is missing or cannot be read, a topic is not in it, has no messages or no
        numbers, the bodies have no time in common, or ``rosbags`` is not installed.

    Examples
    --------
    ::

        log = pp.read_bag("run.bag", {"": ["/odom", "/wrench"]})
        columns = {"x": "pose.pose.position.x", "y": "pose.pose.position.y", "theta": "yaw",
                   "force_x": "wrench.force.x", "force_y": "wrench.force.y",
                   "torque": "wrench.torque.z"}
        history = pp.History.from_dataframe(log, scene, columns=columns, resample=True)
    """
    path = Path(path)
    listed = _listed(topics, path)
    tables, said = dict[str, pd.DataFrame](), list[str]()
    with _opened(path) as reader:
        there = _types(reader)
        for topic in dict.fromkeys(name for names in listed.values() for name in names):
            if topic not in there:
                have = ", ".join(f"{name} ({kind})" for name, kind in there.items()) or "none"
                raise HistoryError(
                    f'bag {path}: there is no topic "{topic}"{nearest(topic, there)} Its topics:'
                    f" {have}"
                )
            tables[topic] = _messages(reader, topic, there[topic], path, said.append)
    bodies = {body: _held({name: tables[name] for name in names}, path)
              for body, names in listed.items()}  # fmt: skip
    first, *others = bodies.values()
    begin = max(table.index[0] for table in bodies.values())
    end = min(table.index[-1] for table in bodies.values())
    stamps = first.index[(first.index >= begin) & (first.index <= end)]
    if not len(stamps):
        spans = ", ".join(
            f"{1e-9 * table.index[0]:.3f} to {1e-9 * table.index[-1]:.3f} s ({body})"
            for body, table in bodies.items()
        )
        raise HistoryError(
            f"bag {path}: the bodies' messages have no time in common: {spans}; record them"
            " together, with the stamps of one clock"
        )
    whole = [first.loc[stamps], *(_interpolated(other, stamps) for other in others)]
    time = 1e-9 * (stamps - stamps[0]).to_numpy()
    for body, table in zip(bodies, whole, strict=True):
        table.insert(0, "time", time)
        if body:
            table.insert(1, "body", body)
    joined: pd.DataFrame = pd.concat(whole, ignore_index=True)
    order = np.arange(len(joined)).reshape(len(whole), -1).T.ravel()  # by time, then body
    rows: pd.DataFrame = joined.iloc[order].reset_index(drop=True)
    rows.attrs["said"] = said
    return rows


@reads(*SUFFIXES, FOLDER)
def _read_topics(path: Path, layout: Recording) -> pd.DataFrame:
    """Return the messages of a layout's topics, as :func:`read_bag` does."""
    if layout.topics:
        return read_bag(path, dict(layout.topics))
    there = ", ".join(f"{topic} ({kind})" for topic, kind in bag_topics(path).items())
    raise HistoryError(
        f"history {path}: say which topics are whose (--topic BODY=/odom, or topics in"
        f" [recording]); it has {there}"
    )


def _listed(topics: object, path: Path) -> dict[str, list[str]]:
    """Return each body's topics, of which there is at least one."""
    try:
        by_body = dict(topics).items()  # type: ignore[call-overload]
        listed = {body: [names] if isinstance(names, str) else [*names] for body, names in by_body}
        if not listed or not all(map(bool, listed.values())):
            raise ValueError
        "".join(name for names in listed.values() for name in names)  # texts
    except (TypeError, ValueError):
        raise HistoryError(
            f"bag {path}: topics is {topics!r}, expected a topic for each body, such as"
            ' {"cart": "/odom"}'
        ) from None
    if "" in listed and len(listed) > 1:
        raise HistoryError(
            f'bag {path}: topics names the body "" among {len(listed)}; name each body as the scene'
            " does"
        )
    return listed


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """Open a bag; raise what fails in reading as a `HistoryError`."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise HistoryError(
            f"bag {path}: reading it needs rosbags: pip install 'pbrl_ppl[ros]'"
        ) from None
    if not (path.is_file() or path.is_dir()):
        raise HistoryError(f"bag {path}: there is no such file or folder; check the path")
    if path.is_file() and path.suffix not in SUFFIXES:
        raise HistoryError(
            f"bag {path}: the suffix is {path.suffix!r}, expected {', '.join(SUFFIXES)} or a folder"
            " with metadata.yaml"
        )
    try:
        # bags of ROS 2 before Iron hold no definitions of their messages
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except HistoryError:
        raise
    except Exception as error:  # damaged files raise errors of many kinds
        # those of rosbags say what is wrong
        told = isinstance(error, FileNotFoundError) or type(error).__name__.endswith("ReaderError")
        why = f" ({reason(error)})" if told else ""
        raise HistoryError(
            f"bag {path}: cannot be read{why}; record it to its end,"
            " or repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
        ) from None


def _types(reader: AnyReader) -> dict[str, str]:
    """Return the message type of each topic, in the order of topics."""
    connections = sorted(reader.connections, key=lambda connection: connection.topic)
    return {connection.topic: connection.msgtype for connection in connections}


def _messages(reader: AnyReader, topic: str, kind: str, path: Path, say: Say) -> pd.DataFrame:
    """Return the numbers of a topic's messages by their stamps (ns)."""
    rows: list[dict[str, float]] = []
    received, stamped = [], []
    connections = [candidate for candidate in reader.connections if candidate.topic == topic]
    for connection, time, content in reader.messages(connections=connections):
        message = reader.deserialize(content, connection.msgtype)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        stamped.append(0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec)
        received.append(time)
        rows.append(_numbers_of(message))
    if not rows:
        raise HistoryError(f'bag {path}: topic "{topic}" ({kind}) has no messages; record it')
    table = pd.DataFrame(rows, index=stamped if all(stamped) else received, dtype=float)
    if table.columns.empty:
        raise HistoryError(
            f'bag {path}: messages of topic "{topic}" ({kind}) have no numbers outside lists of'
            " messages; choose a topic of one body, such as its odometry or pose"
        )
    table = table.sort_index(kind="stable")
    table = table[~table.index.duplicated(keep="last")]
    return with_derived(table, say)


def _numbers_of(message: object, path: str = "", longest: int = 8) -> dict[str, float]:
    """Return the numbers of a message, and of arrays of no more than so many, by their paths."""
    names = [field.name for field in fields(message)]  # type: ignore[arg-type]
    values = {name: getattr(message, name) for name in names}
    lists = (values.get(name) for name in ("name", "names", "joint_names"))
    labels = next((keys for keys in lists if isinstance(keys, list) and keys), None)
    row: dict[str, float] = {}
    for name, value in values.items():
        if is_dataclass(value):
            row |= _numbers_of(value, f"{path}{name}.") if name != "header" else {}
        elif isinstance(value, Real) and not isinstance(value, bool):
            row[path + name] = float(value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "iuf":
            keys = range(len(value)) if labels is None else labels
            if len(value) <= longest and len(value) == len(keys):
                columns = [f"{path}{name}[{label}]" for label in keys]
                row |= zip(columns, map(float, value), strict=True)
    return row


def _held(tables: dict[str, pd.DataFrame], path: Path) -> pd.DataFrame:
    """Return the table of the first topic with the last row before of the others."""
    (first, whole), *others = tables.items()
    for topic, table in others:
        whole = whole[whole.index >= table.index[0]]
        if whole.empty:
            raise HistoryError(
                f'bag {path}: "{topic}" begins after the last message of "{first}"; record them'
                " together, with the stamps of one clock"
            )
        last = table.reindex(whole.index, method="ffill")
        there = {name: f"{name} ({topic})" for name in last if name in whole}
        whole = whole.join(last.rename(columns=there))
    return whole


def _interpolated(table: pd.DataFrame, stamps: pd.Index, longest_gap: float = 3.0) -> pd.DataFrame:
    """Return a table's columns at other stamps (ns), within its own."""
    zero = table.index[0]  # doubles hold nanoseconds since 1970 to 0.2 microseconds alone
    have, want = ((index - zero).to_numpy().astype(float) for index in (table.index, stamps))
    gaps = np.append(np.diff(have), 0.0)
    last = np.searchsorted(have, want, side="right") - 1
    usual = float(np.median(gaps[:-1])) if len(have) > 1 else 0.0
    empty = (gaps[last] > longest_gap * usual) & (have[last] < want)
    columns = {name: np.where(empty, np.nan, np.interp(want, have, table[name])) for name in table}
    return pd.DataFrame(columns, index=stamps)
