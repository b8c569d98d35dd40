"""Tables of others: their names, units and time stamps."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.errors import HistoryError, RecordingWarning, ResamplingWarning
from pbrl_ppl.history import History, measured_alone
from pbrl_ppl.history.measures import in_si
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE, WRENCH
from tests.helpers.free_puck import DISC, Disc
from tests.helpers.histories import NOISE

pytestmark = pytest.mark.one_stack

PUCK = Shape.circle(0.2)
PAIR = Scene(time_step=0.1, bodies=(Body("a", PUCK), Body("b", PUCK)))
NAMES = {"time": "Time (s)", "x": "pos_x", "y": "pos_y", "theta": "yaw", "force_x": "push"}


def own(tmp_path: Path) -> Path:
    """A motion-capture table in mm and degrees: no trajectory, no body, no force but one."""
    time = 0.1 * np.arange(5)
    table = {"Time (s)": 1e3 * time, "pos_x": 1500 * time, "pos_y": [0, 1, "NaN", 3, 4],
             "yaw": 90 * time, "push": 2.0, "marker_7": "lost"}  # fmt: skip
    path = tmp_path / "capture.csv"
    pd.DataFrame(table).to_csv(path, index=False)
    return path


def test_columns_and_units_of_a_motion_capture_table(tmp_path) -> None:
    history = History.load(
        own(tmp_path), DISC, estimate_velocities=True,
        columns=NAMES | {"force_y": 0.0, "torque": 0.0},
        units={"time": "ms", "x": "mm", "y": "mm", "theta": "deg"},
    )  # fmt: skip
    observed = history.dataset["observed"].to_numpy()[0, :, 0]
    time = 0.1 * np.arange(5)
    np.testing.assert_allclose(observed[:, 0], 1.5 * time)
    np.testing.assert_allclose(observed[:, 1], [0, 0.001, np.nan, 0.003, 0.004])
    np.testing.assert_allclose(observed[:, 2], np.pi / 2 * time)
    assert np.isnan(observed[:, 3:]).all()
    np.testing.assert_array_equal(history.dataset["action"][0, :-1, 0], [[2.0, 0.0, 0.0]] * 4)
    assert history.bodies == ("puck",) and history.n_transitions == 4


def test_bodies_side_by_side() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(3, 2, 6))
    wide = {"t": 0.1 * np.arange(3)}
    columns: dict[str, str | float] = {"time": "t", "trajectory": 4}
    for i, body in enumerate("ab"):
        for d, name in enumerate(STATE):
            wide[f"{body}_{name}"] = values[:, i, d]
            columns[f"{body}.{name}"] = f"{body}_{name}"
        columns |= {f"{body}.{name}": float(i) for name in WRENCH}
    dataset = History.from_dataframe(pd.DataFrame(wide), PAIR, columns=columns).dataset
    np.testing.assert_array_equal(dataset["observed"][0], values)
    np.testing.assert_array_equal(dataset["action"][0, :-1, 1], np.ones((2, 3)))
    assert dataset["trajectory"].values.tolist() == [4]
    for name in [name for name in columns if name.startswith("b.")]:
        del columns[name]
    with pytest.raises(HistoryError, match="b has none, and a has; name each body's"):
        History.from_dataframe(pd.DataFrame(wide), PAIR, columns=columns)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"x": "pos_z"}}, 'no column "pos_z" for x; did you mean "pos_'),
        ({"columns": {"z": "pos_x"}}, '"z" is no column of a history'),
        ({"columns": {"cart.x": "pos_x"}}, "the scene has puck"),
        ({"columns": {"puck.time": "pos_x"}}, '"puck.time" is no column'),
        ({"columns": {"x": "pos_x", "body": "pck"}}, 'no column "pck" for body'),
        ({"columns": NAMES, "units": {"x": "parsec"}}, '"parsec" is none of x; expected one of m'),
        ({"columns": NAMES, "units": {"theta": "mm"}}, '"mm" is none of theta'),
        ({"columns": NAMES, "units": {"body": "mm"}}, '"body" has none'),
        ({"columns": NAMES, "units": {"vx": "mm/s"}}, "the table has no such column"),
    ],
)
def test_bad_names_and_units(tmp_path, options, message) -> None:
    with pytest.raises(HistoryError) as error:
        History.load(own(tmp_path), DISC, **options)
    assert message in str(error.value)


def test_units_of_words_are_left_for_the_message() -> None:
    frame = Disc().frame(np.random.default_rng(0))
    frame["x"] = frame["x"].astype(object)
    frame.loc[3, "x"] = "oops"
    with pytest.raises(HistoryError, match="row 5: x is 'oops'"):
        History.from_dataframe(frame, DISC, units={"x": "mm"})


def uneven(
    scene: Scene = DISC, n: int = 400, jitter: float = 0.3, fine: float = 1.0, seed: int = 3
) -> tuple[pd.DataFrame, np.ndarray, np.ndarray]:
    """Exact motion under pushes that change with each sample, at jittered times."""
    rng = np.random.default_rng(seed)
    dt = scene.time_step / fine
    time = dt * (np.arange(n) + rng.uniform(-jitter, jitter, n))
    push = rng.normal(0.0, 2.0, (n, 3))
    states = np.zeros((n, 6))
    for i in range(n - 1):
        h, a = time[i + 1] - time[i], push[i] / (2.0, 2.0, 0.04)
        states[i + 1, :3] = states[i, :3] + h * states[i, 3:] + h**2 * a / 2
        states[i + 1, 3:] = states[i, 3:] + h * a
    frame = pd.DataFrame(
        {"trajectory": 0, "time": time, "body": "puck"}
        | dict(zip(STATE, states.T, strict=True))
        | dict(zip(WRENCH, push.T, strict=True))
    )
    return frame, time, states


def test_uneven_samples_are_exact_without_noise() -> None:
    """Hermite cubics and lines are exact where the acceleration is constant between samples."""
    frame, time, states = uneven()
    with pytest.raises(HistoryError, match="resample, --time-step"):
        History.from_dataframe(frame, DISC)
    with pytest.warns(ResamplingWarning, match=r"not 0.1 s: 400 rows were resampled to (399|400)"):
        history = History.from_dataframe(frame, DISC, resample=True)
    clock = history.dataset["clock"].to_numpy()[0]
    observed = history.dataset["observed"].to_numpy()[0, :, 0]
    place = np.clip(np.searchsorted(time, clock, side="right") - 1, 0, len(time) - 2)
    h = (clock - time[place])[:, None]
    push = frame[list(WRENCH)].to_numpy()[place] / (2.0, 2.0, 0.04)
    np.testing.assert_allclose(observed[:, 3:], states[place, 3:] + h * push, atol=1e-9)
    exact = states[place, :3] + h * states[place, 3:] + h**2 / 2 * push
    np.testing.assert_allclose(observed[:, :3], exact, atol=1e-9)
    # the impulse is kept, so that velocities and wrenches belong together
    action = history.dataset["action"].to_numpy()[0, :-1, 0]
    gained = 0.1 * action / (2.0, 2.0, 0.04)
    np.testing.assert_allclose(np.diff(observed[:, 3:], axis=0), gained, atol=1e-9)


def test_even_samples_stay_what_they_are() -> None:
    frame = Disc().frame(np.random.default_rng(0))
    plain = History.from_dataframe(frame, DISC)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert History.from_dataframe(frame, DISC, resample=True).data_sha256 == plain.data_sha256


def test_a_finer_log_is_thinned_without_interpolation() -> None:
    frame, _, states = uneven(n=401, jitter=0.0, fine=4)
    with pytest.warns(ResamplingWarning) as caught:
        history = History.from_dataframe(frame, DISC, resample=True)
    assert "interpolated" not in str(caught[0].message)
    np.testing.assert_allclose(history.dataset["observed"][0, :, 0], states[::4], atol=1e-9)


def test_the_warning_says_what_becomes_of_the_noise() -> None:
    frame, *_ = uneven()
    with pytest.warns(ResamplingWarning, match="are interpolated .* less independent than they"):
        History.from_dataframe(frame, DISC, resample=True)


def test_gaps_are_left_empty_or_refused() -> None:
    frame, *_ = uneven(jitter=0.1)
    short = frame.drop(index=[100, 101]).reset_index(drop=True)
    with pytest.warns(ResamplingWarning, match="3 rows have empty cells, in gaps"):
        history = History.from_dataframe(short, DISC, resample=True)
    assert np.isnan(history.dataset["observed"].to_numpy()[0, :, 0]).all(axis=1).sum() == 3
    with pytest.raises(HistoryError, match=r"row 102: 1\.\d+ s since .* trajectory of their own"):
        History.from_dataframe(frame.drop(index=range(100, 110)), DISC, resample=True)
    with pytest.raises(HistoryError, match="would make rows up; give a time step of at least 0"):
        History.from_dataframe(frame.iloc[::2], DISC, resample=True)
    back = frame.copy()
    back.loc[7, "time"] = back.loc[5, "time"]
    with pytest.raises(HistoryError, match="row 9: time does not rise"):
        History.from_dataframe(back, DISC, resample=True)
    missing = frame.copy()
    missing.loc[7, "force_x"] = np.nan
    with pytest.raises(HistoryError, match="row 9: a wrench is empty"):
        History.from_dataframe(missing, DISC, resample=True)


@pytest.mark.parametrize("kind", ["forward", "central"])
def test_difference_quotients_do_not_pass_for_velocities(kind) -> None:
    """At uneven places the package's own test of even rows cannot see them."""
    frame, time, states = uneven(n=400)
    rng = np.random.default_rng(6)
    places = states[:, :3] + rng.normal(0.0, NOISE[:3], (len(states), 3))
    frame[list(STATE[:3])] = places
    for d in range(3):
        if kind == "central":
            rate = np.gradient(places[:, d]) / np.gradient(time)
        else:
            rate = np.diff(places[:, d], append=0) / np.diff(time, append=time[-1] + 1)
        frame[STATE[d + 3]] = rate
    with pytest.warns(ResamplingWarning, match="vx of puck, vy of puck, omega of puck: difference"):
        history = History.from_dataframe(frame, DISC, resample=True, estimate_velocities=True)
    assert np.isnan(history.dataset["observed"][..., 3:]).all()
    assert measured_alone(history) is history  # nothing is left to be found


