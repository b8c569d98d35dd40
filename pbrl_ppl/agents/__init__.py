"""Agents that act in a world, learn and plan; episodes and experiments."""

from pbrl_ppl.agents.acting import Acted, act
from pbrl_ppl.agents.agent import Agent, LWRAgent, OOLWRAgent, TrueModelAgent
from pbrl_ppl.agents.episode import Episode
from pbrl_ppl.agents.experiment import run_episode, run_episodes
from pbrl_ppl.agents.library import LibraryAgent
from pbrl_ppl.agents.pbrl import PBRLAgent
from pbrl_ppl.agents.revision import Revision
from pbrl_ppl.agents.world import Outcome, Task, World

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
