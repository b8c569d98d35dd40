"""The board of all recordings beside the project, and the page On hardware."""

import json
import os
import shutil
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.physics import Physics
from pbrl_ppl.state import STATE
from tests.helpers.examples import EXAMPLES
from tests.helpers.falls import BALL, GRAVITY, fall
from tests.helpers.places import ROOT

#: Drag over mass (1/s), and its mass (kg), of a sliding disc.
RATE, MASS = 0.8, 2.0


@pytest.fixture
def measured(monkeypatch):
    """Modules of analysis/attribution can be imported, as the script imports them."""
    monkeypatch.syspath_prepend(str(ROOT / "analysis"))
    import attribution.measured

    return attribution.measured


@pytest.fixture
def page(measured):
    import attribution.measured_page

    return attribution.measured_page


@pytest.fixture
def board(measured):
    import board

    return board


@pytest.fixture
def folder(tmp_path):
    """A disc that slides with linear drag, in closed form: 8 trajectories of 2 s, and 4 to test."""
    folder = tmp_path / "disc"
    folder.mkdir()
    disc = pp.Body("disc", pp.Shape.circle(0.1), known={"mass": MASS}, wheel=False)
    scene = pp.Scene(time_step=0.1, bodies=(disc,), gravity=(0.0, 0.0))
    (folder / "scene.toml").write_text(scene.to_toml())
    rng = np.random.default_rng(5)
    time = 0.1 * np.arange(21)
    for name, n in (("train", 8), ("test", 4)):
        rows = []
        for trajectory in range(n):
            velocity, spin = rng.uniform(-2.0, 2.0, 2), rng.uniform(-1.0, 1.0)
            slowed = np.exp(-RATE * time)
            way = velocity * ((1.0 - slowed) / RATE)[:, None]
            motion = np.column_stack(
                [way, spin * time, velocity * slowed[:, None], np.full_like(time, spin)]
            )
            noisy = motion + rng.normal(0.0, [1e-3] * 3 + [5e-3] * 3, motion.shape)
            rows.append(
                pd.DataFrame(noisy, columns=list(STATE)).assign(
                    trajectory=trajectory, step=range(21), time=time, body="disc",
                    force_x=0.0, force_y=0.0, torque=0.0,
                )
            )  # fmt: skip
        pd.concat(rows).to_csv(folder / f"{name}.csv", index=False)
    return folder


def settings(cache, **changed):
    """The command line's options."""
    usual = {"names": [], "limit": 300, "method": "laplace", "page": False, "raw": False}
    return SimpleNamespace(cache=cache, **usual | changed)


@pytest.fixture
def result(measured):
    """A made-up result of a made-up recording, which names dry friction and a false torque."""
    recording = measured.Recording(
        name="arm",
        folder=ROOT / "nowhere",
        about="An arm.",
        declared="a hinge; no friction",
        ahead=(measured.Ahead(0.2, "angle", 0.09, 0.03, "dry friction"),),
        laws=("pivot_friction", "pivot_damping"),
        also=("sensor_bias",),
        same_data={"pivot_damping": ("angular_drag",)},
        sizes={("pivot_friction", "torque"): 0.14},
    )
    friction, torque, bias = (
        {
            "effect": effect, "body": "arm", "not_separable_from": [],
            "parameters": {name: {"mean": 0.15, "sd": 0.01, "hdi": [0.13, 0.17], "unit": unit}},
        }
        for effect, name, unit in (
            ("pivot_friction", "torque", "N m"),
            ("constant_torque", "torque", "N m"),
            ("sensor_bias", "theta", "rad"),
        )
    )  # fmt: skip
    errors = {"seconds": 0.2, "quantity": "angle", "unit": "rad", "before": 0.09, "after": 0.036}
    made = measured.Result(
        "arm", "laplace", 0, "abc", "0", "effects-added", "Something was missing.",
        (friction, torque, bias), (errors,), seconds=12.0,
    )  # fmt: skip
    return recording, made


