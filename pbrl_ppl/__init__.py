"""A physics engine as model prior, and a loop that closes on measured data.

The public names; each is imported when it is first used, for PyMC takes seconds to load.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pbrl_ppl.calibration import calibrate
    from pbrl_ppl.configurations import joint_probabilities
    from pbrl_ppl.distributions import Prior
    from pbrl_ppl.effects import Attached, Effect, EffectParameter, catalogue
    from pbrl_ppl.errors import PbrlError
    from pbrl_ppl.findings import Findings
    from pbrl_ppl.fitting import fit
    from pbrl_ppl.history import History, Segments
    from pbrl_ppl.identifiability import Identifiability
    from pbrl_ppl.identification import identify, uninformed
    from pbrl_ppl.learned_modes import learned_modes, mode_probabilities
    from pbrl_ppl.mode_prior import Modes
    from pbrl_ppl.model import physics_model
    from pbrl_ppl.op import SimulatorOp
    from pbrl_ppl.physics import Simulator
    from pbrl_ppl.planning.acting import Acted, act
    from pbrl_ppl.planning.actions import Action, ActionSet
    from pbrl_ppl.planning.dynamics import Dynamics
    from pbrl_ppl.planning.goals import Goal, Target
    from pbrl_ppl.planning.plan import Plan, plan
    from pbrl_ppl.posterior import load_posterior, save_posterior
    from pbrl_ppl.prior_check import PriorCheck, prior_predictive_check
    from pbrl_ppl.ranks import Calibration
    from pbrl_ppl.report import Loop, close_loop
    from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
    from pbrl_ppl.transition import Transition
    from pbrl_ppl.updated_prior import updated_scene
    from pbrl_ppl.updating import update

__version__ = "0.1.0"

__all__ = [
    "Acted",
    "Action",
    "ActionSet",
    "Attached",
    "Body",
    "Calibration",
    "Dynamics",
    "Effect",
    "EffectParameter",
    "Findings",
    "Goal",
    "History",
    "Identifiability",
    "Joint",
    "Loop",
    "Modes",
    "PbrlError",
    "Plan",
    "Prior",
    "PriorCheck",
    "Scene",
    "Segments",
    "Shape",
    "Simulator",
    "SimulatorOp",
    "Target",
    "Transition",
    "Wall",
    "act",
    "calibrate",
    "catalogue",
    "close_loop",
    "fit",
    "identify",
    "joint_probabilities",
    "learned_modes",
    "load_posterior",
    "mode_probabilities",
    "physics_model",
    "plan",
    "prior_predictive_check",
    "save_posterior",
    "uninformed",
    "update",
    "updated_scene",
]

_MODULES = {
    "calibration": ("calibrate",),
    "configurations": ("joint_probabilities",),
    "distributions": ("Prior",),
    "effects": ("Attached", "Effect", "EffectParameter", "catalogue"),
    "errors": ("PbrlError",),
    "findings": ("Findings",),
    "fitting": ("fit",),
    "history": ("History", "Segments"),
    "identifiability": ("Identifiability",),
    "identification": ("identify", "uninformed"),
    "learned_modes": ("learned_modes", "mode_probabilities"),
    "mode_prior": ("Modes",),
    "model": ("physics_model",),
    "op": ("SimulatorOp",),
    "physics": ("Simulator",),
    "planning.acting": ("Acted", "act"),
    "planning.actions": ("Action", "ActionSet"),
    "planning.dynamics": ("Dynamics",),
    "planning.goals": ("Goal", "Target"),
    "planning.plan": ("Plan", "plan"),
    "posterior": ("load_posterior", "save_posterior"),
    "prior_check": ("PriorCheck", "prior_predictive_check"),
    "ranks": ("Calibration",),
    "report": ("Loop", "close_loop"),
    "scene": ("Body", "Joint", "Scene", "Shape", "Wall"),
    "transition": ("Transition",),
    "updated_prior": ("updated_scene",),
    "updating": ("update",),
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"pbrl_ppl.{module}"), name)
    raise AttributeError(f"module 'pbrl_ppl' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names, for completion."""
    return __all__
