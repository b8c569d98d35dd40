"""Files that are damaged, foreign or hostile: one clear error each, or a result that they allow.

A try takes a valid file of some kind, mutates it, and runs a command that reads it, within 60 s and
2 GB. A fault is a traceback, an internal message, no message or several, an end by the limits, or
a posterior file that is read with other contents than it was written with.
``python -m reliability.mutated``, in ``analysis/``, goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import shutil
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
from PIL import Image

from pbrl_ppl import PbrlError, cli, load_posterior
from pbrl_ppl.posterior.store import groups

if str(Path(__file__).parents[2]) not in sys.path:  # helpers are shared with the tests
    sys.path.insert(0, str(Path(__file__).parents[2]))

from reliability.commands import Ran, run, warm
from reliability.killed import prepare, without_pictures

ROOT = Path(__file__).parents[2]
SECONDS, MEGABYTES = 60.0, 2048.0
CHECK = "check scene.toml {} --no-prior"
#: Kinds of files: the valid one, its share of the tries, and the commands that read it.
KINDS: Mapping[str, tuple[str, int, tuple[str, ...]]] = {
    "posterior": ("posterior.nc", 25, (
        "simulate {} test.csv -o new.csv", "report {} -o new.html", "update {} test.csv -o new.nc",
        "plan {} --start 0,0,0 --goal 1,0,- --nodes 50 -o new.csv",
        "suggest {} --effect linear_drag --effect quadratic_drag --steps 4 --draws 2 -o new.csv",
        "fit scene.toml test.csv --method map --resume {} -o new.nc",
    )),
    "netcdf": ("log.nc", 10, (CHECK,)),
    "csv": ("train.csv", 13, (CHECK, "new made.toml --history {} --body puck=circle:0.2")),
    "parquet": ("log.parquet", 10, (CHECK,)),
    "scene": ("scene.toml", 14, ("check {} test.csv --no-prior", "rehearse {} --set mass=x")),
    "goal": ("goal.toml", 4, ("plan posterior.nc --start 0,0,0 --goal {} --nodes 50 -o new.csv",)),
    "actions": ("actions.toml", 4, (
        "plan posterior.nc --start 0,0,0 --goal 1,0,- --actions {} --nodes 50 -o new.csv",
    )),
    "json": ("log.json", 5, (CHECK,)),
    "mat": ("log.mat", 3, (f"{CHECK} --columns time=time",)),
    "bag1": ("log.bag", 4, ("check bag.toml {} --no-prior",)),
    "db3": ("log.db3", 4, ("check bag.toml {} --no-prior",)),
    "mcap": ("log.mcap", 4, ("check bag.toml {} --no-prior",)),
    "mjcf": ("model.xml", 4, ("mjcf {}",)),
    "urdf": ("model.urdf", 4, ("mjcf {}",)),
}  # fmt: skip
MJCF = """<mujoco><worldbody><body name="puck" pos="0 0 0"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>
<geom name="disc" type="cylinder" size="0.2 0.05" mass="2"/></body></worldbody></mujoco>"""
URDF = """<robot name="arm"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0"/>
<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision>
<geometry><box size="0.1 0.1 0.5"/></geometry></collision></link><joint name="hinge"
type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/></joint></robot>"""
LAUGHS = '<!DOCTYPE m [<!ENTITY a0 "ha">' + "".join(
    f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(12)
)


def library(argv: list[str]) -> int:
    """Read a MuJoCo model in place of a command."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from mujoco_bridge import scene_from_mjcf

    try:
        scene_from_mjcf(argv[1])
    except PbrlError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def inputs(base: Path) -> None:
    """Write a valid file of each kind."""
    from scipy.io import savemat

    from pbrl_ppl import History, Scene
    from tests.helpers.bags import Bag

    prepare(base)
    scene, table = Scene.load(base / "scene.toml"), pd.read_csv(base / "train.csv")
    for name in ("log.nc", "log.parquet"):
        History.load(base / "train.csv", scene).save(base / name)
    (base / "goal.toml").write_text("[[target]]\nbody = 'puck'\nx = 1.0\ny = 0.0\n")
    (base / "actions.toml").write_text(
        "durations = [0.1, 0.2]\n[[action]]\nbody = 'puck'\nforce = [5.0, 0.0]\n"
    )
    (base / "model.xml").write_text(MJCF)
    (base / "model.urdf").write_text(URDF)
    rows = [[0.1 * i, 0.0, 0.01 * i, 0.1] for i in range(20)]
    (base / "log.json").write_text(json.dumps({"units": "Meters", "slow-forward": rows}))
    one = table[table["trajectory"] == 0]
    numbers = {name: one[name].to_numpy() for name in one if name not in ("body", "trajectory")}
    savemat(base / "log.mat", numbers)
    layout = "topics = { puck = ['/odom', '/wrench'] }\ncolumns = { x = 'pose.pose.position.x',"
    layout += " y = 'pose.pose.position.y', theta = 'yaw', force_x = 'wrench.force.x',"
    layout += " force_y = 'wrench.force.y', torque = 'wrench.torque.z' }\n"
    toml = (base / "scene.toml").read_text()
    (base / "bag.toml").write_text(f"{toml}\n[recording]\n{layout}")
    for form, suffix in (("ros1", "bag"), ("db3", "db3"), ("mcap", "mcap")):
        bag = Bag(form)
        for row in one.itertuples():
            bag.add(row.time, "/odom", bag.odometry(row.time, row.x, row.y, row.theta))
            wrench = (row.force_x, row.force_y, row.torque)
            bag.add(row.time, "/wrench", bag.wrench_stamped(row.time, *wrench))
        written = bag.write(base, "made")
        files = [written] if written.is_file() else [*written.glob(f"*.{suffix}")]
        shutil.move(files[0], base / f"log.{suffix}")
        shutil.rmtree(base / "made", ignore_errors=True)


