"""The paper's figure 4 at a small size: resumed, refused, and read by the benchmark."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

from tests.helpers.places import ROOT

ANALYSIS = ROOT / "analysis"


def ran(folder: Path, script: str, *options: str) -> subprocess.CompletedProcess[str]:
    given = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    command = [sys.executable, str(ANALYSIS / script), *options]
    return subprocess.run(
        command, cwd=folder, env=given, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_shopping_cart(tmp_path) -> None:
    first = ran(tmp_path, "04_shopping_cart.py", "--quick")
    assert first.returncode == 0, first.stderr
    assert "8/8 LWR, seed 2" in first.stdout
    assert "true model" in first.stdout and "return (m)" in first.stdout
    out = tmp_path / "out" / "shopping_cart_quick"
    assert (out / "figure_4ab.png").stat().st_size > 10_000
    with xr.open_dataset(out / "figure_4b.nc", engine="h5netcdf") as kept:
        assert kept.attrs["sigma"] == 0.25 and kept.sizes["seed"] == 2
        assert kept["reward"].notnull().all()
    refused = ran(tmp_path, "04_shopping_cart.py", "--quick")
    assert refused.returncode == 2 and "go on with --resume" in refused.stderr
    (out / "sigma_0" / "lwr-2.nc").unlink()
    again = ran(tmp_path, "04_shopping_cart.py", "--quick", "--resume")
    assert again.returncode == 0 and "7 of 8 episodes are in" in again.stdout
    (out / "sigma_0" / "lwr-2.nc").write_text("nothing")
    broken = ran(tmp_path, "04_shopping_cart.py", "--quick", "--resume")
    assert broken.returncode == 2 and "Traceback" not in broken.stderr
    assert "lwr-2.nc: this is not a NetCDF file" in broken.stderr


@pytest.mark.long
def test_wrong_model(tmp_path) -> None:
    done = ran(tmp_path, "06_wrong_model.py", "--quick", "--json", "result.json")
    assert done.returncode == 0, done.stderr
    assert "6/6 PBRL" in done.stdout and "online_loop_return_ratio" in done.stdout
    result = json.loads((tmp_path / "result.json").read_text())
    assert 0.5 < result["online_loop_return_ratio"] < 2.0 and result["step_seconds"] > 0
    (picture,) = (tmp_path / "out" / "wrong_model_quick").rglob("wrong_model.png")
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.one_stack
def test_scaling(tmp_path) -> None:
    done = ran(tmp_path, "07_scaling.py", "--quick")
    assert done.returncode == 0, done.stderr
    with xr.open_dataset(tmp_path / "out" / "scaling" / "scaling.nc", engine="h5netcdf") as kept:
        # a body of one object and four sectors, then two of two objects each
        assert kept["conditions"].values.tolist() == [16.0, 2 * 256.0]
        met, needed = (kept[name].values[0] for name in ("conditions_met", "observations_needed"))
        assert (met > 1).all() and (met <= kept["conditions"].values).all()
        assert needed[0] <= needed[1] < 50  # each box has to be pushed
    assert (tmp_path / "out" / "scaling" / "scaling.png").stat().st_size > 10_000


@pytest.mark.long
def test_apartment(tmp_path) -> None:
    first = ran(tmp_path, "05_apartment.py", "--quick", "--only", "true", "oolwr")
    assert first.returncode == 0, first.stderr
    assert "true model, seed 1, 0 observations: valid plan" in first.stdout
    assert "OO-LWR, seed 1, 10 observations: no plan" in first.stdout
    out = tmp_path / "out" / "apartment_quick"
    assert (out / "figure_4c.png").stat().st_size > 10_000
    refused = ran(tmp_path, "05_apartment.py", "--quick", "--only", "true")
    assert refused.returncode == 2 and "go on with --resume" in refused.stderr
    again = ran(tmp_path, "05_apartment.py", "--quick", "--only", "true", "pbrl", "--resume")
    assert again.returncode == 0, again.stderr
    assert "true model, seed" not in again.stdout and "categorical, seed 1, 3" in again.stdout
    other = ran(
        tmp_path, "05_apartment.py", "--only", "oolwr", "--resume", "--out", "out/apartment_quick"
    )
    assert other.returncode == 2 and "other settings; give another folder" in other.stderr


@pytest.mark.one_stack
def test_benchmark_reads_what_is_kept(tmp_path) -> None:
    done = ran(tmp_path, "benchmarks/agents.py", "--json")
    assert done.returncode == 0, done.stderr
    keys = json.loads(done.stdout)
    assert keys["pbrl_success"] == 1.0 and keys["step_seconds"] < 2.0
    assert keys["pbrl_minus_true_low"] <= 0.0 <= keys["pbrl_minus_true_high"]
    assert {"oolwr_steps_over_pbrl", "lwr_plateau", "noisy_pbrl_over_true"} <= {*keys}
    assert {f"apartment_{name}_success" for name in ("oolwr", "pbrl", "continuous")} <= {*keys}
    (tmp_path / "figure_4a.nc").write_text("nothing")
    broken = ran(tmp_path, "benchmarks/agents.py", "--results", str(tmp_path))
    assert broken.returncode == 1 and "not a NetCDF file" in broken.stderr
    assert "Traceback" not in broken.stderr
