"""Files: what a process that is killed leaves, and what stands in the way of the next one."""

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import xarray as xr

from pbrl_ppl.criticism import Loop, results
from pbrl_ppl.errors import OutputError
from pbrl_ppl.system import files
from pbrl_ppl.system.files import check_folder, check_survives, write_atomically, write_text

pytestmark = pytest.mark.one_stack


def killed_in(action) -> None:
    """Call a function in a fork of this process, which ends by SIGKILL."""
    child = os.fork()
    if not child:
        action()
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def kill(*_: object) -> None:
    """Kill this process."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_write_leaves_the_earlier_file(tmp_path) -> None:
    """A folder in which only its temporary file is counts as empty, and an hour later it goes."""
    results = tmp_path / "results"
    results.mkdir()
    killed_in(lambda: write_atomically(results / "a.txt", kill))
    (left,) = results.iterdir()
    check_folder(results, overwrite=False)
    write_text(results / "a.txt", "whole")
    killed_in(lambda: write_atomically(results / "a.txt", kill))
    assert (results / "a.txt").read_text() == "whole"
    assert len(list(results.iterdir())) == 3, "another process may still write"
    with pytest.raises(OutputError, match="not empty"):
        check_folder(results, overwrite=False)
    long_ago = time.time() - 4000
    os.utime(left, (long_ago, long_ago))
    write_text(results / "a.txt", "new")
    assert left not in list(results.iterdir())


@pytest.mark.parametrize("renamed", range(6))
def test_a_report_json_has_its_own_posteriors(tmp_path, monkeypatch, renamed) -> None:
    """A kill between two renames leaves no report.json: it never names another run's files."""
    names = {"report.html", "report.json", "before.nc", "after.nc"}

    def save(content: str, overwrite: bool = False) -> None:
        loop = object.__new__(Loop)
        for name in ("declared", "revised"):
            fit = SimpleNamespace(posterior=content)
            object.__setattr__(loop, name, SimpleNamespace(fit=fit))
        monkeypatch.setattr(Loop, "to_dict", lambda self: content)
        monkeypatch.setattr(results, "save_posterior", lambda text, path: path.write_text(text))
        loop.save(tmp_path / "out", overwrite, page=content)

    save("old")
    replace, count = Path.replace, []

    def counted(path: Path, target: Path) -> None:
        if len(count) == renamed:
            kill()
        count.append(target)
        replace(path, target)

    def save_and_die() -> None:
        monkeypatch.setattr(Path, "replace", counted)
        save("new", overwrite=True)
        kill()

    killed_in(save_and_die)
    there = {path.name: path.read_text() for path in (tmp_path / "out").glob("[!.]*")}
    assert there.keys() >= names - {"report.json"}
    if "report.json" in there:
        assert renamed >= 4
        assert set(there) == names
        assert {text.strip().strip('"') for text in there.values()} == {"new"}


@pytest.mark.parametrize(
    ("code", "said"),
    [("while True: pass", "over 1 s"), ("import os; os.abort()", "damaged"), ("1 / 0", "")],
)
def test_a_file_that_ends_its_reader_or_never_ends_is_refused(tmp_path, code, said) -> None:
    """An error of Python is left to who reads the file after this."""
    path = tmp_path / "file"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=said) if said else nullcontext():
        check_survives(path, code, start=1.0)


def test_an_unsealed_file_is_read_apart_first(tmp_path, monkeypatch) -> None:
    path, seen = tmp_path / "other.nc", []
    monkeypatch.setattr(files, "check_survives", lambda path, code: seen.append((path, code)))
    xr.Dataset({"a": ("x", [1.0, 2.0])}).to_netcdf(path, engine="h5netcdf")
    files.check_hdf5(path)
    ((read, code),) = seen
    assert subprocess.run([sys.executable, "-c", code, str(read)], check=True).returncode == 0
    files.seal(path)
    files.check_hdf5(path)
    assert len(seen) == 1
