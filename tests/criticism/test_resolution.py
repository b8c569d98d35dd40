"""Substeps enough for the data, and a mode that smoothing again does not better."""

from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.refinement import shift, with_enough_substeps
from tests.helpers.free_puck import DISC, Disc

pytestmark = pytest.mark.one_stack

#: A drag's exponential shows the steps of a coarse engine.
DRAGGED = DISC.with_effects("puck", "linear_drag")


def quiet(stage: str) -> None:
    """Take no notice."""


def test_substeps_are_doubled_until_they_change_nothing() -> None:
    disc = Disc(8, 15, DRAGGED.replace(substeps=1), drag=0.9)
    mode = disc.mode(np.random.default_rng(3))
    assert shift(mode) > DEFAULT.engine.small_shift
    said = []
    found = with_enough_substeps(mode, said.append)
    assert shift(found) <= DEFAULT.engine.small_shift
    assert found.problem.physics.substeps > 1
    assert said[-1] == f"using {found.problem.physics.substeps} engine steps an interval"


def test_a_good_mode_stays() -> None:
    mode = Disc(8, 15, DISC.replace(substeps=20)).mode(np.random.default_rng(3))
    assert with_enough_substeps(mode, quiet) is mode


def test_a_mode_of_too_much_noise_is_left() -> None:
    """States smoothed with large noise follow the data whatever the parameters: a trap."""
    mode = Disc(8, 15, DISC.replace(substeps=20)).mode(np.random.default_rng(3))
    trapped = replace(mode, phi=1.2 * mode.phi, log_posterior=mode.log_posterior - 50.0)
    found = with_enough_substeps(trapped, quiet)
    assert found.log_posterior > mode.log_posterior - 5.0
    np.testing.assert_allclose(found.phi, mode.phi, rtol=0.01)