def test_an_angle_that_turns_fast_is_unwrapped_by_its_rate() -> None:
    frame, time, _ = uneven(n=200, jitter=0.1)
    frame["theta"], frame["omega"] = (40.0 * time + np.pi) % (2 * np.pi) - np.pi, 40.0
    with pytest.warns(ResamplingWarning):
        data = History.from_dataframe(frame, DISC, resample=True).dataset
    off = data["observed"].to_numpy()[0, :, 0, 2] - 40.0 * data["clock"].to_numpy()[0]
    np.testing.assert_allclose(np.angle(np.exp(1j * off)), 0.0, atol=1e-6)


def test_bodies_with_clocks_of_their_own() -> None:
    parts = []
    for name, shift in (("a", 0.0), ("b", 0.037)):
        frame, *_ = uneven(PAIR, n=50)
        parts.append(frame.assign(body=name, time=frame["time"] + shift))
    both = pd.concat([part.assign(trajectory=t) for t in ("run", 2) for part in parts])
    with pytest.warns(ResamplingWarning):
        data = History.from_dataframe(both, PAIR, resample=True).dataset
    assert data["trajectory"].values.tolist() == ["run", "2"]
    assert not data["observed"][:, :40].isnull().any()
    np.testing.assert_array_equal(data["observed"][0], data["observed"][1])


