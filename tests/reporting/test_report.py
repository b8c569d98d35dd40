"""The report: the right words and numbers, a page that needs nothing else, files all or none."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.criticism import FILES, Loop, results
from pbrl_ppl.criticism.results import Errors, Law, SearchLength
from pbrl_ppl.errors import OutputError
from pbrl_ppl.history import History, UnusedVelocity
from pbrl_ppl.parameters import BODY_PARAMETERS
from pbrl_ppl.posterior import Fit
from pbrl_ppl.posterior.cross_validation import Comparison, LeaveOneOut
from pbrl_ppl.posterior.identifiability import Direction, Identifiability, Width
from pbrl_ppl.reporting import in_brief, render
from pbrl_ppl.reporting.loop_plots import plot_rollout, unwrap
from pbrl_ppl.reporting.posteriors import PARAMETERS, most_interesting, summary
from pbrl_ppl.reporting.reports import Source
from pbrl_ppl.reporting.words import number, remains_in_words, verdict_in_words
from tests.helpers.html import Page, stands_alone
from tests.helpers.made_up import DRAG, changed, idata, made_up, made_up_posterior
from tests.helpers.revised import revised, unexplained


def page(verdict: str) -> Page:
    return Page(render(made_up(verdict)))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("verdict", ["adequate", "effects-added", "unexplained"])
def test_page_stands_alone(verdict: str) -> None:
    stands_alone(render(made_up(verdict)), pictures=4)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")
def test_page_plays_the_held_out_motions() -> None:
    for loop, models, pictures in (
        (revised(), ["before", "after"], 5),
        (unexplained(), ["before"], 6),
    ):
        stands_alone(html := render(loop), pictures)
        motion = Page(html).motion
        assert motion["models"] == models
        assert len(motion["motions"]) == 6
        for played in motion["motions"]:
            assert np.shape(played["measured"]) == (13, 1, 3) == np.shape(played["before"])
            assert played["time"] == sorted(played["time"])
        assert motion["motions"][0]["distance"][0] > 0.2


@pytest.mark.usefixtures("undrawn")
def test_page_of_an_added_effect() -> None:
    text = page("effects-added").text
    assert "Linear drag or quadratic drag on the cart: held-out error 2.40 → 1.02 times" in text
    assert f"What it is. {DRAG.capitalize()} (linear drag)." in text
    assert "As good as certain (p < 1e-16, corrected for all 4 candidates)" in text
    assert (
        "Its coefficient is 3.00 kg/s; with 94 % probability it lies between 2.81 and 3.19 kg/s"
        in text
    )
    assert "fits them no better than quadratic drag would" in text
    assert "fell by 57 %, from 2.40 to 1.02 times the noise; noise alone gives" in text
    assert "does not mean that nothing is missing" not in text
    assert "Scene: of cart. Recording: given in Python; held out: other trajectories." in text
    assert "10 engine steps" in text and "40 steps were used instead" in text
    assert "force x 0.200 N, force y −0.100 N" in text
    assert "seed 1" in text and "pymc 5.28" in text and "ab" * 32 in text
    assert "did not converge" not in text and "Not converged" not in text


#: A search that finds drag on short pieces, and drops a second law on longer ones.
LENGTHS = (
    SearchLength(4, 0.4, {"x": 0.02}, ("linear_drag on cart",), (), {"x": 1.0}),
    SearchLength(30, 3.0, {"x": 0.01}, (), ("spring on cart",), {"x": 4.0}),
)


def with_small() -> Loop:
    """Findings of a main law, of one that is small, and of an unusual one that may be there."""
    found = made_up()
    law = replace(found.added[0], simulated_nats=480.0, simulated_share=0.8)
    return changed(
        found, added=(replace(law, not_separable_from=()),), lengths=LENGTHS,
        lesser=(Law("angular_drag", "cart", simulated_share=0.1),),
        hypotheses=(Law("spring", "cart", simulated_share=0.4),),
    )  # fmt: skip


@pytest.mark.usefixtures("undrawn")
def test_page_shows_the_search_by_length_of_pieces() -> None:
    html = render(with_small())
    stands_alone(html, pictures=4)
    text = Page(html).text
    for said in (
        "4 0.400 x 0.0200 m linear drag on cart –",
        "30 3.00 x 0.0100 m – spring on cart",
        "Linear drag on the cart takes 80 % off the error of the longest pieces (480 nats"
        " of evidence).",
        "it gains 210 ± 19.0 nats",
    ):
        assert said in text
    assert "Search for missing laws" not in page("effects-added").text  # none is made up
    short = replace(LENGTHS[0], rows=1, seconds=0.1, accepted=())
    text = Page(render(changed(made_up("adequate"), lengths=(short,)))).text
    assert "single transitions are predicted" in text


@pytest.mark.usefixtures("undrawn")
def test_laws_that_are_not_added_are_named_with_their_shares() -> None:
    loop = with_small()
    assert verdict_in_words(loop).startswith("Linear drag on the cart, 3.00 kg/s (94 % 2.81 to ")
    for said in (
        "Angular drag on the cart takes 10 % off the error of the longest simulations: too little"
        " to be added.",
        "one of these would take a part off: spring on the cart (40 %); few rigs have it, so it was"
        " not added: declare it to try.",
    ):
        assert said in Page(render(loop)).text
        assert any(said in line for line in in_brief(loop, "out"))
    stuck = verdict_in_words(changed(loop, verdict="not-converged"))
    assert "(found so far: linear drag on the cart)" in stuck


@pytest.mark.usefixtures("undrawn")
def test_page_names_its_files_and_its_command() -> None:
    source = Source("cart.toml", "train.csv", "test.csv", "pbrl-ppl close-loop cart.toml")
    text = Page(render(made_up(), source=source)).text
    assert "Scene: cart.toml. Recording: train.csv; held out: test.csv." in text
    assert "This page is made again by pbrl-ppl close-loop cart.toml" in text


@pytest.mark.usefixtures("undrawn")
def test_page_explains_its_words() -> None:
    text = page("effects-added").text
    for name, said in (
        ("w_x[cart]", "place of the wheel along the body"),
        ("linear_drag_coefficient[cart]", "coefficient of the effect linear drag"),
        ("sigma[omega]", "typical error of measuring it"),
        ("score", "How strongly the model's errors look as a missing effect would"),
    ):
        assert f"{name} {said}" in text
    assert set(BODY_PARAMETERS) <= set(PARAMETERS)


@pytest.mark.usefixtures("undrawn")
def test_page_where_nothing_is_missing() -> None:
    text = page("adequate").text
    said = "Nothing was found missing: held-out error 1.01 times the noise; only noise remains."
    assert said in text
    assert "What was tested. The declared model passes all 2 tests of its residual." in text
    assert "The table of all candidates has the detection limit of each" in text
    assert "48 % – – coefficient 0.0200 kg/s" in text
    assert "linear drag on the cart came closest (p = 0.37)." in text
    assert "fell by" not in text and "After:" not in text
    assert "What remains." not in text


@pytest.mark.usefixtures("undrawn")
def test_candidates_that_were_not_added_say_why() -> None:
    findings = made_up()
    said = ("added", "fits less well than linear drag, by 12.0 nats", "p = 0.04: chance")
    told = [replace(c, why=w) for c, w in zip(findings.candidates, said, strict=False)]
    findings = changed(findings, candidates=(*told, findings.candidates[-1]))
    assert "Not added:" not in page("effects-added").text
    text = Page(render(findings)).text
    assert "Decision" in text and said[2] in text
    assert f"Not added: quadratic drag on the cart ({said[1]})." in text


def test_what_is_small_is_said_to_be_there() -> None:
    for verdict in ("adequate", "effects-added"):
        findings = made_up(verdict)
        one = findings.candidates[len(findings.added)]
        findings = changed(findings, small=(replace(one, body="Cart_2"),))
        said = f" There is {one.effect.replace('_', ' ')} on the Cart 2, which changes"
        # beside what was added the table of candidates has them
        assert (said in remains_in_words(findings)) == (verdict == "adequate")
        assert "Nothing was found missing" not in verdict_in_words(findings)
    # what remains may be what looks like it
    findings = changed(made_up("unexplained"), small=made_up().candidates[:1])
    assert "linear drag" not in verdict_in_words(findings) + remains_in_words(findings)


@pytest.mark.usefixtures("undrawn")
def test_page_where_something_is_unexplained() -> None:
    text = page("unexplained").text
    assert (
        "No effect in the catalogue explains the residual: held-out error 2.40 times the noise;"
        " 0.15 rad/s² in omega of the cart, which depends on omega, is unexplained."
    ) in text
    assert "What remains. Its omega is off in a way that depends on omega (p = 0.0020)." in text
    assert "an acceleration of 0.2 rad/s² in omega is left" in text
    assert "detection limit of each" not in text


@pytest.mark.usefixtures("undrawn")
def test_a_verdict_without_converged_chains_is_none() -> None:
    findings = made_up("not-converged")
    assert verdict_in_words(findings).startswith("No verdict: the chains have not converged")
    assert "No verdict" in page("not-converged").text


@pytest.mark.usefixtures("undrawn")
def test_page_says_what_the_data_do_not() -> None:
    widths = (
        Width("mass[cart]", 1.5, 0.015, 0.01, "informed"),
        Width("r[cart]", 1.0, 0.99, 0.99, "prior only"),
    )
    pair = Direction((("mass[cart]", 0.6), ("push_gain_gain[cart]", -0.8)), 0.01)
    said = Identifiability(widths, ("r[cart]", "inertia_scale_scale[cart]"), (pair,))
    findings = changed(made_up(), identifiability=said)
    words = " ".join(" ".join(Page(render(findings)).words).split())
    assert "Identifiability" in words
    assert "The data say nothing about r[cart]: record contacts" in words
    assert "nothing about inertia_scale_scale[cart]: record the body turning" in words
    assert "mass[cart] up with push_gain_gain[cart] down" in words
    assert "say nothing beyond the prior" in words
    assert "mass[cart] 1 % inform it" in words
    kept = findings.to_dict()["identifiability"]
    assert kept["parameters"][1] == {
        "parameter": "r[cart]",
        "prior_sd": 1.0,
        "posterior_sd": 0.99,
        "ratio": 0.99,
        "verdict": "prior only",
    }
    assert kept["directions"][0]["weights"] == {"mass[cart]": 0.6, "push_gain_gain[cart]": -0.8}
    fine = changed(findings, identifiability=Identifiability(widths[:1], (), ()))
    assert "Predictions depend on every parameter" in render(fine)
    without = made_up()
    assert "Identifiability" not in render(without)
    assert without.to_dict()["identifiability"] is None


@pytest.mark.usefixtures("undrawn")
def test_page_compares_by_leave_one_out() -> None:
    """Of an added effect, both models and the gain; of none, the declared model alone."""
    one = LeaveOneOut(4000.0, 30.0, 11.5, 2, 0.7)
    two = replace(one, elpd_loo=4210.0, high_pareto_k=0)
    findings = changed(made_up(), loo=Comparison(one, two, 210.0, 19.0, 360))
    text = Page(render(findings)).text
    assert "Leave-one-out cross-validation on the 360 transitions of the fit" in text
    assert "elpd_loo (nats; more is better) 4,000 4,210" in text
    assert "How many have a Pareto k above 0.70 2 0" in text
    assert "the revised model gains 210 ± 19.0" in text
    assert "makes elpd_loo unreliable" in text
    assert findings.to_dict()["loo"] == {
        "before": vars(one),
        "after": vars(two),
        "elpd_difference": 210.0,
        "elpd_difference_se": 19.0,
        "count": 360,
        "left_out": "transition",
    }
    same = changed(made_up("adequate"), loo=Comparison(two, two, 0.0, 0.0, 360))
    text = Page(render(same)).text
    assert "How many have a Pareto k above 0.70 0 " in text
    assert "the revised model gains" not in text
    assert "unreliable" not in text
    whole = changed(made_up("adequate"), loo=Comparison(two, two, 0.0, 0.0, 9, "trajectory"))
    text = Page(render(whole)).text
    assert "Leave-one-trajectory-out cross-validation on the 9 trajectories of the fit" in text
    # where it cannot be computed, the report does without
    assert made_up().to_dict()["loo"] is None
    assert "Leave-one-out cross-validation on" not in page("effects-added").text


@pytest.mark.usefixtures("undrawn")
def test_page_says_what_did_not_converge() -> None:
    text = Page(render(made_up("adequate", stuck=True))).text
    assert "1 of 9 parameters did not converge" in text
    assert "Not converged." in text and "w_x[cart]: R-hat 2." in text


@pytest.mark.usefixtures("undrawn")
def test_names_from_files_are_escaped() -> None:
    findings = made_up("unexplained")
    remains = replace(findings.unexplained, body="<script>alert(1)</script>", sentence="a<b>&")
    html = render(changed(findings, unexplained=remains))
    assert Page(html).tags.count("script") == 1  # it opens details in print
    assert "A<b>&" in Page(html).text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")
def test_names_of_trajectories_cannot_end_the_script_of_the_motions() -> None:
    dataset = unexplained().held_out.dataset
    names = [f"</script><script>alert({i})" for i in range(dataset.sizes["trajectory"])]
    loop = changed(unexplained(), held_out=History(dataset.assign_coords(trajectory=names)))
    page = Page(render(loop))
    assert page.tags.count("script") == 2
    assert {motion["name"] for motion in page.motion["motions"]} <= set(names)


@pytest.mark.usefixtures("undrawn")
def test_added_effects_with_a_rest() -> None:
    findings = made_up()
    first = replace(findings.added[0], not_separable_from=())
    second = replace(first, effect="push_offset", sentence="it turns", body="big_cart")
    both = changed(findings, added=(first, second))
    assert verdict_in_words(both) == (
        "Linear drag on the cart and push offset on the big cart: held-out error 2.40 -> 1.02 times"
        " the noise; only noise remains."
    )
    left = made_up("unexplained")
    some = changed(both, verdict="unexplained", unexplained=left.unexplained, tests=left.tests)
    some = changed(some, acceleration=left.acceleration, after=left.before)
    assert verdict_in_words(some) == (
        "Linear drag on the cart and push offset on the big cart: held-out error 2.40 -> 2.40 times"
        " the noise; 0.15 rad/s² in omega of the cart, which depends on omega, is still"
        " unexplained."
    )
    assert "What remains. Its omega is off in a way" in Page(render(some)).text
    noted = changed(some, verdict="effects-added", after=findings.after)
    assert "what remains, 0.15 rad/s² in omega of the cart, does not show in forecasts." in (
        verdict_in_words(noted)
    )


def test_odd_findings_still_make_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pbrl_ppl.reporting.reports.png", lambda figure: b"")
    findings = made_up()
    nothing = Errors({}, {}, float("nan"), float("nan"))
    many = 9 * findings.candidates
    odd = changed(
        findings,
        noise_floor=nothing,
        candidates=many,
        added=(replace(findings.added[0], p_value=0.0),),
    )
    text = Page(render(odd)).text
    assert "As good as certain (p < 1e-16" in text
    assert "The 20 best of 36 are shown" in text
    assert "times the noise; noise alone gives –" in text
    Page(render(changed(made_up("adequate"), candidates=(), before=nothing, after=nothing)))


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (0.0, "0"),
        (-0.05, "−0.0500"),
        (12345.6, "12,346"),
        (9.996, "10.00"),
        (2.5e-7, "2.50 × 10⁻⁷"),
        (float("inf"), "–"),
        (None, "–"),
    ],
)
def test_numbers(value: float | None, written: str) -> None:
    assert number(value) == written


def test_rollout_angles_have_no_jumps() -> None:
    jumping = np.array([3.0, 3.1, np.nan, -3.1, -3.0])
    smooth = unwrap(jumping)
    assert np.isnan(smooth[2])
    assert np.allclose(np.delete(smooth, 2), [3.0, 3.1, 2 * np.pi - 3.1, 2 * np.pi - 3.0])
    figure = plot_rollout(made_up())
    theta = figure.axes[2]
    assert theta.get_ylabel() == "theta (rad)"
    for line in theta.lines:
        values = np.asarray(line.get_ydata(), dtype=float)
        assert np.nanmax(np.abs(np.diff(values))) < 1.0
        assert abs(values[0] - 2.8) < 0.1


def test_parameters_of_most_interest() -> None:
    table = summary(made_up(stuck=True).posterior_after)
    shown = most_interesting(table, ["linear_drag_coefficient[cart]", "not_there[cart]"])
    assert shown[:2] == ["linear_drag_coefficient[cart]", "w_x[cart]"]
    assert len(shown) == 6


def test_summary_has_the_same_columns_everywhere() -> None:
    table = summary(made_up_posterior())
    assert list(table.columns) == ["mean", "sd", "lower", "upper", "ess_bulk", "ess_tail", "r_hat"]
    drag = table.loc["linear_drag_coefficient[cart]"]
    assert drag["mean"] == pytest.approx(3.0, abs=0.01)
    assert drag["upper"] - drag["lower"] == pytest.approx(0.376, rel=0.05)
    assert "sigma[omega]" in table.index


@pytest.mark.usefixtures("undrawn")
def test_a_parameter_that_never_moved() -> None:
    constant = idata({"mass": np.ones((4, 500, 1))}, {"mass": ["body"]})
    findings = made_up("adequate")
    findings = changed(findings, revised=replace(findings.revised, fit=Fit(None, constant)))
    assert "mass[cart]: R-hat –" in Page(render(findings)).text


def test_loop_says_what_it_found() -> None:
    loop = made_up()
    assert "effects-added" in repr(loop) and "linear_drag on cart" in repr(loop)
    assert copy.copy(loop).verdict == "effects-added"
    with pytest.raises(AttributeError, match="vredict"):
        _ = loop.vredict


@pytest.mark.usefixtures("undrawn")
def test_save_writes_the_contract(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "out"
    loop = made_up()
    assert loop.save(folder, page=render(loop)) == folder
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    assert [p.name for p in tmp_path.iterdir()] == ["new"]
    got = json.loads((folder / "report.json").read_text())
    assert list(got) == [
        "verdict",
        "numerical",
        "added",
        "candidates",
        "small",
        "lesser",
        "hypotheses",
        "search",
        "tests",
        "unexplained_acceleration",
        "unexplained",
        "error",
        "identifiability",
        "loo",
        "velocities_not_used",
        "bad_frames",
        "drawn",
        "provenance",
    ]
    assert list(got["added"][0]) == [
        "effect",
        "body",
        "statistic",
        "p_value",
        "parameters",
        "not_separable_from",
        "elpd_difference",
        "elpd_difference_se",
        "simulated_nats",
        "simulated_share",
    ]
    assert got["added"][0]["parameters"]["coefficient"] == {
        "mean": 3.0,
        "sd": 0.1,
        "hdi": [2.81, 3.19],
        "unit": "kg/s",
    }
    assert list(got["candidates"][0]) == [
        "effect",
        "body",
        "statistic",
        "dof",
        "p_value",
        "estimate",
        "identifiable",
        "looks",
        "detectable",
        "caps",
        "why",
        "simulated_nats",
        "simulated_share",
    ]
    assert list(got["error"]) == ["before", "after", "noise_floor"]
    assert got["error"]["before"]["normalised_rmse"] == 2.4
    assert (folder / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second posterior fails halfway."""

    def fail(posterior: Any, path: Path) -> None:
        path.write_bytes(b"half")
        if path.name == "after.nc":
            raise KeyboardInterrupt

    monkeypatch.setattr(results, "save_posterior", fail)


