"""One story a report, and on the terminal: no figure beside a verdict that it contradicts."""

from dataclasses import replace

import pytest

from pbrl_ppl.criticism import Loop
from pbrl_ppl.criticism.results import Acceleration, Law, Unexplained
from pbrl_ppl.effects import Effect, EffectParameter, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.reporting import in_brief, render
from pbrl_ppl.reporting.tables import limits_in_words
from pbrl_ppl.reporting.words import (
    held_out_in_words,
    remains_in_words,
    verdict_in_words,
)
from tests.helpers.html import Page
from tests.helpers.made_up import changed, made_up
from tests.helpers.revised import revised, unexplained

pytestmark = [
    pytest.mark.usefixtures("undrawn"),
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
]

ONE = "The noise is that of the measurements alone, one interval ahead."


def text_of(findings: Loop) -> str:
    return Page(render(findings)).text


def nearest() -> Loop:
    """Unexplained, with the nearest effect in the model."""
    left = made_up("unexplained")
    return changed(
        made_up(),
        verdict="unexplained",
        unexplained=left.unexplained,
        tests=left.tests,
        acceleration=left.acceleration,
    )


def with_acceleration(findings: Loop, **sizes: tuple[float, bool]) -> Loop:
    """Findings with these relative accelerations left, each significant or not."""
    shares = {name: share for name, (share, _) in sizes.items()}
    sure = {name: certain for name, (_, certain) in sizes.items()}
    return changed(findings, acceleration=Acceleration(shares, shares, shares, shares, sure))


def test_negligible_acceleration_is_in_the_headline() -> None:
    findings = with_acceleration(
        made_up("adequate"), vx=(0.0051, True), vy=(0.3, False), omega=(0.004, True)
    )
    said = verdict_in_words(findings)
    assert said == (
        "Nothing that matters was found missing: held-out error 1.01 times the noise; what remains,"
        " 0.0051 m/s² in vx, is negligible."
    )
    assert remains_in_words(findings) == (
        "The declared model passes all 2 tests of its residual. An acceleration of 0.0051 m/s² in"
        " vx is left unexplained in each interval, 0.51 % of the bodies' acceleration: significant,"
        " but too small to matter, or within the error of the engine."
    )
    text = text_of(findings)
    assert said in text and ONE in text
    assert "vy 0.300 30 % m/s² no" in text and "vx 0.00510 0.51 % m/s² yes" in text
    lines = in_brief(findings, "out")
    assert lines[0] == f"Verdict: adequate. {said}"
    nothing = with_acceleration(findings, vx=(0.0051, False))
    assert verdict_in_words(nothing).endswith("; only noise remains.")
    assert ONE not in text_of(nothing) + "".join(in_brief(nothing, "out"))


def test_the_unit_of_an_error_is_told_where_something_is_unexplained() -> None:
    for findings in (made_up("unexplained"), nearest()):
        assert ONE in text_of(findings)
        assert any(ONE in line for line in in_brief(findings, "out"))
    for verdict in ("adequate", "effects-added"):
        assert ONE not in text_of(made_up(verdict))


def test_a_held_out_error_that_the_verdict_does_not_lead_to_expect_is_explained() -> None:
    for verdict, model in (("adequate", "declared"), ("effects-added", "revised")):
        findings = made_up(verdict)
        for error, told in ((3.0, True), (1.2, False)):
            far = changed(findings, after=replace(findings.after, normalised_rmse=error))
            said = f"the held-out ones differ from the {model} model by 3.00 times the noise"
            assert (said in text_of(far)) == told
            assert any(said in line for line in in_brief(far, "out")) == told


def test_intervals_without_a_verdict_are_left_out() -> None:
    stuck = changed(made_up(), verdict="not-converged")
    text = text_of(stuck)
    for claim in ("How sure.", "How large.", "with 94 % probability", "Adding linear drag"):
        assert claim not in text
    assert not any("94 % interval" in line for line in in_brief(stuck, "out"))


def test_effects_beside_which_more_is_missing_are_told() -> None:
    for findings in (nearest(), made_up()):
        assert "How large." in text_of(findings)
        assert any("94 % interval" in line for line in in_brief(findings, "out"))
    assert "More is missing than the effects found (linear drag)" in text_of(nearest())