# -- counts ----------------------------------------------------------------------------------------

ARM = Scene(
    time_step=0.01,
    bodies=(Body("arm", Shape.box(0.04, 0.3)),),
    joints=(Joint("hinge", ("arm", "world"), (0.0, 0.15), (0.0, 0.0)),),
)


def turning(bits: int, signed: bool, *, counts: int = 8192, runs: int = 2) -> pd.DataFrame:
    """An arm that turns to and fro by some turns, its counter, and its counts in a second."""
    low = -(2 ** (bits - 1)) if signed else 0
    time = 0.01 * np.arange(400)
    turns = 3.0 * 2**bits / counts * np.sin(0.8 * time)
    rate = np.gradient(turns, time)

    def counted(values: np.ndarray) -> np.ndarray:
        return np.mod(np.round(counts * values) - low, 2**bits) + low

    one = pd.DataFrame({"millis": 1000.0 * time, "count": counted(turns)})
    one["rate"] = np.round(counts * rate)
    one["turns"] = turns
    return pd.concat([one] * runs, ignore_index=True)  # the clock starts again


@pytest.mark.parametrize(("bits", "signed"), [(8, False), (16, True), (16, False), (32, True)])
def test_a_counter_that_overflows_goes_on(tmp_path, bits, signed) -> None:
    """Each run from its own beginning, and it is said which row is the first."""
    counts = {8: 20, 16: 8192, 32: 2**28}[bits]
    frame, path = turning(bits, signed, counts=counts), tmp_path / "log.csv"
    frame.drop(columns=["turns", "rate"]).to_csv(path, index=False)
    units = {"time": "ms", "theta": f"{counts}/turn"}
    with pytest.warns(RecordingWarning, match=f"theta is a counter of {bits} bits that overflows"):
        history = History.load(path, ARM, columns={"time": "millis", "theta": "count"}, units=units)
    theta = history.dataset["observed"].sel(state="theta").to_numpy()
    expected = 2.0 * np.pi * frame["turns"].to_numpy().reshape(2, -1)
    assert theta.shape[0] == 2
    np.testing.assert_allclose(theta[..., 0], expected, atol=2.0 * np.pi / counts)


