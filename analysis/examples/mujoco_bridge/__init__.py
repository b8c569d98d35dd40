"""MuJoCo's models as planar scenes, its rollouts as histories, and posteriors as MJCF with ranges.

Copy this folder beside your script. It needs ``mujoco`` (``pip install mujoco``) to read models.
"""

from .ranges import mjcf_ranges as mjcf_ranges
from .rollouts import from_mujoco as from_mujoco
from .scenes import ConversionWarning as ConversionWarning
from .scenes import scene_from_mjcf as scene_from_mjcf
