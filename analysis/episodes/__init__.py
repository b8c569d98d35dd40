"""Episodes of agents in simulated worlds: the runs of the paper's experiments."""

from episodes.episode import Episode as Episode
from episodes.processes import processes as processes
from episodes.processes import processors as processors
from episodes.runs import run_episode as run_episode
from episodes.runs import run_episodes as run_episodes
from episodes.world import EpisodeError as EpisodeError
from episodes.world import Outcome as Outcome
from episodes.world import World as World
