"""The notebooks run from their first cell to their last at small size, and find what they say.

None is marked slow, so that both generations of PyMC and ArviZ run them in CI.
"""

import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from pbrl_ppl.posterior import load_posterior
from tests.helpers.places import ROOT

pytestmark = pytest.mark.first(3)

FOLDER = ROOT / "analysis" / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.py"))
#: Ends the cell whose constants are replaced, as Papermill does it.
PARAMETERS = re.compile(r'(?<=\n)# %% tags=\["parameters"\]\n.*?(?=\n# %%)', re.S)


@pytest.fixture
def run(tmp_path):
    """Run a notebook with other constants; its names when it has ended."""
    backend = plt.get_backend()
    plt.switch_backend("Agg")

    def executed(name: str, **constants: object) -> dict[str, Any]:
        text = (FOLDER / name).read_text()
        (cell,) = PARAMETERS.findall(text)
        constants |= {"OUT": tmp_path}
        assert all(re.search(rf"^.*\b{key}\b.* = ", cell, re.M) for key in constants)
        names: dict[str, Any] = {"__name__": "__main__", "_constants": constants}
        text = PARAMETERS.sub(lambda m: m.group() + "\nglobals().update(_constants)\n", text)
        exec(compile(text, name, "exec"), names)
        return names

    yield executed
    plt.close("all")
    plt.switch_backend(backend)


def pictures(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.png") if path.stat().st_size > 5000}


def test_all_are_run_here_and_in_the_index() -> None:
    """One line each."""
    index = (FOLDER / "README.md").read_text()
    assert re.findall(r"^\| \[`(\w+\.py)`\]\(\1\) \|", index, re.M) == NOTEBOOKS
    here = Path(__file__).read_text()
    assert [name for name in NOTEBOOKS if f'run("{name}"' in here] == NOTEBOOKS


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_figures_of_the_package_are_shown(name) -> None:
    """They are not pyplot's: a kernel that has not drawn yet would print `<Figure size ...>`."""
    text = (FOLDER / name).read_text()
    if re.search(r"^from pbrl_ppl\.report import .*\bplot_", text, re.M):
        assert "# %%\n# %matplotlib inline\n" in text


def test_from_a_log_to_a_posterior(run, tmp_path) -> None:
    names = run("01_log_to_posterior.py", TRAJECTORIES=3, METHOD="laplace", DRAWS=100)
    # the castor's resistance is not in this model, and passes for a little mass
    assert names["table"].loc["mass[cart]", "mean"] == pytest.approx(6.5, rel=0.1)
    assert names["check"].sentences == ()
    loaded = load_posterior(names["path"])
    assert (loaded["posterior"]["mass"] == names["idata"]["posterior"]["mass"]).all()
    assert pictures(tmp_path) == {"01_recording", "01_prior_check", "01_posterior"}


def test_bayesian_workflow(run, tmp_path) -> None:
    names = run("02_bayesian_workflow.py", TRAJECTORIES=3, METHOD="laplace", DRAWS=100)
    assert names["comparison"].index[0] == "with drag"
    worse = names["comparison"].loc["declared"]
    assert abs(worse["elpd_diff"]) > 4 * worse["dse"]
    assert names["slopes"]["declared"] < -0.02 < abs(names["slopes"]["with drag"])
    assert names["sensitivity"].abs().drop(["r", "mu_c"]).max() < names["sensitivity"].abs()["r"]
    assert {"02_rank", "02_predictive", "02_loo_pit", "02_residual"} < pictures(tmp_path)


def test_closing_the_loop(run, tmp_path, capsys) -> None:
    none = tmp_path / "nowhere"
    absent = {"PENDULUM": none, "BLOCK": none}
    names = run("03_closing_the_loop.py", TRAJECTORIES=3, METHOD="laplace", **absent)
    cart = names["cart"]
    assert [added.effect for added in cart.added] == ["angular_drag"]
    assert cart.added[0].parameters["coefficient"].mean == pytest.approx(1.2, rel=0.1)
    said = capsys.readouterr().out
    assert "skipped: the measured pendulum is not here" in said
    assert "skipped: the measured block is not here" in said
    assert (tmp_path / "03_cart.html").is_file()
    assert pictures(tmp_path) == {"03_candidates", "03_errors", "03_rollout"}


# what the model lacks is large, and the loop says so before it fits
@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.PriorWarning")
def test_your_own_effect(run, tmp_path) -> None:
    names = run("04_your_own_effect.py", TRAJECTORIES=5, INTERVALS=15, METHOD="laplace")
    (added,) = names["loop"].added
    assert added.effect == "swirl"
    low, high = added.parameters["strength"].hdi
    assert low < names["STRENGTH"] < high
    # it is not forced into a name that is not its own
    assert names["without"].verdict == "unexplained"
    assert pictures(tmp_path) == {"04_candidates"}


def test_planning(run, tmp_path) -> None:
    names = run("05_planning.py", TRAJECTORIES=3, METHOD="laplace", DRAWS=100, PLANNED=2)
    assert names["plan"].reached
    assert float(names["end"].sel(state="x").mean()) == pytest.approx(2.0, abs=0.3)
    assert "scene" not in names
    assert pictures(tmp_path) == {"05_plan"}


def test_figures_of_the_paper(run, tmp_path) -> None:
    """What its text says of the kept episodes is what they say."""
    names = run("06_figures_of_the_paper.py", RESAMPLES=99)
    free, noisy = (names["tables"][panel] for panel in "ab")
    assert list(free["reached the goal"]) == [10, 10, 7, 4]
    assert list(noisy["reached the goal"]) == [10, 10, 2, 2]
    bumps = "steps with bumps, mean"
    assert free.loc["OO-LWR", bumps] < free.loc["PBRL", bumps]
    assert noisy.loc["OO-LWR", bumps] > noisy.loc["PBRL", bumps]
    steps = free["steps, median of those"]
    assert 4 <= steps["PBRL"] - steps["true model"] < 5 and steps["OO-LWR"] > 2 * steps["PBRL"]
    assert names["right_after_two"] == 9
    first = names["first"].dropna("seed")
    assert (first.size, float(first.min()), float(first.max())) == (9, 7, 10)
    assert pictures(tmp_path) == {"06_figure_4ab", "06_learned", "06_bumps"}


def test_many_robots(run, tmp_path, monkeypatch) -> None:
    """The robots' reports have no pictures here: drawing those takes most of the time."""
    monkeypatch.setattr("pbrl_ppl.reporting.reports.picture", lambda plot, *data: "")
    names = run("07_many_robots.py", ROBOTS=2, TRAJECTORIES=4, INTERVALS=10, DRAWS=300)
    assert names["found"] == names["dragged"] == ["puck2"]
    assert list(names["table"]["verdict"]) == ["adequate", "effects-added"]
    median = names["intervals"]["median"].to_numpy()[:2]
    assert median == pytest.approx(names["true_mass"], rel=0.03)
    width = names["known"]["97 %"] / names["known"]["3 %"]
    assert width["the kind"] < 0.1 * width["Table 1"]
    assert pictures(tmp_path) == {"07_masses"}
