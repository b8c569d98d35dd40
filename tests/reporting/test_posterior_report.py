"""Reports of posterior files: all diagnostics, on files of both generations."""

import shlex
import warnings

import numpy as np
import pytest

from pbrl_ppl.cli import main
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.posterior import DATATREE, from_groups, groups, load_posterior
from pbrl_ppl.reporting import plot_rank, render_posterior
from pbrl_ppl.reporting.posteriors import coverage, summary
from tests.helpers.html import Page, stands_alone
from tests.helpers.made_up import made_up_posterior
from tests.helpers.revised import revised
from tests.helpers.stacks import GENERATIONS, file

pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("generation", GENERATIONS)
def test_page_of_a_file(generation: str) -> None:
    html = render_posterior(load_posterior(file(generation)))
    stands_alone(html, pictures=2)
    text = Page(html).text
    assert "Posterior of puck. The data inform 1 of 1 parameters." in text
    assert "Did the sampler work? Yes. The chains agree" in text
    assert "Intervals that should hold 94 % of measurements hold " in text
    assert "elpd_loo (nats; more is better)" in text
    assert "Pareto k above" in text and "mass[puck] mass 2." in text
    assert "pp.fit(model, method='metropolis', seed=3, draws=500, chains=2)" in text


@pytest.mark.usefixtures("undrawn")
def test_page_of_whole_trajectories() -> None:
    html = render_posterior(revised().posterior_after)
    stands_alone(html, pictures=2)
    text = Page(html).text
    assert "Posterior of puck with linear drag of puck. The data inform 2 of 2 parameters." in text
    assert "likelihood of whole trajectories; sampler laplace" in text
    assert "No chains. Independent draws" in text and "Not converged" not in text
    assert 'likelihood="trajectories"' in text
    shares = coverage(revised().posterior_after)
    assert set(shares) == {"x", "y", "theta", "vx", "vy", "omega"}
    assert all(share == pytest.approx(0.94, abs=0.08) for share in shares.values())


@pytest.mark.usefixtures("undrawn")
def test_page_of_importance_draws() -> None:
    """Effective sample sizes are no larger than what the weights leave."""
    chains = load_posterior(file("5"))
    weights = {"method": "importance", "pareto_k": 0.25, "importance_ess": 432.1}
    few = {"warnings": '["the draws are too few: effective sample size is ..."]'}
    drawn = from_groups(groups(chains), chains.attrs | weights | few)
    assert summary(drawn)["ess_bulk"].max() == 432.1
    text = Page(render_posterior(drawn)).text
    assert "Did the sampler work? Yes. The draws suffice." in text
    assert "Pareto k of their weights is 0.250 (above 0.7" in text
    assert "the effective sample size by their weights is 432" in text
    assert "Warning of the fit" not in text


@pytest.mark.usefixtures("undrawn")
def test_what_cannot_be_had_is_said() -> None:
    whole = load_posterior(file("5"))
    parts = {k: v for k, v in groups(whole).items() if k != "posterior_predictive"}
    text = Page(render_posterior(from_groups(parts, whole.attrs))).text
    assert "it has no group 'posterior_predictive'" in text
    short = {
        k: v.isel(draw=slice(20)) if "draw" in v.sizes else v for k, v in groups(whole).items()
    }
    with pytest.raises(PosteriorError, match="it has 40 draws, a report needs at least 100"):
        render_posterior(from_groups(short, whole.attrs))
    warned = from_groups(groups(whole), {**whole.attrs, "warnings": '["mass is pressed"]'})
    assert "Warning of the fit. mass is pressed" in Page(render_posterior(warned)).text


@pytest.mark.usefixtures("undrawn")
def test_a_draw_of_zero_likelihood_has_no_cross_validation() -> None:
    whole = load_posterior(file("5"))
    parts = groups(whole)
    values = parts["log_likelihood"]["next_state"].copy(deep=True)
    values[0, 0, 3] = -np.inf
    parts["log_likelihood"] = parts["log_likelihood"].assign(next_state=values)
    text = Page(render_posterior(from_groups(parts, whole.attrs))).text
    assert "Not available: it gives no finite number" in text
    assert "Intervals that should hold 94 % of measurements hold " in text


def test_ranks_that_differ_are_said_and_others_are_not() -> None:
    fine, stuck = (
        [axes.get_title() for axes in plot_rank(made_up_posterior(stuck)).axes]
        for stuck in (False, True)
    )
    assert not any("chains differ" in title for title in fine)
    assert [title for title in stuck if "differ" in title] == ["w_x[cart]: chains differ"]


@pytest.mark.usefixtures("undrawn")
def test_command(tmp_path, capsys) -> None:
    page = tmp_path / "a page.html"
    source = file("6" if DATATREE else "5")
    command = ["report", str(source), "-o", str(page)]
    with warnings.catch_warnings():
        assert main([*command, "-q"]) == 0
    html = page.read_text(encoding="utf-8")
    assert capsys.readouterr().out == f"report: {page}\n"
    assert shlex.join(["pbrl-ppl", *command, "--quiet"]) in Page(html).text
    assert main([*command, "-q"]) == 2  # it is there
    assert "pass --overwrite" in capsys.readouterr().err
    for wrong in (tmp_path / "none.nc", page):
        assert main(["report", str(wrong), "-q", "-o", str(tmp_path / "new.html")]) == 2
        assert capsys.readouterr().err.startswith("error: ")
    assert [path.name for path in tmp_path.iterdir()] == ["a page.html"]
