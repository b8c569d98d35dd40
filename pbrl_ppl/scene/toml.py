"""Scenes as TOML: documents read with every key checked, and values written."""

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.checks import nearest
from pbrl_ppl.scene.recording import Recording
from pbrl_ppl.state import STATE

Table = dict[str, Any]

#: Required and optional keys of each table.
KEYS: dict[str, tuple[str, str]] = {
    "the file": ("world", "noise recording body wall joint actuator"),
    "[world]": ("time_step", "gravity normal_gravity substeps test_is_later joints"),
    "[noise]": ("", " ".join(STATE)),
    "[recording]": ("", " ".join(field.name for field in fields(Recording))),
    "body": (
        "name shape",
        "wheel static kinematic known prior effects pose class attributes typical",
    ),
    "shape": ("kind", "size radius vertices"),
    "wall": ("from to", ""),
    "joint": ("kind", "bodies anchor_a anchor_b axis known name prior"),
    "actuator": ("name kind body", "column at of frame known prior"),
}


def read(text: str) -> tuple[Table, dict[str, list[tuple[str, Table]]]]:
    """Return ``[world]`` with noise and recording, and the tables of each array with their places.

    Raises
    ------
    SceneError
        If the text is not TOML (says the line), or a key is unknown or missing, or ``joints`` of
        ``[world]`` is not ``any``.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"not TOML: {error}") from None
    _check_keys(document, "the file")
    _check_keys(document["world"], "[world]")
    if (joints := document["world"].get("joints", "any")) != "any":
        raise SceneError(
            f'[world]: joints is {joints!r}, expected "any" (any two bodies, or a body and the'
            " world, may be joined by a rod); declare those that are there as [[joint]]"
        )
    noise = document.get("noise", {})
    _check_keys(noise, "[noise]")
    recording = document.get("recording")
    if recording is not None:
        _check_keys(recording, "[recording]")
    arrays: dict[str, list[tuple[str, Table]]] = {}
    for key in ("body", "wall", "joint", "actuator"):
        arrays[key] = list(_tables(document, key))
        for where, table in arrays[key]:
            _check_keys(table, where, key)
            if key == "body":
                _check_keys(table["shape"], f"shape of {where}", "shape")
    return {**document["world"], "noise": noise, "recording": recording}, arrays


def write(sections: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Return TOML text of tables with these headers; entries that are None are left out."""
    parts = []
    for header, table in sections:
        lines = [f"{key} = {_value(item)}" for key, item in table.items() if item is not None]
        parts.append("\n".join([header, *lines, ""]))
    return "\n".join(parts)


def _check_keys(table: object, where: str, kind: str = "") -> None:
    """Refuse a table with unknown keys or without the required ones of its kind."""
    required, optional = (keys.split() for keys in KEYS[kind or where])
    known = required + optional
    if not isinstance(table, Mapping):
        raise SceneError(f"{where} is {table!r}, expected a table of {', '.join(known)}")
    for key in table:
        if key not in known:
            raise SceneError(f'unknown key "{key}" in {where}{nearest(key, known)}')
    for key in required:
        if key not in table:
            raise SceneError(f'{where} has no "{key}"; add it')


def _tables(document: Table, key: str) -> Iterator[tuple[str, Table]]:
    """Yield the place and the table, for each of an array of tables."""
    array = document.get(key, [])
    if not isinstance(array, list):
        raise SceneError(f"{key} is not an array of tables; write [[{key}]], with two brackets")
    for number, table in enumerate(array, start=1):
        where = f"[[{key}]] number {number}"
        if isinstance(table, Mapping) and isinstance(table.get("name"), str):
            where += f' ("{table["name"]}")'
        yield where, table


def _value(item: Any) -> str:
    """Return one TOML value: a string, boolean, number, list or inline table."""
    if isinstance(item, bool):
        return "true" if item else "false"
    if isinstance(item, str):
        # TOML's basic strings take JSON's escapes, except that DEL must be escaped in TOML.
        return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(item, Mapping):
        pairs = [
            f"{_key(key)} = {_value(value)}" for key, value in item.items() if value is not None
        ]
        return "{ " + ", ".join(pairs) + " }" if pairs else "{}"
    if isinstance(item, tuple | list):
        return "[" + ", ".join(_value(part) for part in item) + "]"
    return repr(item)


def _key(name: str) -> str:
    """Return a key, in quotes where it needs them: a body's name may be anything."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _value(name)
