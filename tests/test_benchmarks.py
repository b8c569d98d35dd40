"""Benchmarks without what they compare with."""

import sys
import types

import pytest

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is compared with; install the extra `test`")


def test_without_its_toolbox_mujoco_is_left_out(benchmarks, monkeypatch, capsys) -> None:
    """mujoco.sysid can be imported without the extra `bench`, and is then empty."""
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
