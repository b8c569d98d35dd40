"""A report's first line: one sentence, the same everywhere, with the numbers of report.json."""

import json
from dataclasses import replace

import pytest

from pbrl_ppl.criticism import Loop
from pbrl_ppl.criticism.results import Estimate
from pbrl_ppl.reporting import in_brief, render
from pbrl_ppl.reporting.loop_plots import plot_errors, plot_rollout
from pbrl_ppl.reporting.tables import acceleration_table, error_tables
from pbrl_ppl.reporting.words import number, remains_in_words, verdict_in_words
from tests.helpers.html import Page
from tests.helpers.made_up import changed, made_up
from tests.helpers.revised import every_verdict

pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")

HEADLINES = {
    "adequate": "Nothing was found missing: held-out error 1.01 times the noise; only noise"
    " remains.",
    "effects-added": "Linear drag on the puck, 0.8000 kg/s (94 % 0.7800 to 0.8200): held-out error"
    " 2.40 -> 1.02 times the noise; only noise remains.",
    "unexplained": "No effect in the catalogue explains the residual: held-out error 2.40 times the"
    " noise; 0.1 m/s² in vx of the puck, which depends on velocity x, is unexplained.",
    "unexplained-beside": "Linear drag on the puck, 0.8000 kg/s (94 % 0.7800 to 0.8200): held-out"
    " error 2.40 -> 1.80 times the noise; 0.1 m/s² in vx of the puck, which depends on velocity x,"
    " is still unexplained.",
    "not-converged": "No verdict: the chains have not converged (found so far: linear drag on the"
    " puck); take more draws (--draws), Gaussians at the modes (--method laplace), or give the"
    " parameters tighter priors.",
    "diverging": "Linear drag on the puck, 0.8000 kg/s (94 % 0.7800 to 0.8200): held-out error 2.40"
    " -> 1.02 times the noise; forecasts of 2.00 s diverge.",
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("case", HEADLINES)
def test_the_first_line_is_one_sentence_everywhere(case: str) -> None:
    loop, said = every_verdict()[case], HEADLINES[case]
    html = render(loop)
    assert verdict_in_words(loop) == said
    assert f"<h1>{said.replace('->', '→')}</h1>" in html
    assert in_brief(loop, "out")[0] == f"Verdict: {loop.verdict}. {said}"
    agrees_with_json(loop, said)
    motion = Page(html).motion
    for played in motion["motions"]:
        for model in motion["models"]:
            drawn = [None not in poses[0] for poses in played[model]]
            assert sum(drawn) >= 2
            assert all(drawn) == (played["diverged"][model == "after"] is None)


def agrees_with_json(loop: Loop, said: str) -> None:
    """Check that the numbers of a headline are those of report.json."""
    told = json.loads(json.dumps(loop.to_dict()))
    if told["verdict"] == "not-converged":
        return
    errors = [told["error"][model]["normalised_rmse"] for model in ("before", "after")]
    shown = [number(each) for each in (errors if told["added"] else errors[:1])]
    assert f"held-out error {' -> '.join(shown)} times the noise" in said
    for added in told["added"]:
        for size in added["parameters"].values():
            low, high = (number(end, 4) for end in size["hdi"])
            assert f"{number(size['mean'], 4)} {size['unit']} (94 % {low} to {high})" in said
    if told["verdict"] == "unexplained":
        left = told["unexplained"]
        size = told["unexplained_acceleration"]["after"][left["dimension"]]
        assert f"{size:.2g} m/s² in {left['dimension']} of the {left['body']}" in said
        assert left["depends_on"] in said


def test_effects_with_forecasts_at_the_noise_are_not_called_a_failure() -> None:
    beside = every_verdict()["unexplained-beside"]
    near = changed(beside, after=every_verdict()["effects-added"].after)
    assert verdict_in_words(near).endswith(
        "is still unexplained, but forecasts are as good as the noise allows."
    )
    assert verdict_in_words(near).startswith("Linear drag on the puck")


def test_what_remains_without_a_place_names_the_failed_test() -> None:
    loop = made_up("unexplained")
    left = replace(loop.unexplained, body="", dimension="", depends_on="nothing that was recorded")
    assert verdict_in_words(changed(loop, unexplained=left)).endswith(
        "; the model fails the test of unexplained acceleration."
    )
    passed = tuple(replace(test, passed=True) for test in loop.tests)
    assert verdict_in_words(changed(loop, unexplained=left, tests=passed)).endswith(
        "; held-out forecasts became worse."
    )


def test_sizes_of_several_parameters_are_below_the_headline() -> None:
    loop = every_verdict()["effects-added"]
    size = Estimate(0.2, 0.01, (0.18, 0.22), "N")
    force = replace(loop.added[0], effect="constant_force", parameters={"x": size, "y": size})
    assert verdict_in_words(changed(loop, added=(force,))).startswith(
        "Constant force on the puck: held-out error "
    )
    many = replace(force, not_separable_from=("a_b", "c", "d"))
    assert verdict_in_words(changed(loop, added=(many,))).startswith(
        "Constant force or one of 3 others that fit as well on the puck: "
    )


def test_bodies_that_hardly_accelerate_have_no_percentage() -> None:
    loop = made_up("adequate")
    sizes = {"vx": 0.4, "vy": 0.0, "omega": 0.0}
    still = replace(
        loop.acceleration, before=sizes, after=sizes,
        relative_before=sizes | {"vx": 300.6}, relative_after=sizes | {"vx": 300.6},
        certain_after={"vx": True, "vy": False, "omega": False},
    )  # fmt: skip
    loop = changed(loop, acceleration=still)
    assert verdict_in_words(loop).endswith(
        "; what remains, 0.4 m/s² in vx, is no more than the engine's error."
    )
    assert "0.4 m/s² in vx is left unexplained in each interval, more than" in remains_in_words(
        loop
    )
    table = acceleration_table(loop)
    assert table.rows[0] == ("vx", "0.400", "> 100 %", "m/s²", "yes")
    assert "30,060" not in " ".join([*in_brief(loop, "out"), str(table.rows)])


def test_errors_of_diverging_predictions_are_not_left_out() -> None:
    loop = every_verdict()["diverging"]
    assert "Held-out error of x 2.00 s ahead: 0.0192 -> diverged (noise floor 0.00800 m)." in (
        in_brief(loop, "out")
    )
    assert "do not plan with this model" in in_brief(loop, "out")[-2]
    (far,) = [table for table in error_tables(loop) if "20 intervals" in table.caption]
    assert far.rows[0] == ("x", "0.0192", "diverged", "0.00800", "m")


def test_lines_that_end_early_say_why() -> None:
    loop = every_verdict()["diverging"]
    panels = plot_rollout(loop).axes
    notes = [[text.get_text() for text in axes.texts] for axes in panels]
    assert all(note == ["after: diverged after 1.1 s"] for note in notes)
    bars = plot_errors(loop).axes[1]
    assert [text.get_text() for text in bars.texts].count("diverged") == 6
