"""PyMC 5 with ArviZ 0.x and PyMC 6 with ArviZ 1.x: equal posteriors, interchangeable files.

``data/`` holds a fit of each generation; ``python -m tests.helpers.stacks`` writes them.
"""

from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pytest

from pbrl_ppl.posterior import draws, group, load_posterior, save_posterior, scene_of
from pbrl_ppl.sampling import update
from tests.helpers.stacks import GENERATIONS, SCENE, file, fitted, history


@pytest.fixture(scope="module")
def here() -> Any:
    return fitted()


@pytest.mark.parametrize("generation", GENERATIONS)
def test_posteriors_agree(here, generation: str) -> None:
    """Mass and six sigmas, first and second moments, within 4 Monte Carlo errors.

    False alarms: 0.1 % for each generation.
    """
    there = load_posterior(file(generation))
    assert f'"pymc": "{generation}.' in str(there.attrs["versions"])
    theirs, ours = group(there, "posterior"), group(here, "posterior")
    for name in ("mass", "sigma"):
        for power in (1, 2):
            moments = [(each[name] - 2.0 * (name == "mass")) ** power for each in (ours, theirs)]
            errors = [az.mcse(each.to_dataset(name=name))[name] for each in moments]
            gap = np.abs(np.subtract(*(each.mean(("chain", "draw")).values for each in moments)))
            assert (gap < 4 * np.hypot(*(each.values for each in errors))).all()


@pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")
@pytest.mark.parametrize("generation", GENERATIONS)
def test_a_file_of_either_generation_is_whole_and_of_use(
    generation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = load_posterior(file(generation))
    assert scene_of(there) == SCENE
    assert draws(there)["mass"].shape == (1000, 1)
    likelihood = group(there, "log_likelihood")["next_state"]
    assert likelihood.sizes == {"chain": 2, "draw": 500, "transition": 12}
    monkeypatch.setattr("pbrl_ppl.posterior.MIN_ESS", 30)  # no refit
    further = update(there, history(2, trajectories=1))
    assert group(further, "log_likelihood")["next_state"].sizes["transition"] == 16
    save_posterior(further, tmp_path / "again.nc")
    again = load_posterior(tmp_path / "again.nc")
    np.testing.assert_array_equal(draws(again)["mass"], draws(further)["mass"])
