"""Simulation-based calibration: whether the sampler is right."""

from pbrl_ppl.calibration.calibration import calibrate
from pbrl_ppl.calibration.ranks import Calibration, bins

__all__ = ["Calibration", "bins", "calibrate"]
