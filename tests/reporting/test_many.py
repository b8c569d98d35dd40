"""Many logs: manifest, resumption, failures, and the pages, with loops that take no time."""

import json
import os
import signal
import time
from collections import Counter
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pbrl_ppl.criticism.loop import FILES
from pbrl_ppl.errors import ManifestError, OutputError
from pbrl_ppl.reporting import ManyLoops, Source, close_loop_many, many, read_manifest
from tests.helpers.fleet import BEGUN, KEPT, cluster, lines, made_logs, pretend


def run(logs: Any, folder: Path, **options: Any) -> Any:
    return close_loop_many(logs, folder, run=pretend, **options)


def test_manifest(tmp_path) -> None:
    (tmp_path / "logs.csv").write_text(
        "\ufeffname, kind,scene,train,test\nred,cart,s.toml,a.csv,\n\nblue,,s.toml,b.csv,c.csv\n"
    )
    red, blue = read_manifest(tmp_path / "logs.csv")
    assert (red.name, red.kind, red.test) == ("red", "cart", None)
    assert blue.train == tmp_path / "b.csv" and blue.test == tmp_path / "c.csv"
    assert blue.scene.is_absolute() and blue.kind == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("name,scene,train\n", "it has no rows"),
        ("name,scene\na,b\n", "missing column.* train"),
        ("name,scene,trian,train\na,b,c,d\n", 'unknown column "trian"; did you mean "train"'),
        ("name,scene,train,train\na,b,c,d\n", "there twice; drop one"),
        ("name,scene,train\na,b\n", "row 2: 2 cells, expected 3"),
        ("name,scene,train\na,b,\n", "row 2: train is empty"),
        ("name,scene,train\n../a,b,c\n", 'row 2: name is "../a"; expected letters'),
        ("name,scene,train,kind\na,b,c,x/y\n", 'row 2: kind is "x/y"'),
        ("name,scene,train\na,b,c\nA,b,c\n", 'the name "A" is there twice'),
    ],
)
def test_bad_manifests(tmp_path, text, message) -> None:
    path = tmp_path / "logs.csv"
    path.write_text(text)
    with pytest.raises(ManifestError, match=message):
        read_manifest(path)
    with pytest.raises(ManifestError, match="no such file"):
        read_manifest(tmp_path / "nope.csv")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ManifestError, match="cannot be read"):
        read_manifest(path)


def test_failures_do_not_stop_the_rest_and_are_tried_again(tmp_path) -> None:
    logs = made_logs(tmp_path, a="angular_drag", b="fail", c="crash", d="warn", e="linear_drag")
    out, said = tmp_path / "out", []
    loops = run(logs, out, progress=said.append)
    assert loops.failed == ("b", "c")
    assert repr(loops) == "ManyLoops(1 adequate, 2 effects-added, 2 failed)"
    table = loops.table().set_index("name")
    assert table.loc["b", "message"] == "row 3: x is lost"
    assert table.loc["c", "message"] == "ZeroDivisionError: by zero"
    assert table.loc["a", "effects"] == "angular_drag[cart]"
    assert table.loc["d", "warnings"] == 1
    assert "ZeroDivisionError" in json.loads((out / "c" / "error.json").read_text())["traceback"]
    assert sorted(p.name for p in (out / "a").iterdir()) == sorted(FILES)
    effects = loops.effects()
    assert list(effects["name"]) == ["a", "e"]
    assert tuple(effects.loc[0, ["effect", "mean", "low", "unit"]]) == (
        "angular_drag", 1.2, 1.0, "kg/s")  # fmt: skip
    assert said[0].startswith("1/5 a: effects-added (angular_drag[cart])")
    page = (out / "index.html").read_text()
    for words in ('href="a/report.html"', 'href="b/error.json"', "row 3: x is lost",
                  "1.20 ± 0.100 kg/s", "below 0.0300", "rows were"):  # fmt: skip
        assert words in page
    # the cause is cured: only what failed is run again
    (tmp_path / "b.csv").write_text("")
    again = run(logs, out, progress=said.append)
    assert again.failed == ("c",)
    assert Counter(lines(tmp_path, BEGUN)) == {"a": 1, "b": 2, "c": 2, "d": 1, "e": 1}
    assert not (out / "b" / "error.json").exists()
    assert any(line.startswith("3 of 5 logs are in") for line in said)
    assert json.loads((out / "summary.json").read_text())["logs"][1]["status"] == "done"


