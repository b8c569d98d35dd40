"""Paths of the repository and of recorded data."""

from pathlib import Path

import pbrl_ppl as pp

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "models"
#: Recorded histories beside the project; a test on them is skipped where they are not.
RECORDED = ROOT.parent / "shared" / "data"


def load(folder: Path, data: Path | None = None) -> tuple[pp.Scene, pp.History, pp.History]:
    """Return scene, train and test of a folder; the recordings may be in another."""
    scene = pp.Scene.load(folder / "scene.toml")
    parts = (pp.History.load((data or folder) / f"{part}.csv", scene) for part in ("train", "test"))
    return scene, *parts
