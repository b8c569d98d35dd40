"""Measured files to a validated `xarray.Dataset`; trajectories and segments."""

from pbrl_ppl.history.bad_frames import (
    BadFrame,
    bad_frames,
    without_bad_frames,
    without_measurements,
)
from pbrl_ppl.history.derived import (
    UnusedVelocity,
    measured_alone,
    measurement_noise,
    unused_velocities,
)
from pbrl_ppl.history.ends import End, strange_ends, trimmed
from pbrl_ppl.history.files import read_table
from pbrl_ppl.history.gaps import check_start, longest_gap, unseen
from pbrl_ppl.history.history import History, Segments
from pbrl_ppl.history.mujoco import from_mujoco
from pbrl_ppl.history.reading import Reading, as_history
from pbrl_ppl.history.rebuild import from_segments, segment_rows
from pbrl_ppl.history.start import estimate_rates, fill_hinges, hung_bodies, lever
from pbrl_ppl.history.unit_check import unit_mismatches

__all__ = [
    "BadFrame",
    "End",
    "History",
    "Reading",
    "Segments",
    "UnusedVelocity",
    "as_history",
    "bad_frames",
    "check_start",
    "estimate_rates",
    "fill_hinges",
    "from_mujoco",
    "from_segments",
    "hung_bodies",
    "lever",
    "longest_gap",
    "measured_alone",
    "measurement_noise",
    "read_table",
    "segment_rows",
    "strange_ends",
    "trimmed",
    "unit_mismatches",
    "unseen",
    "unused_velocities",
    "without_bad_frames",
    "without_measurements",
]
