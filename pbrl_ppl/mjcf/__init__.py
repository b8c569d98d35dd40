"""MJCF and URDF models as planar scenes, and revised scenes as MJCF for domain randomisation."""

from .reading import scene_from_mjcf as scene_from_mjcf
from .writing import mjcf_ranges as mjcf_ranges
