"""The scoreboard of attribution: its scores by hand, and its data; no loop is run."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import pbrl_ppl as pp
from tests.helpers.places import ROOT

pytest.importorskip("Box2D", reason="Box2D makes the cases; install the extra `test`")

pytestmark = pytest.mark.one_stack


@pytest.fixture
def attribution(monkeypatch):
    """Modules of analysis/attribution can be imported, as the script imports them."""
    monkeypatch.syspath_prepend(str(ROOT / "analysis"))
    import attribution.baselines
    import attribution.cases
    import attribution.measured
    import attribution.one_case
    import attribution.oracle
    import attribution.scores
    import attribution.words

    return attribution


@pytest.fixture
def row(attribution):
    """A made-up row: names added, first one first, an alternative after a slash."""

    def make(kind, verdict, *added, effect="linear_drag", seen=True, remains=False, hdi=(0.0, 2.0)):
        names = [name.split("/") for name in added]
        findings = {
            "verdict": verdict,
            "unexplained": {"sentence": "something"} if remains else None,
            "small": [],
            "added": [
                {
                    "effect": name,
                    "not_separable_from": others,
                    "parameters": {"coefficient": {"mean": 1.0, "hdi": list(hdi)}},
                }
                for name, *others in names
            ],
        }
        hidden = kind not in ("clean", "nonsense")
        return attribution.one_case.Row(
            name="made up",
            kind=kind,
            body="cart",
            effect=effect if hidden else None,
            truth={"coefficient": 1.5} if hidden else {},
            oracle=attribution.oracle.Oracle(99.0, 1e-9 if seen else 0.3) if hidden else None,
            findings=None if verdict == "failed" else findings,
            error="why" if verdict == "failed" else None,
            seconds=10.0,
        )

    return make


def test_scores_by_hand(attribution, row) -> None:
    rows = [
        row("catalogued", "effects-added", "linear_drag"),  # named, inside
        row("catalogued", "effects-added", "quadratic_drag/linear_drag"),  # named, of a group
        row("catalogued", "effects-added", "linear_drag", "dead_zone", hdi=(0, 1)),  # named, off
        row("catalogued", "effects-added", "dead_zone", "linear_drag"),  # misnamed
        row("catalogued", "effects-added", "dead_zone", remains=True),  # says that more remains
        row("catalogued", "adequate"),  # missed
        row("catalogued", "not-converged", "linear_drag"),
        row("catalogued", "failed"),
        row("catalogued", "adequate", seen=False),  # nobody could have seen it
        row("left-out", "unexplained", remains=True),  # abstained
        row("left-out", "effects-added", "quadratic_drag"),  # misnamed
        row("outside", "effects-added", "quadratic_drag", remains=True),  # abstained
        row("outside", "adequate"),  # missed
        row("outside", "effects-added", "quadratic_drag", seen=False),
        row("clean", "adequate"),
        row("clean", "adequate"),
        row("clean", "effects-added", "linear_drag"),
        row("clean", "unexplained", remains=True),
        row("nonsense", "adequate"),
        row("nonsense", "not-converged"),
    ]
    assert attribution.scores.score(rows) == {
        "naming": 3 / 8,
        "abstention": 2 / 4,
        "misnamed": 2 / 12,
        "missed": 2 / 12,
        "false_alarms": 2 / 4,
        "coverage": 1 / 2,  # the second named another effect of its group
        "excess": None,  # nobody asked the oracle for forecasts
        "baseline_naming": None,
        "nonsense_adequate": 1,
        "cases": 20,
        "detected": 12,
        "failed": 1,
        "not_converged": 2,
        "seconds": 200.0,
    }
    assert attribution.words.table(rows).row_count == 20
    assert {attribution.words.plain(each)["outcome"] for each in rows[:8]} == {
        "named", "misnamed", "abstained", "missed", "not-converged", "failed"
    }  # fmt: skip


def test_excess_and_baselines_by_hand(attribution, row) -> None:
    found = row("catalogued", "effects-added", "linear_drag")
    found.findings["error"] = {"after": {"rollout_rmse": {"x": 0.011, "vx": 0.11}}}
    # the loop may leave out a velocity that looks as if computed from positions
    oracle = attribution.oracle.Oracle(99.0, 1e-9, {"x": 0.01, "vx": 0.1, "vy": 0.1})
    rows = [
        replace(found, oracle=oracle, baselines={"correlation": name})
        for name in ("linear_drag", "spring", None)
    ]
    scores = attribution.scores.score(rows)
    assert scores["excess"] == pytest.approx(0.1)
    assert scores["naming_correlation"] == scores["baseline_naming"] == pytest.approx(1 / 3)
    assert "naming_sparse_regression" not in scores  # it was not there
    twin = replace(rows[0], effect="force_gain", baselines={"correlation": "torque_gain"})
    assert attribution.scores.score([twin])["baseline_naming"] == 1.0


@pytest.mark.parametrize(
    ("effect", "value"), [("linear_drag", 0.6), ("angular_drag", 0.02), ("magnus_force", 0.15)]
)
def test_baselines_name_what_is_linear_in_its_coefficient(attribution, effect, value) -> None:
    """Of a free puck, strongly: the simple ways do work where they can."""
    case = attribution.cases.Case("made up", "catalogued", "puck", effect, value)
    train, _ = case.histories(seed=1)
    declared = attribution.oracle.declared_mode(case, train, seed=1)
    names = attribution.baselines.ask_baselines(declared)
    assert names["correlation"] == effect
    assert names["sparse_regression"] in (effect, None)  # without pysindy, none


def test_the_closest_of_an_effect_s_terms_counts(attribution) -> None:
    """Not the last: an effect may have a term in each equation, and two in one."""
    x = np.linspace(-1.0, 1.0, 50)
    left = {"x": x, "y": np.cos(9 * x)}
    named = {
        "x": {("body_force", "cos"): x, ("body_force", "sin"): x**2, ("spring", "x"): x + x**3},
        "y": {("spring", "y"): x**2},
    }
    assert attribution.baselines.WAYS["correlation"](left, named) == "body_force"


def test_no_cases_no_shares(attribution) -> None:
    scores = attribution.scores.score([])
    assert scores["naming"] is None
    assert scores["cases"] == 0


def test_cases_are_as_announced(attribution) -> None:
    cases = attribution.cases.all_cases()
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    kinds = [case.kind for case in cases]
    assert kinds.count("clean") >= 60
    assert 0.18 < kinds.count("clean") / len(cases) < 0.25
    tenth = attribution.cases.a_tenth(cases)
    assert 0.09 < len(tenth) / len(cases) < 0.12
    assert {case.kind for case in tenth} == set(attribution.cases.KINDS)
    assert len(attribution.cases.all_cases(2)) == 2 * len(cases)
    for case in cases:
        truth = attribution.oracle.true_parameters(case)
        assert bool(truth) == (case.effect is not None)
        left = {effect.name for effect in case.catalogue}
        assert (case.effect in left) == (case.kind == "catalogued"), case.name


def test_a_hidden_drag_is_in_the_data(attribution) -> None:
    """Of a puck without a wheel: m dv = (F - c v) dt, so least squares give F's and v's share."""
    cases = {case.name: case for case in attribution.cases.all_cases()}
    name = "puck-linear_drag-large"
    case, blind = cases[f"catalogued-{name}"], cases[f"left-out-{name}"]
    assert case.value == 0.6
    assert "linear_drag" not in {effect.name for effect in blind.catalogue}
    train, test = case.histories(seed=0)
    assert (len(train.dataset["trajectory"]), len(test.dataset["trajectory"])) == (12, 4)
    segments = train.segments()
    v, later = segments.start[:, 0, 3:5], segments.observed[:, 0, 0, 3:5]
    force = segments.actions[:, 0, 0, :2]
    mean = 0.5 * (v + later)
    table = np.column_stack([force.ravel(), mean.ravel()])
    (per_force, per_speed), *_ = np.linalg.lstsq(table, (later - v).ravel() / 0.1, rcond=None)
    assert 1 / per_force == pytest.approx(2.0, rel=0.02)
    assert -per_speed / per_force == pytest.approx(0.6, rel=0.05)
    again, _ = case.histories(seed=0)
    assert again.data_sha256 == train.data_sha256 != case.histories(seed=1)[0].data_sha256


def test_a_log_in_degrees(attribution) -> None:
    cases = {case.name: case for case in attribution.cases.all_cases()}
    train, _ = cases["nonsense-pendulum-degrees-0"].histories(seed=0)
    angle = train.dataset["start"].to_numpy()[..., 2]
    assert np.nanmax(np.abs(angle)) > 20


def test_a_failure_is_a_row(attribution, monkeypatch) -> None:
    def breaks(*args, **settings):
        raise pp.PbrlError("no way; try another")

    monkeypatch.setattr(attribution.one_case, "revise", breaks)
    case = next(c for c in attribution.cases.all_cases() if c.name == "clean-puck-00")
    row = attribution.one_case.run_case(case, seed=0)
    assert row.verdict == "failed"
    assert "PbrlError: no way" in row.error


def test_what_is_kept_is_not_made_again(attribution, row, monkeypatch, tmp_path) -> None:
    import attribution_benchmark as benchmark

    cases = attribution.cases.all_cases()[:2]
    made = []

    def quick(case, seed, draws, method):
        made.append(case.name)
        return row(case.kind, "adequate" if case is cases[0] else "failed")

    monkeypatch.setattr(benchmark, "run_case", quick)
    with ThreadPoolExecutor(1) as executor:
        for _ in range(2):
            rows = list(benchmark.results(cases, executor, 0, None, "laplace", tmp_path))
            assert sorted(each.verdict for each in rows) == ["adequate", "failed"]
        # a failure is tried again; other settings are another case
        assert made == [cases[0].name, cases[1].name, cases[1].name]
        list(benchmark.results(cases[:1], executor, 1, None, "laplace", tmp_path))
    assert len(made) == 4


def test_an_interrupted_run_keeps_what_is_done(attribution, row, monkeypatch) -> None:
    import attribution_benchmark as benchmark

    def rows():
        yield row("clean", "adequate")
        raise KeyboardInterrupt

    said = []
    monkeypatch.setattr(benchmark, "say", said.append)
    done = benchmark.watched(rows(), 5, kept=0, verbose=False)
    assert [each.verdict for each in done] == ["adequate"]
    assert said[0].startswith("1/5 made up: adequate, 10 s; about")
    assert said[1].startswith("interrupted: 1 of 5")


def test_a_dead_worker_is_a_row(attribution, monkeypatch) -> None:
    import attribution_benchmark as benchmark

    class Dies:
        def submit(self, *arguments):
            future = Future()
            future.set_exception(RuntimeError("gone"))
            return future

    (only,) = benchmark.results(attribution.cases.all_cases()[:1], Dies(), 0, None, "laplace", None)
    assert only.verdict == "failed"
    assert "gone" in only.error
    assert "--workers" in only.error


def test_the_measured_pendulum_is_left_out_where_it_is_not(attribution, tmp_path) -> None:
    none = attribution.measured.pendulum_errors(tmp_path / "nowhere")
    assert {"pendulum_1s", "pendulum_2s", "pendulum_angle_only_1s"} < set(none)
    assert set(none.values()) == {None}


def test_other_measured_recordings_are_left_out_where_they_are_not(attribution, tmp_path) -> None:
    measured = attribution.measured
    none = measured.double_pendulum_errors(tmp_path / "nowhere")
    none |= measured.push_errors(tmp_path / "nowhere")
    assert none == {"double_pendulum_01s": None, "push_mm": None, "push_deg": None}


def test_the_pushed_blocks_error_is_in_the_plane(attribution, shared_data, monkeypatch) -> None:
    folder = shared_data.parent / "contact" / "planar-push"
    if not folder.is_dir():
        pytest.skip(f"no recorded pushes at {folder}")
    error = {"x": 3e-3, "y": 4e-3, "theta": np.radians(2.0)}
    found = SimpleNamespace(after=SimpleNamespace(rollout_rmse=error))
    monkeypatch.setattr(attribution.measured, "revise", lambda *args, **settings: found)
    told = attribution.measured.push_errors(folder)
    assert told == pytest.approx({"push_mm": 5.0, "push_deg": 2.0})


@pytest.mark.slow
def test_the_double_pendulums_error_is_of_a_tenth_of_a_second(
    attribution, shared_data, monkeypatch, tmp_path
) -> None:
    """Three trajectories, and nothing added: as far off as without friction."""
    folder = shared_data / "real" / "double-pendulum-driven"
    if not folder.is_dir():
        pytest.skip(f"no recorded double pendulum at {folder}")
    (tmp_path / "scene.toml").write_text((folder / "scene.toml").read_text())
    for name in ("train", "test"):
        rows = pd.read_csv(folder / f"{name}.csv")
        first = rows["trajectory"].isin(rows["trajectory"].unique()[:3])
        rows[first].to_csv(tmp_path / f"{name}.csv", index=False)
    found = SimpleNamespace(added=(), numerical=SimpleNamespace(substeps_used=20))
    monkeypatch.setattr(attribution.measured, "revise", lambda *args, **settings: found)
    told = attribution.measured.double_pendulum_errors(tmp_path)
    assert 0.01 < told["double_pendulum_01s"] < 0.2
