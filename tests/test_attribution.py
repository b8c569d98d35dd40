"""The scoreboard of attribution: its scores by hand, its cases and their data; no loop is run."""

import argparse
import json
import signal
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.physics import Physics
from pbrl_ppl.state import STATE
from tests.helpers.places import ROOT

for engine in ("Box2D", "mujoco"):
    pytest.importorskip(engine, reason=f"{engine} makes cases; install the extra `test`")

pytestmark = pytest.mark.one_stack


@pytest.fixture
def attribution(monkeypatch):
    """Modules of analysis/attribution can be imported, as the script imports them."""
    monkeypatch.syspath_prepend(str(ROOT / "analysis"))
    import attribution.baselines
    import attribution.bodies
    import attribution.cases
    import attribution.one_case
    import attribution.oracle
    import attribution.scores
    import attribution.sizes
    import attribution.words
    import attribution.worlds

    return attribution


@pytest.fixture
def row(attribution):
    """A made-up row: names added, an alternative after a slash, another body after an at sign."""

    def make(
        kind, verdict, *added, effect="linear_drag", seen=True, gain=0.5, remains=False,
        hdi=(0.0, 2.0), after=1.0, method="laplace", excess=None, main=1.0,
    ):  # fmt: skip
        names = [name.partition("@") for name in added]
        findings = {
            "verdict": verdict,
            "unexplained": {"sentence": "something"} if remains else None,
            "small": [],
            "error": {"before": {"normalised_rmse": 2.0}, "after": {"normalised_rmse": after}},
            "added": [
                {
                    "effect": name.split("/")[0],
                    "body": body or "cart",
                    "not_separable_from": name.split("/")[1:],
                    "parameters": {"coefficient": {"mean": 1.0, "hdi": list(hdi)}},
                }
                for name, _, body in names
            ],
        }
        hidden = kind not in ("clean", "nonsense")
        p_value = 1e-9 if seen else 0.3
        known = {} if excess is None else {"x": 1.0}
        findings["error"]["after"]["rollout_rmse"] = {name: 1.0 + excess for name in known}
        oracle = attribution.oracle.Oracle(99.0, p_value, known, gain, main=main)
        return attribution.one_case.Row(
            name="made up",
            kind=kind,
            body="cart",
            method=method,
            effect=effect if hidden else None,
            on="cart" if hidden else None,
            truth={"coefficient": 1.5} if hidden else {},
            oracle=oracle if hidden else None,
            findings=None if verdict == "failed" else findings,
            error="why" if verdict == "failed" else None,
            seconds=10.0,
        )

    return make


def test_scores_by_hand(attribution, row) -> None:
    rows = [
        row("catalogued", "effects-added", "linear_drag"),  # named, inside
        row("catalogued", "effects-added", "quadratic_drag/linear_drag"),  # named, of a group
        row("catalogued", "unexplained", "linear_drag", hdi=(0, 1)),  # named, off, overcautious
        row("catalogued", "effects-added", "linear_drag", "spring"),  # a wrong name beside it
        row("catalogued", "effects-added", "spring", "linear_drag", after=2.5),  # the same, worse
        row("catalogued", "effects-added", "linear_drag@other"),  # misnamed: of another body
        row("catalogued", "unexplained", "spring", remains=True),  # says that more remains
        row("catalogued", "adequate"),  # missed
        row("catalogued", "adequate", gain=0.005),  # detected, and does not matter
        row("catalogued", "effects-added", "spring", gain=0.005),  # misnamed all the same
        row("catalogued", "unexplained", main=0.19),  # no main law, and something is said to remain
        row("catalogued", "unexplained", "spring", main=0.19),  # a wrong name all the same
        row("catalogued", "not-converged", "linear_drag"),
        row("catalogued", "failed"),
        row("catalogued", "adequate", seen=False),  # nobody could have seen it
        row("left-out", "unexplained", remains=True),  # abstained
        row("left-out", "effects-added", "quadratic_drag"),  # misnamed
        row("outside", "effects-added", "quadratic_drag", remains=True),  # abstained
        row("outside", "adequate"),  # missed
        row("outside", "effects-added", "quadratic_drag", seen=False),
        row("outside", "effects-added", "quadratic_drag", excess=0.005),  # equivalent
        row("clean", "adequate", method="importance"),
        row("clean", "adequate"),
        row("clean", "effects-added", "linear_drag", after=2.5),  # worse
        row("clean", "unexplained", remains=True),
        row("nonsense", "adequate"),
        row("nonsense", "not-converged"),
    ]
    assert attribution.scores.score(rows) == {
        "naming": 3 / 12,
        "overcautious": 1 / 12,
        "extra_names": 2,
        "abstention": 2 / 4,
        "misnamed": 3 / 16,
        "missed": 2 / 16,
        "wrong_names_open": 3,
        "false_alarms": 2 / 4,
        "worse_after": 2,
        "coverage": 1 / 2,  # the second named another effect of its group
        "excess": None,  # of catalogued ones nobody asked the oracle for forecasts
        "baseline_naming": None,
        "nonsense_adequate": 1,
        "cases": 27,
        "detected": 19,
        "negligible": 1,
        "equivalent": 1,
        "small": 1,
        "failed": 1,
        "not_converged": 2,
        "method_importance": 1,
        "method_laplace": 26,
        "seconds": 270.0,
    }
    assert attribution.words.table(rows).row_count == 27
    assert {attribution.words.plain(each)["outcome"] for each in rows[:14]} == {
        "named", "extra name", "misnamed", "abstained", "missed", "negligible", "not-converged",
        "failed", "small",
    }  # fmt: skip


