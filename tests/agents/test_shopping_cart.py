"""The paper's shopping-cart task, at a small size."""

import os
import subprocess
import sys

import pytest

from tests.helpers.places import ROOT


@pytest.mark.slow
def test_figure(tmp_path) -> None:
    script = [sys.executable, str(ROOT / "analysis" / "04_shopping_cart.py"), "--quick"]
    given = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    ran = subprocess.run(
        script, cwd=tmp_path, env=given, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert "8/8 LWR, seed 2" in ran.stdout
    assert "true model" in ran.stdout and "return (m)" in ran.stdout
    assert (tmp_path / "out" / "shopping_cart_quick" / "figure_4ab.png").stat().st_size > 10_000
