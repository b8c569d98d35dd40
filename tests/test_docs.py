"""Pages of analysis/docs: the reference, generated from the package, and quoted messages."""

import ast
import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import typer

import pbrl_ppl
from pbrl_ppl.cli.app import app
from pbrl_ppl.effects import catalogue
from tests.helpers.places import ROOT

pytestmark = pytest.mark.one_stack

DOCS = ROOT / "analysis" / "docs"
NAMES = {effect.name for effect in catalogue}


@pytest.fixture(scope="module")
def reference() -> Any:
    """The hook that makes the reference."""
    spec = importlib.util.spec_from_file_location("docs_reference", DOCS / "reference.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_effects_has_the_whole_catalogue(reference: Any) -> None:
    page = reference.rooms()["effects"]
    entries = re.split(r"^### ", page, flags=re.M)[1:]
    by_name = {entry.partition("\n")[0]: entry for entry in entries}
    assert set(by_name) == NAMES and len(entries) == len(catalogue)
    for effect in catalogue:
        entry = by_name[effect.name]
        assert effect.sentence[1:] in entry and effect.reference in entry
        assert f'effects = ["{effect.name}"]' in entry and "def _" in entry
        for parameter in effect.parameters:
            (row,) = re.findall(rf"^\| `{effect.variable(parameter)}` .*", entry, re.M)
            scale = parameter.scale.partition("/")[0]
            assert scale in row and parameter.unit.removesuffix("1") in row


def test_what_is_written_by_hand_is_of_the_catalogue(reference: Any) -> None:
    assert set(reference.FORMULAS) <= NAMES
    assert {name for names, _ in reference.LOOK_ALIKES for name in names} <= NAMES
    conditions = {effect.applies.__name__ for effect in catalogue}
    assert conditions == set(reference.APPLIES)


def test_every_public_name_has_an_entry(reference: Any) -> None:
    pages = "\n".join(reference.rooms().values())
    nav = (DOCS / "mkdocs.yml").read_text()
    for name in pbrl_ppl.__all__:
        assert re.search(rf"::: pbrl_ppl\.{name}$|#pbrl_ppl\.{name} }}", pages, re.M), name
    for room in reference.rooms():
        assert f"reference/{room}.md" in nav


def test_roles_become_links(reference: Any) -> None:
    html = "see :func:<code>pbrl_ppl.fit</code>, :meth:<code>~pbrl_ppl.Loop.save</code>"
    shown = reference.on_page_content(f"{html} and :class:<code>Units</code>", None, None, None)
    assert ":" not in re.sub("<[^>]*>", "", shown)
    assert '<autoref identifier="pbrl_ppl.fit" optional><code>fit</code>' in shown
    assert '<autoref identifier="pbrl_ppl.Loop.save" optional><code>save</code>' in shown
    assert "<code>Units</code>" in shown


def texts(path: Path) -> list[str]:
    """Return the string literals of a file, with a mark for each value put in."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else "\0" for part in node.values)
            found.append("".join(map(str, parts)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return found


def test_the_guide_to_verdicts_quotes_the_package() -> None:
    page = (DOCS / "pages" / "guides" / "verdicts.md").read_text()
    quoted = re.findall(r"^- `([^`]+)`:", page, re.M)
    assert len(quoted) > 25
    said = "\1".join(text for path in (ROOT / "pbrl_ppl").rglob("*.py") for text in texts(path))
    said += "".join(path.read_text() for path in (ROOT / "pbrl_ppl").rglob("*.jinja"))
    assert [words for words in quoted if words not in said] == []


def test_the_guide_has_every_verdict_and_warning() -> None:
    page = (DOCS / "pages" / "guides" / "verdicts.md").read_text()
    decisions = (DOCS / "pages" / "explanation" / "decisions.md").read_text()
    listed = decisions.partition("\n## Verdicts\n")[2].partition("\n## ")[0]
    verdicts = re.findall(r"^\| `([a-z-]+)` \|", listed, re.M)
    assert "effects-added" in verdicts and len(verdicts) == 4
    for verdict in verdicts:
        assert f"\n### {verdict}\n" in page
    tree = ast.parse((ROOT / "pbrl_ppl" / "errors.py").read_text())
    classes = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
    headings = "".join(re.findall(r"^### .*", page, re.M))
    assert {name for name in classes if name.endswith("Warning")} <= set(
        re.findall(r"\w+Warning", headings)
    )


def test_commands_in_the_guide_exist() -> None:
    """Those in its sentences: test_prose.py looks at blocks."""
    page = (DOCS / "pages" / "guides" / "verdicts.md").read_text()
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    shown = re.findall(r"`pbrl-ppl ([a-z][^`]+)`", page)
    assert len(shown) >= 10
    for line in shown:
        name, *words = line.split()
        flags = {flag for each in commands[name].params for flag in each.opts}
        assert {word for word in words if re.match("--?[a-z]", word)} <= flags, line


def test_other_subjects_of_the_fit_have_their_anchors() -> None:
    """Links from elsewhere led to sections of the page that are pages now."""
    page = (DOCS / "pages" / "guides" / "fit.md").read_text()
    for anchor in ("as-data-come-in", "with-arviz", "is-the-sampler-right", "three-likelihoods"):
        assert f'<a id="{anchor}">' in page


def test_the_readme_shows_a_row_of_the_page_on_hardware() -> None:
    """If the measured recordings were run again, copy the row's new numbers."""
    readme = (ROOT / "README.md").read_text().partition("\n## ")[0]
    page = (DOCS / "pages" / "results" / "hardware.md").read_text()
    (name,) = re.findall(r"`([\w-]+)` of\s+\[On hardware\]", readme)
    (row,) = re.findall(rf"^\| {name} \|.*", page, re.M)
    (shown,) = re.findall(r"^\| a .*", readme, re.M)
    assert shown.split(" | ")[0].removeprefix("| ") in row
    numbers = re.findall(r"[\d.]+ \([\d.]+ to [\d.]+\)|[\d.]+ → [\d.]+", shown)
    assert len(numbers) == 3 and all(each in row for each in numbers)
    assert re.findall(r"`([a-z-]+)`", shown)[-1] in row
