"""Histories: files there and back, completed starts, segments, and every rule."""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pbrl_ppl.errors import HistoryError, OutputError
from pbrl_ppl.history import History, check_start
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE, WRENCH
from tests.helpers.places import RECORDED

pytestmark = pytest.mark.one_stack

needs_data = pytest.mark.skipif(
    not RECORDED.is_dir(), reason="../shared/data is not beside the repository"
)

BOX = Shape.box(0.2, 0.4)
CART = Scene(time_step=0.1, bodies=(Body("cart", BOX),))
PAIR = Scene(time_step=0.1, bodies=(Body("chair", BOX), Body("desk", BOX)))


def table(
    scene: Scene = CART, steps: tuple[int, ...] = (4, 3), seed: int = 0, first_step: int = 0
) -> pd.DataFrame:
    """Return random rows: trajectories of these many steps."""
    rng = np.random.default_rng(seed)
    rows = []
    for trajectory, n in enumerate(steps):
        for step in range(n):
            for body in scene.dynamic:
                wrench = rng.normal(size=3) if step < n - 1 else [math.nan] * 3
                cells = [trajectory, first_step + step, 5 + step * scene.time_step, body.name]
                rows.append([*cells, *rng.normal(size=6), *wrench])
    return pd.DataFrame(rows, columns=["trajectory", "step", "time", "body", *STATE, *WRENCH])


def test_arrays_hold_the_rows() -> None:
    frame = table(PAIR)
    dataset = History.from_dataframe(frame, PAIR).dataset
    assert dataset["observed"].dims == ("trajectory", "time", "body", "state")
    assert dataset["observed"].shape == (2, 4, 2, 6)
    assert dataset["action"].dims == ("trajectory", "time", "body", "wrench")
    assert dataset["n_rows"].values.tolist() == [4, 3]
    desk = frame[(frame["trajectory"] == 1) & (frame["body"] == "desk")]
    labelled = dataset.sel(trajectory=1, body="desk")
    np.testing.assert_array_equal(labelled["observed"][:3], desk[list(STATE)])
    np.testing.assert_array_equal(labelled["action"][:2], desk[list(WRENCH)][:2])
    assert labelled["action"][2:].isnull().all()
    assert labelled["observed"][3].isnull().all()
    np.testing.assert_array_equal(dataset["clock"][1, :3], desk["time"])
    assert dataset["observed"].attrs["units"] == "m, m, rad, m/s, m/s, rad/s"
    assert dataset.attrs["time_step"] == 0.1


@needs_data
def test_all_the_data_loads() -> None:
    paths = sorted(RECORDED.rglob("*.csv"))
    assert paths
    for path in paths:
        scene = Scene.load(path.parent / "scene.toml")
        history = History.load(path, scene)
        frame = pd.read_csv(path)
        n = len(frame) // len(scene.dynamic) - frame["trajectory"].nunique()
        assert history.n_transitions == n
        assert history.segments().n == n
        again = History.from_dataframe(history.to_dataframe(), scene)
        assert again.data_sha256 == history.data_sha256


label = st.text("abcXYZ é_-.07", min_size=1, max_size=5).map(str.strip).filter(bool)
labels = st.one_of(
    st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=4, unique=True),
    st.lists(label, min_size=1, max_size=4, unique=True),
)
cell = st.floats(-1e9, 1e9) | st.just(float("nan"))


@st.composite
def tables(draw: st.DrawFn) -> pd.DataFrame:
    names = draw(labels)
    steps = tuple(draw(st.integers(2, 4)) for _ in names)
    frame = table(PAIR, steps, draw(st.integers(0, 99)), draw(st.integers(-3, 3)))
    frame["trajectory"] = [names[i] for i in frame["trajectory"]]
    # Not row 0: a history needs one state to start from.
    for row in draw(st.lists(st.integers(2, len(frame) - 1), max_size=5)):
        frame.loc[row, draw(st.sampled_from(STATE))] = draw(cell)
    return frame


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tables())
def test_files_round_trip(tmp_path: Path, frame: pd.DataFrame) -> None:
    history = History.from_dataframe(frame, PAIR)
    for suffix in (".csv", ".parquet", ".nc"):
        path = tmp_path / f"history{suffix}"
        history.save(path)
        again = History.load(path, PAIR)
        assert again.dataset.identical(history.dataset)
        assert again.data_sha256 == history.data_sha256


