"""A planner that is given a posterior file and nothing else: the command, and both stacks."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbrl_ppl.cli import main
from pbrl_ppl.errors import GoalError, PosteriorError
from pbrl_ppl.planning import ActionSet, Dynamics, Goal, plan
from pbrl_ppl.posterior import draws, from_groups, groups, load_posterior, save_posterior
from tests.helpers.stacks import DATA, GENERATIONS, file, fitted

START, GOAL = {"puck": (0.0, 0.0, 0.0)}, Goal.of({"puck": (1.5, 0.5, None)}, tolerance=0.1)
#: What PyMC 5 planned on the file that PyMC 5 wrote, and on that of PyMC 6.
PLANS = {generation: DATA / f"puck-plan{generation}.csv" for generation in GENERATIONS}
COMMAND = ["--start", "0,0,0", "--goal", "puck=1.5,0.5,-", "--tolerance", "0.1", "--quiet"]


def planned(idata, **options):
    return plan(idata, START, GOAL, draws=8, seed=1, **options)


@pytest.mark.parametrize("generation", GENERATIONS)
def test_both_stacks_plan_alike(generation: str) -> None:
    """From either generation's file, whichever generation plans."""
    found = planned(load_posterior(file(generation))).to_dataframe()
    there = pd.read_csv(PLANS[generation])
    assert list(found.columns) == list(there.columns)
    for column in there.columns.drop("body"):
        np.testing.assert_allclose(found[column], there[column], atol=1e-9)


@pytest.mark.filterwarnings("ignore:the draws are too few")  # few draws, on purpose
def test_a_fresh_process_with_the_file_plans_as_memory_does(tmp_path: Path) -> None:
    idata = fitted(draws=100)
    here = planned(idata)
    save_posterior(idata, tmp_path / "puck.nc")
    arguments = [str(tmp_path / "puck.nc"), *COMMAND, "--draws", "8", "-o", str(tmp_path / "p.csv")]
    run = "import sys; from pbrl_ppl.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", run, "plan", *arguments], check=True, capture_output=True, text=True
    )
    assert "the goal is reached" in done.stdout
    there = pd.read_csv(tmp_path / "p.csv")
    # what reading decimal numbers may lose
    pd.testing.assert_frame_equal(there, here.to_dataframe(), rtol=1e-14, atol=0.0)


def test_map_is_the_stored_mode_and_draws_are_seeded() -> None:
    """One parameter, of a wide prior: it is near the draw of highest likelihood."""
    idata = load_posterior(file("5"))
    likelihood = groups(idata)["log_likelihood"]["next_state"].sum("transition").values.ravel()
    (best,) = Dynamics.of(idata).phi[0]
    masses = draws(idata)["mass"].ravel()
    assert json.loads(idata.attrs["mode"])["parameters"] == {"mass[puck]": best}
    assert abs(best - masses[likelihood.argmax()]) < masses.std()
    one, two, other = (Dynamics.of(idata, 8, seed=seed).phi for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)
    assert len(np.unique(one)) == 8
    with pytest.raises(PosteriorError, match="expected 1 to 1000"):
        Dynamics.of(idata, 1001)


def test_actions_are_such_as_were_recorded() -> None:
    """Nine tenths of the recorded forces are no stronger."""
    idata = load_posterior(file("5"))
    given = groups(idata)["constant_data"]["actions"].values.reshape(-1, 3)
    force, torque = ActionSet.recorded(idata).strongest("puck")
    assert np.mean(np.hypot(given[:, 0], given[:, 1]) <= force) == pytest.approx(0.9, abs=0.1)
    assert np.mean(abs(given[:, 2]) <= torque) == pytest.approx(0.9, abs=0.1)
    still = groups(idata)
    still["constant_data"] = still["constant_data"].copy(deep=True)
    still["constant_data"]["actions"][:] = 0.0
    with pytest.raises(GoalError, match="nothing was pushed"):
        ActionSet.recorded(from_groups(still, idata.attrs))


