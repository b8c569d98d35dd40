"""The distribution: its version, its source archive, the installed package outside the clone."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from reliability import supply

import pbrl_ppl
from tests.helpers.places import ROOT

PARTS = ("pbrl_ppl", "models", "pyproject.toml", "setup.py", "README.md", "LICENSE")


def run(*argv: str, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        argv, cwd=cwd, env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def makes_wheels() -> bool:
    """Return whether setuptools builds wheels without the wheel package (70.1 and later)."""
    try:
        major, minor = version("setuptools").split(".")[:2]
    except PackageNotFoundError:
        return False
    return (int(major), int(minor)) >= (70, 1)


@pytest.fixture(scope="module")
def files() -> list[str]:
    """Return the files of the clone that belong to the package, without ignored ones."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PARTS]
    try:
        return run(*listing, cwd=ROOT).split()
    except (OSError, AssertionError):
        pytest.skip("no git repository says which files belong to the package")


def test_the_citation_has_the_version_of_the_package() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (.*)$", citation, re.M) == [pbrl_ppl.__version__]


def test_the_citation_is_valid() -> None:
    """It has the fields that the Citation File Format 1.2.0 requires."""
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["cff-version"] == "1.2.0" and citation["type"] in ("software", "dataset")
    assert str(citation["version"]) == pbrl_ppl.__version__
    for each in (citation, *citation["references"]):
        assert each["title"] and all({"name", "family-names"} & set(who) for who in each["authors"])


def test_readme_lists_the_extras() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (said,) = re.findall(r"^Extras, as in.*?\n\n", (ROOT / "README.md").read_text(), re.M | re.S)
    named = set(re.findall(r"`(\w+)`", said))
    assert named == set(project["optional-dependencies"])


@pytest.mark.slow
def test_the_package_runs_after_an_install_from_its_source_archive(
    files: list[str], tmp_path: Path
) -> None:
    """No network access: setuptools and the dependencies come from the environment."""
    if not makes_wheels():
        pytest.skip("setuptools is missing or old: pip install -e '.[test]'")
    source, library, elsewhere = (tmp_path / name for name in ("source", "library", "elsewhere"))
    elsewhere.mkdir()
    for name in files:
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    build = "from setuptools import build_meta; build_meta.build_sdist('dist')"
    run(sys.executable, "-c", build, cwd=source)
    (archive,) = (source / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        inside = {name.partition("/")[2] for name in packed.getnames()}
    assert {name for name in files if (ROOT / name).is_file()} <= inside
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-index", "--no-build-isolation", "--no-compile"]
    run(*pip, *options, "--target", str(library), str(archive), cwd=elsewhere)
    borrow_compiled(library / "pbrl_ppl" / "physics")

    path = {"PYTHONPATH": str(library), "PYTHONDONTWRITEBYTECODE": "1"}
    rooms = [each.parent.name for each in (ROOT / "pbrl_ppl").glob("*/__init__.py")]
    code = f"import sys, {', '.join(f'pbrl_ppl.{room}' for room in sorted(rooms))}"
    code += "; sys.exit(pbrl_ppl.cli.main(['--version', '-v']))"
    found = run(sys.executable, "-c", code, cwd=elsewhere, **path)
    assert str(library / "pbrl_ppl") in found and "compiled, works" in found
    first, *others = sorted(each.parent.name for each in (ROOT / "models").glob("*/scene.toml"))
    command = str(library / "bin" / "pbrl-ppl")
    run(command, "new", f"{first}.toml", "--from", first, cwd=elsewhere, **path)
    # the other models in one process, to save seconds
    codes = "[main(['new', f'{m}.toml', '--from', m, '--overwrite']) for m in sys.argv[1:]]"
    code = f"import sys; from pbrl_ppl.cli import main; sys.exit(max({codes}))"
    run(sys.executable, "-c", code, *others, cwd=elsewhere, **path)
    assert (elsewhere / "train.csv").is_file()
    kept = {path.relative_to(library / "pbrl_ppl") for path in library.rglob("models/**/*")}
    assert {Path(name) for name in files if name.startswith("models/")} <= kept
    assert (library / "pbrl_ppl" / "py.typed").is_file()
    (metadata,) = library.glob("pbrl_ppl-*.dist-info/METADATA")
    assert f"\nVersion: {pbrl_ppl.__version__}\n" in metadata.read_text()


def borrow_compiled(physics: Path) -> None:
    """Copy this clone's compiled engine loop to the installed package, to save minutes.

    Numba accepts it because the source files have the same size and time.
    """
    for source in (ROOT / "pbrl_ppl" / "physics").glob("*.py"):
        shutil.copystat(source, physics / source.name)
    for made in (ROOT / "pbrl_ppl" / "physics" / "__pycache__").glob("*.nb?"):
        (physics / "__pycache__").mkdir(exist_ok=True)
        shutil.copy(made, physics / "__pycache__")


def test_the_docs_list_the_dependencies_with_their_bounds() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    page = ROOT / "analysis" / "docs" / "pages" / "explanation" / "dependencies.md"
    said = re.findall(r"^\| ([\w-]+) \| ([\d.]+) \|", page.read_text(), re.M)
    bounds = [re.match(r"([\w-]+)>=([\d.]+)", one) for one in project["dependencies"]]
    assert said == [one.groups() for one in bounds if one]


def test_no_dependency_has_copyleft_but_those_that_the_docs_name() -> None:
    """PyTensor 2 needs etuples, which needs cons."""
    told = {one.metadata["Name"]: supply.licence(one) for one in supply.installed()}
    assert {"numpy", "pymc", "cffi"} <= set(told)
    assert {name for name, text in told.items() if supply.COPYLEFT.search(text)} <= {"cons"}
    assert "not stated" not in told.values()


def test_the_bill_of_materials_is_closed(tmp_path: Path) -> None:
    supply.sbom(tmp_path / "sbom.json")
    bom = json.loads((tmp_path / "sbom.json").read_text())
    refs = [bom["metadata"]["component"]["bom-ref"], *(one["bom-ref"] for one in bom["components"])]
    assert len(set(refs)) == len(refs) > 30
    assert [one["ref"] for one in bom["dependencies"]] == refs
    needed = {ref for one in bom["dependencies"] for ref in one["dependsOn"]}
    assert needed == set(refs[1:])
