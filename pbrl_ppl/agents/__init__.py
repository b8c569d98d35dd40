"""Acting in a world: plan, look where that led, plan again."""

from pbrl_ppl.agents.acting import Acted, act

__all__ = ["Acted", "act"]
