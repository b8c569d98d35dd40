"""Measured files to a validated `xarray.Dataset`; trajectories and segments."""

from pbrl_ppl.history.bad_frames import (
    bad_frames,
    without_bad_frames,
    without_measurements,
)
from pbrl_ppl.history.checks import check_start, longest_gap, unit_mismatches, unseen
from pbrl_ppl.history.conversion import as_history
from pbrl_ppl.history.derived import (
    UnusedVelocity,
    measured_alone,
    measurement_noise,
    unused_velocities,
)
from pbrl_ppl.history.ends import End, strange_ends, trimmed
from pbrl_ppl.history.files import read_table
from pbrl_ppl.history.history import History, Segments, from_segments, segment_rows
from pbrl_ppl.history.kinematics import estimate_rates, fill_hinges, hung_bodies, lever
from pbrl_ppl.history.mujoco import from_mujoco

__all__ = [
    "End",
    "History",
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
