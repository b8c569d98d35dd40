"""A learned remainder: of a force that no effect explains, with its uncertainty; none if none."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl import criticism
from pbrl_ppl.cli import main
from pbrl_ppl.criticism import learn_remainder
from pbrl_ppl.criticism.results import Unexplained
from pbrl_ppl.criticism.rivals import posterior_mode
from pbrl_ppl.effects import LEARNED_REMAINDER
from pbrl_ppl.errors import FitError
from pbrl_ppl.posterior import Fit, group, scene_of
from pbrl_ppl.reporting import render_posterior
from tests.helpers.free_puck import BOX, MASS, box2d
from tests.helpers.made_up import made_up

#: kg s/m^2; no effect of the catalogue grows with the cube of the speed.
CUBIC = 0.3
# few draws are enough here, and say that they are few
pytestmark = [
    pytest.mark.one_stack,
    pytest.mark.first(4),
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
]


def posterior_of(frame):
    """Of the declared model, without drag."""
    model = pp.physics_model(BOX, pp.History.from_dataframe(frame, BOX), likelihood="trajectories")
    return pp.fit(model, method="laplace", draws=50, seed=1, progress=False)


def unexplained(posterior) -> pp.Loop:
    """A loop that found no name for what is missing, without the search."""
    left = Unexplained("puck", "vx", "speed", 0.5, 0.001, "vx of puck depends on its speed")
    fitted = Fit.of(posterior)
    mode = posterior_mode(fitted)
    return replace(
        made_up("unexplained"), scene=BOX, candidates=(), unexplained=left,
        declared=fitted, revised=fitted, innovations=(mode, mode),
    )  # fmt: skip


def force(idata, speeds, draws=60) -> np.ndarray:
    """Mean force over an interval at these speeds along x, shape (draw, speed), N."""
    dynamics = pp.Dynamics.of(idata, draws, seed=1)
    begin = np.zeros((draws, len(speeds), 1, 6))
    begin[..., 0, 3] = speeds
    ends = dynamics.step(begin, np.zeros((len(speeds), 1, 3)))
    return MASS * (ends - begin)[..., 0, 3] / BOX.time_step


def rollout_error(idata, history) -> np.ndarray:
    """Root mean square error of x, y, vx, vy at the end of each held-out trajectory."""
    dynamics = pp.Dynamics.of(idata, 20, seed=1)
    pieces = history.segments(15)
    ends = [
        dynamics.rollout(start, actions).mean(axis=0)[-1, 0]
        for start, actions in zip(pieces.start, pieces.actions, strict=True)
    ]
    return np.sqrt(np.mean((np.array(ends) - pieces.observed[:, -1, 0]) ** 2, axis=0))[[0, 1, 3, 4]]


@pytest.fixture(scope="module")
def frames(make_history):
    return box2d(make_history, 4, cubic_drag=CUBIC)


@pytest.fixture(scope="module")
def loop(frames) -> pp.Loop:
    return unexplained(posterior_of(frames[0]))


@pytest.fixture(scope="module")
def learned(loop):
    return loop.learn_remainder(seed=1)


@pytest.mark.slow
def test_held_out_motion_is_predicted_and_nothing_is_named(frames, loop, learned) -> None:
    held_out = pp.History.from_dataframe(frames[1], BOX)
    before, after = (rollout_error(one, held_out) for one in (loop.posterior_after, learned))
    assert (after < 0.2 * before).all()
    assert loop.verdict == "unexplained"
    assert loop.added == ()
    assert LEARNED_REMAINDER not in json.dumps(loop.to_dict())
    assert json.loads(learned.attrs["effects"]) == [[LEARNED_REMAINDER, "puck"]]
    # the mass is that of the pushes, and the rest is as good as without noise of its own
    left = group(learned, "posterior")["unexplained_acceleration"].mean(("chain", "draw")).values
    gone = group(loop.posterior_after, "posterior")["unexplained_acceleration"]
    assert (left[:2] < 0.05 * gone.mean(("chain", "draw")).values[:2]).all()


@pytest.mark.slow
def test_the_force_is_known_where_it_was_seen_and_open_beyond(frames, learned) -> None:
    speeds = np.array([0.5, 1.0, 1.5])
    found = force(learned, speeds)
    middle = speeds - 0.5 * BOX.time_step * CUBIC * speeds**3 / MASS
    off = (found.mean(axis=0) + CUBIC * middle**3) / found.std(axis=0)
    assert (np.abs(off) < 4).all()
    assert (found.std(axis=0) < 0.1).all()
    seen = np.hypot(frames[0]["vx"], frames[0]["vy"]).max()
    beyond = force(learned, np.array([1.3 * seen]))
    assert beyond.std() > 5 * found.std(axis=0).max()
    # far from all that was seen: nothing, and the physics alone
    np.testing.assert_allclose(force(learned, np.array([6 * seen])), 0.0, atol=1e-3)


@pytest.mark.slow
def test_a_file_of_it_is_whole(learned, tmp_path) -> None:
    """Predictions and plans need nothing else; no next scene declares it."""
    path = tmp_path / "remainder.nc"
    pp.save_posterior(learned, path)
    loaded = pp.load_posterior(path)
    np.testing.assert_array_equal(force(loaded, [1.0, 2.0]), force(learned, [1.0, 2.0]))
    allowed = pp.ActionSet.box("puck", forces=(-6.0, 0.0, 6.0), durations=(0.2,))
    start, goal = {"puck": (0, 0, 0)}, pp.Goal.of({"puck": (0.6, 0.0, None)}, tolerance=0.2)
    plan = pp.plan(loaded, start, goal, allowed, draws=4, nodes=3000)
    assert plan.reached
    said = pp.identify(loaded)
    assert not any(LEARNED_REMAINDER in width.parameter for width in said.parameters)
    assert LEARNED_REMAINDER not in pp.updated_scene(loaded).to_toml()
    assert LEARNED_REMAINDER in scene_of(loaded).to_toml()
    with pytest.raises(FitError, match="has a learned remainder already"):
        learn_remainder(loaded, "puck")


@pytest.mark.long
def test_an_update_keeps_it(frames, learned) -> None:
    """Of a few new transitions; and a report shows it."""
    frame = frames[1][(frames[1]["trajectory"] == 0) & (frames[1]["step"] < 4)]
    since = pp.History.from_dataframe(frame, BOX)
    updated = pp.update(learned, since, seed=1, progress=False)
    assert updated.attrs[LEARNED_REMAINDER] == learned.attrs[LEARNED_REMAINDER]
    assert abs(force(updated, [1.0]).mean() - force(learned, [1.0]).mean()) < 0.1
    assert LEARNED_REMAINDER in render_posterior(learned)


@pytest.mark.slow
def test_the_command_writes_it_beside_the_report(loop, learned, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(criticism, "close_loop", lambda *given, **options: loop)
    monkeypatch.setattr(pp.Loop, "learn_remainder", lambda self, **options: learned)
    (tmp_path / "scene.toml").write_text(BOX.to_toml())
    train = tmp_path / "train.csv"
    train.write_text(
        "trajectory,step,time,body,x,y,theta,vx,vy,omega,force_x,force_y,torque\n"
        "0,0,0.0,puck,0,0,0,0,0,0,1,0,0\n0,1,0.1,puck,0,0,0,0,0,0,,,\n"
    )
    files = [str(tmp_path / "scene.toml"), str(train), "-o", str(tmp_path / "out"), "-q", "--json"]
    assert main(["close-loop", *files, "--learn-remainder"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["verdict"] == "unexplained"
    assert said["added"] == []
    assert "a force without a law" in said["learned_remainder"]["words"]
    assert said["learned_remainder"]["posterior"] == str(tmp_path / "out" / "remainder.nc")
    assert pp.load_posterior(tmp_path / "out" / "remainder.nc").attrs[LEARNED_REMAINDER]
    kept = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert kept["learned_remainder"] == said["learned_remainder"]["words"]
    assert (kept["verdict"], kept["added"]) == ("unexplained", [])
    assert kept["learned_remainder"] in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_clean_data_have_nothing_to_learn(make_history) -> None:
    posterior = posterior_of(box2d(make_history, 4, trajectories=6)[0])
    with pytest.raises(FitError, match="nothing to learn"):
        learn_remainder(posterior, "puck", seed=1)
    with pytest.raises(FitError, match="no moving body 'cart'"):
        learn_remainder(posterior, "cart", seed=1)


def test_a_verdict_with_names_is_left_alone() -> None:
    with pytest.raises(FitError, match="nothing to learn: the verdict is adequate"):
        made_up("adequate").learn_remainder()


@pytest.mark.one_stack
def test_without_the_library_it_says_what_to_install(tmp_path, monkeypatch, capsys) -> None:
    """At once, not after the search."""
    monkeypatch.setitem(sys.modules, "sklearn", None)
    install = "pip install 'pbrl_ppl[remainder]'"
    with pytest.raises(FitError, match=re.escape(install)):
        learn_remainder(None, "puck")
    monkeypatch.setattr(criticism, "close_loop", lambda *given, **options: pytest.fail("searched"))
    (tmp_path / "scene.toml").write_text(BOX.to_toml())
    train = tmp_path / "train.csv"
    train.write_text(
        "trajectory,step,time,body,x,y,theta,vx,vy,omega,force_x,force_y,torque\n"
        "0,0,0.0,puck,0,0,0,0,0,0,1,0,0\n0,1,0.1,puck,0,0,0,0,0,0,,,\n"
    )
    files = [str(tmp_path / "scene.toml"), str(train), "-o", str(tmp_path / "out"), "-q"]
    assert main(["close-loop", *files, "--learn-remainder"]) == 2
    assert install in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