def test_a_result_is_the_same_from_its_file(measured, result, tmp_path) -> None:
    _, made = result
    made.save(tmp_path / "some" / "arm.json")
    assert measured.Result.load(tmp_path / "some" / "arm.json") == made
    assert measured.Result.load(tmp_path / "other.json") is None


def with_names(made, *groups):
    """The result with these names added, alternatives after a slash."""
    names = [group.split("/") for group in groups]
    return replace(
        made,
        added=tuple(
            made.added[0] | {"effect": first, "not_separable_from": others}
            for first, *others in names
        ),
    )


@pytest.mark.parametrize(
    ("names", "judged", "false", "missing"),
    [
        (["pivot_friction", "pivot_damping"], "right", [], []),
        (["pivot_friction", "angular_drag"], "right", [], []),  # the same data as a law
        (["pivot_friction", "pivot_damping", "sensor_bias"], "right", [], []),  # may be there too
        (["pivot_friction"], "partly", [], ["pivot_damping"]),
        (["constant_torque/pivot_friction"], "partly", [], ["pivot_damping"]),  # confounded
        (["pivot_friction", "constant_torque"], "wrong", ["constant_torque"], ["pivot_damping"]),
        (["sensor_bias"], "missed", [], ["pivot_friction", "pivot_damping"]),
        ([], "missed", [], ["pivot_friction", "pivot_damping"]),
    ],
)
def test_names_are_judged(measured, result, names, judged, false, missing) -> None:
    recording, made = result
    made = with_names(made, *names)
    assert measured.judgement(recording, made) == judged
    assert measured.false_names(recording, made) == false
    assert measured.missing_laws(recording, made) == missing


@pytest.mark.parametrize(
    ("names", "expected", "judged"),
    [
        (["pivot_friction", "pivot_damping"], "effects-added", "unexplained"),
        (["pivot_friction", "pivot_damping"], "effects-added, or unexplained beside", "right"),
        (["pivot_friction"], "", "unexplained"),
        (["pivot_friction"], "effects-added, or unexplained beside", "unexplained"),
        (["pivot_friction", "constant_torque"], "", "wrong"),
        (["sensor_bias"], "", "missed"),
        ([], "", "missed"),
    ],
)
def test_what_the_loop_leaves_unexplained_is_judged(
    measured, result, names, expected, judged
) -> None:
    recording, made = result
    made = replace(with_names(made, *names), verdict="unexplained")
    assert measured.judgement(replace(recording, expected=expected), made) == judged


def test_a_clean_recording_has_no_names(measured, result) -> None:
    recording, made = result
    clean = replace(recording, laws=(), also=(), expected="")
    silent = replace(made, added=(), verdict="adequate")
    assert measured.judgement(clean, silent) == "right"
    assert measured.judgement(clean, made) == "wrong"
    assert measured.judgement(clean, replace(silent, verdict="unexplained")) == "unexplained"
    # something is there that no catalogue has
    camera = replace(clean, outside=("camera",), also=("sensor_bias",), expected="unexplained")
    assert measured.judgement(camera, silent) == "missed"
    assert measured.judgement(camera, replace(silent, verdict="unexplained")) == "right"
    assert measured.judgement(camera, with_names(made, "sensor_bias")) == "right"


def test_a_name_on_another_body_is_wrong(measured, result) -> None:
    recording, made = result
    made = with_names(made, "pivot_friction", "pivot_damping")
    assert measured.judgement(replace(recording, body="arm"), made) == "right"
    assert measured.judgement(replace(recording, body="leg"), made) == "wrong"


def test_without_a_verdict_a_result_is_late_or_failed(measured, result) -> None:
    recording, made = result
    made = with_names(made, "pivot_friction", "pivot_damping")
    assert measured.judgement(recording, made, limit=12) == "right"
    assert measured.judgement(recording, made, limit=11) == "late"
    late = replace(made, verdict="late", error="no verdict in 300 s")
    assert measured.judgement(recording, late) == "late"
    assert measured.judgement(recording, replace(late, verdict="failed")) == "failed"
    assert measured.judgement(recording, replace(made, verdict="not-converged")) == "failed"