def damaged(content: bytes, draw: random.Random) -> bytes:
    """Return bytes truncated, turned, inserted, deleted, swapped, repeated or zeroed."""
    size = len(content)
    a, b = sorted(draw.randrange(size + 1) for _ in range(2))
    c = min(size, a + draw.choice((1, 8, 100, 4096)))
    noise = draw.randbytes(draw.choice((1, 8, 1000)))
    turned = bytearray(content)
    for _ in range(draw.choice((1, 3, 30))):
        turned[draw.randrange(size)] ^= 1 << draw.randrange(8)
    return draw.choice(
        (content[:a], bytes(turned), content[:a] + noise + content[a:], content[:a] + content[c:],
         content[b:] + content[a:b] + content[:a], content[:b] + content[a:],
         content[:a] + bytes(c - a) + content[c:], content[:a] + content[c:] + content[a:c])
    )  # fmt: skip


def foreign(content: bytes, draw: random.Random, base: Path) -> bytes:
    """Return the bytes of a file of another kind."""
    picture, packed = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (8, 8)).save(picture, "PNG")
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("a.csv", "1,2")
    others = [base / name for name, *_ in KINDS.values()]
    return draw.choice(
        (b"", b"\0" * 5000, b"\xff\xfe" + b"a" * 99, b"<html></html>", picture.getvalue(),
         b"\n" * 99, packed.getvalue(), draw.choice(others).read_bytes(), draw.randbytes(3000),
         b"PAR1PAR1")
    )  # fmt: skip


def special(path: Path, draw: random.Random) -> None:
    """Put something in a file's place that is no ordinary file."""
    path.unlink()
    draw.choice(
        (path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero"),
         lambda: path.symlink_to("/dev/null"), lambda: path.symlink_to(path.name),
         lambda: path.symlink_to("missing"), lambda: path.symlink_to("/proc/self/mem"),
         lambda: path.symlink_to("/"), lambda: None)
    )()  # fmt: skip


