"""Likelihoods in numpy: data, noise, Eq. 11, whole trajectories and the log-posterior."""

from pbrl_ppl.likelihood.cells import ACCELERATION, DRIFT, JOLT, Cells, cells_of, check_moves
from pbrl_ppl.likelihood.data import Data, Observations, estimate_sigma, sigma_prior
from pbrl_ppl.likelihood.declared import declared_problem
from pbrl_ppl.likelihood.likelihood import (
    GAUSSIAN,
    Likelihood,
    TrajectoryLikelihood,
    TransitionLikelihood,
    log_norm,
    next_state_random,
    robust,
)
from pbrl_ppl.likelihood.log_posterior import (
    exponential,
    log_noise_prior,
    log_posterior,
    log_prior,
    noise_law,
    noise_prior_slope,
)
from pbrl_ppl.likelihood.noise_scales import bodies_acceleration, noise_medians, ranges
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.likelihood.sensitivity import Sensitivity
from pbrl_ppl.likelihood.simulation import simulated_trajectories, with_measurements
from pbrl_ppl.likelihood.smoothing import (
    along_trajectories,
    linearised,
    single_transitions,
    smoothed,
    with_sensitivity,
)
from pbrl_ppl.likelihood.tails import degrees_of_freedom, sum_tails, tail_places
from pbrl_ppl.likelihood.trajectory_noise import TrajectoryNoise

__all__ = [
    "ACCELERATION",
    "DRIFT",
    "GAUSSIAN",
    "JOLT",
    "Cells",
    "Data",
    "Likelihood",
    "Observations",
    "Problem",
    "Sensitivity",
    "TrajectoryLikelihood",
    "TrajectoryNoise",
    "TransitionLikelihood",
    "along_trajectories",
    "bodies_acceleration",
    "cells_of",
    "check_moves",
    "declared_problem",
    "degrees_of_freedom",
    "estimate_sigma",
    "exponential",
    "linearised",
    "log_noise_prior",
    "log_norm",
    "log_posterior",
    "log_prior",
    "next_state_random",
    "noise_law",
    "noise_medians",
    "noise_prior_slope",
    "ranges",
    "robust",
    "sigma_prior",
    "simulated_trajectories",
    "single_transitions",
    "smoothed",
    "sum_tails",
    "tail_places",
    "with_measurements",
    "with_sensitivity",
]
