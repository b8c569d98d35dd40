"""``--trim``, and the warning without it."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.cli import main
from tests.helpers.histories import COLUMNS

SCENE = """
[world]
gravity = [0.0, -9.81]
time_step = 0.03333333333
substeps = 4

[[body]]
name = "ball"
shape = { kind = "circle", radius = 0.03 }
"""


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder to run in, with a recording of which the second fall begins six rows late."""
    rng, dt, rows = np.random.default_rng(0), 1.0 / 30.0, []
    for trajectory, held in enumerate((0, 6)):
        for i in range(44):
            fall = max(i - held, 0) * dt
            y = -9.81 * fall**2 / 2 + 1e-3 * rng.standard_normal()
            wrench = [0.0] * 3 if i < 43 else [np.nan] * 3
            rows.append([trajectory, i, i * dt, "ball", 0.0, y, 0.0, *[np.nan] * 3, *wrench])
    pd.DataFrame(rows, columns=COLUMNS).to_csv(tmp_path / "falls.csv", index=False)
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("files")
def test_check_warns_of_a_held_body_and_trim_leaves_the_rows_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["check", "scene.toml", "falls.csv", "--estimate-velocities", "--no-prior"]
    assert main(command) == 0
    said = capsys.readouterr()
    (warning,) = (line for line in said.err.splitlines() if line.startswith("warning"))
    assert "ball is held in the first" in warning
    assert "rows of trajectory 1 (t = 0 to" in warning
    assert "--trim leaves the rows out" in warning
    assert "86 (43 in a trajectory)" in said.out
    assert main([*command, "--trim"]) == 0
    said = capsys.readouterr()
    assert "left out" in said.err
    assert any(f"{n} ({n - 43} to 43 in a trajectory)" in said.out for n in (79, 80))