def hostile_toml(text: str, draw: random.Random) -> str:
    """Return TOML with values that are large, deep, twice there, no numbers or odd."""
    value = draw.choice(
        ("1e400", "-1e308", "1e-320", "nan", "inf", "9" * 400, "9" * 6000, "[" * 400 + "]" * 400,
         "{a=" * 9000 + "1" + "}" * 9000, "[" * 99999, '"' + "x" * 10**6 + '"', '"\\u202e\\u0000"',
         "1979-05-27", "true", "''", "[]", "{}", "0x" + "f" * 999, '"🙂" ', "-0.0", "[[1, 2]]",
         "[1, 2, 3, 4]", "[nan, 1]", "-1", "0", "1_000", "{ kind = 'box', size = [1, 1] }")
    )  # fmt: skip
    lines = text.splitlines()
    places = [i for i, line in enumerate(lines) if "=" in line]
    at = draw.choice(places)
    key = lines[at].partition("=")[0]
    way = draw.randrange(5)
    if way == 0:
        lines.insert(at, lines[at])
    elif way == 1:
        lines.insert(at, f"{'k' * 9} = {value}")
    elif way == 2:
        lines += lines * draw.choice((1, 300))
    else:
        lines[at] = f"{key}= {value}"
    return "\n".join(lines) + "\n"


def hostile_csv(text: str, draw: random.Random) -> str:
    """Return a table with many columns, long fields, odd characters or enormous numbers."""
    head, *rows = text.splitlines()
    cell = draw.choice(
        ("1e400", "nan", "inf", "9" * 5000, "x" * 200000, "\0", "\x1b[2J", "\u202e", '"', "'",
         "=1+1", "1,2", "1;2", "", " ", "−1", "٣", "1e", "0x10", "True", "1979-05-27", "🙂", "\r",
         "\f")
    )  # fmt: skip
    at = draw.randrange(len(rows))
    cells = rows[at].split(",")
    place = draw.randrange(len(cells))
    rows[at] = ",".join([*cells[:place], cell, *cells[place + 1 :]])
    way = draw.randrange(6)
    if way == 0:
        many = draw.choice((10**4, 10**6))
        return "\n".join(",".join([line, *["1"] * many]) for line in (head, *rows[:2])) + "\n"
    if way == 1:
        head = head.replace(draw.choice(head.split(",")), cell, 1)
    if way == 2:
        head = ",".join(draw.sample(head.split(","), head.count(",") + 1))
    if way == 3:
        return '"' + "\n".join([head, *rows]) * 3
    return "\n".join([head, *rows]) + "\n"


def hostile_hdf5(path: Path, draw: random.Random) -> None:
    """Give an HDF5 file huge or empty arrays, other types, or attributes of other kinds."""
    with h5py.File(path, "a") as file:
        places: list[str] = []
        file.visititems(lambda name, item: places.append(name) if hasattr(item, "shape") else None)
        name = draw.choice(places)
        kept, way = dict(file[name].attrs), draw.randrange(8)
        big = (10**5, 10**5) if draw.random() < 0.5 else (2 * 10**9,)
        if way == 0:  # declared and never written
            del file[name]
            file.create_dataset(name, big, "f8", chunks=True)
        elif way == 1:  # a bomb: it was written, and packs well
            del file[name]
            made = file.create_dataset(
                name, (4 * 10**8,), "f8", chunks=(10**7,), compression="gzip"
            )
            made[: 10**7] = 0.0
        elif way == 2:
            del file[name]
            file[name] = np.array([b"text"] * 3)
        elif way == 3:
            del file[name]
        elif way == 4:
            value = file[name][()]
            del file[name]
            file[name] = np.full(np.shape(value), np.nan)
        elif way == 5:
            del file[name]
            file[name] = h5py.SoftLink("/" + name)
        elif way == 6:
            del file[name]
            file[name] = h5py.ExternalLink("/etc/passwd", "/")
        if way < 5 and name in file:
            for key, item in kept.items():
                if draw.random() < 0.7 and not isinstance(item, np.ndarray):
                    file[name].attrs[key] = item
        if way == 7 and len(file.attrs):
            key = draw.choice(sorted(file.attrs))
            file.attrs[key] = draw.choice(
                ("", "{", "[" * 9999, 7, "nan", "[world]\ntime_step = 1e99", b"\xff", "null", "{}")
            )


