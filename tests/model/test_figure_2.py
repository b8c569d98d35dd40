"""`analysis/figure_2.py`: the picture of the graphical model."""

import shutil
import subprocess
import sys

import pytest

from tests.helpers.places import ROOT

SCRIPT = ROOT / "analysis" / "figure_2.py"
pytestmark = pytest.mark.one_stack


def test_it_draws_every_node_and_f_between_them(tmp_path) -> None:
    pytest.importorskip("graphviz")
    if shutil.which("dot") is None:
        pytest.skip("Graphviz is not installed")
    to = tmp_path / "figure.svg"
    subprocess.run([sys.executable, str(SCRIPT), str(to)], check=True, cwd=ROOT)
    text = to.read_text(encoding="utf-8")
    edges = [("start", "f"), ("actions", "f"), ("w_theta", "f"), ("mass", "f"), ("f", "next_state"),
             ("sigma", "next_state")]  # fmt: skip
    for a, b in edges:
        assert f"<title>{a}&#45;&gt;{b}</title>" in text
    assert "<title>start&#45;&gt;next_state</title>" not in text


def test_without_graphviz_it_says_what_it_needs() -> None:
    code = (
        "import sys, runpy; sys.modules['graphviz'] = None;"
        f" runpy.run_path({str(SCRIPT)!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2
    assert done.stderr == "figure_2: needs the package graphviz; pip install graphviz\n"