def test_hash_is_of_the_data_alone() -> None:
    frame = table(PAIR)
    history = History.from_dataframe(frame, PAIR)
    # Neither the order of columns, nor that of bodies in a step, nor the count of steps matters.
    order = [i + 1 - 2 * (i % 2) for i in range(len(frame))]
    other = frame.iloc[order, ::-1].drop(columns="step")
    assert History.from_dataframe(other, PAIR).data_sha256 == history.data_sha256
    frame.loc[3, "x"] += 1e-12
    assert History.from_dataframe(frame, PAIR).data_sha256 != history.data_sha256


@pytest.mark.parametrize("kind", ["object", "string", "category", "int64[pyarrow]", "Float64"])
def test_kinds_of_columns(kind: str) -> None:
    frame = table()
    expected = History.from_dataframe(frame, CART)
    frame["trajectory"] = frame["trajectory"].astype("str" if kind == "category" else kind)
    if kind == "Float64":
        frame["force_x"] = frame["force_x"].astype(kind)
    elif kind != "int64[pyarrow]":
        frame["body"] = frame["body"].astype(kind)
    got = History.from_dataframe(frame, CART)
    assert got.dataset.identical(expected.dataset)


def test_interleaved_trajectories_and_index_columns() -> None:
    frame = table()
    expected = History.from_dataframe(frame, CART).data_sha256
    mixed = frame.sort_values("time", kind="stable")
    assert History.from_dataframe(mixed, CART).data_sha256 == expected
    indexed = frame.set_index(["trajectory", "step"])
    assert History.from_dataframe(indexed, CART).data_sha256 == expected


def test_csv_dialects(tmp_path: Path) -> None:
    expected = History.from_dataframe(table(), CART).data_sha256
    text = table().to_csv(index=False)
    path = tmp_path / "history.csv"
    for variant in (
        "\ufeff" + text,
        text.replace("\n", "\r\n"),
        text.replace(",", ", "),
        text.replace("cart", '"cart"'),
        text.replace("\n", "\n\n").replace("\n\n", "\n", 1),
        text.replace(",,", ",nan,"),
    ):
        path.write_bytes(variant.encode())
        assert History.load(path, CART).data_sha256 == expected
    path.rename(tmp_path / "history.CSV")
    assert History.load(str(tmp_path / "history.CSV"), CART).data_sha256 == expected


def test_body_may_be_called_null(tmp_path: Path) -> None:
    scene = Scene(time_step=0.1, bodies=(Body("null", BOX), Body("NA", BOX)))
    history = History.from_dataframe(table(scene), scene)
    history.save(tmp_path / "history.csv")
    assert History.load(tmp_path / "history.csv", scene).bodies == ("null", "NA")


def test_saving_is_atomic(tmp_path: Path) -> None:
    history = History.from_dataframe(table(), CART)
    path = tmp_path / "history.csv"
    path.write_text("old")
    history.save(path)
    assert history.save(path) is None
    assert [p.name for p in tmp_path.iterdir()] == ["history.csv"]
    for bad in (tmp_path / "none" / "h.csv", path / "h.nc", tmp_path / "no" / "h.parquet"):
        with pytest.raises(OutputError, match="cannot be written"):
            history.save(bad)
    with pytest.raises(OutputError, match=r"suffix is '.txt'"):
        history.save(tmp_path / "history.txt")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(OutputError):
        history.save(tmp_path / "folder.csv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder.csv", "history.csv"]


