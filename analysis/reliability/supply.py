"""Supply: both ends of the bounds of dependencies, licences, an SBOM.

    python -m reliability.supply bounds lowest --python python3.11 --into /tmp/lowest
    python -m reliability.supply bounds highest --python python3.13 --into /tmp/highest
    python -m reliability.supply wheels 3.14        # whether all are to be had for it; runs nothing
    python -m reliability.supply licences           # a table of the installed dependencies
    python -m reliability.supply sbom out/sbom.json # CycloneDX 1.5, of the installed dependencies

``bounds`` resolves `pyproject.toml` with uv (``pip install uv``), direct dependencies at their
lowest or all at their newest release, installs them into a new environment, imports the package
without warnings and runs TESTS there. Each end is a line of ``out/reliability/supply.jsonl``.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import time
import uuid
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
OUT = Path("out/reliability")
TESTS = (
    "tests/test_public_names.py", "tests/model", "tests/posterior", "tests/history", "tests/cli",
)  # fmt: skip
MARKS = "not slow and not long"
COPYLEFT = re.compile(r"\b(A|L)?GPL|\bMPL|Mozilla|EUPL|CDDL|GNU", re.IGNORECASE)


def _uv(*argv: str) -> None:
    environment = os.environ | {"UV_PYTHON_DOWNLOADS": "never"}
    subprocess.run(["uv", *argv], check=True, cwd=ROOT, env=environment)


def bounds(end: str, python: str, into: Path) -> dict[str, object]:
    """Make an environment at one end of the bounds, and run the tests there."""
    resolution = {"lowest": "lowest-direct", "highest": "highest"}[end]
    listed = into.parent / f"{into.name}.txt"
    _uv("pip", "compile", "-q", "pyproject.toml", "--extra", "test", "--no-header", "--no-annotate",
        "--resolution", resolution, "--python", python, "-o", str(listed))  # fmt: skip
    if not (into / "bin" / "python").exists():
        _uv("venv", "-q", "--python", python, str(into))
    own = str(into / "bin" / "python")
    _uv("pip", "install", "-q", "--python", own, "-r", str(listed))
    paths = {"PYTHONPATH": f"{ROOT}:{ROOT / 'analysis'}", "NUMBA_CACHE_DIR": str(into / "numba"),
             "PYTHONPYCACHEPREFIX": str(into / "pyc")}  # fmt: skip
    begin = time.monotonic()
    argv = [own, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", MARKS, *TESTS]
    ran = subprocess.run(argv, cwd=ROOT, env=os.environ | paths, capture_output=True, text=True)
    lines = ran.stdout.splitlines()
    return {
        "end": end,
        "python": subprocess.run([own, "-V"], capture_output=True, text=True).stdout.split()[-1],
        "direct": [line for line in listed.read_text().splitlines() if _name(line) in direct()],
        "passed": ran.returncode == 0,
        "told": lines[-1] if lines else ran.stderr[-300:],
        "failed": [line for line in lines if line.startswith(("FAILED", "ERROR"))],
        "seconds": round(time.monotonic() - begin),
    }


def wheels(python: str) -> None:
    """Print the newest releases that have wheels for a Python, installed or not."""
    _uv("pip", "compile", "-q", "pyproject.toml", "--no-header", "--no-annotate", "--only-binary",
        ":all:", "--python-version", python)  # fmt: skip


def _name(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0].lower().replace("_", "-")


def direct() -> set[str]:
    """Return the names of the package's dependencies in pyproject.toml, extras aside."""
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return {_name(one) for one in project["dependencies"]}


def installed() -> Iterator[Distribution]:
    """Yield the distributions that the package needs, directly or not, by name."""
    found: dict[str, Distribution] = {}
    wanted = sorted(direct())
    while wanted:
        name = wanted.pop()
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue  # of another platform, or an optional one
        for text in found[name].requires or ():
            needed = Requirement(text)
            if needed.marker is None or needed.marker.evaluate({"extra": ""}):
                wanted.append(_name(needed.name))
    return iter(found[name] for name in sorted(found))


