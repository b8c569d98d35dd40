"""Goals, actions and the searches for a plan under posterior draws."""

from .actions import Action as Action
from .actions import ActionSet as ActionSet
from .dynamics import PAST as PAST
from .dynamics import Dynamics as Dynamics
from .dynamics import TransitionModel as TransitionModel
from .dynamics import remembered as remembered
from .dynamics import rollout as rollout
from .experiments import Suggestion as Suggestion
from .experiments import suggest_actions as suggest_actions
from .goals import Goal as Goal
from .goals import Target as Target
from .planner import Plan as Plan
from .planner import SearchOptions as SearchOptions
from .planner import plan as plan
from .planner import start_state as start_state