def hostile_json(draw: random.Random) -> str:
    """Return JSON that is deep, or large, or no log."""
    return draw.choice(
        (
            "[" * 10**6,
            '{"a":' * 10**5,
            '{"a": [[1e999, 1, 2, 3]]}',
            '{"\\ud800": [[0,0,0,0],[1,1,1,1]]}',
            '{"a\\u001b[2J": [[0,0,0,0],[1,1,1,1]]}',
            "null",
            "[1]",
            '{"a": [[1,2],[3]]}',
            "9" * 9999,
            '{"a": [["x",1,2,3]]}',
            '{"units": 5, "a": [[0,0,0,0],[0.1,0,0,0]]}',
            "NaN",
            '{"a": [' + "[0,0,0,0]," * 10**5 + "[1,1,1,1]]}",
            '{"a": [[[[1]]]]}',
            '"' + "x" * 10**7 + '"',
        )
    )


def hostile_parquet(path: Path, draw: random.Random) -> None:
    """Give a Parquet file other metadata or columns of other types."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    name = draw.choice(table.column_names)
    value = draw.choice(
        ([[1.0]], [{"a": 1}], ["\x1b[2J"], [b"\xff\0"], [10**18], [True], [None], ["1e400"], ["x"])
    )
    way = draw.randrange(5)
    if way == 0:
        table = table.replace_schema_metadata(
            {"pandas": draw.choice(("{", "[]", "null", '{"a":' * 99))}
        )
    elif way == 1:
        table = table.rename_columns([name] * table.num_columns)
    elif way == 2:
        table = table.slice(0, 0)
    elif way == 3:
        table = pa.table({f"c{i}": [1.0] for i in range(3000)})
    else:
        column = pa.array(value * table.num_rows)
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, path)


def hostile_xml(text: str, draw: random.Random) -> str:
    """Return XML with entities in entities, deep nesting, or values that are no numbers."""
    first, _, rest = text.partition(">")
    value = draw.choice(("nan", "1e400", "x" * 10**6, "", "-1", "0", "1 2 3 4 5 6", "&a12;", "inf"))
    parts = rest.split('"')
    at = draw.choice(range(1, len(parts), 2))
    parts[at] = value
    return draw.choice(
        (f"{LAUGHS}]>{first} model='&a12;'>{rest}", f"{LAUGHS}]>{first}>&a12;{rest}",
         "<a>" * 10**5, first + ">" + '"'.join(parts), first + ">" + '"'.join(parts),
         f'<!DOCTYPE m [<!ENTITY e SYSTEM "file:///etc/passwd">]>{first}>&e;{rest}',
         f'{first}><include file="{"model.xml"}"/>{rest}', f"{first}>" + rest * 2)
    )  # fmt: skip


def mutate(kind: str, path: Path, draw: random.Random, base: Path) -> str:
    """Mutate a file in place, and return in which way."""
    way = draw.choices(("damaged", "foreign", "special", "hostile"), (50, 12, 8, 30))[0]
    if kind in ("bag1", "db3", "mcap", "mat") and way == "hostile":
        way = "damaged"
    if way == "special":
        special(path, draw)
    elif way == "hostile" and kind in ("posterior", "netcdf"):
        hostile_hdf5(path, draw)
    elif way == "hostile" and kind == "parquet":
        hostile_parquet(path, draw)
    elif way == "hostile" and kind == "json":
        path.write_text(hostile_json(draw))
    elif way == "hostile":
        text: Callable[[str, random.Random], str] = (
            hostile_csv if path.suffix == ".csv"
            else hostile_toml if path.suffix == ".toml" else hostile_xml
        )  # fmt: skip
        path.write_text(text(path.read_text(), draw), newline="")
    else:
        content = path.read_bytes()
        changed = damaged(content, draw) if way == "damaged" else foreign(content, draw, base)
        path.write_bytes(changed)
    return way


def contents(path: Path) -> dict[str, object]:
    """Return all values of a posterior file, as text."""
    idata = load_posterior(path)
    values = {name: json.dumps(data.to_dict(), default=str) for name, data in groups(idata).items()}
    return values | {str(key): repr(value) for key, value in idata.attrs.items()}


def other_contents(path: Path, whole: dict[str, object]) -> str:
    """Return where a posterior file differs from what was written, or nothing."""
    try:
        found = contents(path)
    except PbrlError as error:
        return f"now refused: {error}"
    wrong = [name for name in {*whole, *found} if whole.get(name) != found.get(name)]
    return f"read with other contents: {', '.join(sorted(wrong))}" if wrong else ""


def fault_of(ran: Ran) -> str:
    """Return what is wrong with a command that read a mutated file, or nothing."""
    if ran.code < 0 and ran.seconds >= SECONDS:
        return f"still running after {SECONDS:g} s"
    return ran.fault((0, 1, 2, 3))


def main() -> None:
    """Run the tries that are not yet there, and print their sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", type=int, help="numbers of tries, to repeat them")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "reliability")
    arguments = parser.parse_args()
    log, base = arguments.out / "mutated.jsonl", arguments.out / "mutated"
    warm()
    without_pictures()
    if not (base / "log.mcap").exists():
        shutil.rmtree(base, ignore_errors=True)
        inputs(base)
    whole = contents(base / "posterior.nc")
    with contextlib.chdir(base), contextlib.redirect_stdout(io.StringIO()):
        for kind in ("parquet", "mcap", "mat"):  # their packages are then imported
            name, _, (argv,) = KINDS[kind]
            cli.main(argv.format(name).split())
    log.touch()
    rows = {row["try"]: row for row in map(json.loads, log.read_text().splitlines())}
    for number in arguments.only or range(arguments.tries):
        if number in rows and not arguments.only:
            continue
        draw = random.Random(f"{arguments.seed} {number}")
        (kind,) = draw.choices(list(KINDS), [share for _, share, _ in KINDS.values()])
        name, _, commands = KINDS[kind]
        place = arguments.out / "mutated-try"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(base, place, ignore=shutil.ignore_patterns(".std*"))
        way = mutate(kind, place / name, draw, base)
        argv = draw.choice(commands).format(name).split()
        program = library if argv[0] == "mjcf" else None
        ran = run(argv, place, limit=SECONDS, memory=MEGABYTES, program=program)
        fault = fault_of(ran)
        if not fault and kind == "posterior" and way == "damaged" and ran.code != 2:
            fault = other_contents(place / name, whole)
        row = {
            "try": number, "kind": kind, "way": way, "command": argv[0], "code": ran.code,
            "seconds": round(ran.seconds, 2), "fault": fault, "said": ran.err[-400:],
        }  # fmt: skip
        rows[number] = row
        if not arguments.only:
            with log.open("a") as file:
                file.write(json.dumps(row) + "\n")
        if fault or arguments.only:
            print(json.dumps(row), flush=True)
            if arguments.only:
                print(ran.err)
    shown = [row for row in rows.values() if row["try"] < arguments.tries]
    faults = sum(bool(row["fault"]) for row in shown)
    losses = sum("other contents" in row["fault"] for row in shown)
    refused = sum(row["code"] == 2 for row in shown)
    print(
        f"{len(shown)} tries, {refused} refused, {faults} faults, {losses} losses (wrong contents)"
    )


if __name__ == "__main__":
    main()