def test_bars_by_hand(page, result) -> None:
    """Errors at most 1.25 times the best law's 0.03 rad, at most 60 s; a failure passes none."""
    recording, made = result
    good = with_names(made, "pivot_friction", "pivot_damping")
    assert page.ratios(recording, good) == pytest.approx([1.2])
    assert page.bars(recording, good) == (True, True, True)
    for after in (0.038, None, np.inf):
        far = replace(good, errors=({**made.errors[0], "after": after},))
        assert page.bars(recording, far) == (True, False, True)
    assert page.bars(recording, replace(good, seconds=61.0)) == (True, True, False)
    broken = replace(made, verdict="failed", added=(), errors=(), error="MemoryError: ")
    assert page.bars(recording, broken) == (False, False, False)
    others = [recording, replace(recording, name="leg"), replace(recording, name="head")]
    told = page.summary(others, {"arm": good, "leg": broken})
    assert told.startswith("Of 3 recordings 2 were run: 1 right, 1 failed.")
    assert told.endswith("law in the catalogue: 1. At most 60 s: 1.")


def test_failures_by_hand(page, result) -> None:
    recording, made = result
    assert page.failures(recording, made) == ["False name: `constant_torque`."]
    recording = replace(recording, laws=("pivot_friction",))
    friction, _, bias = made.added
    assert page.failures(recording, replace(made, added=(friction, bias))) == []
    assert page.failures(recording, replace(made, added=())) == ["Not right: missed."]
    (far,) = page.failures(
        recording, replace(made, added=(friction,), errors=({**made.errors[0], "after": 0.06},))
    )
    assert far == "The error of the angle at 0.2 s is 2.00 times that of the best law."
    (off,) = page.failures(
        replace(recording, sizes={("pivot_friction", "torque"): 0.2}),
        replace(made, added=(friction,)),
    )
    assert off.endswith("0.130 to 0.170, does not hold the 0.200 of the independent fit.")
    (broken,) = page.failures(recording, replace(made, error="PbrlError: no way"))
    assert broken == "The loop failed: PbrlError: no way."


def test_a_table_has_a_row_a_recording(page, result) -> None:
    recording, made = result
    own = replace(recording, name="own", laws=("pivot_friction", "constant_torque"), ahead=())
    others = [replace(recording, name=name) for name in ("leg", "head")]
    broken = replace(made, verdict="failed", added=(), errors=(), error="a | b\nc", seconds=300)
    found = {"arm": made, "head": broken, "own": made}
    table = page.markdown_table([recording, *others, own], found).splitlines()
    assert len(table) == 6
    assert {line.count("|") for line in table} == {9}
    arm, leg, head, own_row = table[2:]
    assert "`pivot_friction` of arm: torque 0.150 (0.130 to 0.170) N m" in arm
    assert "| **wrong** | 0.0900 → 0.0360 rad at 0.2 s: 1.20 times |" in arm
    assert arm.endswith("| 0.0900 → 0.0300 rad at 0.2 s | effects-added | 12 |")
    assert leg.endswith("| not run | – | – | 0.0900 → 0.0300 rad at 0.2 s | – | – |")
    assert "| a / b c | **failed** | – |" in head
    assert head.endswith("rad at 0.2 s | **failed** | **300** |")
    assert "| right | 0.0900 → 0.0360 rad at 0.2 s | – | effects-added | 12 |" in own_row


