"""Table 1, Eqs. 11 and 12, the engine as a pytensor Op, and the `pm.Model` made of them."""

from pbrl_ppl.model.cells import ACCELERATION, DRIFT, JOLT, Cells, check_moves
from pbrl_ppl.model.data import Data
from pbrl_ppl.model.declaration import build_model, declared_problem, prior_predictive_draws
from pbrl_ppl.model.library import ParameterLibrary
from pbrl_ppl.model.likelihood import (
    Observations,
    log_density,
    next_state_random,
    robust,
    whiten,
)
from pbrl_ppl.model.log_posterior import (
    exponential,
    log_noise_prior,
    log_posterior,
    log_prior,
    noise_law,
    noise_prior_slope,
)
from pbrl_ppl.model.noise import Noise, estimate_sigma, sigma_prior
from pbrl_ppl.model.noise_scales import bodies_acceleration, noise_medians, ranges
from pbrl_ppl.model.op import SimulatorOp
from pbrl_ppl.model.physics import Physics
from pbrl_ppl.model.problem import Problem
from pbrl_ppl.model.recorded_cells import cells_of
from pbrl_ppl.model.sensitivity import Sensitivity
from pbrl_ppl.model.simulation import simulated_trajectories, with_measurements
from pbrl_ppl.model.smoothing import (
    along_trajectories,
    linearised,
    single_transitions,
    smoothed,
    with_sensitivity,
)
from pbrl_ppl.model.table1 import build_layout, index_priors
from pbrl_ppl.model.tails import degrees_of_freedom, tail_places
from pbrl_ppl.model.trajectory_noise import TrajectoryNoise
from pbrl_ppl.model.transition import Transition

__all__ = [
    "ACCELERATION",
    "DRIFT",
    "JOLT",
    "Cells",
    "Data",
    "Noise",
    "Observations",
    "ParameterLibrary",
    "Physics",
    "Problem",
    "Sensitivity",
    "SimulatorOp",
    "TrajectoryNoise",
    "Transition",
    "along_trajectories",
    "bodies_acceleration",
    "build_layout",
    "build_model",
    "cells_of",
    "check_moves",
    "declared_problem",
    "degrees_of_freedom",
    "estimate_sigma",
    "exponential",
    "index_priors",
    "linearised",
    "log_density",
    "log_noise_prior",
    "log_posterior",
    "log_prior",
    "next_state_random",
    "noise_law",
    "noise_medians",
    "noise_prior_slope",
    "prior_predictive_draws",
    "ranges",
    "robust",
    "sigma_prior",
    "simulated_trajectories",
    "single_transitions",
    "smoothed",
    "tail_places",
    "whiten",
    "with_measurements",
    "with_sensitivity",
]