def test_certainty_comes_from_simulations_where_they_named_an_effect() -> None:
    findings = made_up()
    doubtful = replace(findings.added[0], p_value=0.02)
    sure = replace(doubtful, simulated_nats=120.0, simulated_share=0.5)
    texts = [text_of(changed(findings, added=(one,))) for one in (doubtful, sure)]
    assert "Not sure" in texts[0] and "As good as certain" in texts[1]
    assert "takes 50 % off the declared model's error in the longest simulations, 120" in texts[1]


def test_dependence_is_shown_only_where_its_test_failed() -> None:
    failed = text_of(unexplained())
    assert "depends on velocity x (near" in failed
    assert "depends on no recorded quantity" not in failed
    left = Unexplained(
        "puck", "vx", "nothing that was recorded", 3.1, 0.0, "after 1 s vx of Puck is off"
    )
    passed = text_of(changed(unexplained(), unexplained=left))
    assert "The residual depends on no recorded quantity: record more quantities" in passed
    assert "R² =" not in passed and "velocity x" not in passed
    assert "After 1 s vx of Puck is off." in passed  # with its capitals
    assert "310 %" not in passed  # a factor is no share
    assert "What remains. After 1 s vx of Puck is off (p < 1e-16)." in passed
    # a test that names no body has no p-value
    nowhere = text_of(changed(unexplained(), unexplained=replace(left, body="")))
    assert "What remains. After 1 s vx of Puck is off." in nowhere


def test_a_candidate_with_a_large_score_says_why_it_was_not_added() -> None:
    findings = made_up("adequate")
    first = replace(findings.candidates[0], p_value=1e-20, why="changes predictions by 0.2 %")
    text = text_of(changed(findings, candidates=(first, *findings.candidates[1:])))
    assert "came closest (p < 1e-16); it was not added: changes predictions by 0.2 %." in text


def candidate(effect: str, is_upper_limit: bool = False, **sizes: float) -> Law:
    named = {each.name: each for each in catalogue}
    units = {p.name: p.unit for p in named[effect].parameters}
    return Law(
        effect, "cart", "", 1.0, 1, 0.5, dict.fromkeys(units, 0.25), units, 1.0,
        detectable=sizes, is_upper_limit=is_upper_limit,
    )  # fmt: skip


def test_limits_of_what_was_not_measured_are_left_out() -> None:
    findings = made_up()
    seen = {name: findings.after.one_step_rmse[name] for name in ("x", "y", "theta")}
    blind = changed(findings, after=replace(findings.after, one_step_rmse=seen))
    bias = candidate("sensor_bias", x=0.01, y=0.01, theta=0.02, vx=0.3, vy=0.3, omega=0.1)
    positions = "x 0.0100 m, y 0.0100 m, theta 0.0200 rad"
    assert limits_in_words(bias, blind) == positions
    velocities = "vx 0.300 m/s, vy 0.300 m/s, omega 0.100 rad/s"
    assert limits_in_words(bias, findings) == f"{positions}, {velocities}"
    text = text_of(changed(blind, candidates=(bias,)))
    assert "x 0.250 m, y 0.250 m, theta 0.250 rad 100 %" in text  # estimates too
    # a coordinate of another effect is no measurement
    offset = candidate("com_offset", x=0.01, y=0.02)
    nothing = changed(findings, after=replace(findings.after, one_step_rmse={}))
    kept = limits_in_words(offset, nothing)
    assert kept == "x 0.0100 m, y 0.0200 m"