def licence(one: Distribution) -> str:
    """Return a distribution's licence: its SPDX expression, or what it says in its place."""
    meta = one.metadata
    if expression := meta.get("License-Expression"):
        return str(expression)
    classified = [
        line.rpartition(" :: ")[2]
        for line in meta.get_all("Classifier", [])
        if line.startswith("License ::") and not line.endswith("OSI Approved")
    ]
    text = str(meta.get("License") or "").strip()
    first = text.splitlines()[0] if text else ""
    return "; ".join(classified) or first[:60] or _heading(one) or "not stated"


def _heading(one: Distribution) -> str:
    """Return the first line of a distribution's licence file."""
    for path in one.files or ():
        if re.search(r"LICEN[CS]E|COPYING", path.name) and ".dist-info" in str(path):
            lines = (line.strip() for line in path.read_text().splitlines())
            return next((f"{line[:60].title()} (its licence file)" for line in lines if line), "")
    return ""


def licences() -> None:
    """Print a table of what is installed, with a mark at licences with copyleft."""
    needed, count = direct(), 0
    print("| package | version | licence | direct |\n|---|---|---|---|")
    for one in installed():
        told, name = licence(one), one.metadata["Name"]
        copyleft = bool(COPYLEFT.search(told))
        count += copyleft
        mark = "yes" if _name(name) in needed else ""
        print(f"| {name} | {one.version} | {told}{' (copyleft)' * copyleft} | {mark} |")
    print(f"\n{count} with copyleft")


def sbom(path: Path) -> None:
    """Write a software bill of materials of what is installed: CycloneDX 1.5, JSON."""
    from pbrl_ppl import __version__

    ids = {_name(one.metadata["Name"]): _purl(one) for one in installed()}
    own = f"pkg:pypi/pbrl-ppl@{__version__}"
    components, depends = [], [{"ref": own, "dependsOn": sorted(ids[one] for one in direct())}]
    for one in installed():
        expression = one.metadata.get("License-Expression")
        told = {"expression": expression} if expression else {"license": {"name": licence(one)}}
        components.append({
            "type": "library", "bom-ref": _purl(one), "purl": _purl(one),
            "name": one.metadata["Name"], "version": one.version, "licenses": [told],
        })  # fmt: skip
        needed = (Requirement(text) for text in one.requires or ())
        names = {
            _name(each.name)
            for each in needed
            if each.marker is None or each.marker.evaluate({"extra": ""})
        }
        refs = sorted(ids[name] for name in names if name in ids)
        depends.append({"ref": _purl(one), "dependsOn": refs})
    root = {"type": "library", "bom-ref": own, "purl": own, "name": "pbrl_ppl",
            "version": __version__, "licenses": [{"license": {"id": "MIT"}}]}  # fmt: skip
    bom = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.uuid4()}",
        "version": 1,
        "metadata": {"component": root},
        "components": components,
        "dependencies": depends,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(bom, indent=1) + "\n")
    print(f"{len(components)} components: {path}")


def _purl(one: Distribution) -> str:
    return f"pkg:pypi/{_name(one.metadata['Name'])}@{one.version}"


def main() -> None:
    """Run a part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parts = parser.add_subparsers(dest="part", required=True)
    ends = parts.add_parser("bounds")
    ends.add_argument("end", choices=["lowest", "highest"])
    ends.add_argument("--python", default="python3")
    ends.add_argument("--into", type=Path, required=True, help="folder of the environment")
    parts.add_parser("wheels").add_argument("python")
    parts.add_parser("licences")
    parts.add_parser("sbom").add_argument("path", type=Path)
    given = parser.parse_args()
    if given.part == "bounds":
        result = bounds(given.end, given.python, given.into.absolute())
        OUT.mkdir(parents=True, exist_ok=True)
        with (OUT / "supply.jsonl").open("a") as file:
            file.write(json.dumps(result) + "\n")
        print(*result["direct"], *result["failed"], result["told"], sep="\n")
    elif given.part == "wheels":
        wheels(given.python)
    elif given.part == "licences":
        licences()
    else:
        sbom(given.path)


if __name__ == "__main__":
    main()
