"""The paper's shopping-cart task, and one with a wrong model, at a small size."""

import json
import os
import subprocess
import sys

import pytest

from tests.helpers.places import ROOT


def script(name: str, *options: str, folder) -> str:
    """What a script of `analysis` prints."""
    command = [sys.executable, str(ROOT / "analysis" / name), *options]
    given = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    ran = subprocess.run(
        command, cwd=folder, env=given, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.slow
def test_figure(tmp_path) -> None:
    said = script("04_shopping_cart.py", "--quick", folder=tmp_path)
    assert "8/8 LWR, seed 2" in said
    assert "true model" in said and "return (m)" in said
    assert (tmp_path / "out" / "shopping_cart_quick" / "figure_4ab.png").stat().st_size > 10_000


@pytest.mark.slow
def test_wrong_model(tmp_path) -> None:
    said = script("05_wrong_model.py", "--quick", "--json", "result.json", folder=tmp_path)
    assert "6/6 PBRL" in said and "online_loop_return_ratio" in said
    result = json.loads((tmp_path / "result.json").read_text())
    assert 0.5 < result["online_loop_return_ratio"] < 2.0 and result["step_seconds"] > 0
    (picture,) = (tmp_path / "out" / "wrong_model_quick").rglob("wrong_model.png")
    assert picture.stat().st_size > 10_000
