"""Modes of the posterior: climb, search, evidence, and joints of unknown bodies."""

from pbrl_ppl.modes.configurations import ATTRIBUTE as ATTRIBUTE
from pbrl_ppl.modes.configurations import Pair as Pair
from pbrl_ppl.modes.configurations import Weighed as Weighed
from pbrl_ppl.modes.configurations import doubts as doubts
from pbrl_ppl.modes.configurations import index_law as index_law
from pbrl_ppl.modes.configurations import joint_probabilities as joint_probabilities
from pbrl_ppl.modes.configurations import stored as stored
from pbrl_ppl.modes.evidence import trajectory_evidence as trajectory_evidence
from pbrl_ppl.modes.joint_search import weigh as weigh
from pbrl_ppl.modes.laplace import Mode as Mode
from pbrl_ppl.modes.laplace import posterior_steps as posterior_steps
from pbrl_ppl.modes.library_choice import choose_from_library as choose_from_library
from pbrl_ppl.modes.noise import NOTHING as NOTHING
from pbrl_ppl.modes.noise import profile_sigma as profile_sigma
from pbrl_ppl.modes.search import find_mode as find_mode
from pbrl_ppl.modes.trajectories import find_trajectory_mode as find_trajectory_mode
from pbrl_ppl.modes.trajectories import following as following
from pbrl_ppl.modes.trajectories import nearby_mode as nearby_mode
from pbrl_ppl.modes.trajectories import trajectory_mode as trajectory_mode
