"""Draws from the posterior: `fit` and its samplers, `update`, and whether the sampler is right."""

from pbrl_ppl.sampling.calibration import calibrate
from pbrl_ppl.sampling.declaration import physics_model
from pbrl_ppl.sampling.fitting import fit
from pbrl_ppl.sampling.pooling import Pooled, pool
from pbrl_ppl.sampling.ranks import Calibration, bins
from pbrl_ppl.sampling.updating import update

__all__ = ["Calibration", "Pooled", "bins", "calibrate", "fit", "physics_model", "pool", "update"]
