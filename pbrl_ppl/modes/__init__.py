"""Modes of the posterior: climb, search, evidence, and joints of unknown bodies."""

from .configurations import ATTRIBUTE as ATTRIBUTE
from .configurations import Pair as Pair
from .configurations import Weighed as Weighed
from .configurations import doubts as doubts
from .configurations import index_law as index_law
from .configurations import joint_probabilities as joint_probabilities
from .configurations import stored as stored
from .evidence import trajectory_evidence as trajectory_evidence
from .joint_search import weigh as weigh
from .ladder import climb_ladder as climb_ladder
from .ladder import fit_pieces as fit_pieces
from .ladder import ladder as ladder
from .ladder import refined as refined
from .laplace import Mode as Mode
from .laplace import posterior_steps as posterior_steps
from .library_choice import choose_from_library as choose_from_library
from .noise import NOTHING as NOTHING
from .noise import profile_sigma as profile_sigma
from .search import find_mode as find_mode
from .simulation import find_simulation_mode as find_simulation_mode
from .simulation import simulation_mode as simulation_mode
from .trajectories import find_trajectory_mode as find_trajectory_mode
from .trajectories import following as following
from .trajectories import nearby_mode as nearby_mode
from .trajectories import trajectory_mode as trajectory_mode
