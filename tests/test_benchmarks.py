"""Benchmarks at a small size, and without what they compare with."""

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import pbrl_ppl as pp


def test_without_its_toolbox_mujoco_is_left_out(benchmarks, monkeypatch, capsys) -> None:
    """mujoco.sysid can be imported without the extra `bench`, and is then empty."""
    why = "MuJoCo is compared with; install the extra `test`"
    mujoco = pytest.importorskip("mujoco", reason=why)
    import inference

    empty = types.ModuleType("mujoco.sysid")
    monkeypatch.setattr(mujoco, "sysid", empty, raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.sysid", empty)
    monkeypatch.delitem(sys.modules, "mujoco_sysid", raising=False)
    few = inference.cart(2)
    monkeypatch.setattr(inference, "cart", lambda n: few)
    monkeypatch.setattr(inference, "find_mode", lambda problem, seed: None)  # half a minute
    assert [key for key, *_ in inference.measure_map()] == ["map_seconds"]
    assert "left out: mujoco.sysid is there without what it needs; pip install" in (
        capsys.readouterr().err
    )


def test_what_touches_nothing_is_compared_with_bare_stepping(benchmarks, monkeypatch) -> None:
    import engine

    monkeypatch.setattr(engine, "ROUNDS", 1)
    measured = {row.key: row.measure() for row in (*engine.free_rows(64), *engine.jacobian_rows())}
    assert list(measured) == [
        "free_over_c",
        "free_plain_over_c",
        "free_effects_over_c",
        "jacobian_over_value",
        "coarse_jacobian_over_value",
    ]
    assert all(0 < value < np.inf for value in measured.values())
    assert measured["jacobian_over_value"] > 1


@pytest.mark.parametrize(("asked", "keys"), [([], ["quick"]), (["--only", "slow"], ["slow"])])
def test_usual_parts_are_measured_unless_others_are_asked_for(
    benchmarks, monkeypatch, capsys, asked, keys
) -> None:
    import inference

    def part(key):
        return lambda: iter([(key, "what", "", 1.0)])

    monkeypatch.setattr(sys, "argv", ["loop.py", "--json", *asked])
    inference.measure({key: part(key) for key in ("quick", "slow")}, "", usual=["quick"])
    assert list(json.loads(capsys.readouterr().out)) == keys


def made_up_loop(*names):
    """Return what the benchmark reads of a loop."""
    added = tuple(types.SimpleNamespace(effect=name, body="cart") for name in names)
    return types.SimpleNamespace(verdict="adequate", added=added, provenance={"transitions": 60})


def test_loops_on_recordings_that_are_not_there_are_left_out(
    benchmarks, monkeypatch, capsys, tmp_path
) -> None:
    import loop

    for name in ("PAIR", "REAL", "PUSHED"):
        monkeypatch.setattr(loop, name, tmp_path / name)
    assert [*loop.measure_pair(), *loop.measure_real()] == []
    said = capsys.readouterr().err
    assert f"pair_seconds is left out: nothing at {tmp_path / 'PAIR'}" in said
    assert "real_seconds_max is left out: nothing at" in said


def test_the_longest_loop_on_a_measured_recording_is_told(
    benchmarks, monkeypatch, tmp_path
) -> None:
    import loop

    took = {"arm": 3.0, "two-arms": 7.0, "pushed": 5.0}
    for name in ("real/arm", "real/two-arms", "pushed"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "scene.toml").touch()
    monkeypatch.setattr(loop, "REAL", tmp_path / "real")
    monkeypatch.setattr(loop, "PUSHED", tmp_path / "pushed")
    monkeypatch.setattr(loop, "closed", lambda scene, data: (took[data.name], made_up_loop("drag")))
    rows = list(loop.measure_real())
    assert {key: value for key, _, _, value in rows} == {
        "arm_seconds": 3.0,
        "two_arms_seconds": 7.0,
        "pushed_seconds": 5.0,
        "real_seconds_max": 7.0,
    }
    assert rows[0][1] == "arm, 60 transitions; adequate, added: drag on cart (s)"


def test_a_long_recording_is_made_and_its_memory_told(benchmarks, monkeypatch, capsys) -> None:
    import long_loop

    def closed(scene_file: Path, folder: Path):
        scene = pp.Scene.load(scene_file)
        counts = {
            name: pp.History.load(folder / f"{name}.csv", scene).n_transitions
            for name in ("train", "test")
        }
        assert counts == {"train": 600, "test": 60}
        return 2.0, made_up_loop()

    monkeypatch.setattr(long_loop, "closed", closed)
    monkeypatch.setattr(sys, "argv", ["long_loop.py", "600"])
    long_loop.main()
    told = json.loads(capsys.readouterr().out)
    assert told["seconds"] == 2.0
    assert 0.01 < told["gigabytes"] < 100
    assert told["told"] == "60 transitions; adequate, added: nothing"
