"""Wrong units are recognised by the factor between positions and velocities; gaps are found."""

import re

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.history import History, unit_mismatches, unseen
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import COLUMNS
from tests.helpers.pushes import SCENE, pushed, rows

pytestmark = pytest.mark.one_stack

DT = 0.05
PUCK = Scene(time_step=DT, bodies=(Body("puck", Shape.circle(0.2)),))
DEGREES = 180 / np.pi


def recorded(
    units=(1.0,) * 6, *, seed: int = 0, noise=(0.002, 0.01), n: int = 4, spin: float = 0.0
) -> History:
    """Pushed at random; each state's column multiplied by its unit, after noise in SI units."""
    rng = np.random.default_rng(seed)
    rows = []
    for trajectory in range(n):
        push = rng.normal(size=(30, 3)) * (2.0, 2.0, 8.0)
        v = np.cumsum(np.vstack([[*rng.normal(size=2), rng.normal() + spin], DT * push]), axis=0)
        p = np.cumsum(np.vstack([rng.normal(size=3), DT * v[:-1] + DT**2 / 2 * push]), axis=0)
        p = p + noise[0] * rng.normal(size=p.shape)
        p[:, 2] = np.angle(np.exp(1j * p[:, 2]))
        state = np.hstack([p, v + noise[1] * rng.normal(size=v.shape)]) * units
        for step, values in enumerate(state):
            wrench = [0.0] * 3 if step < len(p) - 1 else [np.nan] * 3
            rows.append([trajectory, step, step * DT, "puck", *values, *wrench])
    return History.from_dataframe(pd.DataFrame(rows, columns=COLUMNS), PUCK)


@pytest.mark.parametrize(
    ("column", "factor", "says"),
    [
        ("theta", DEGREES, "theta of puck changes 5[5-9].* times as fast as omega says: units? "
         "theta may be in deg; read it with --units theta=deg"),
        ("omega", DEGREES, "omega of puck is 5[5-9].* times the rate at which theta changes: "
         "units? omega may be in deg/s; read it with --units omega=deg/s"),
        ("omega", 30 / np.pi, "--units omega=rpm"),
        ("x", 1000.0, "x of puck changes (1e.03|9..|1.0.e.03) times as fast as vx says: units? "
         "x may be in mm; read it with --units x=mm"),
        ("vy", 1000.0, "--units vy=mm/s"),
        ("x", 9.81, "x of puck changes 9.* times as fast as vx says: units?$"),
        ("vx", 9.81, "vx of puck is 9.* times the rate at which x changes: units?$"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("noise", [(0.0, 0.0), (0.002, 0.01)])
def test_a_unit_is_recognised(column, factor, says, noise) -> None:
    units = [factor if name == column else 1.0 for name in COLUMNS[4:10]]
    (sentence,) = unit_mismatches(recorded(units, noise=noise))
    assert re.search(says.replace("?", r"\?"), sentence)


def test_the_cure_is_one(tmp_path) -> None:
    """Read as the sentence says, the recording agrees with itself."""
    degrees = recorded((1, 1, DEGREES, 1, 1, 1))
    assert len(unit_mismatches(degrees)) == 1
    frame = degrees.to_dataframe()
    assert unit_mismatches(History.from_dataframe(frame, PUCK, units={"theta": "deg"})) == ()


@pytest.mark.parametrize("seed", range(20))
def test_clean_recordings_say_nothing(seed) -> None:
    """Of noise from none to five times the velocities; some turn more than half round in a row."""
    noise = 10.0 ** np.random.default_rng(seed).uniform(-5, 0.7, size=2)
    spin = (0.0, 1.3 * np.pi / DT)[seed % 2]
    assert unit_mismatches(recorded(seed=seed, noise=noise, spin=spin)) == ()


@pytest.mark.parametrize("seed", range(10))
def test_velocities_that_are_noise_say_nothing(seed) -> None:
    history = recorded(seed=seed, noise=(0.001, 100.0))
    assert unit_mismatches(history) == ()
    at_rest = history.to_dataframe()
    for noise in (0.001, 0.0):  # none of a coarse sensor
        at_rest[["x", "y", "theta"]] = noise * np.random.default_rng(seed).normal(size=(124, 3))
        assert unit_mismatches(History.from_dataframe(at_rest, PUCK)) == ()


def test_latent_velocities_and_gaps_say_nothing_or_no_less() -> None:
    frame = recorded((1, 1, DEGREES, 1, 1, 1)).to_dataframe()
    gaps = frame.copy()
    gaps.loc[gaps.index % 7 == 3, ["theta", "omega"]] = np.nan
    assert len(unit_mismatches(History.from_dataframe(gaps, PUCK))) == 1
    latent = frame.assign(omega=np.nan)
    read = History.from_dataframe(latent, PUCK, estimate_velocities=True)
    assert unit_mismatches(read) == ()


def test_few_rows_say_nothing() -> None:
    frame = recorded((1, 1, DEGREES, 1, 1, 1), n=1).to_dataframe()
    frame = frame[frame["step"] < 5]
    assert unit_mismatches(History.from_dataframe(frame, PUCK)) == ()


def test_a_block_that_was_seen_before_and_after_a_push() -> None:
    _, history = pushed(steps=(4, 6))
    hidden = np.zeros((2, 6, 2), dtype=bool)
    hidden[0, 1:3, 0] = hidden[1, 1:5, 0] = True  # the block; the finger's path is given
    np.testing.assert_array_equal(unseen(history), hidden)
    assert history.longest_gap == 5


def test_rows_that_are_lost_now_and_then_do_not_make_a_recording_sparse() -> None:
    table = rows(steps=(30,))
    state = ["x", "y", "theta", "vx", "vy", "omega"]
    seen = (table["body"] == "finger") | ~table["step"].between(10, 16)
    finger = table.loc[table["body"] == "finger", state].to_numpy()
    table.loc[table["body"] == "block", state] = np.nan_to_num(finger)
    table.loc[~seen, state] = np.nan
    history = History.from_dataframe(table, SCENE)
    assert unseen(history).sum() == 7
    assert history.longest_gap == 1
