"""Draws from the posterior: `fit` and its samplers, and `update`."""

from .fitting import fit as fit
from .fitting import sample as sample
from .methods import WeightsError as WeightsError
from .updating import update as update
