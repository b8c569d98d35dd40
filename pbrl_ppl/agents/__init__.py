"""Agents that act in a world, learn and plan; episodes and experiments."""

from .acting import Acted as Acted
from .acting import act as act
from .agent import Agent as Agent
from .agent import LWRAgent as LWRAgent
from .agent import OOLWRAgent as OOLWRAgent
from .agent import TrueModelAgent as TrueModelAgent
from .episode import Episode as Episode
from .experiment import run_episode as run_episode
from .experiment import run_episodes as run_episodes
from .library import LibraryAgent as LibraryAgent
from .pbrl import PBRLAgent as PBRLAgent
from .revision import Revision as Revision
from .world import Outcome as Outcome
from .world import Task as Task
from .world import World as World
