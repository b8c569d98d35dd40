"""Agents that act in a world, learn and plan."""

from .agent import Acted as Acted
from .agent import Agent as Agent
from .agent import LWRAgent as LWRAgent
from .agent import OOLWRAgent as OOLWRAgent
from .agent import Revision as Revision
from .agent import Task as Task
from .agent import TrueModelAgent as TrueModelAgent
from .agent import act as act
from .pbrl import LibraryAgent as LibraryAgent
from .pbrl import PBRLAgent as PBRLAgent