def test_segments_do_not_overlap() -> None:
    frame = table(PAIR, steps=(6, 4, 3))
    segments = History.from_dataframe(frame, PAIR).segments(2)
    assert (segments.n, segments.horizon) == (4, 2)
    assert segments.trajectory.tolist() == [0, 0, 1, 2]
    assert segments.step.tolist() == [0, 2, 0, 0]
    assert segments.start.shape == (4, 2, 6)
    assert segments.actions.shape == (4, 2, 2, 3)
    assert segments.observed.shape == (4, 2, 2, 6)
    rows = frame[frame["trajectory"] == 0].set_index(["step", "body"])
    np.testing.assert_array_equal(segments.start[1, 1], rows.loc[(2, "desk"), list(STATE)])
    np.testing.assert_array_equal(segments.actions[1, 1, 0], rows.loc[(3, "chair"), list(WRENCH)])
    np.testing.assert_array_equal(segments.observed[1, 1, 0], rows.loc[(4, "chair"), list(STATE)])


def test_segments_with_incomplete_start_are_dropped() -> None:
    frame = table()
    frame.loc[1, "vx"] = math.nan
    segments = History.from_dataframe(frame, CART).segments()
    assert segments.step.tolist() == [0, 2, 0, 1]
    assert np.isnan(segments.observed[0, 0, 0, 3])
    assert not np.isnan(segments.start).any()


def test_trajectories_shorter_than_the_horizon_end_early() -> None:
    frame = table(PAIR, steps=(3, 5, 4))
    history = History.from_dataframe(frame, PAIR)
    segments = history.segments(4)
    assert segments.trajectory.tolist() == [0, 1, 2]
    assert segments.step.tolist() == [0, 0, 0]
    assert np.isfinite(segments.observed).all(axis=(2, 3)).sum(axis=1).tolist() == [2, 4, 3]
    np.testing.assert_array_equal(segments.actions[0, 2:], 0.0)
    np.testing.assert_array_equal(segments.observed[0, :2], history.segments(2).observed[0])
    assert history.segments(9).horizon == 9


def test_segments_start_at_the_first_complete_state() -> None:
    frame = table(steps=(7,))
    frame.loc[[0, 3, 4], "x"] = math.nan
    assert History.from_dataframe(frame, CART).segments(2).step.tolist() == [1]
    frame.loc[4, "x"] = 0.0
    assert History.from_dataframe(frame, CART).segments(2).step.tolist() == [1, 4]


def test_no_piece_goes_through_a_break() -> None:
    history = History.from_dataframe(table(steps=(7, 4)), CART)
    data = history.dataset
    states = np.nan_to_num(data["start"].to_numpy())
    whole = history.pieces(states, 2)
    n = int(data["n_rows"].max()) - 1
    breaks = np.zeros((history.n_trajectories, n), dtype=bool)
    none = history.pieces(states, 2, breaks)
    np.testing.assert_array_equal(none.observed, whole.observed)
    breaks[0, 2] = True
    cut = history.pieces(states, 2, breaks)
    first = cut.trajectory == 0
    rows = cut.step[first][:, None] + np.arange(2)
    seen = np.isfinite(cut.observed[first]).any(axis=(2, 3))
    assert 2 not in rows[seen]
    assert {0, 1, 3, 4} <= set(rows[seen].tolist())


def test_split_and_select() -> None:
    history = History.from_dataframe(table(steps=(3, 4, 2, 5, 3)), CART)
    train, test = history.split(0.4, seed=3)
    assert (train.n_trajectories, test.n_trajectories) == (3, 2)
    both = [*train.dataset["trajectory"].values, *test.dataset["trajectory"].values]
    assert sorted(both) == [0, 1, 2, 3, 4]
    assert train.n_transitions + test.n_transitions == history.n_transitions
    again, _ = history.split(0.4, seed=3)
    assert again.data_sha256 == train.data_sha256
    assert len({history.split(0.4, seed=s)[0].data_sha256 for s in range(8)}) > 1
    assert [h.n_trajectories for h in history.split(0.01)] == [4, 1]
    chosen = history.select([2, 0])
    assert chosen.dataset["trajectory"].values.tolist() == [2, 0]
    assert chosen.dataset.sizes["time"] == 3
    assert chosen.data_sha256 == History.from_dataframe(chosen.to_dataframe(), CART).data_sha256
    assert "2 trajectories, 3 transitions" in repr(chosen)


