"""Draws from the posterior: `fit` and its samplers, and `update`."""

from pbrl_ppl.sampling.fitting import fit
from pbrl_ppl.sampling.updating import update

__all__ = ["fit", "update"]