def test_an_indistinguishable_effect_is_a_right_name(attribution, row) -> None:
    equivalent = row("catalogued", "effects-added", "frame_rotation", effect="actuator_rotation")
    assert attribution.scores.outcome(equivalent) == "named"
    assert attribution.scores.outcome(replace(equivalent, body="arm")) == "misnamed"


def test_excess_and_baselines_by_hand(attribution, row) -> None:
    found = row("catalogued", "effects-added", "linear_drag")
    found.findings["error"]["after"]["rollout_rmse"] = {"x": 0.011, "vx": 0.11}
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
    assert "naming_correlation" not in attribution.scores.score([replace(rows[0], body="pair")])
    equivalent = replace(rows[0], effect="force_gain", baselines={"correlation": "torque_gain"})
    assert attribution.scores.score([equivalent])["baseline_naming"] == 1.0


def puck(attribution, effect=None, value=None, n_train=12):
    """A case of a free puck with this much of an effect."""
    setup = attribution.bodies.mh.Setup(
        "puck", (0.4, 0.3), 2.0, r=0.1, mu_c=0.3, wrench_sd=(4.0, 4.0, 0.1), n_train=n_train
    )
    body = attribution.bodies.Body("puck", (setup,))
    known = {"effect": effect, "on": "puck", "strength": 0.0} if effect else {}
    case = attribution.cases.Case("made up", "catalogued" if effect else "clean", body, **known)
    if effect is None:
        return case
    size = attribution.sizes.value(effect, body, "puck", 1.0, 1.0)
    return case.at(value / size)


@pytest.mark.parametrize(
    ("effect", "value"), [("linear_drag", 0.6), ("angular_drag", 0.02), ("magnus_force", 0.15)]
)
def test_baselines_name_what_is_linear_in_its_coefficient(attribution, effect, value) -> None:
    """Of a free puck, strongly: the simple ways do work where they can."""
    case = puck(attribution, effect, value)
    assert case.value == pytest.approx(value)
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
    assert 190 <= len(cases) <= 205
    methods = [case.method for case in cases if not case.draws]
    assert 0.08 < methods.count("importance") / len(methods) < 0.12
    tenth = attribution.cases.a_tenth(cases)
    assert 0.09 < len(tenth) / len(cases) < 0.12
    assert {case.kind for case in tenth} == set(attribution.cases.KINDS)
    for sort in attribution.bodies.SORTS:
        own = {case.kind for case in cases if case.body.sort == sort}
        assert {"catalogued", "left-out", "clean"} <= own
    for case in cases:
        truth = attribution.oracle.true_parameters(case.at(0.3))
        assert bool(truth) == (case.effect is not None)
        left = {effect.name for effect in case.catalogue}
        assert (case.effect in left) == (case.kind == "catalogued"), case.name
        first = case.body.setups[0]
        assert first.n_train * first.n_intervals <= 400
    allowed = attribution.cases.all_cases(method="laplace")
    assert {case.method for case in allowed if not case.draws} == {"laplace"}


