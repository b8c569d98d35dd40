"""Recordings of two posteriors, one after the other."""

import numpy as np
import pytest
import xarray as xr

from pbrl_ppl.posterior.data import SMOOTHED, both_recordings

pytestmark = pytest.mark.one_stack


def test_a_file_from_before_trajectories_had_a_begin_is_updated() -> None:
    """As History reads it: its clocks began at zero. It was a KeyError."""
    dim = "recorded_trajectory"
    new = xr.Dataset(
        {"slope": ("transition", [1.0]), SMOOTHED: (dim, [1.0]), "recorded_number": (dim, [0.0]),
         "recorded_began": (dim, [7.0])}
    )  # fmt: skip
    both = both_recordings(new.drop_vars("recorded_began"), new)
    np.testing.assert_array_equal(both["recorded_began"], [0.0, 7.0])
