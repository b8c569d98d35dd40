"""Where data lie."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "models"
#: Recorded histories beside the project; a test on them is skipped where they are not.
RECORDED = ROOT.parent / "shared" / "data"
