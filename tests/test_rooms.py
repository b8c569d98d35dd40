"""Layout: the rooms listed in CONTRIBUTING.md, and test files that import no other test file."""

import ast
import re
import tomllib

from tests.helpers.places import ROOT


def test_no_test_imports_another() -> None:
    """Code that several test files share is in tests/helpers."""
    files = sorted((ROOT / "tests").rglob("*.py"))
    others = re.compile(r"^\s*(?:from|import) tests(?!\.helpers\b).*", re.M)
    assert [(each.name, others.findall(each.read_text())) for each in files
            if others.search(each.read_text())] == []  # fmt: skip


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
