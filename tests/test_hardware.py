"""Measured recordings: the script that runs the loop on them, and the page On hardware."""

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
from tests.helpers.falls import BALL, GRAVITY, fall
from tests.helpers.places import ROOT

for engine in ("Box2D", "mujoco"):
    pytest.importorskip(engine, reason=f"{engine} makes cases; install the extra `test`")

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
def benchmark(measured):
    import attribution_benchmark

    return attribution_benchmark


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


def settings(**changed):
    """The command line's options."""
    usual = {"folder": None, "only": None, "list": False, "write_page": False, "cache": None}
    usual |= {"seed": 0, "method": None, "verbose": False, "json": None, "limit": 300}
    return SimpleNamespace(**usual | changed)


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
    ("names", "right", "false", "missing"),
    [
        (["pivot_friction", "pivot_damping"], True, [], []),
        (["pivot_friction"], True, [], ["pivot_damping"]),
        (["pivot_friction", "angular_drag"], True, [], []),  # the same data as a law
        (["pivot_friction", "sensor_bias"], True, [], ["pivot_damping"]),  # may be there too
        (["constant_torque/pivot_friction"], True, [], ["pivot_damping"]),  # confounded
        (["pivot_friction", "constant_torque"], False, ["constant_torque"], ["pivot_damping"]),
        ([], False, [], ["pivot_friction", "pivot_damping"]),
    ],
)
def test_names_are_scored(page, result, names, right, false, missing) -> None:
    recording, made = result
    made = with_names(made, *names)
    assert page.is_right(recording, made) == right
    assert page.false_names(recording, made) == false
    assert page.missing_laws(recording, made) == missing


def test_bars_by_hand(page, result) -> None:
    """Errors at most 1.25 times the best law's 0.03 rad, at most 60 s; a failure passes none."""
    recording, made = result
    good = with_names(made, "pivot_friction")
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
    assert told.startswith("Of 3 recordings 2 were run. Right names and no false one: 1.")


def test_failures_by_hand(page, result) -> None:
    recording, made = result
    friction, _, bias = made.added
    assert page.failures(recording, made) == ["False name: `constant_torque`."]
    assert page.failures(recording, replace(made, added=(friction, bias))) == []
    assert page.failures(recording, replace(made, added=())) == ["No right name."]
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
    # a recording of a user's own: nothing is known of what is there
    assert page.failures(replace(recording, laws=(), also=(), ahead=(), sizes={}), made) == []


def test_a_table_has_a_row_a_recording(page, result) -> None:
    recording, made = result
    own = replace(recording, name="own", laws=(), also=(), ahead=())
    others = [replace(recording, name=name) for name in ("leg", "head")]
    broken = replace(made, verdict="failed", added=(), errors=(), error="a | b\nc", seconds=300)
    found = {"arm": made, "head": broken, "own": made}
    table = page.markdown_table([recording, *others, own], found).splitlines()
    assert len(table) == 6
    assert {line.count("|") for line in table} == {9}
    arm, leg, head, own_row = table[2:]
    assert "`pivot_friction` of arm: torque 0.150 (0.130 to 0.170) N m" in arm
    assert "| **no** | 0.0900 → 0.0360 rad at 0.2 s: 1.20 times |" in arm
    assert arm.endswith("| 0.0900 → 0.0300 rad at 0.2 s | effects-added | 12 |")
    assert leg.endswith("| not run | – | – | 0.0900 → 0.0300 rad at 0.2 s | – | – |")
    assert "| a / b c | **no** | – |" in head
    assert head.endswith("rad at 0.2 s | **failed** | **300** |")
    assert "| – | 0.0900 → 0.0360 rad at 0.2 s | – | effects-added | 12 |" in own_row


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
    """Made again of the same results it is the same: `--write-page` was run on what is there."""
    if not measured.SHARED.is_dir():
        pytest.skip(f"the independent fits are not at {measured.SHARED}")
    shutil.copytree(page.RESULTS, tmp_path / "hardware")
    shutil.copy(page.PAGE, tmp_path)
    page.write_page(tmp_path / "hardware.md")
    assert (tmp_path / "hardware.md").read_text() == page.PAGE.read_text()
    for picture in page.RESULTS.glob("*.png"):
        assert picture.stat().st_size <= 60_000


def test_a_folder_is_run_once(benchmark, measured, result, folder, tmp_path, monkeypatch) -> None:
    """Until the code, the seed or the method is another; a failure is tried again."""
    _, made = result
    runs = []

    def quick(function, recording, seed, method, progress, *, limit):
        runs.append((recording.name, seed, method))
        now = {"sources": benchmark.sources(), "seed": seed, "method": method}
        return replace(made, name=recording.name, **now), b"picture"

    monkeypatch.setattr(benchmark, "apart", quick)
    given = settings(folder=folder, cache=tmp_path / "kept", json=str(tmp_path / "all.json"))
    for _ in range(2):
        benchmark.measure(given)
    assert runs == [("disc", 0, "laplace")]
    assert (tmp_path / "kept" / "disc.png").read_bytes() == b"picture"
    assert json.loads((tmp_path / "all.json").read_text())["disc"]["verdict"] == "effects-added"
    benchmark.measure(SimpleNamespace(**vars(given) | {"seed": 1}))
    broken = replace(measured.Result.load(tmp_path / "kept" / "disc.json"), error="why")
    broken.save(tmp_path / "kept" / "disc.json")
    benchmark.measure(SimpleNamespace(**vars(given) | {"seed": 1}))
    assert runs[1:] == [("disc", 1, "laplace")] * 2


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
    scene, train, test = measured.load_recording(recording)
    by_name = {effect.name: effect for effect in pp.catalogue}
    added = [by_name[name].on("arm") for name in ("pivot_damping", "pivot_friction")]
    problem = Problem.of(Physics.declare(scene, added, substeps=20, threads=1), train)
    labels = [label.removesuffix("[arm]") for label in problem.layout.labels]
    phi = np.array([given.get(label, 0.1) for label in labels])  # no wheel: the others do nothing
    for ahead in recording.ahead:
        intervals = round(ahead.seconds / scene.time_step)
        found = forecast_errors(problem, phi, test, recording.start_rows, intervals)
        assert found == {"theta": pytest.approx(ahead.best, rel=0.03)}


