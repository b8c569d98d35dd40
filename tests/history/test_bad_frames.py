"""Single bad frames are marked; impacts, blows, stops and noise are not."""

import numpy as np
import pytest

from pbrl_ppl.history import History, bad_frames, without_bad_frames
from pbrl_ppl.state import STATE
from tests.helpers.kinks import MOTIONS, RATES, kinked
from tests.helpers.places import RECORDED, load

pytestmark = pytest.mark.one_stack


def changed(history: History, cells: dict[tuple[int, int, int], float]) -> History:
    """The history with something added to (trajectory, row, state) of the first body."""
    observed = history.dataset["observed"].to_numpy().copy()
    for (trajectory, row, d), off in cells.items():
        observed[trajectory, row, 0, d] += off
    return History(history.dataset.assign(observed=history.dataset["observed"].copy(data=observed)))


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("name", MOTIONS)
def test_kinks_are_no_bad_frames(name: str, rate: int) -> None:
    """About 15,000 measurements of each motion; of noise alone 1e-10 would be marked."""
    for seed in range(2):
        for noise in (0.0, 1e-4, 2e-3, 1e-2):
            for quantum in (0.0, 1e-3):
                history, _ = kinked(name, rate, seed, noise=noise, quantum=quantum)
                assert not bad_frames(history).any()


@pytest.mark.parametrize("rate", [30, 100, 500])
@pytest.mark.parametrize("name", MOTIONS)
def test_a_bad_frame_is_found_and_no_other(name: str, rate: int) -> None:
    """Of 0.31 m (rad), 150 times the noise: at least four of six, for it may hit an impact."""
    d, found = 2 if name == "swing" else 0, 0
    rng = np.random.default_rng(rate)
    for seed in range(6):
        history, _ = kinked(name, rate, seed, noise=2e-3)
        where = (int(rng.integers(4)), int(rng.integers(5, 35)), d)
        marked = bad_frames(changed(history, {where: 0.31}))
        hit = marked[where[0], where[1], 0, d]
        found += int(hit)
        assert marked.sum() == hit
    assert found >= 4


def test_two_neighbouring_rows_an_angle_beyond_a_half_turn_and_a_velocity() -> None:
    history, _ = kinked("swing", 100, 1, noise=2e-3)
    cells = {(0, 20, 2): 0.5, (0, 21, 2): 0.4, (1, 30, 2): 3.1, (2, 40, 5): 3.0}
    expected = np.zeros((4, 120, 1, len(STATE)), dtype=bool)
    for trajectory, row, d in cells:
        expected[trajectory, row, 0, d] = True
    assert np.array_equal(bad_frames(changed(history, cells)), expected)


def test_a_velocity_that_positions_confirm_is_none() -> None:
    """Two impacts in neighbouring intervals: a row's velocity is another, and the body moved on."""
    history, _ = kinked("struck", 10, 0)
    observed = history.dataset["observed"].to_numpy().copy()
    observed[..., 0], observed[..., 3] = 0.1 * np.arange(40)[None, :, None], 1.0
    observed[0, 20, 0, 3] = 3.0
    observed[0, 20:, 0, 0] += 0.1
    observed[0, 21:, 0, 0] += 0.1
    rng = np.random.default_rng(0)
    observed[..., [0, 3]] += rng.normal(0.0, (1e-3, 1e-2), (*observed.shape[:3], 2))
    data = history.dataset
    assert not bad_frames(History(data.assign(observed=data["observed"].copy(data=observed)))).any()


def test_bad_frames_go_missing_and_are_named() -> None:
    history, _ = kinked("dry friction", 100, 0, noise=2e-3)
    clean, frames = without_bad_frames(changed(history, {(2, 35, 0): 0.31}))
    assert [(each.trajectory, each.row, each.state) for each in frames] == [(2, 35, "x")]
    assert frames[0].off == pytest.approx(0.31, abs=0.02)
    words = "x of puck at t = 0.35 s of trajectory 2 is off by 0.31 m and left out (1 of 480 rows)"
    assert str(frames[0]).replace("0.32", "0.31").replace("0.3 m", "0.31 m") == words
    missing = ~np.isfinite(clean.dataset["observed"].to_numpy())
    assert np.argwhere(missing).tolist() == [[2, 35, 0, 0]]
    assert clean.data_sha256 == history.data_sha256
    same, none = without_bad_frames(history)
    assert same is history
    assert none == []


def test_start_has_nothing_that_was_computed_from_a_bad_frame() -> None:
    history, scene = kinked("dry friction", 100, 0, noise=2e-3)
    table = changed(history, {(2, 35, 0): 0.31}).to_dataframe()
    table[["vx", "vy", "omega"]] = np.nan
    history = History.from_dataframe(table, scene, estimate_velocities=True)
    clean, _ = without_bad_frames(history)
    start = clean.dataset["start"].to_numpy()[:, :, 0]
    assert np.argwhere(np.isnan(start[..., 3])).tolist() == [[2, i] for i in range(33, 38)]
    # the position itself is measured, and comes back by interpolation
    assert np.isfinite(start[..., :3]).all(axis=-1).sum() in (479, 480)


def test_many_are_heavy_tailed_noise_and_stay() -> None:
    history, _ = kinked("dry friction", 100, 0, noise=2e-3)
    rng = np.random.default_rng(0)
    cells = {
        (t, i, 0): 0.5 * float(rng.choice([-1, 1])) for t in range(4) for i in range(8, 112, 14)
    }
    with pytest.warns(UserWarning, match=r"x of puck: \d\.\d % .* heavy-tailed"):
        same, frames = without_bad_frames(changed(history, cells))
    assert frames == []
    assert np.isfinite(same.dataset["observed"]).all()


@pytest.mark.skipif(not RECORDED.is_dir(), reason="../shared/data is not beside the repository")
def test_clean_simulated_recordings_have_none() -> None:
    for folder in sorted(each.parent for each in RECORDED.glob("*/scene.toml")):
        _, train, test = load(folder)
        assert not bad_frames(train).any()
        assert not bad_frames(test).any()