def test_the_command_writes_the_plan_and_says_how_it_ends(tmp_path, capsys) -> None:
    out = tmp_path / "plan.csv"
    assert main(["plan", str(file("5")), *COMMAND, "-o", str(out)]) == 0
    assert "the goal is reached" in capsys.readouterr().out
    assert len(pd.read_csv(out)) > 3
    assert main(["plan", str(file("5")), *COMMAND, "-o", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_the_command_s_weight_is_the_search_s(tmp_path, capsys) -> None:
    """Written as Python plans, and no longer than with the weight that is the default."""
    idata, times = load_posterior(file("5")), []
    for weight in (None, 1):
        out = tmp_path / f"{weight}.csv"
        given = [] if weight is None else ["--weight", str(weight)]
        assert main(["plan", str(file("5")), *COMMAND, *given, "-o", str(out)]) == 0
        capsys.readouterr()
        here = plan(idata, START, GOAL, seed=1, **({} if weight is None else {"weight": weight}))
        found = pd.read_csv(out)
        assert found["time"].max() == pytest.approx(here.duration)
        times.append(here.duration)
    assert times[1] <= times[0]


def test_an_unreachable_goal_ends_with_code_1_and_the_best(tmp_path, capsys) -> None:
    path, out = tmp_path / "actions.toml", tmp_path / "plan.csv"
    path.write_text('[[action]]\nbody = "puck"\nforce = [4, 0]\nframe = "world"\n')
    backwards = ["--start", "0,0,0", "--goal", "-2,0,-", "--actions", str(path), "--quiet"]
    command = ["plan", str(file("5")), *backwards, "-o", str(out), "--nodes", "4000"]
    assert main(command) == 1
    assert "the goal is not reached" in capsys.readouterr().out
    assert out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--goal", "1,1,-"], "nothing says where puck is"),
        (["--start", "0,0,0"], "no target"),
        (["--start", "0,0,0", "--goal", "pluck=1,1,-"], 'did you mean "puck"'),
        (["--start", "0,0,0", "--goal", "1,one,-"], "'one' is not a number"),
        (["--start", "0,-,0", "--goal", "1,1,-"], "no free coordinates"),
        (["--start", "0,0,0", "--goal", "1,1"], "got 2 values"),
        (["--start", "0,0,0", "--goal", "gaol.toml"], "no such file"),
        (["--start", "0,0,0", "--goal", "1,1,-", "--actions", "none.toml"], "no such file"),
        (["--start", "0,0,0", "--goal", "1,1,-", "--method", "mpi"], 'did you mean "mppi"'),
        (["--start", "0,0,0", "--goal", "1,1,-", "--tail", "2"], "tail is 2.0"),
        (["--start", "0,0,0", "--goal", "1,1,-", "--weight", "0.5"], "weight is 0.5"),
        (
            ["--start", "0,0,0", "--goal", "1,1,-", "--weight", "1", "--method", "mppi"],
            "--weight: it is for astar",
        ),
        (["--start", "0,0,0", "--goal", "1,1,-", "--draws", "5000"], "expected 1 to 1000"),
    ],
)
def test_bad_input_is_one_message(arguments, message, tmp_path, capsys) -> None:
    out = tmp_path / "plan.csv"
    assert main(["plan", str(file("5")), *arguments, "-q", "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "message"), [("plan.txt", "ends in .csv"), ("no/plan.csv", "there is no folder")]
)
def test_an_output_that_cannot_be_is_refused_first(name, message, tmp_path, capsys) -> None:
    assert main(["plan", str(file("5")), *COMMAND, "-o", str(tmp_path / name)]) == 2
    assert message in capsys.readouterr().err


def test_a_file_that_is_no_posterior_is_named(tmp_path, capsys) -> None:
    path = tmp_path / "no.nc"
    path.write_text("no")
    assert main(["plan", str(path), *COMMAND, "-o", str(tmp_path / "plan.csv")]) == 2
    assert "not a NetCDF file" in capsys.readouterr().err


if __name__ == "__main__":
    for generation, path in PLANS.items():
        planned(load_posterior(file(generation))).save(path)


@pytest.mark.one_stack
def test_a_plan_prints_as_a_sentence() -> None:
    found = planned(load_posterior(file("5")))
    assert str(found) == found.in_words()
    assert str(found).startswith(f"the goal is reached: {len(found.wrenches)} intervals")
    assert repr(found) == (
        f"Plan({len(found.wrenches)} intervals, {found.duration:.3g} s, goal reached)"
    )


@pytest.mark.one_stack
@pytest.mark.parametrize(
    ("given", "why"),
    [
        ([], "puck.nc names no effects that its data cannot separate"),
        (["--effect", "spring"], "got --effect 'spring' alone"),
    ],
)
def test_suggest_asks_for_effects_in_the_command_s_terms(tmp_path, capsys, given, why) -> None:
    save_posterior(load_posterior(file("5")), tmp_path / "puck.nc")
    command = ["suggest", str(tmp_path / "puck.nc"), "--start", "0,0,0", "-q"]
    assert main([*command, "-o", str(tmp_path / "next.csv"), *given]) == 2
    said = capsys.readouterr().err
    cure = "name two or more, such as --effect linear_drag --effect quadratic_drag"
    assert why in said and cure in said and "effects=" not in said