def test_a_seed_draws_the_same_cases_and_another_one_others(attribution) -> None:
    one, two, other = (attribution.cases.all_cases(seed) for seed in (3, 3, 4))
    assert repr(one) == repr(two)  # what is not measured has a noise of NaN
    assert not {case.body for case in one} & {case.body for case in other}
    drawn = {case.factor for case in one} - {None}
    assert not drawn & {case.factor for case in other}
    assert min(drawn) > 1
    assert max(drawn) <= 50


def test_every_effect_of_the_tables_can_be_made_and_known(attribution) -> None:
    """The generator takes its value, and the oracle has as many parameters."""
    sizes, bodies = attribution.sizes, attribution.bodies
    known = {effect.name for effect in pp.catalogue} | {"force_cutoff", "point_attractor"}
    rng = np.random.default_rng(0)
    for sort, effects in sizes.EFFECTS.items():
        assert set(effects) <= known
        body = bodies.draw_body(sort, rng)
        for effect in (*effects, *sizes.OUTSIDE_OF.get(sort, ())):
            value = sizes.value(effect, body, body.names[0], 0.3, 1.0)
            attribution.worlds.Effects(**{effect: value})


@pytest.mark.parametrize("sort", ["sled", "lever", "chain", "pair"])
def test_a_drawn_body_makes_histories_that_its_scene_explains(attribution, sort) -> None:
    """Without noise, at the true parameters, the package's engine makes the same intervals."""
    body = attribution.bodies.draw_body(sort, np.random.default_rng(2))
    nearly_none = tuple(1e-6 * np.array(body.setups[0].noise))
    first = replace(
        body.setups[0], n_train=2, n_test=1, n_intervals=6, time_step=0.05, noise=nearly_none
    )
    setups = (first, *(replace(s, time_step=0.05) for s in body.setups[1:]))
    case = attribution.cases.Case("made up", "clean", replace(body, setups=setups))
    train, test = case.histories(seed=0)
    assert train.bodies == body.names
    assert (train.n_trajectories, test.n_trajectories) == (2, 1)
    assert train.n_transitions == 12
    again, _ = case.histories(seed=0)
    assert again.data_sha256 == train.data_sha256 != case.histories(seed=1)[0].data_sha256
    scene = case.body.scene.replace(substeps=200)
    problem = Problem.of(Physics.declare(scene), train)
    truth = {
        f"{name}[{s.name}]": getattr(s, name) for s in setups for name in ("mass", "r", "mu_c")
    }
    scale = dict(body.base).get("inertia_scale")
    truth |= {f"inertia_scale_scale[{s.name}]": scale for s in setups}
    phi = np.array([truth[label] for label in problem.layout.labels])
    residual = problem.residual(phi)[:, 0]
    columns = [STATE.index(name) for name in body.noise]
    segments = problem.segments
    change = (segments.observed[:, 0, 0] - segments.start[:, 0])[:, columns]
    # two engines touch a step apart
    assert np.abs(residual).max() < (2e-2 if sort == "pair" else 2e-3) * np.abs(change).max()


def test_mujoco_and_box2d_agree(attribution) -> None:
    """Of the same free box with the same physics undeclared, and of the same pendulum."""
    worlds, mh = attribution.worlds, attribution.bodies.mh
    rng = np.random.default_rng(0)
    (box,) = attribution.bodies.draw_body("sled", rng).setups
    wrenches = np.repeat(rng.normal(0.0, box.wrench_sd, (4, 1, 3)), 2, axis=0)
    start = np.array([[0.0, 0.0, 0.3, 0.5, -0.2, 1.0]])
    for effects in (
        {"linear_drag": 1.0, "magnus_force": 0.3},
        {"mass_change": (1.5, 0.0, 0.1), "actuator_delay": 0.5},
        {"actuator_lag": 0.05, "inertia_scale": 1.3, "push_offset": (0.05, 0.03)},
    ):
        body = attribution.bodies.Body("sled", (replace(box, time_step=0.04),))
        ours = worlds.integrate(body, start, wrenches, [worlds.Effects(**effects)])[:, 0]
        box2d = mh.rollout(body.setups[0], start[0], wrenches[:, 0], mh.Effects(**effects))
        assert np.abs(ours - box2d).max() < 3e-3 * np.abs(box2d - box2d[0]).max()
    (arm,) = attribution.bodies.draw_body("lever", rng).setups
    arm = replace(arm, time_step=0.04)
    start, still = np.array([[0.0, 0.0, 1.2, 0.0, 0.0, 0.5]]), np.zeros((8, 1, 3))
    weight = arm.mass * 9.81 * abs(arm.hinge)
    for effects in ({}, {"gravity_tilt": 0.1}, {"pivot_friction": 0.1 * weight}):
        body = attribution.bodies.Body("lever", (arm,))
        ours = worlds.integrate(body, start, still, [worlds.Effects(**effects)])[:, 0]
        box2d = mh.rollout(arm, start[0], still[:, 0], mh.Effects(**effects))
        assert np.abs(ours - box2d).max() < 3e-3


