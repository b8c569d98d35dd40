"""Scenes as TOML: documents read with every key checked, and values written."""

import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from typing import Any

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene.actuators import Actuator
from pbrl_ppl.scene.bodies import Body, Wall
from pbrl_ppl.scene.checks import located, nearest
from pbrl_ppl.scene.joints import Joint
from pbrl_ppl.scene.recording import Recording
from pbrl_ppl.scene.shape import Shape
from pbrl_ppl.state import STATE

Table = dict[str, Any]

#: Fields of a scene that are arrays of tables, with the key and the class of each.
PARTS: Mapping[str, tuple[str, type]] = {
    "bodies": ("body", Body),
    "walls": ("wall", Wall),
    "joints": ("joint", Joint),
    "actuators": ("actuator", Actuator),
}
#: Keys that are not the names of the fields that they set.
_RENAMED = {"object_class": "class", "start": "from", "end": "to"}
#: Keys of ``[world]`` that are always written.
_WORLD = ("gravity", "normal_gravity", "time_step", "substeps")
#: Values that are written of a body though they are empty.
_EMPTY: Table = {"known": {}, "prior": {}, "effects": ()}


def read(text: str) -> tuple[Table, bool]:
    """Return the fields of a scene, and whether any of its bodies may be joined.

    Raises
    ------
    SceneError
        If the text is not TOML (says the line), a key is unknown or missing, ``joints`` of
        ``[world]`` is not ``any``, or a part of the scene is impossible.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"not TOML: {error}") from None
    arrays = [key for key, _ in PARTS.values()]
    _checked(document, "the file", ["world"], ["noise", "recording", *arrays])
    optional = ["gravity", "normal_gravity", "substeps", "test_is_later", "joints"]
    world = _checked(document["world"], "[world]", ["time_step"], optional)
    if (joints := world.pop("joints", None)) not in ("any", None):
        raise SceneError(
            f'[world]: joints is {joints!r}, expected "any" (any two bodies, or a body and the'
            " world, may be joined by a rod); declare those that are there as [[joint]]"
        )
    world["noise"] = _checked(document.get("noise", {}), "[noise]", [], STATE)
    if "recording" in document:
        entries = _entries(Recording, document["recording"], "[recording]")
        world["recording"] = Recording(**entries)
    for field, (key, kind) in PARTS.items():
        world[field] = tuple(_part(kind, *place) for place in _tables(document, key))
    return world, joints == "any"


def sections(scene: Mapping[str, Any]) -> Iterator[tuple[str, Table]]:
    """Yield the header and the table of each section of a scene's file, from its fields."""
    world = {key: scene[key] for key in _WORLD}
    yield "[world]", world if scene["test_is_later"] else {**world, "test_is_later": False}
    if scene["noise"]:
        yield "[noise]", dict(scene["noise"])
    if scene["recording"] is not None:
        yield "[recording]", scene["recording"].table()
    for field, (key, kind) in PARTS.items():
        empty = _EMPTY if kind is Body else {}
        for part in scene[field]:
            table = {
                name: empty.get(name) if value in ((), "") else value
                for name, value in vars(part).items()
            }
            for name in filter(table.__contains__, _RENAMED):
                table[_RENAMED[name]] = table.pop(name)
            yield f"[[{key}]]", table


def write(sections: Iterable[tuple[str, Mapping[str, Any]]]) -> str:
    """Return TOML text of tables with these headers; entries that are None are left out."""
    parts = []
    for header, table in sections:
        lines = [f"{key} = {_value(item)}" for key, item in table.items() if item is not None]
        parts.append("\n".join([header, *lines, ""]))
    return "\n".join(parts)


def _part(kind: type, where: str, table: object) -> Any:
    """Return a body, wall, joint or actuator from its table."""
    entries = _entries(kind, table, where)
    if kind is not Body:
        with located(where):
            return kind(**entries)
    shape = _entries(Shape, entries.pop("shape"), f"shape of {where}")
    with located(where):
        return Body(shape=Shape(**shape), **entries)


def _entries(kind: Any, table: object, where: str) -> Table:
    """Return values of a class's fields from a table whose keys are checked."""
    names = {_RENAMED.get(field.name, field.name): field for field in fields(kind)}
    required = [key for key, field in names.items() if field.default is MISSING]
    optional = [key for key in names if key not in required]
    checked = _checked(table, where, required, optional)
    return {names[key].name: value for key, value in checked.items()}


def _checked(table: object, where: str, required: Iterable[str], optional: Iterable[str]) -> Table:
    """Return a table; refuse one with unknown keys or without the required ones."""
    known = [*required, *optional]
    if not isinstance(table, Mapping):
        raise SceneError(f"{where} is {table!r}, expected a table of {', '.join(known)}")
    for key in table:
        if key not in known:
            raise SceneError(f'unknown key "{key}" in {where}{nearest(key, known)}')
    for key in required:
        if key not in table:
            raise SceneError(f'{where} has no "{key}"; add it')
    return dict(table)


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
    if isinstance(item, Shape):
        item = vars(item)
    if isinstance(item, tuple) and item and all(map(_is_entry, item)):
        item = dict(item)
    if isinstance(item, Mapping):
        pairs = [
            f"{_key(key)} = {_value(value)}" for key, value in item.items() if value is not None
        ]
        return "{ " + ", ".join(pairs) + " }" if pairs else "{}"
    if isinstance(item, tuple | list):
        return "[" + ", ".join(_value(part) for part in item) + "]"
    return repr(item)


def _is_entry(item: object) -> bool:
    """Return whether this is an entry of a table: a name and a value."""
    return isinstance(item, tuple) and len(item) == 2 and isinstance(item[0], str)


def _key(name: str) -> str:
    """Return a key, in quotes where it needs them: a body's name may be anything."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _value(name)