def test_bad_requests() -> None:
    history = History.from_dataframe(table(), CART)
    for horizon in (0, True, 1.5):
        with pytest.raises(HistoryError, match="expected a whole number"):
            history.segments(horizon)
    with pytest.raises(HistoryError, match="cannot be split"):
        history.select([0]).split()
    with pytest.raises(HistoryError, match="between 0 and 1"):
        history.split(1.0)
    for positions in ([2], [], [-1]):
        with pytest.raises(HistoryError, match="expected some of 0 to 1"):
            history.select(positions)
    with pytest.raises(HistoryError, match="each once"):
        history.select([0, 0])


# Starts -----------------------------------------------------------------------------------------

ARM = Scene(
    time_step=0.1,
    bodies=(Body("arm", BOX),),
    joints=(Joint("hinge", ("arm", "world"), (0.1, 0.3), (1.0, 2.0)),),
)


def turned(
    angle: npt.NDArray[np.float64], point: tuple[float, float]
) -> npt.NDArray[np.complex128]:
    """Return a body's point turned by an angle, as a complex number."""
    return np.exp(1j * angle) * complex(*point)


def blank(frame: pd.DataFrame, *columns: str) -> pd.DataFrame:
    frame[list(columns)] = math.nan
    return frame


def test_hinge_to_the_world_gives_the_start() -> None:
    frame = blank(table(ARM), "x", "y", "vx", "vy")
    frame.loc[1, ["x", "vy"]] = [7.0, 8.0]
    dataset = History.from_dataframe(frame, ARM).dataset
    start = dataset["start"].values[0, :, 0]
    lever = turned(start[:, 2], (0.1, 0.3))
    place, speed = complex(1, 2) - lever, -1j * start[:, 5] * lever
    expected = np.stack(
        [place.real, place.imag, start[:, 2], speed.real, speed.imag, start[:, 5]], axis=1
    )
    expected[1, 0], expected[1, 4] = 7.0, 8.0  # what was measured is kept
    np.testing.assert_allclose(start, expected, atol=1e-12)
    assert dataset["observed"].sel(state="x").isnull().sum() == 7


@pytest.mark.parametrize("turn", [False, True])
def test_chain_of_hinges_gives_the_start(turn: bool) -> None:
    names, upper, lower, foot = ("lower", "upper", "foot"), (0.0, -0.2), (0.1, 0.15), (0.05, -0.1)
    joints = [
        Joint("hinge", ("lower", "upper"), lower, upper),
        Joint("hinge", ("foot", "lower"), (0.0, 0.1), foot),
        Joint("hinge", ("world", "upper"), (1.0, 2.0), (0.0, 0.2)),
    ]
    if turn:
        joints = [Joint("hinge", j.bodies[::-1], j.anchor_b, j.anchor_a) for j in reversed(joints)]
    scene = Scene(time_step=0.1, bodies=tuple(Body(n, BOX) for n in names), joints=tuple(joints))
    frame = blank(table(scene), "x", "y", "vx", "vy")
    start = History.from_dataframe(frame, scene).dataset["start"].values[1, :3]
    angle, rate = start[:, :, 2].T, start[:, :, 5].T
    # Down the chain, each body's origin is the pivot above less its own lever.
    place = [complex(1, 2) - turned(angle[1], (0, 0.2))]
    speed = [-1j * rate[1] * turned(angle[1], (0, 0.2))]
    for above, below, holds, held in ((1, 0, upper, lower), (0, 2, foot, (0.0, 0.1))):
        lever, own = turned(angle[above], holds), turned(angle[below], held)
        place.append(place[-1] + lever - own)
        speed.append(speed[-1] + 1j * rate[above] * lever - 1j * rate[below] * own)
    for body, p, v in zip((1, 0, 2), place, speed, strict=True):
        expected = np.stack([p.real, p.imag, v.real, v.imag], axis=1)
        np.testing.assert_allclose(start[:, body][:, [0, 1, 3, 4]], expected, atol=1e-12)


