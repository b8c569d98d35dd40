"""The PyMC model: Table 1, Eqs. 11 and 12, and the engine as a black-box pytensor Op."""

from pbrl_ppl.model.declaration import build_model, prior_predictive_draws
from pbrl_ppl.model.op import SimulatorOp

__all__ = ["SimulatorOp", "build_model", "prior_predictive_draws"]