def test_changed_inputs_are_run_again(tmp_path) -> None:
    logs, out = made_logs(tmp_path, a="", b=""), tmp_path / "out"
    run(logs, out)
    run(logs, out)
    assert lines(tmp_path, BEGUN) == ["a", "b"]
    (tmp_path / "b.csv").write_text("linear_drag")  # a file
    assert list(run(logs, out).effects()["name"]) == ["b"]
    assert lines(tmp_path, BEGUN)[2:] == ["b"]
    run(logs, out, seed=2)  # a setting
    assert lines(tmp_path, BEGUN)[3:] == ["a", "b"]
    with_test = [replace(logs[0], test=tmp_path / "b.csv"), logs[1]]
    run(with_test, out, seed=2)
    assert lines(tmp_path, BEGUN)[5:] == ["a"]
    run(with_test, out, seed=2, again=True)
    assert lines(tmp_path, BEGUN)[6:] == ["a", "b"]
    # what has no report that says it is done is made again, and a dead worker's rests are cleared
    (out / "a" / "report.json").write_text("{half")
    (out / "a" / ".making-x").mkdir()
    run(with_test, out, seed=2)
    assert lines(tmp_path, BEGUN)[8:] == ["a"]
    assert sorted(p.name for p in (out / "a").iterdir()) == sorted(FILES)


def test_the_page_of_many_quick_logs_is_not_written_after_each(tmp_path, monkeypatch) -> None:
    """It has a row a log: a page after each of n logs takes time in proportion to n^2."""
    names, write, counts = [f"log{i:02d}" for i in range(20)], many._written, []

    def slow(loops: ManyLoops, source: Source) -> ManyLoops:
        counts.append(sum(row["status"] == "done" for row in loops.rows))
        time.sleep(0.1)
        return write(loops, source)

    monkeypatch.setattr(many, "_written", slow)
    logs = made_logs(tmp_path, **dict.fromkeys(names, "") | {"log15": "interrupt"})
    with pytest.raises(KeyboardInterrupt):
        run(logs, tmp_path / "out")
    assert counts[0] == 0 and counts[-1] == 15 and len(counts) < 10
    counts.clear()
    (tmp_path / "log15.csv").write_text("")
    run(logs, tmp_path / "out")
    assert counts[0] == 15 and counts[-1] == 20


def test_an_interrupt_keeps_what_is_finished(tmp_path) -> None:
    logs, out = made_logs(tmp_path, a="", b="interrupt", c=""), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(logs, out)
    rows = json.loads((out / "summary.json").read_text())["logs"]
    assert [row["status"] for row in rows] == ["done", "waiting", "waiting"]
    (tmp_path / "b.csv").write_text("")
    resumed = run(logs, out)
    assert not resumed.failed
    assert lines(tmp_path, KEPT) == ["a", "b", "c"]
    whole = run(logs, tmp_path / "whole")  # as if it had not been interrupted
    timed = ["seconds", "finished"]
    for got, expected in ((resumed.table(), whole.table()), (resumed.effects(), whole.effects())):
        got, expected = (one.drop(columns=timed, errors="ignore") for one in (got, expected))
        pd.testing.assert_frame_equal(got, expected)


def test_folders_of_others_are_left_alone(tmp_path) -> None:
    logs, mine = made_logs(tmp_path / "logs", a=""), tmp_path / "mine"
    mine.mkdir()
    (mine / "index.html").write_text("my page")
    with pytest.raises(OutputError, match="not of many logs"):
        run(logs, mine)
    (mine / "summary.json").write_text("{}")
    with pytest.raises(OutputError, match="not of many logs"):
        run(logs, mine)
    assert (mine / "index.html").read_text() == "my page"
    with pytest.raises(OutputError, match="is a file"):
        run(logs, mine / "index.html")


class _Losing(Executor):
    """Runs calls here, but for one whose worker is lost."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        if fn.args[0].name == "b":
            future.set_exception(BrokenProcessPool("its worker died"))
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_a_lost_worker_fails_its_log_alone(tmp_path) -> None:
    logs = made_logs(tmp_path, a="", b="", c="")
    loops = run(logs, tmp_path / "out", executor=_Losing())
    assert loops.failed == ("b",)
    assert loops.rows[1]["message"] == "BrokenProcessPool: its worker died"
    assert (tmp_path / "out" / "b" / "error.json").is_file()
    assert not run(logs, tmp_path / "out").failed
    assert lines(tmp_path, BEGUN) == ["a", "c", "b"]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker(tmp_path) -> None:
    """Nothing is lost and nothing done twice, but for what the worker was at."""
    logs = made_logs(tmp_path, **{f"log{i}": "wait" for i in range(8)})
    with cluster(tmp_path / "dask") as client:
        processes = list(client.run(os.getpid).values())
        assert len(set(processes)) == 2

        def kill(said: str) -> None:
            if said.startswith("4/8"):
                os.kill(processes[0], signal.SIGKILL)

        executor = client.get_executor(pure=False)
        loops = run(logs, tmp_path / "out", executor=executor, progress=kill)
        assert processes[0] not in client.run(os.getpid).values()
    assert not loops.failed
    assert set(loops.table()["status"]) == {"done"}
    assert Counter(lines(tmp_path, KEPT)) == dict.fromkeys((log.name for log in logs), 1)
    begun = Counter(lines(tmp_path, BEGUN))
    assert set(begun) == {log.name for log in logs}
    assert begun.total() in (8, 9)
