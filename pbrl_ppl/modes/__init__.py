"""Modes of the posterior: climb, search, evidence, and joints of unknown bodies."""

from pbrl_ppl.modes.configurations import (
    ATTRIBUTE,
    Pair,
    Weighed,
    doubts,
    index_law,
    joint_probabilities,
    stored,
)
from pbrl_ppl.modes.evidence import trajectory_evidence
from pbrl_ppl.modes.joint_search import weigh
from pbrl_ppl.modes.laplace import Mode, posterior_steps
from pbrl_ppl.modes.library_choice import choose_from_library
from pbrl_ppl.modes.noise import NOTHING, profile_sigma
from pbrl_ppl.modes.search import find_mode
from pbrl_ppl.modes.trajectories import (
    find_trajectory_mode,
    following,
    nearby_mode,
    trajectory_mode,
)

__all__ = [
    "ATTRIBUTE",
    "NOTHING",
    "Mode",
    "Pair",
    "Weighed",
    "choose_from_library",
    "doubts",
    "find_mode",
    "find_trajectory_mode",
    "following",
    "index_law",
    "joint_probabilities",
    "nearby_mode",
    "posterior_steps",
    "profile_sigma",
    "stored",
    "trajectory_evidence",
    "trajectory_mode",
    "weigh",
]
