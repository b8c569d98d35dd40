"""Recordings and scenes that are allowed, on which the loop must end with a verdict."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism import close_loop
from pbrl_ppl.effects import catalogue
from pbrl_ppl.history import History
from tests.helpers.free_puck import DISC, Disc

# a posterior of few draws is enough to test that there is one
pytestmark = pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning")

COM_OFFSET = tuple(effect for effect in catalogue if effect.name == "com_offset")


def test_a_prior_of_a_declared_effect_is_used() -> None:
    puck = replace(
        DISC.bodies[0],
        effects=("com_offset",),
        prior={f"com_offset_{axis}": {"mu": 0.0, "sigma": 0.01} for axis in "xy"},
    )
    scene = DISC.replace(bodies=(puck,))
    train, test = (
        History.from_dataframe(Disc(4, 8, seed=seed).frame(np.random.default_rng(seed)), scene)
        for seed in (1, 2)
    )
    found = close_loop(scene, train, test, catalogue=COM_OFFSET, seed=1, method="laplace")
    assert "com_offset_x" in found.posterior_after.posterior