def test_limits_beyond_the_prior_are_no_limits() -> None:
    findings = made_up()

    def said(one: Law) -> str:
        return limits_in_words(one, findings)

    # normal, sigma 20 N: 99.9 % are within 3.29 sigma, 65.8 N
    assert said(candidate("constant_force", force_x=60.0, force_y=116317.0)) == (
        "force x 60.0 N, force y no plausible size"
    )
    assert said(candidate("constant_force", force_x=70.0, force_y=70.0)) == "no plausible size"
    assert said(candidate("dead_zone", threshold=float("inf"))) == "no plausible size"
    assert said(candidate("hidden_obstacle")) == ""
    # a gain of 1 does nothing: its limit is a distance from there
    assert said(candidate("force_gain", factor=0.05)) == "factor 1.00 ± 0.0500"
    # a smaller cap is stronger: log-normal, median 20 N, sigma 1.5: 0.1 % are below 0.19 N
    assert said(candidate("saturation", True, limit=8.0)) == "limit up to 8.00 N"
    assert said(candidate("saturation", True, limit=0.1)) == "no plausible size"
    # of an effect that is looked up nowhere the size alone is known
    assert limits_in_words(
        candidate("dead_zone", threshold=1e4), changed(findings, catalogue=())
    ) == ("threshold 10,000 N")
    own = Effect(
        "dead_zone", (EffectParameter("threshold", "N", Prior("half_normal", sigma=1e5)),), "",
        "", catalogue[0].stage,
    )  # fmt: skip
    assert limits_in_words(
        candidate("dead_zone", threshold=1e4), changed(findings, catalogue=(own,))
    ) == ("threshold 10,000 N")


def test_the_terminal_has_ten_lines_and_says_where_and_what_next() -> None:
    five = changed(made_up(), added=made_up().added * 5)
    verdicts = ("adequate", "effects-added", "unexplained", "not-converged")
    every = {verdict: in_brief(made_up(verdict), "out") for verdict in verdicts}
    assert max(map(len, every.values())) <= 6 and len(in_brief(five, "out")) <= 10
    for verdict, lines in every.items():
        assert lines[0].startswith(f"Verdict: {verdict}. ")
        assert sum(line.startswith("Held-out error of x 2.00 s ahead: ") for line in lines) == 1
        assert lines[-1].startswith("Report: out/report.html")
        assert lines[-2].startswith("Next: ")
        assert not any("would not show" in line or "plausible" in line for line in lines)
    assert "Held-out error of x 2.00 s ahead: 0.00808 m" in every["adequate"][1]
    assert "detection limit" in every["adequate"][-2]
    assert "  Its omega is off in a way that depends on omega (p = 0.0020)." in every["unexplained"]
    assert "plots the residual against omega" in every["unexplained"][-2]
    assert "--draws" in every["not-converged"][-2]
    alone = changed(made_up(), added=(replace(made_up().added[0], not_separable_from=()),))
    assert in_brief(alone, "out")[-2] == (
        "Next: open the report; plan and update with the posterior after.nc."
    )
    left = replace(made_up("unexplained").unexplained, depends_on="nothing that was recorded")
    nowhere = in_brief(changed(made_up("unexplained"), unexplained=replace(left, body="")), "out")
    assert "  Its omega is off in a way that depends on omega." in nowhere
    assert nowhere[-2] == "Next: open the report; record more quantities, or longer."


def test_the_error_far_ahead_is_of_the_dimension_that_changed_most() -> None:
    """In its unit, with what noise alone makes."""
    findings = made_up()
    far = findings.before.rollout_rmse | {"theta": 0.3}
    findings = changed(findings, before=replace(findings.before, rollout_rmse=far))
    said = "Held-out error of theta 2.00 s ahead: 0.300 -> 0.0163 rad, 94.6 % less"
    assert f"{said} (noise floor 0.0160 rad)." in in_brief(findings, "out")


def test_a_dimension_that_does_not_move_is_not_shown() -> None:
    """However much its error changed in rounding."""
    loop = revised()
    far = {"x": 0.2, "omega": 2.21e-8}
    after = {"x": 0.1, "omega": 2.21e-9}
    still = loop.held_out.dataset["observed"].copy()
    still[..., 5] = 0.0
    loop = changed(
        loop,
        before=replace(loop.before, simulated_rmse={}, rollout_rmse=far),
        after=replace(loop.after, simulated_rmse={}, rollout_rmse=after),
        held_out=History(loop.held_out.dataset.assign(observed=still)),
    )
    assert held_out_in_words(loop).startswith("Held-out error of x ")


def test_effects_of_one_trajectory_are_told_with_caution() -> None:
    findings = made_up()
    one = changed(findings, provenance={**findings.data.provenance, "trajectories": 1})
    said = "A single trajectory cannot tell a law from a lasting random force"
    assert said in text_of(one) and any(said in line for line in in_brief(one, "out"))
    assert said not in text_of(findings)
