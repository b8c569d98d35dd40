"""Files that are damaged, hostile or no files: an error that says so, at once."""

import os
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from pbrl_ppl.errors import GoalError, HistoryError, PbrlError, PosteriorError, SceneError
from pbrl_ppl.history import History
from pbrl_ppl.planning import Goal
from pbrl_ppl.posterior import load_posterior, save_posterior
from pbrl_ppl.posterior.store import from_groups
from pbrl_ppl.scene import Scene
from pbrl_ppl.system.files import is_as_sealed, seal
from tests.helpers.puck import SCENE

pytestmark = pytest.mark.one_stack


def posterior(path):
    """Write a posterior file, and return its path."""
    import xarray as xr

    names = ("posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data")
    draws = xr.Dataset({"mass": (("chain", "draw"), np.ones((1, 50)))})
    save_posterior(
        from_groups(dict.fromkeys(names, draws), {"pbrl_ppl": "posterior", "schema": 2}), path
    )
    return path


@pytest.fixture
def history(tmp_path):
    """Return a recording as NetCDF, and its scene."""
    scene = Scene.from_toml(SCENE)
    states = np.random.default_rng(1).normal(size=(2, 20, 1, 6))
    path = tmp_path / "log.nc"
    History.of_arrays(states, scene).save(path)
    return path, scene


def test_a_seal_is_of_every_byte(tmp_path) -> None:
    """It is the hash of all before it; what was never sealed has none."""
    path = tmp_path / "a"
    path.write_bytes(os.urandom(3_000_000))
    assert is_as_sealed(path) is None
    seal(path)
    content = path.read_bytes()
    assert is_as_sealed(path) is True
    for place in (0, 1_500_000, 2_999_999):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert is_as_sealed(path) is False
    path.write_bytes(content[1:])
    assert is_as_sealed(path) is False
    path.write_bytes(b"")
    assert is_as_sealed(path) is None


def test_a_turned_bit_is_refused_before_hdf5_reads_it(tmp_path, history) -> None:
    """In every 97th byte of a posterior and of a recording."""
    log, scene = history
    read_log = partial(History.load, scene=scene)
    for path, read in {posterior(tmp_path / "a.nc"): load_posterior, log: read_log}.items():
        content = path.read_bytes()
        for place in range(0, len(content) - 81, 97):
            path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
            with pytest.raises((PosteriorError, HistoryError), match="damaged"):
                read(path)


def test_another_programs_change_of_a_posterior_is_refused(tmp_path) -> None:
    """A file of an earlier version has no seal, and is read."""
    path = posterior(tmp_path / "a.nc")
    with h5py.File(path, "a") as file:
        file["posterior/mass"][0, 0] = 2.0
    with pytest.raises(PosteriorError, match="another program changed it"):
        load_posterior(path)
    with h5py.File(path, "a") as file:
        del file.attrs["sealed"]
    assert "sealed" not in load_posterior(path).attrs


@pytest.mark.parametrize("written", [False, True])
def test_arrays_beyond_memory_are_refused_unread(tmp_path, history, written) -> None:
    """Declared and never written, or packed from zeros: a few kilobytes on the disk."""
    log, scene = history
    path = posterior(tmp_path / "a.nc")
    read_log = partial(History.load, scene=scene)
    for file, group, read in ((path, "posterior", load_posterior), (log, "/", read_log)):
        with h5py.File(file, "a") as stored:
            made = stored[group].create_dataset(
                "bomb", (10**10,), "f8", chunks=(10**6,), compression="gzip"
            )
            if written:
                made[: 10**6] = 0.0
        with pytest.raises((PosteriorError, HistoryError)):
            read(file)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "loop"])
def test_what_is_no_file_is_refused_at_once(tmp_path, kind) -> None:
    """A pipe waited for ever, and /dev/zero has no end."""
    make = {
        "pipe": os.mkfifo, "device": partial(Path.symlink_to, target="/dev/zero"),
        "folder": Path.mkdir, "loop": lambda path: path.symlink_to(path),
    }  # fmt: skip
    read_log = partial(History.load, scene=Scene.from_toml(SCENE))
    for suffix, read in {
        ".toml": Scene.load, ".csv": read_log, ".nc": load_posterior, ".goal": Goal.load,
        ".parquet": read_log, ".txt": read_log, ".mcap": read_log,
    }.items():  # fmt: skip
        path = tmp_path / f"a{suffix}"
        make[kind](path)
        with pytest.raises(PbrlError) as error:
            read(path)
        assert "Errno" not in str(error.value)


@pytest.mark.parametrize("value", ["[" * 50_000, "{a = " * 50_000, "9" * 5000])
def test_toml_that_python_cannot_hold(tmp_path, value) -> None:
    """Its errors were Python's own: of recursion, and of digits."""
    (tmp_path / "a.toml").write_text(f"a = {value}")
    with pytest.raises(SceneError, match=r"a\.toml"):
        Scene.load(tmp_path / "a.toml")
    with pytest.raises(GoalError, match=r"a\.toml"):
        Goal.load(tmp_path / "a.toml")
