"""Several files as trajectories of one history."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, logs_in
from pbrl_ppl.scene import Body, Recording, Scene, Shape

pytestmark = pytest.mark.one_stack

LAYOUT = Recording(columns={"time": "t"})
PUCK = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),), recording=LAYOUT)


def write(path: Path, x: float, rows: int = 3) -> None:
    """Write a table with a title line and tabs, whose clock begins at 0."""
    lines = [f"{0.1 * i:.1f}\t{x + i:g}\t0" for i in range(rows)]
    path.write_text("\n".join(["\tpuck\t", "t\tx\ty", *lines]) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of three logs of different lengths, and files that are none."""
    for number, rows in ((10, 4), (2, 3), (1, 5)):
        write(tmp_path / f"run_{number}.txt", 100.0 * number, rows)
    for name in ("notes.md", "._run_1.txt", "~$run.xlsx"):
        (tmp_path / name).write_text("no log")
    return tmp_path


def test_a_folder_is_one_history_in_natural_order(folder: Path) -> None:
    history = History.load(folder, PUCK)
    assert history.dataset["trajectory"].values.tolist() == ["run_1", "run_2", "run_10"]
    assert history.dataset["n_rows"].values.tolist() == [5, 3, 4]
    observed = history.dataset["observed"].to_numpy()[:, :, 0, 0]
    np.testing.assert_array_equal(observed[:, 0], [100.0, 200.0, 1000.0])
    assert np.isnan(observed[1, 3:]).all() and np.isnan(observed[2, 4:]).all()
    files = History.load([folder / "run_10.txt", folder / "run_2.txt"], PUCK)
    assert files.dataset["trajectory"].values.tolist() == ["run_2", "run_10"]
    alone = History.load(folder / "run_2.txt", PUCK)
    assert alone.dataset["trajectory"].values.tolist() == [0]


def test_a_message_names_the_file(folder: Path) -> None:
    (folder / "run_2.txt").write_text("t\tx\n0\t1\n0.1\t2\n0.4\t3\n")
    with pytest.raises(HistoryError, match=r"run_2.txt row 4: 0.3 s since the step before"):
        History.load(folder, PUCK)
    (folder / "empty").mkdir()
    with pytest.raises(HistoryError, match=r"empty: the folder has no log; expected files"):
        History.load(folder / "empty", PUCK)
    with pytest.raises(HistoryError, match=r"none.csv: there is no such file"):
        History.load([folder, folder / "none.csv"], PUCK)
    with pytest.raises(HistoryError, match="cannot be read: File name too long"):
        History.load("x" * 300, PUCK)


def test_trajectories_of_a_log_keep_their_labels(tmp_path: Path) -> None:
    head, rows = "trajectory,t,x\n", "{0},0,1\n{0},0.1,2\n"
    (tmp_path / "a.csv").write_text(head + rows.format(7))
    (tmp_path / "b.csv").write_text(head + rows.format("up") + rows.format("down"))
    labels = History.load(tmp_path, PUCK).dataset["trajectory"].values.tolist()
    assert labels == ["a", "b.up", "b.down"]


def test_commands_beside_each_log_are_no_logs(tmp_path: Path) -> None:
    for name, force in (("a", 1.0), ("b", 2.0)):
        write(tmp_path / f"{name}.csv", 0.0)
        (tmp_path / f"{name}_cmd.csv").write_text(f"time,push\n0,{force}\n0.1,{force}\n")
    layout = Recording(columns={"time": "t", "force_x": "push"}, commands="{stem}_cmd.csv")
    scene = PUCK.replace(recording=layout)
    with pytest.warns(UserWarning, match="push"):
        history = History.load(tmp_path, scene)
    assert history.dataset["action"].to_numpy()[:, 0, 0, 0].tolist() == [1.0, 2.0]
    assert [path.name for path in logs_in(tmp_path, layout)] == ["a.csv", "b.csv"]


def test_a_workbook_is_read_as_a_text_table_is(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl", reason="openpyxl reads workbooks; install the extra `excel`")
    rows = [["taken on a rail", None], ["t", "x"], ["s", "mm"]]
    rows += [[0.1 * i, 1000 / 3 * i if i != 1 else None] for i in range(4)]
    pd.DataFrame(rows).to_excel(tmp_path / "a.xlsx", header=False, index=False)
    history = History.load(tmp_path / "a.xlsx", PUCK)
    x = history.dataset["observed"].to_numpy()[0, :, 0, 0]
    np.testing.assert_allclose(x, [0.0, np.nan, 2 / 3, 1.0], rtol=1e-15)
    (tmp_path / "b.xlsx").write_bytes(b"PK damaged")
    with pytest.raises(HistoryError, match=r"b.xlsx: not a workbook"):
        History.load(tmp_path / "b.xlsx", PUCK)


def test_a_workbook_needs_openpyxl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.xlsx").write_bytes(b"PK")
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(HistoryError, match=r"needs openpyxl: pip install 'pbrl_ppl\[excel\]'"):
        History.load(tmp_path / "a.xlsx", PUCK)