def test_a_centre_of_mass_beside_the_origin_goes_straight(attribution) -> None:
    worlds = attribution.worlds
    body = attribution.bodies.draw_body("sled", np.random.default_rng(0))
    start = np.array([[0.0, 0.0, 0.3, 0.5, -0.2, 3.0]])
    off = worlds.Effects(com_offset=(0.1, 0.05))
    states = worlds.integrate(body, start, np.zeros((6, 1, 3)), [off])[:, 0]
    origin, turn = states[:, 0] + 1j * states[:, 1], np.exp(1j * states[:, 2])
    assert np.abs(np.diff(origin + turn * (0.1 + 0.05j), 2)).max() < 1e-9
    assert np.abs(np.diff(origin, 2)).max() > 1e-5


def test_two_discs_bounce_and_keep_their_momentum(attribution) -> None:
    worlds = attribution.worlds
    body = attribution.bodies.draw_body("pair", np.random.default_rng(6))
    radii = [setup.size[0] / 2 for setup in body.setups]
    left = [-radii[0] - 0.01, 0.0, 0.0, 1.0, 0.0, 0.0]
    right = [radii[1] + 0.01, 0.0, 0.0, -1.0, 0.0, 0.0]
    setups = tuple(replace(setup, time_step=0.05) for setup in body.setups)
    body = replace(body, setups=setups)
    none = [worlds.Effects(), worlds.Effects()]
    states = worlds.collide(body, np.array([left, right]), np.zeros((3, 2, 3)), none)
    momentum = sum(s.mass * states[:, i, 3] for i, s in enumerate(setups))
    assert np.abs(momentum - momentum[0]).max() < 1e-5 * setups[0].mass
    bounce = setups[0].r * setups[1].r
    parting = states[-1, 1, 3] - states[-1, 0, 3]
    assert parting == pytest.approx(2.0 * bounce, abs=0.02)


@pytest.mark.slow
def test_the_oracle_s_limit_is_where_it_begins_to_detect(attribution) -> None:
    """Of drag on a free puck: three times the limit is seen, a third of it is not."""
    case = replace(puck(attribution, "linear_drag", 0.1), strength=None, factor=1.0)
    limit = attribution.oracle.sized(case, seed=0)
    seen = {}
    for times in (1 / 3, 3.0):
        sized = limit.at(times * limit.strength)
        train, test = sized.histories(seed=0)
        declared = attribution.oracle.declared_mode(sized, train, seed=0)
        seen[times] = attribution.oracle.ask(sized, declared, test, seed=0)
    assert not seen[1 / 3].detects
    assert seen[3.0].detects
    assert seen[3.0].gain > seen[1 / 3].gain


def test_the_oracle_s_gain_is_what_matters(attribution) -> None:
    oracle = attribution.oracle.Oracle
    assert oracle(99.0, 1e-9, gain=0.02).matters
    assert not oracle(99.0, 1e-9, gain=0.005).matters


def test_a_hidden_drag_is_in_the_data(attribution) -> None:
    """Of a puck without a wheel: m dv = (F - c v) dt, so least squares give F's and v's share."""
    case = puck(attribution, "linear_drag", 0.6)
    blind = replace(case, kind="left-out")
    assert "linear_drag" in {effect.name for effect in case.catalogue}
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


def test_a_log_in_degrees(attribution) -> None:
    cases = {case.name: case for case in attribution.cases.all_cases()}
    train, _ = cases["nonsense-arm-degrees"].histories(seed=0)
    angle = train.dataset["start"].to_numpy()[..., 2]
    assert np.nanmax(np.abs(angle)) > 20


