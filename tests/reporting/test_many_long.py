"""Two logs from files to a page, for real, on a cluster and here."""

import numpy as np
import pytest

from pbrl_ppl.effects import catalogue
from pbrl_ppl.posterior import groups, load_posterior
from pbrl_ppl.reporting import close_loop_many, read_manifest
from pbrl_ppl.scene import Scene
from tests.helpers.fleet import cluster
from tests.helpers.free_puck import DISC, Disc

pytestmark = pytest.mark.long

EFFECTS = tuple(effect for effect in catalogue if effect.name in ("linear_drag", "angular_drag"))


def test_two_pucks_one_of_which_drags(tmp_path) -> None:
    """Named where it is, not where it is not; both masses are known better together."""
    (tmp_path / "scene.toml").write_text(DISC.to_toml())
    for name, drag, seed in (("free", 0.0, 1), ("drags", 1.5, 2)):
        frame = Disc(trajectories=6, drag=drag).frame(np.random.default_rng(seed))
        frame.to_csv(tmp_path / f"{name}.csv", index=False)
    (tmp_path / "logs.csv").write_text(
        "name,scene,train,kind\nfree,scene.toml,free.csv,puck\ndrags,scene.toml,drags.csv,puck\n"
        "lost,scene.toml,nowhere.csv,puck\n"
    )
    out = tmp_path / "out"
    options = {"seed": 1, "method": "laplace", "catalogue": EFFECTS}
    with cluster(tmp_path / "dask") as client:
        executor = client.get_executor(pure=False)
        loops = close_loop_many(tmp_path / "logs.csv", out, executor=executor, **options)
    assert loops.failed == ("lost",)
    table = loops.table().set_index("name")
    assert table.loc["free", "verdict"] == "adequate"
    assert table.loc["drags", "effects"] == "linear_drag[puck]"
    assert "there is no such file" in table.loc["lost", "message"]
    drag = loops.effects().iloc[0]
    assert drag["low"] < 1.5 < drag["high"]
    pooled = loops.pooled["puck"]
    mass = pooled.table().set_index("parameter").loc["mass[puck]"]
    assert mass["mean_low"] < 2.0 < mass["mean_high"]
    assert mass["p_same"] > 0.001
    assert pooled.left_out == ("linear_drag_coefficient[puck]",)
    assert Scene.load(out / "kind-puck.toml").body("puck").prior
    assert "posterior" in groups(load_posterior(out / "drags" / "after.nc"))
    # the same one after another: a log that is there is not run again, the other is found alike
    (out / "free" / "report.json").unlink()
    again = close_loop_many(read_manifest(tmp_path / "logs.csv")[:2], out, **options)
    second = again.table().astype(str).set_index("name").drop(columns="seconds")
    assert second.equals(table.astype(str).loc[["free", "drags"]].drop(columns="seconds"))
