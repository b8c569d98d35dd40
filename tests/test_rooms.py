"""Rooms: their list in CONTRIBUTING.md, their sizes, and tests that import no other test."""

import ast
import re
import statistics
import tomllib

from tests.helpers.places import ROOT

#: The most lines of a module, what their median is under, and the most entries of the package.
MOST_LINES, MEDIAN_LINES, MOST_ENTRIES = 350, 150, 20


def test_no_test_imports_another() -> None:
    """What several need is in tests/helpers."""
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


def test_sizes() -> None:
    """`make lint` calls this too, where pytest need not be: hence the messages."""
    package = ROOT / "pbrl_ppl"
    modules = sorted(package.rglob("*.py"))
    lines = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in modules}
    longer = {module: count for module, count in lines.items() if count > MOST_LINES}
    assert not longer, f"modules of more than {MOST_LINES} lines: {longer}; split them by idea"
    median = statistics.median(lines.values())
    assert median < MEDIAN_LINES, f"the modules' median is {median} lines, not under {MEDIAN_LINES}"
    entries = sorted(path.name for path in package.iterdir() if path.name != "__pycache__")
    assert len(entries) <= MOST_ENTRIES, f"pbrl_ppl/ has {len(entries)} entries: {entries}"
