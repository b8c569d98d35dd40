"""CONTRIBUTING.md lists the rooms as they are: in the order of imports, in their own words."""

import ast
import re
import tomllib

from tests.helpers.places import ROOT


def test_contributing_lists_the_rooms() -> None:
    listed = re.findall(r"^\| `(\w+)/` \| (.*) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.M)
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    (layers,) = (
        each["layers"] for each in tools["importlinter"]["contracts"] if each["type"] == "layers"
    )
    rooms = [name for name in reversed(layers) if (ROOT / "pbrl_ppl" / name).is_dir()]
    said = [ast.get_docstring(ast.parse((ROOT / "pbrl_ppl" / name / "__init__.py").read_text()))
            for name in rooms]  # fmt: skip
    first = [(text or "").splitlines()[0] for text in said]
    assert listed == list(zip(rooms, first, strict=True))