def test_hinge_to_a_static_or_a_measured_body() -> None:
    post = Body("post", BOX, static=True, pose=(1.0, 0.0, math.pi / 2))
    hinge = Joint("hinge", ("post", "arm"), (0.5, 0.0), (0.0, 0.25))
    scene = Scene(time_step=0.1, bodies=(post, Body("arm", BOX)), joints=(hinge,))
    frame = blank(table(scene), "x", "y", "vx", "vy")
    frame[["theta", "omega"]] = [0.0, 2.0]
    start = History.from_dataframe(frame, scene).dataset["start"].values[0, 0, 0]
    np.testing.assert_allclose(start, [1.0, 0.25, 0.0, 0.5, 0.0, 2.0], atol=1e-12)
    free = Scene(
        time_step=0.1,
        bodies=PAIR.bodies,
        joints=(Joint("hinge", ("desk", "chair"), (0.0, 0.0), (0.0, 0.0)),),
    )
    frame = table(PAIR)
    frame.loc[frame["body"] == "desk", ["x", "y", "vx", "vy"]] = math.nan
    start = History.from_dataframe(frame, free).dataset["start"].values
    np.testing.assert_allclose(start[0, :, 1, :2], start[0, :, 0, :2])


def test_unknown_hinges_fill_nothing() -> None:
    hinge = Joint("hinge", ("arm", "world"), (0, 0), (0, 0), known=False)
    scene = ARM.replace(joints=(hinge,))
    history = History.from_dataframe(blank(table(ARM), "x", "y", "vx", "vy"), scene)
    with pytest.raises(HistoryError, match=r'x, y, vx, vy of body "arm".*hinge'):
        check_start(history, scene)


def test_estimated_velocities() -> None:
    frame = table(steps=(8, 3, 2))
    t = frame["time"] - 5
    frame["x"], frame["y"] = 1 + 2 * t + 3 * t**2, t
    frame["theta"] = np.angle(np.exp(1j * (3 + 4 * t)))  # wraps at pi
    frame = frame.drop(columns=["vx", "vy", "omega"])
    with pytest.raises(HistoryError, match=r'vx, vy, omega of body "cart".*estimate_velocities'):
        check_start(History.from_dataframe(frame, CART), CART)
    history = History.from_dataframe(frame, CART, estimate_velocities=True)
    check_start(history, CART)
    start, observed = history.dataset["start"].values, history.dataset["observed"].values
    np.testing.assert_allclose(start[0, :, 0, 3], 2 + 6 * t[:8], atol=1e-9)
    np.testing.assert_allclose(start[1, :3, 0, 3], 2 + 6 * t[:3], atol=1e-9)
    np.testing.assert_allclose(start[2, :2, 0, 3], 2.3, atol=1e-9)
    np.testing.assert_allclose(start[0, :, 0, 4:], np.tile([1.0, 4.0], (8, 1)), atol=1e-9)
    assert np.isnan(observed[..., 3:]).all()
    assert history.segments().n == 10


def test_estimates_skip_gaps_and_measured_columns() -> None:
    frame = blank(table(steps=(9,)), "vx")
    frame["x"] = 2 * frame["time"]
    frame.loc[[4], "x"] = math.nan
    start = History.from_dataframe(frame, CART, estimate_velocities=True).dataset["start"].values
    np.testing.assert_allclose(start[0, [0, 1, 2, 3, 5, 6, 7, 8], 0, 3], 2.0)
    assert np.isnan(start[0, 4, 0, 3])
    np.testing.assert_array_equal(start[0, :, 0, 5], frame["omega"])


