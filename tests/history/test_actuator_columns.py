"""Commands of actuators: read from columns of their names, and guessed for a new scene."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from pbrl_ppl.cli import main
from pbrl_ppl.errors import HistoryError, RecordingWarning
from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics
from pbrl_ppl.planning import Dynamics, predicted_path
from pbrl_ppl.posterior import load_posterior, save_posterior
from pbrl_ppl.scene import Actuator, Body, Recording, Scene, Shape

pytestmark = pytest.mark.one_stack


def craft(*names: str) -> Scene:
    fans = tuple(
        Actuator(name=name, kind="thruster", body="craft", known={"gain": 0.5})
        for name in names or ("left_fan", "right_fan")
    )
    return Scene(time_step=0.1, bodies=(Body("craft", Shape.circle(0.1)),), actuators=fans)


def log(n: int = 12) -> pd.DataFrame:
    time = 0.1 * np.arange(n)
    table = pd.DataFrame({"time": time, "x": time, "y": 0.0, "theta": 0.1 * time})
    return table.assign(left_fan=np.arange(n) % 2, right_fan=1.0)


def commands(history: History) -> np.ndarray:
    return history.dataset["action"].to_numpy()[0, :-1, 0]


def test_columns_of_actuators_are_read(tmp_path: Path) -> None:
    log().to_csv(tmp_path / "log.csv", index=False)
    read = commands(History.load(tmp_path / "log.csv", craft()))
    np.testing.assert_array_equal(read[:, 0], np.arange(11) % 2)
    np.testing.assert_array_equal(read[:, 1:], np.tile([1.0, 0.0], (11, 1)))


def test_a_saved_history_is_read_again(tmp_path: Path) -> None:
    scene = craft()
    history = History.from_dataframe(log(), scene, layout=Recording())
    history.save(tmp_path / "saved.csv")
    again = History.load(tmp_path / "saved.csv", scene)
    assert again.data_sha256 == history.data_sha256


@pytest.mark.parametrize("mark", [",", ";"])
@pytest.mark.parametrize("recording", [None, Recording()], ids=["plain", "declared"])
def test_an_empty_cell_of_a_file_holds_the_command(recording, mark: str, tmp_path: Path) -> None:
    """Of a column that no history has, with decimal points or commas."""
    given = np.arange(12) % 4 == 0
    table = log().assign(left_fan=np.where(given, 0.5 + np.arange(12), np.nan))
    decimal = "," if mark == ";" else "."
    table.to_csv(tmp_path / "log.csv", index=False, sep=mark, decimal=decimal)
    with pytest.warns(RecordingWarning, match="8 rows: the command before holds"):
        history = History.load(tmp_path / "log.csv", craft().replace(recording=recording))
    np.testing.assert_array_equal(commands(history)[:, 0], 0.5 + np.arange(11) // 4 * 4)


def test_new_reads_topics_that_were_merged(tmp_path: Path) -> None:
    """Rows of poses and rows of commands: the time step is the poses', the command an actuator."""
    poses = log(40).drop(columns=["left_fan", "right_fan"])
    sent = pd.DataFrame({"time": 0.05 + 0.5 * np.arange(8), "throttle": 0.1 * np.arange(8)})
    merged = pd.concat([poses, sent]).sort_values("time", kind="stable")
    merged.to_csv(tmp_path / "log.csv", index=False)
    scene, path = tmp_path / "scene.toml", tmp_path / "log.csv"
    asked = ["--history", str(path), "--columns", "body=craft", "--body", "craft=circle:0.1"]
    assert main(["new", str(scene), *asked, "--quiet"]) == 0
    written = Scene.load(scene)
    assert written.time_step == 0.1
    with pytest.warns(RecordingWarning, match="8 rows hold commands and no state"):
        history = History.load(path, written.replace(recording=Recording()))
    assert history.n_transitions == 39
    expected = 0.1 * (np.arange(39) // 5 - 0.5 * (np.arange(39) % 5 == 0) * (np.arange(39) > 0))
    np.testing.assert_allclose(commands(history)[:, 0], expected, atol=1e-9)


def test_one_row_a_body() -> None:
    """Of two bodies one has an actuator; the column is read on its rows."""
    scene = craft("fan")
    scene = scene.replace(bodies=(*scene.bodies, Body("puck", Shape.circle(0.1))))
    rows = [log().drop(columns=["left_fan", "right_fan"]).assign(body=b) for b in ("craft", "puck")]
    table = pd.concat(rows).assign(fan=3.0, trajectory=0, force_x=7.0, force_y=0.0, torque=0.0)
    table = table.assign(vx=np.nan, vy=np.nan, omega=np.nan).sort_values("time", kind="stable")
    action = History.from_dataframe(table, scene).dataset["action"].to_numpy()[0, :-1]
    assert (action[:, 0, 0] == 3.0).all()
    assert (action[:, 1, 0] == 7.0).all()


def test_a_missing_column_is_named() -> None:
    with pytest.raises(HistoryError, match='no column "right_fan"'):
        History.from_dataframe(log().drop(columns="right_fan"), craft(), layout=Recording())


@pytest.mark.parametrize(
    ("column", "shape", "kind"),
    [
        ("left fan [%]", "craft=circle:0.1", "thruster"),
        ("motor_pwm", "arm=box:0.02x0.2", "motor"),
        ("goal position", "arm=box:0.02x0.2", "servo"),
    ],
)
def test_new_proposes_actuators(tmp_path: Path, column: str, shape: str, kind: str) -> None:
    """From a log of a free body, or of an angle alone; the log is read with what it proposes."""
    hung = shape.startswith("arm")
    commands_sent = 100.0 * (np.arange(12) % 3)
    table = log().drop(columns=["left_fan", "right_fan"]).assign(**{column: commands_sent})
    if hung:
        table = table.drop(columns=["x", "y"])
    path, scene_path = tmp_path / "log.csv", tmp_path / "scene.toml"
    table.to_csv(path, index=False)
    given = ["--side" if hung else "--top", "--quiet"]
    assert main(["new", str(scene_path), "--history", str(path), "--body", shape, *given]) == 0
    scene = Scene.load(scene_path)
    (actuator,) = scene.actuators
    assert actuator.kind == kind
    assert actuator.full == (1.0 if kind == "servo" else 200.0)  # a goal is in rad
    if kind == "thruster":
        assert actuator.at[1] > 0.0
    np.testing.assert_array_equal(commands(History.load(path, scene))[:, 0], commands_sent[:-1])


def test_a_fit_is_planned_with(tmp_path: Path) -> None:
    """The posterior file has the actuators: both fans push the craft straight ahead."""
    rng, scene = np.random.default_rng(1), craft()
    scene = scene.replace(bodies=(Body("craft", Shape.circle(0.1), known={"mass": 0.5}),))
    physics = Physics.declare(scene)
    sent = np.zeros((4, 12, 1, 3))
    sent[..., :2] = rng.integers(0, 2, (4, 12, 1, 2))
    states = physics.predict(np.array([0.2, 0.5]), np.zeros((4, 1, 6)), sent)
    whole = np.concatenate([np.zeros((4, 1, 1, 6)), states], axis=1)
    noisy = whole + rng.normal(0.0, 1e-3, whole.shape)
    model = pp.physics_model(scene, History.of_arrays(noisy, scene, sent))
    idata = pp.fit(model, method="laplace", seed=1, progress=False)
    save_posterior(idata, tmp_path / "craft.nc")
    dynamics = Dynamics.of(load_posterior(tmp_path / "craft.nc"))
    both = np.zeros((10, 1, 3))
    both[..., :2] = 1.0
    x, y, *_ = predicted_path(dynamics, np.zeros((1, 6)), both)[0, -1, 0]
    assert x == pytest.approx(0.5 * (2 * 0.5 / 0.5) * 1.0**2, rel=1e-6)  # F t^2 / 2 m
    assert abs(y) < 1e-9