def test_a_failure_is_a_row(attribution, monkeypatch) -> None:
    def breaks(*args, **settings):
        raise pp.PbrlError("no way; try another")

    monkeypatch.setattr(attribution.one_case, "close_loop", breaks)
    row = attribution.one_case.run_case(puck(attribution), seed=0)
    assert row.verdict == "failed"
    assert "PbrlError: no way" in row.error


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="no alarms on this system")
def test_a_case_that_takes_too_long_is_a_failure(attribution, monkeypatch) -> None:
    monkeypatch.setattr(
        attribution.one_case, "close_loop", lambda *args, **settings: time.sleep(30)
    )
    begin = time.monotonic()
    row = attribution.one_case.run_case(puck(attribution, n_train=2), seed=0, limit=2)
    assert time.monotonic() - begin < 20
    assert row.verdict == "failed"
    assert "no end after 2 s" in row.error


def settings(cache=None, **changed):
    """The command line's options."""
    usual = {"seed": 0, "draws": None, "limit": 0, "cache": cache, "workers": 1, "method": None}
    usual |= {"part": (1, 1), "quick": False, "only": None, "list": False}
    return SimpleNamespace(**usual | {"json": None, "verbose": False} | changed)


def test_what_is_kept_is_not_made_again(attribution, row, monkeypatch, tmp_path) -> None:
    import attribution_benchmark as benchmark

    cases = attribution.cases.all_cases()[:2]
    made = []

    def quick(case, seed, draws, limit):
        made.append(case.name)
        return row(case.kind, "adequate" if case is cases[0] else "failed")

    monkeypatch.setattr(benchmark, "run_case", quick)
    with ThreadPoolExecutor(1) as executor:
        for _ in range(2):
            rows = list(benchmark.results(cases, executor, settings(tmp_path)))
            assert sorted(each.verdict for each in rows) == ["adequate", "failed"]
        # a failure is kept, and tried again; other settings are another case
        assert made == [cases[0].name, cases[1].name, cases[1].name]
        assert benchmark.kept(cases[1], settings(tmp_path)).error == "why"
        list(benchmark.results(cases[:1], executor, settings(tmp_path, seed=1)))
        chains = [replace(cases[0], method="importance")]
        list(benchmark.results(chains, executor, settings(tmp_path)))
    assert len(made) == 5


def test_parts_add_up_in_one_cache(attribution, row, monkeypatch, tmp_path) -> None:
    import attribution_benchmark as benchmark

    made = []

    def batches(cases, options):
        for case in cases:
            made.append(case.name)
            done = replace(row(case.kind, "adequate"), name=case.name)
            benchmark.save(done, benchmark.cache_path(tmp_path, case, 0, None))
            yield done

    monkeypatch.setattr(benchmark, "in_batches", batches)
    cases = attribution.cases.all_cases()
    for i in (1, 2, 3):
        out = settings(tmp_path, part=(i, 3), json=str(tmp_path / "board.json"))
        monkeypatch.setattr(benchmark, "parsed", lambda out=out: out)
        benchmark.main()
        found = json.loads((tmp_path / "board.json").read_text())
        assert found["cases"] == len(made) == len(found["rows"])
        assert found["cases_not_run"] == len(cases) - len(made)
    assert sorted(made) == sorted(case.name for case in cases)
    assert {each["method"] for each in found["rows"]} == {"laplace"}
    assert benchmark.part("2/3") == (2, 3)
    for wrong in ("0/3", "4/3", "3", "a/b"):
        with pytest.raises(argparse.ArgumentTypeError, match="expected I/N"):
            benchmark.part(wrong)


def test_an_interrupted_run_keeps_what_is_done(attribution, row, monkeypatch) -> None:
    import attribution_benchmark as benchmark

    def rows():
        yield row("clean", "adequate")
        raise KeyboardInterrupt

    said = []
    monkeypatch.setattr(benchmark, "say", said.append)
    done = benchmark.watched(rows(), 5, made=0, verbose=False)
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

    (only,) = benchmark.results(attribution.cases.all_cases()[:1], Dies(), settings())
    assert only.verdict == "failed"
    assert "gone" in only.error
    assert "--workers" in only.error