def test_numbers_that_jump_and_count_nothing_stay(tmp_path) -> None:
    """A sensor's range of 16 bits with a jump in it, in fractions; and a jump of half the range."""
    time = 0.01 * np.arange(40)
    for place in (np.where(time < 0.2, 32767.5, -32768.5), np.where(time < 0.2, 16000.0, -16000.0)):
        path = tmp_path / "log.csv"
        pd.DataFrame({"t": time, "x": place}).to_csv(path, index=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            history = History.load(path, DISC.replace(time_step=0.01), columns={"time": "t"})
        np.testing.assert_array_equal(history.dataset["observed"].to_numpy()[0, :, 0, 0], place)


def test_a_rate_in_counts_is_by_the_second() -> None:
    frame = pd.DataFrame({"vx": [5000.0], "omega": [8192.0], "x": [2500.0]})
    read = in_si(frame, {"vx": "2000/m", "omega": "8192/turn", "x": "2000/m"})
    np.testing.assert_allclose(read.to_numpy(), [[2.5, 2.0 * np.pi, 1.25]])


@pytest.mark.parametrize("unit", ["0/turn", "-5/turn", "nan/turn", "many/turn", "5/apple", "/turn"])
def test_counts_to_nothing_are_no_unit(unit) -> None:
    with pytest.raises(HistoryError, match=r'none of theta.*or a number of counts to one, "8192/'):
        in_si(pd.DataFrame({"theta": [1.0]}), {"theta": unit})


def test_times_by_number_have_their_unit(tmp_path) -> None:
    """A file without a head, in milliseconds; and frames of a camera, 240 a second."""
    for unit, step in (("ms", 10.0), ("100/s", 1.0)):
        path = tmp_path / "log.txt"
        np.savetxt(path, np.column_stack([step * np.arange(30), np.sin(0.1 * np.arange(30))]))
        history = History.load(
            path, DISC.replace(time_step=0.01), columns={"time": 0, "x": 1}, units={"time": unit}
        )
        clock = history.dataset["clock"].to_numpy()[0]
        np.testing.assert_allclose(clock, 0.01 * np.arange(30), atol=1e-12)
