"""Measured files to a validated `xarray.Dataset`; trajectories and segments."""

from .bad_frames import bad_frames as bad_frames
from .bad_frames import without_bad_frames as without_bad_frames
from .bad_frames import without_measurements as without_measurements
from .conversion import as_history as as_history
from .derived import UnusedVelocity as UnusedVelocity
from .derived import measured_alone as measured_alone
from .derived import measurement_noise as measurement_noise
from .derived import unit_mismatches as unit_mismatches
from .derived import unused_velocities as unused_velocities
from .ends import End as End
from .ends import strange_ends as strange_ends
from .ends import trimmed as trimmed
from .files import read_table as read_table
from .history import History as History
from .history import Segments as Segments
from .history import check_start as check_start
from .history import from_segments as from_segments
from .history import longest_gap as longest_gap
from .history import segment_rows as segment_rows
from .history import unseen as unseen
from .kinematics import estimate_rates as estimate_rates
from .kinematics import fill_hinges as fill_hinges
from .kinematics import hung_bodies as hung_bodies
from .kinematics import lever as lever
from .units import mass_contradictions as mass_contradictions
from .units import with_units as with_units
