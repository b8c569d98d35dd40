"""Effects of the example files, by name."""

from pbrl_ppl.cli.options import own_effects
from tests.helpers.places import ROOT

#: The files of `analysis/examples/effects`.
FILES = sorted((ROOT / "analysis" / "examples" / "effects").glob("*.py"))
EXAMPLES = {effect.name: effect for effect in own_effects(FILES)}
