"""Held bodies and abrupt stops at the ends of trajectories; clean motions have none."""

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import End, History, trimmed, unmodelled_ends
from pbrl_ppl.scene import Body, Scene, Shape, Wall
from tests.helpers.histories import COLUMNS
from tests.helpers.kinks import MOTIONS, RATES, kinked
from tests.helpers.places import RECORDED, load

pytestmark = pytest.mark.one_stack


def falls(
    rate: int,
    *,
    held: int = 0,
    stopped: int = 0,
    rebound: float = 0.0,
    noise: float = 2e-3,
    n: int = 3,
    rows: int = 50,
    push: float = 0.0,
    floor: bool = False,
    velocities: bool = False,
) -> tuple[History, Scene]:
    """Balls in air (terminal velocity 6 m/s), held for some rows, stopped before the last ones.

    ``push`` (N) is commanded when the ball sets off; ``floor`` puts one where it stops.
    """  # fmt: skip
    rng, dt, table, height = np.random.default_rng(rate), 1.0 / rate, [], 0.0
    time = dt * np.arange(rows)
    fallen = np.maximum(time - held * dt, 0.0)
    y = -36.0 / 9.81 * np.log(np.cosh(9.81 * fallen / 6.0))
    v = -6.0 * np.tanh(9.81 * fallen / 6.0)
    if stopped:
        end = time[-1] - (stopped - 0.5) * dt
        height, speed = float(np.interp(end, time, y)), 0.0
        speed = -rebound * float(np.interp(end, time, v))
        after = time > end
        y = np.where(after, height + speed * (time - end), y)
        v = np.where(after, speed, v)
    for trajectory in range(n):
        seen = y + noise * rng.standard_normal(rows)
        rate_seen = v + 0.01 * rng.standard_normal(rows) if velocities else np.full(rows, np.nan)
        for i in range(rows):
            force = push if i >= held else 0.0
            wrench = [0.0, force, 0.0] if i < rows - 1 else [np.nan] * 3
            cells = [0.0, seen[i], 0.0, np.nan, rate_seen[i], np.nan]
            table.append([trajectory, i, time[i], "ball", *cells, *wrench])
    scene = Scene(
        gravity=(0.0, -9.81),
        time_step=dt,
        bodies=(Body("ball", Shape.circle(0.03)),),
        walls=(Wall((-9.0, height - 0.03), (9.0, height - 0.03)),) if floor else (),
    )
    frame = pd.DataFrame(table, columns=COLUMNS)
    return History.from_dataframe(frame, scene, estimate_velocities=True), scene


@pytest.mark.parametrize("velocities", [False, True])
@pytest.mark.parametrize(("rate", "held", "rows"), [(10, 5, 40), (30, 6, 44), (100, 20, 100)])
def test_a_held_ball(rate: int, held: int, rows: int, velocities: bool) -> None:
    history, scene = falls(rate, held=held, rows=rows, velocities=velocities)
    ends = unmodelled_ends(history, scene)
    assert [(end.trajectory, end.first, end.what) for end in ends] == [
        (trajectory, True, "held") for trajectory in range(3)
    ]
    assert all(held <= end.rows <= held + max(2, held // 5) for end in ends)
    kept = trimmed(history, ends)
    assert not unmodelled_ends(kept, scene)
    assert kept.n_transitions == history.n_transitions - sum(end.rows for end in ends)


@pytest.mark.parametrize("rebound", [0.0, 0.5])
@pytest.mark.parametrize("rate", [10, 30, 60])
def test_an_abrupt_stop(rate: int, rebound: float) -> None:
    history, scene = falls(rate, stopped=5, rebound=rebound, noise=5e-4)
    ends = unmodelled_ends(history, scene)
    assert [(end.trajectory, end.first, end.what) for end in ends] == [
        (trajectory, False, "stopped") for trajectory in range(3)
    ]
    assert all(5 <= end.rows <= 6 for end in ends)
    kept = trimmed(history, ends)
    assert not unmodelled_ends(kept, scene)
    assert kept.dataset["action"].isel(trajectory=0, time=-1).isnull().all()


def test_what_the_scene_or_a_command_explains() -> None:
    assert not unmodelled_ends(*falls(30, stopped=5, floor=True))
    # as if it lay on a table and was pushed off
    assert not unmodelled_ends(*falls(30, held=6, push=1.0))
    assert not unmodelled_ends(*falls(30))


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("name", sorted({*MOTIONS} - {"struck"}))
def test_clean_motions_have_none(name: str, rate: int) -> None:
    """A struck puck is left out: what strikes it is not in its scene."""
    for seed in range(2):
        for noise in (0.0, 2e-3, 1e-2):
            assert not unmodelled_ends(*kinked(name, rate, seed, noise=noise))


@pytest.mark.skipif(not RECORDED.is_dir(), reason="../shared/data is not beside the repository")
def test_clean_simulated_recordings_have_none() -> None:
    for folder in sorted(each.parent for each in RECORDED.glob("*/scene.toml")):
        scene, *histories = load(folder)
        for history in histories:
            assert not unmodelled_ends(history, scene)


def test_trimmed_is_as_recorded_without_the_rows() -> None:
    history, scene = falls(30)
    ends = [
        End(1, True, 4, 0.0, 0.1, "ball", "held"),
        End(2, False, 7, 1.4, 1.6, "ball", "stopped"),
    ]
    kept = trimmed(history, ends)
    table = history.to_dataframe()
    late = (table["trajectory"] == 1) & (table["step"] < 4)
    early = (table["trajectory"] == 2) & (table["step"] >= 43)
    expected = History.from_dataframe(
        table[~late & ~early].drop(columns="step"), scene, estimate_velocities=True
    )
    for name in ("observed", "action", "clock", "n_rows", "before"):
        assert kept.dataset[name].equals(expected.dataset[name])
    assert kept.data_sha256 == expected.data_sha256
    assert trimmed(history, []) is history
    with pytest.raises(HistoryError, match="trajectory 1 has 2 rows without its first 48"):
        trimmed(history, [End(1, True, 48, 0.0, 1.6, "ball", "held")])


def test_words() -> None:
    assert (
        str(End(3, False, 5, 1.2, 1.35, "ball", "stopped"))
        == "ball stops abruptly before the last 5 rows of trajectory 3 (t = 1.2 to 1.35 s)"
    )