def test_a_page_is_written_between_its_markers_again_and_again(page, result, tmp_path) -> None:
    recording, made = result
    path = tmp_path / "hardware.md"
    path.write_text(f"# Title\n\n{page.BEGIN}\nold\n{page.END}\n\nThe end.\n")
    made.save(tmp_path / "hardware" / "arm.json")
    (tmp_path / "hardware" / "arm.png").write_bytes(b"")
    page.write_page(path, [recording])
    text = path.read_text()
    assert text.startswith("# Title\n") and text.endswith("\n\nThe end.\n")
    assert "old" not in text
    assert "**False name: `constant_torque`.**" in text
    assert "(hardware/arm.png)" in text
    page.write_page(path, [recording])
    assert path.read_text() == text
    path.write_text("# Title\n")
    with pytest.raises(ValueError, match="expected one line"):
        page.write_page(path, [recording])


def test_the_page_shows_the_results_beside_it(measured, page, tmp_path) -> None:
    """Made again of the same results it is the same: `--page` was run on what is there."""
    if not measured.SHARED.is_dir():
        pytest.skip(f"the independent fits are not at {measured.SHARED}")
    shutil.copytree(page.RESULTS, tmp_path / "hardware")
    shutil.copy(page.PAGE, tmp_path)
    page.write_page(tmp_path / "hardware.md")
    assert (tmp_path / "hardware.md").read_text() == page.PAGE.read_text()
    for picture in page.RESULTS.glob("*.png"):
        assert picture.stat().st_size <= 60_000


@pytest.fixture
def runs(board, result, folder, monkeypatch):
    """Recordings `arm` and `leg`, whose loops end at once, and what was run of them."""
    recording, made = result
    here = tuple(replace(recording, name=name, folder=folder) for name in ("arm", "leg"))
    runs = []

    def apart(function, recording, path, method, within, *, limit):
        runs.append((recording.name, method, within))
        if recording.name == "leg":
            raise ChildProcessError("exit code -9")
        replace(made, name=recording.name, sources=board.sources()).save(path)
        path.with_suffix(".png").write_bytes(b"picture")

    monkeypatch.setattr(board, "MEASURED", here)
    monkeypatch.setattr(board, "RAW", ())
    monkeypatch.setattr(board, "simulated", tuple)
    monkeypatch.setattr(board, "SHARED", folder)
    monkeypatch.setattr(board, "apart", apart)
    return runs


def shown(board, options, monkeypatch, capsys):
    """Lines of the board."""
    monkeypatch.setattr(board, "parsed", lambda: options)
    board.main()
    return capsys.readouterr().out.splitlines()


def test_the_board_has_a_line_a_recording(board, runs, monkeypatch, tmp_path, capsys) -> None:
    """The recordings after one that crashes are run all the same."""
    arm, leg, total = shown(board, settings(tmp_path), monkeypatch, capsys)
    assert arm.split()[:5] == ["arm", "wrong", "effects-added", "12", "s"]
    assert arm.endswith("pivot_friction of arm, constant_torque of arm, sensor_bias of arm")
    assert leg.split()[:3] == ["leg", "failed", "failed"]
    assert leg.endswith("ChildProcessError: exit code -9")
    assert total == "2 of 2 recordings: 1 wrong, 1 failed; 12 s"
    assert runs == [("arm", "laplace", 300), ("leg", "laplace", 300)]


def test_a_recording_is_run_once(board, runs, monkeypatch, tmp_path, capsys) -> None:
    """Until the code or the method is another; a failure is tried again."""
    for _ in range(2):
        shown(board, settings(tmp_path), monkeypatch, capsys)
    assert [name for name, *_ in runs] == ["arm", "leg", "leg"]
    shown(board, settings(tmp_path, names=["ar"], method="importance"), monkeypatch, capsys)
    monkeypatch.setattr(board, "sources", lambda: "other")
    shown(board, settings(tmp_path, names=["arm"]), monkeypatch, capsys)
    assert [name for name, *_ in runs[3:]] == ["arm", "arm"]
    # a verdict after the limit is late, and needs no run
    (line, _) = shown(board, settings(tmp_path, names=["arm"], limit=5), monkeypatch, capsys)
    assert line.split()[:3] == ["arm", "late", "effects-added"]
    assert len(runs) == 5


