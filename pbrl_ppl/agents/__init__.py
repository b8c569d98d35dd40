"""Acting in a world: agents that plan, look where that led, and learn."""

from pbrl_ppl.agents.acting import Acted, act
from pbrl_ppl.agents.agent import Agent
from pbrl_ppl.agents.baselines import LWRAgent, OOLWRAgent, TrueModelAgent
from pbrl_ppl.agents.episode import Episode
from pbrl_ppl.agents.experiment import run_episodes
from pbrl_ppl.agents.library import LibraryAgent
from pbrl_ppl.agents.online import run_episode
from pbrl_ppl.agents.pbrl import PBRLAgent
from pbrl_ppl.agents.revision import Revision
from pbrl_ppl.agents.task import Task
from pbrl_ppl.agents.world import Outcome, World

__all__ = [
    "Acted",
    "Agent",
    "Episode",
    "LWRAgent",
    "LibraryAgent",
    "OOLWRAgent",
    "Outcome",
    "PBRLAgent",
    "Revision",
    "Task",
    "TrueModelAgent",
    "World",
    "act",
    "run_episode",
    "run_episodes",
]
