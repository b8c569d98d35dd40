"""Whether the sampler is right: simulation-based calibration."""

from pbrl_ppl.calibration.calibration import calibrate
from pbrl_ppl.calibration.ranks import Calibration, bins

__all__ = ["Calibration", "bins", "calibrate"]