def test_a_late_recording_is_run_again_with_more_time(
    board, runs, monkeypatch, tmp_path, capsys
) -> None:
    def apart(*given, limit):
        runs.append(limit)
        raise TimeoutError("no end")

    monkeypatch.setattr(board, "apart", apart)
    times = iter([0.0, 10.0, 10.0, 30.0])
    monkeypatch.setattr(board, "children", lambda: next(times))
    for limit in (10, 10, 20):
        options = settings(tmp_path, names=["arm"], limit=limit)
        line, total = shown(board, options, monkeypatch, capsys)
        assert line.split()[:3] == ["arm", "late", "late"]
        assert line.endswith(f"no verdict in {limit} s")
    assert runs == [100, 200]
    assert total == "1 of 1 recordings: 1 late; 20 s"


def test_a_process_ends_at_its_processor_time(board, measured, folder, tmp_path) -> None:
    """Imports take longer than a second."""
    options = settings(tmp_path, limit=1)
    board.run_apart(measured.Recording("disc", folder), tmp_path / "disc.json", options)
    result = measured.Result.load(tmp_path / "disc.json")
    assert (result.verdict, result.error) == ("late", "no verdict in 1 s")
    assert 0.0 < result.seconds < 60.0


def test_the_page_is_made_by_the_board(board, page, runs, monkeypatch, tmp_path, capsys) -> None:
    """Results of measured recordings, with pictures, are kept beside it."""
    path = tmp_path / "hardware.md"
    path.write_text(f"{page.BEGIN}\n{page.END}\n")
    monkeypatch.setattr(board, "RESULTS", path.with_suffix(""))
    monkeypatch.setattr(board, "write_page", lambda: page.write_page(path, board.MEASURED))
    shown(board, settings(tmp_path / "cache", page=True), monkeypatch, capsys)
    assert (tmp_path / "hardware" / "arm.png").read_bytes() == b"picture"
    text = path.read_text()
    assert "Of 2 recordings 2 were run: 1 wrong, 1 failed." in text
    assert "ChildProcessError: exit code -9" in text


def test_without_recordings_the_board_says_so(board, runs, monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(board, "parsed", lambda: settings(tmp_path, names=["tail"]))
    with pytest.raises(SystemExit, match="no recording has tail in its name"):
        board.main()
    monkeypatch.setattr(board, "SHARED", tmp_path / "nowhere")
    with pytest.raises(SystemExit) as ended:
        board.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("the recordings are not part of the project")


def test_all_recordings_beside_the_project_are_on_the_board(board, measured) -> None:
    """Each folder and each raw file, with laws of the catalogue, an example or an actuator."""
    if not measured.SHARED.is_dir():
        pytest.skip(f"no recordings at {measured.SHARED}")
    every = board.chosen(settings(None))
    assert len({each.name for each in every}) == len(every)
    assert all(each.is_there for each in every)
    told = {each.folder for each in every}
    folders = {path.parent for path in measured.SHARED.glob("*/**/scene.toml")}
    assert folders <= told
    lines = (measured.SHARED / "raw" / "README.md").read_text().splitlines()
    assert sum(line.startswith("| `") for line in lines) == len(board.RAW)
    laws = {effect.name for effect in pp.catalogue} | {*EXAMPLES, "pwm_dead_zone"}
    assert all(each.right <= laws for each in every)
    (pair,) = (each for each in every if each.name == "pair-linear-drag")
    assert (pair.laws, pair.body) == (("linear_drag",), "desk")


def test_a_raw_log_is_read_as_a_new_user_would(measured, folder) -> None:
    """By one command and one edit of the scene that it writes."""
    from attribution.raw import Raw

    table = pd.read_csv(folder / "test.csv")
    columns = {"x": "px", "y": "py", "theta": "yaw", "time": "t"}
    table[["trajectory", *columns]].rename(columns=columns).to_csv(folder / "log.csv", index=False)
    options = ("--columns", "x=px,y=py,theta=yaw,time=t", "--top", "--body", "disc=circle:0.1")
    log = Raw(
        "disc", folder, train="log.csv", new=options,
        edits=(("# known = { mass", "known = { mass = 2.0 }"),), more="[noise]\nx = 0.001",
    )  # fmt: skip
    scene, train, test = log.load()
    assert (dict(scene.bodies[0].known), dict(scene.noise)) == ({"mass": 2.0}, {"x": 0.001})
    assert (train.n_trajectories, test) == (4, None)
    with pytest.raises(ValueError, match="no line that begins 'anchor_a'"):
        replace(log, edits=(("anchor_a", ""),)).load()
    with pytest.raises(ValueError, match=r"^units: .* is none of x"):
        replace(log, new=(*options, "--units", "x=m/54")).load()


def test_forecasts_from_fitted_initial_states_by_hand(measured) -> None:
    """A fall without drag: a straight line through 7 rows, of what gravity leaves."""
    from attribution.fitted_initial_states import forecast_errors

    history = fall(0, trajectories=3, memory=0.0)
    problem = Problem.of(Physics(BALL, substeps=40), history, horizon=2)
    found = forecast_errors(problem, np.zeros(0), history, 7, 20)
    time = np.arange(45) / 30
    line = history.dataset["observed"].to_numpy()[:, :, 0, 1] + 0.5 * GRAVITY * time**2
    errors = [
        own[begin + 26] - np.polyval(np.polyfit(time[:7], own[begin : begin + 7], 1), time[26])
        for own in line
        for begin in (0, 10)
    ]
    assert found == {"y": pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.02)}
    assert forecast_errors(problem, np.zeros(0), history, 7, 40) == {}