def test_estimated_angular_velocity_feeds_the_hinge() -> None:
    frame = blank(table(ARM, steps=(8,)), "x", "y", "vx", "vy", "omega")
    frame["theta"] = 2 * frame["time"]
    history = History.from_dataframe(frame, ARM, estimate_velocities=True)
    start = history.dataset["start"].values[0, :, 0]
    speed = -2j * turned(start[:, 2], (0.1, 0.3))
    np.testing.assert_allclose(start[:, 3] + 1j * start[:, 4], speed, atol=1e-9)


# Rules ------------------------------------------------------------------------------------------


def changed(**cells: object) -> pd.DataFrame:
    """Return a table of 7 rows with the cells of row 3 (index 1) changed."""
    frame = table().astype(object)
    for name, value in cells.items():
        frame.loc[1, name] = value
    return frame


def swapped(frame: pd.DataFrame, i: int, j: int) -> pd.DataFrame:
    order = list(range(len(frame)))
    order[i], order[j] = order[j], order[i]
    return frame.iloc[order]


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (table().drop(columns="force_x"), r"missing column\(s\) force_x"),
        (table().drop(columns=["time", "body"]), r"missing column\(s\) time, body"),
        (table().rename(columns={"theta": "teta"}), 'column "teta"; did you mean "theta"'),
        (pd.concat([table(), table()["x"]], axis=1), 'column "x" is there twice'),
        (table()[:0], "it has no rows"),
        (changed(body="crat"), 'row 3: body "crat".*did you mean "cart"'),
        (changed(body=None), 'row 3: body "" does not move'),
        (changed(trajectory=None), "row 3: trajectory is empty"),
        (changed(time=None), "row 3: time is empty in trajectory 0"),
        (changed(step=0.5), "row 3: step is 0.5 in trajectory 0; expected a whole number"),
        (changed(step=1e300), r"row 3: step is 1e\+300"),
        (changed(x="abc"), "row 3: x is 'abc' in trajectory 0; expected a number or an empty"),
        (
            changed(x=math.inf),
            'row 3: x of body "cart" is inf in trajectory 0; expected a finite number',
        ),
        (changed(torque=-math.inf), 'row 3: torque of body "cart" is -inf'),
        (changed(torque=None), 'row 3: torque of body "cart" is empty in trajectory 0.*write 0'),
        (table().assign(x=True), "row 2: x is 'True'"),
        (table().assign(time=pd.Timestamp("2020-01-01")), "row 2: time is '2020"),
        (changed(time=4.99), "row 3: time goes back by 0.01 s in trajectory 0; sort the rows"),
        (swapped(table(), 1, 2), "row 4: time goes back by 0.1 s in trajectory 0"),
        (swapped(table().drop(columns="step"), 1, 2), "row 4: time goes back by 0.1 s"),
        (changed(step=0, time=5.0), 'row 3: a second row of body "cart" at step 0 in trajectory 0'),
        (changed(step=0), 'row 3: a second row of body "cart" at step 0'),
        (changed(time=5.0).drop(columns="step"), 'row 3: a second row of body "cart" at time 5 s'),
        (changed(step=-1), "row 3: step goes back from 0 to -1"),
        (table().drop(index=1), "row 3: step skips from 0 to 2 in trajectory 0; expected 1"),
        (table().drop(index=1).drop(columns="step"), "row 3: 0.2 s since.*expected 0.1 s"),
        (changed(time=5.102), "row 3: 0.102 s since the step before.*expected 0.1 s.*time_step"),
        (table()[:5], "row 6: trajectory 1 has 1 step; expected at least 2"),
        ([1, 2], "got list, expected a pandas.DataFrame"),
    ],
)
def test_bad_tables_say_what_and_where(frame: pd.DataFrame, message: str) -> None:
    if isinstance(frame, pd.DataFrame):
        frame = frame.reset_index(drop=True)
    with pytest.raises(HistoryError, match=message):
        History.from_dataframe(frame, CART)