@pytest.mark.usefixtures("broken")
def test_failure_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        made_up().save(tmp_path / "new" / "out", page="a page")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("broken")
def test_failure_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        made_up().save(tmp_path, overwrite=True, page="a page")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


def test_overwrite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "save_posterior", lambda posterior, path: path.write_bytes(b"nc"))
    loop = made_up()
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"is not empty.*overwrite"):
        loop.save(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    loop.save(tmp_path, overwrite=True, page="a page")
    loop.save(tmp_path, overwrite=True, page="a page")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*FILES, "notes.txt"])


def test_folder_that_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="is a file, expected a folder"):
            made_up().save(place, overwrite=True)
    (tmp_path / "out" / "after.nc").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"after\.nc in it is a folder"):
        made_up().save(tmp_path / "out", overwrite=True)

    def refuse(*args: Any, **options: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OutputError, match=r"made or written \(Permission denied\)"):
        made_up().save(tmp_path / "new")


@pytest.mark.usefixtures("undrawn")
def test_report_alone(tmp_path: Path) -> None:
    path = pp.report(made_up(), tmp_path / "report.html")
    assert path.read_text(encoding="utf-8") == render(made_up())
    for place in (tmp_path, tmp_path / "none" / "report.html"):
        with pytest.raises(OutputError, match="cannot be written"):
            pp.report(made_up(), place)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_velocities_that_are_not_used_are_named() -> None:
    unused = (UnusedVelocity("cart", "vy", "y", True, 0.05),)
    findings = changed(made_up(), velocities_not_used=unused)
    said = "vy of cart was computed from y, 50 ms late, and is not used."
    assert said in " ".join(Page(render(findings)).text.split())
    assert findings.to_dict()["velocities_not_used"][0]["lag"] == 0.05