def test_errors_of_an_independent_fit_are_those_of_its_parameters(measured) -> None:
    """A servo with the friction that another integrator fitted: errors within 3 %."""
    from attribution.fitted_initial_states import forecast_errors

    (recording,) = (each for each in measured.MEASURED if each.name == "bam-xl330")
    if not recording.folder.is_dir():
        pytest.skip(f"no recording at {recording.folder}")
    known = json.loads((recording.folder / "reference.json").read_text())
    gravity, gain, viscous, dry = known["steps"]["viscous + dry"]["parameters"]
    mass, length, sides = 0.49, 0.1, (0.04, 0.14)
    inertia = mass * 9.81 * length / gravity  # about the hinge; parameters are over it
    given = {
        "inertia_scale_scale": (inertia - mass * length**2) * 12 / mass / np.dot(sides, sides),
        "torque_gain_factor": gain * inertia,
        "pivot_damping_coefficient": viscous * inertia,
        "pivot_friction_torque": dry * inertia,
    }
    scene, train, test = recording.load()
    by_name = {effect.name: effect for effect in pp.catalogue}
    added = [by_name[name].on("arm") for name in ("pivot_damping", "pivot_friction")]
    problem = Problem.of(Physics.declare(scene, added, substeps=20, threads=1), train)
    labels = [label.removesuffix("[arm]") for label in problem.layout.labels]
    phi = np.array([given.get(label, 0.1) for label in labels])  # no wheel: the others do nothing
    for ahead in recording.ahead:
        intervals = round(ahead.seconds / scene.time_step)
        found = forecast_errors(problem, phi, test, recording.start_rows, intervals)
        assert found == {"theta": pytest.approx(ahead.best, rel=0.03)}


def test_a_process_that_does_not_end_or_crashes_is_told(board) -> None:
    assert board.apart(abs, -3, limit=0) == 3
    with pytest.raises(TimeoutError, match="no end after 1 s; allow more with --limit"):
        board.apart(time.sleep, 60, limit=1)
    with pytest.raises(ChildProcessError, match="ended with exit code 3"):
        board.apart(os._exit, 3, limit=0)


def test_a_failure_is_a_result(measured, folder, tmp_path) -> None:
    (folder / "test.csv").unlink()
    measured.run(measured.Recording("disc", folder), tmp_path / "disc.json")
    result = measured.Result.load(tmp_path / "disc.json")
    assert result.verdict == "failed"
    assert result.error.startswith("FileNotFoundError")


