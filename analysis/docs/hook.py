"""MkDocs hook: pages from files of the repository, links between files as links between pages."""

import os
import re
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[2]
NOTEBOOKS = ROOT / "analysis" / "notebooks"
#: Executed notebooks, if `make notebooks` was run.
EXECUTED = ROOT / "out" / "notebooks"
#: Files that become pages.
PAGES = {
    "README.md": "index.md",
    "analysis/benchmarks/README.md": "results/benchmarks.md",
    "analysis/paper.md": "results/paper.md",
    "analysis/notebooks/README.md": "notebooks/index.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changelog.md",
    **{f"models/{path.parent.name}/README.md": f"models/{path.parent.name}.md"
       for path in ROOT.glob("models/*/README.md")},
}  # fmt: skip
#: Modules that the reference describes: links to them lead there.
DESCRIBED = {
    "pbrl_ppl/effects/catalogue.py": "reference/effects.md",
    "pbrl_ppl/errors.py": "reference/errors.md",
}
_LINK = re.compile(r"(?<=\]\()(?![a-z]+:|[#/])([^)\s#]+)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made from other files."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    for script in sorted(NOTEBOOKS.glob("*.py")):
        for uri, content in notebook(script).items():
            files.append(File.generated(config, uri, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Convert links to files into links to pages; copy linked files that have no page."""
    if not page.file.abs_src_path:
        return markdown
    folder = Path(page.file.abs_src_path).parent
    pages = {ROOT / source: uri for source, uri in (PAGES | DESCRIBED).items()}
    pages |= {path: f"notebooks/{path.stem}.md" for path in NOTEBOOKS.glob("*.py")}
    pages |= {Path(file.abs_src_path): file.src_uri for file in files if file.abs_src_path}

    def turned(match: re.Match[str]) -> str:
        target = (folder / match[1]).resolve()
        if target not in pages:
            if not target.is_file() or not target.is_relative_to(ROOT):
                return match[0]  # the build reports it
            uri = f"files/{target.relative_to(ROOT)}"
            # as text, so that a browser displays it
            shown = uri + ".txt" if target.suffix in (".py", ".toml", ".md") else uri
            pages[target] = shown
            files.append(File.generated(config, shown, content=target.read_bytes()))
        return os.path.relpath(pages[target], Path(page.file.src_uri).parent)

    return _LINK.sub(turned, markdown)


def notebook(script: Path) -> dict[str, str | bytes]:
    """Return a notebook's page and its pictures; without outputs if it changed after its run."""
    book, run = jupytext.read(script), EXECUTED / f"{script.stem}.ipynb"
    note = "*Not run when this page was made: `make notebooks docs` shows its pictures and tables.*"
    if run.is_file():
        executed = nbformat.read(run, as_version=4)
        if [cell.source for cell in executed.cells] == [cell.source for cell in book.cells]:
            book, note = executed, ""
    text, resources = MarkdownExporter().from_notebook_node(
        book, {"unique_key": script.stem, "output_files_dir": "."}
    )
    text = re.sub(r"<style scoped>.*?</style>", "", text, flags=re.S)
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    heading, rest = text.lstrip().split("\n", 1)
    kept = f"files/analysis/notebooks/{script.name}.txt"
    outputs = {f"notebooks/{Path(name).name}": it for name, it in resources["outputs"].items()}
    page = f"{heading}\n\n[The script](../{kept}). {note}\n{rest}"
    return {f"notebooks/{script.stem}.md": page, kept: script.read_text(), **outputs}
