"""Goals, actions and the searches for a plan under posterior draws."""

from pbrl_ppl.planning.actions import Action, ActionSet
from pbrl_ppl.planning.dynamics import Dynamics, TransitionModel, rollout
from pbrl_ppl.planning.experiments import Suggestion, suggest_actions
from pbrl_ppl.planning.goals import Goal, Target
from pbrl_ppl.planning.planner import Plan, plan, start_state

__all__ = [
    "Action",
    "ActionSet",
    "Dynamics",
    "Goal",
    "Plan",
    "Suggestion",
    "Target",
    "TransitionModel",
    "plan",
    "rollout",
    "start_state",
    "suggest_actions",
]