@pytest.mark.slow
def test_a_simulated_folder_is_run_as_a_measured_one(
    measured, folder, monkeypatch, tmp_path
) -> None:
    """Errors told are those of the loop's own models; its drag is 1.6 kg/s."""
    loops = []

    def kept(*given, **options):
        loops.append(measured_revise(*given, **options))
        return loops[-1]

    measured_revise = measured.close_loop
    monkeypatch.setattr(measured, "close_loop", kept)
    own = measured.Recording("disc", folder, about="A disc.")
    measured.run(own, tmp_path / "disc.json")
    result = measured.Result.load(tmp_path / "disc.json")
    picture = (tmp_path / "disc.png").read_bytes()
    assert (result.error, result.verdict) == (None, "effects-added")
    (drag,) = result.added
    assert drag["effect"] == "linear_drag"
    size = drag["parameters"]["coefficient"]
    # a false alarm in 6e-5
    assert abs(size["mean"] - RATE * MASS) < 4.0 * size["sd"]
    assert picture.startswith(b"\x89PNG")
    assert len(picture) <= 60_000
    (found,) = loops
    angle, place = result.errors
    for row, names in ((angle, ["theta"]), (place, ["x", "y"])):
        assert row["seconds"] == pytest.approx(0.1 * found.forecasts.horizon)
        for key in ("before", "after"):
            told = getattr(found, key).rollout_rmse
            assert row[key] == pytest.approx(np.hypot.reduce([told[n] for n in names]), rel=0.02)
    assert place["after"] < 0.1 * place["before"]
    # none of the held-out trajectories is as long as 3 s
    asked = replace(own, ahead=(measured.Ahead(0.5, "position"), measured.Ahead(3.0, "angle")))
    train, test = own.load()[1:]
    half, long = measured.errors_ahead(asked, found, train, test)
    assert half["after"] < place["after"] * 3
    assert long["before"] is None and long["after"] is None
    fitted, long = measured.errors_ahead(replace(asked, start_rows=9), found, train, test)
    assert fitted["after"] < 0.1 * fitted["before"]
    assert long["before"] is None and long["after"] is None


def test_recordings_load_with_the_coordinates_that_are_used(measured) -> None:
    there = [each for each in measured.MEASURED if each.folder.is_dir()]
    if not there:
        pytest.skip(f"no recordings at {measured.SHARED}")
    assert len({each.name for each in measured.MEASURED}) == len(measured.MEASURED)
    for recording in there:
        scene, train, test = recording.load()
        for history in (train, test):
            observed = np.isfinite(history.dataset["observed"].to_numpy()).any(axis=(0, 1, 2))
            names = {name for name, seen in zip(STATE, observed, strict=True) if seen}
            assert names & {"theta", "y"}
            if recording.coordinates == ("theta",):
                assert names <= {"theta", "omega"}  # x, y, vx and vy follow from the hinge
        longest = int(test.dataset["n_rows"].min()) - 1
        for ahead in recording.ahead:
            assert round(ahead.seconds / scene.time_step) <= longest
        # a reference may name laws that have become examples
        assert recording.right <= {effect.name for effect in pp.catalogue} | {*EXAMPLES}


@pytest.mark.long
def test_a_measured_recording_is_run(measured, tmp_path) -> None:
    """Angle and torque alone; without friction an independent fit is off by 0.086 rad."""
    (recording,) = (each for each in measured.MEASURED if each.name == "pendulum-torque")
    if not recording.folder.is_dir():
        pytest.skip(f"no recording at {recording.folder}")
    measured.run(recording, tmp_path / "arm.json")
    result = measured.Result.load(tmp_path / "arm.json")
    assert result.error is None and (tmp_path / "arm.png").is_file()
    (row,) = result.errors
    assert 0.05 < row["before"] < 0.2
    assert row["after"] <= row["before"]