def test_sampling_within_one_percent_passes() -> None:
    frame = table(steps=(5,))
    frame["time"] += [0, 0.0005, -0.0004, 0.0004, 0]
    assert History.from_dataframe(frame, CART).n_transitions == 4


def test_bodies_at_one_step_have_one_time() -> None:
    frame = table(PAIR)
    frame.loc[3, "time"] += 0.05
    with pytest.raises(HistoryError, match=r"row 5: step 1 has two times, 0\.05 s apart"):
        History.from_dataframe(frame, PAIR)


def test_bodies_missing() -> None:
    with pytest.raises(HistoryError, match='body "desk" of the scene has no rows'):
        History.from_dataframe(table().replace("cart", "chair"), PAIR)
    gap = table(PAIR).drop(index=3).reset_index(drop=True)
    with pytest.raises(HistoryError, match=r'row 4: body "desk" has no row at time 5.1 s in traj'):
        History.from_dataframe(gap, PAIR)
    table_ = Body("table", BOX, static=True, pose=(0, 0, 0))
    scene = CART.replace(bodies=(*CART.bodies, table_))
    with pytest.raises(HistoryError, match=r'row 3: body "table".*it is static'):
        History.from_dataframe(changed(body="table"), scene)
    assert History.from_dataframe(table(), scene).bodies == ("cart",)


def test_the_first_broken_rule_is_reported_in_the_row_of_the_file(tmp_path: Path) -> None:
    text = table().to_csv(index=False).splitlines()
    path = tmp_path / "history.csv"
    text[5] = text[5].replace("cart,", "cart,abc")
    text.insert(3, "")  # a blank line counts
    path.write_text("\n".join(text), encoding="utf-8")
    with pytest.raises(HistoryError, match=r"history.csv row 7: x is 'abc"):
        History.load(path, CART)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xls", b"", "suffix is '.xls', expected one of .csv, .txt, .tsv, .dat, .xlsx"),
        ("a.csv", b"", "the file is empty"),
        ("a.csv", b"\n \n", "the file is empty"),
        ("a.csv", b"\xff\xfe,\n1,2\n", "not a CSV table|unknown column"),
        ("a.csv", b"x\0y,z\n1,2\n", "unknown column"),
        ("a.csv", b'x,"y\n1,2\n', "not a CSV table|unknown column|no rows|missing"),
        ("a.csv", b'x,"y"\n1,2,3\n', "not a CSV table|more cells|missing"),
        ("a.csv", b"x,y\n1,2\n1,2,3\n", "row 3: 3 cells, expected 2"),
        ("a.csv", b"x,y\n1,2\n1\n", "row 3: 1 cells, expected 2"),
        ("a.parquet", b"PAR1 no", "not a Parquet table"),
        ("a.nc", b"CDF no", "not a NetCDF file"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HistoryError, match=message):
        History.load(tmp_path / name, CART)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 900), st.integers(0, 30), st.text('0159.,-eE\n\r\t"nax ;/\0é', max_size=6))
def test_damaged_csv_loads_or_says_why(tmp_path: Path, at: int, cut: int, put: str) -> None:
    text = table(PAIR, steps=(3, 2)).to_csv(index=False)
    path = tmp_path / "history.csv"
    path.write_text(text[:at] + put + text[at + cut :], encoding="utf-8")
    try:
        assert History.load(path, PAIR).n_trajectories >= 1
    except HistoryError as error:
        assert "\n  File" not in str(error)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".nc"])
def test_files_that_are_not_there(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(HistoryError, match="no such file"):
        History.load(tmp_path / f"none{suffix}", CART)
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(HistoryError, match="the folder has no log"):
        History.load(tmp_path / f"folder{suffix}", CART)


def test_foreign_netcdf(tmp_path: Path) -> None:
    dataset = History.from_dataframe(table(), CART).dataset
    dataset[["action", "clock"]].to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(HistoryError, match="'observed' has dimensions None"):
        History.load(tmp_path / "a.nc", CART)