def test_recordings_that_are_not_there_are_left_out(
    benchmark, result, tmp_path, monkeypatch, capsys
) -> None:
    recording, _ = result
    monkeypatch.setattr(benchmark, "MEASURED", (recording, replace(recording, name="leg")))
    said = []
    monkeypatch.setattr(benchmark, "say", said.append)
    benchmark.measure(settings(only=["ar"], cache=tmp_path))
    assert [each.partition(" at ")[0] for each in said] == ["arm: no recording"]
    assert capsys.readouterr().out.count("not run") == 2
    with pytest.raises(SystemExit, match="no recording has tail in its name"):
        benchmark.measure(settings(only=["tail"]))


def test_a_process_that_does_not_end_or_crashes_is_told(benchmark) -> None:
    assert benchmark.apart(abs, -3, limit=0) == 3
    with pytest.raises(TimeoutError, match="no end after 1 s; allow more with --limit"):
        benchmark.apart(time.sleep, 60, limit=1)
    with pytest.raises(ChildProcessError, match="ended with exit code 3"):
        benchmark.apart(os._exit, 3, limit=0)


@pytest.mark.parametrize("error", [TimeoutError("no end"), ChildProcessError("exit code -9")])
def test_a_recording_that_does_not_end_or_crashes_is_a_row(
    benchmark, result, folder, tmp_path, monkeypatch, capsys, error
) -> None:
    """The recordings after it are run all the same."""
    recording, made = result
    here = [replace(recording, name=name, folder=folder) for name in ("arm", "leg")]

    def apart(function, one, *given, limit):
        assert limit == 300
        if one.name == "arm":
            raise error
        return replace(made, name=one.name), b"picture"

    monkeypatch.setattr(benchmark, "MEASURED", here)
    monkeypatch.setattr(benchmark, "apart", apart)
    benchmark.measure(settings(cache=tmp_path))
    arm, leg = capsys.readouterr().out.splitlines()[2:]
    assert f"| {type(error).__name__}: {error} | **no** |" in arm
    assert "| effects-added | 12 |" in leg
    kept = benchmark.Result.load(tmp_path / "arm.json")
    assert kept.error == f"{type(error).__name__}: {error}"


def test_what_is_there_is_shown_after_an_interruption(
    benchmark, result, folder, tmp_path, monkeypatch, capsys
) -> None:
    recording, _ = result

    def apart(*given, limit):
        raise KeyboardInterrupt

    monkeypatch.setattr(benchmark, "MEASURED", [replace(recording, folder=folder)])
    monkeypatch.setattr(benchmark, "apart", apart)
    benchmark.measure(settings(cache=tmp_path))
    assert "| not run |" in capsys.readouterr().out


def test_a_failure_is_a_result(measured, folder) -> None:
    (folder / "test.csv").unlink()
    result, picture = measured.run(measured.Recording("disc", folder))
    assert (result.verdict, picture) == ("failed", None)
    assert result.error.startswith("FileNotFoundError")


@pytest.mark.slow
def test_a_simulated_folder_is_run_as_a_measured_one(measured, folder, monkeypatch) -> None:
    """Errors told are those of the loop's own models; its drag is 1.6 kg/s."""
    loops = []

    def kept(*given, **options):
        loops.append(measured_revise(*given, **options))
        return loops[-1]

    measured_revise = measured.close_loop
    monkeypatch.setattr(measured, "close_loop", kept)
    own = measured.Recording("disc", folder)
    result, picture = measured.run(own)
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
        assert row["seconds"] == pytest.approx(0.1 * found.rollout_horizon)
        for key in ("before", "after"):
            told = getattr(found, key).rollout_rmse
            assert row[key] == pytest.approx(np.hypot.reduce([told[n] for n in names]), rel=0.02)
    assert place["after"] < 0.1 * place["before"]
    # none of the held-out trajectories is as long as 3 s
    asked = replace(own, ahead=(measured.Ahead(0.5, "position"), measured.Ahead(3.0, "angle")))
    train, test = measured.load_recording(own)[1:]
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
        scene, train, test = measured.load_recording(recording)
        for history in (train, test):
            observed = np.isfinite(history.dataset["observed"].to_numpy()).any(axis=(0, 1, 2))
            names = {name for name, seen in zip(STATE, observed, strict=True) if seen}
            assert {"theta"} <= names
            if recording.coordinates == ("theta",):
                assert names <= {"theta", "omega"}  # x, y, vx and vy follow from the hinge
        longest = int(test.dataset["n_rows"].min()) - 1
        for ahead in recording.ahead:
            assert round(ahead.seconds / scene.time_step) <= longest
        catalogue = {effect.name for effect in pp.catalogue}
        assert recording.right <= catalogue


@pytest.mark.long
def test_a_measured_recording_is_run(measured) -> None:
    """Angle and torque alone; without friction an independent fit is off by 0.086 rad."""
    (recording,) = (each for each in measured.MEASURED if each.name == "pendulum-torque")
    if not recording.folder.is_dir():
        pytest.skip(f"no recording at {recording.folder}")
    result, picture = measured.run(recording)
    assert result.error is None and picture is not None
    (row,) = result.errors
    assert 0.05 < row["before"] < 0.2
    assert row["after"] <= row["before"]
