"""A physics engine as model prior, and a loop that closes on measured data.

The public names; each is imported when it is first used, for PyMC takes seconds to load.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pbrl_ppl.agents import Acted, act
    from pbrl_ppl.calibration import Calibration, calibrate
    from pbrl_ppl.criticism import Findings, PriorCheck, prior_predictive_check
    from pbrl_ppl.effects import Attached, Effect, EffectParameter, catalogue
    from pbrl_ppl.errors import PbrlError
    from pbrl_ppl.history import History, Segments
    from pbrl_ppl.model import ParameterLibrary, SimulatorOp, Transition, physics_model
    from pbrl_ppl.modes import joint_probabilities
    from pbrl_ppl.parameters import Prior
    from pbrl_ppl.physics import Simulator
    from pbrl_ppl.planning import Action, ActionSet, Dynamics, Goal, Plan, Target, plan
    from pbrl_ppl.posterior import (
        Identifiability,
        identify,
        learned_library,
        library_probabilities,
        load_posterior,
        save_posterior,
        uninformed,
        updated_scene,
    )
    from pbrl_ppl.report import Loop, close_loop
    from pbrl_ppl.sampling import fit, update
    from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall

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
    "ParameterLibrary",
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
    "learned_library",
    "library_probabilities",
    "load_posterior",
    "physics_model",
    "plan",
    "prior_predictive_check",
    "save_posterior",
    "uninformed",
    "update",
    "updated_scene",
]

_MODULES = {
    "agents": (
        "Acted",
        "act",
    ),
    "calibration": (
        "Calibration",
        "calibrate",
    ),
    "criticism": (
        "Findings",
        "PriorCheck",
        "prior_predictive_check",
    ),
    "effects": (
        "Attached",
        "Effect",
        "EffectParameter",
        "catalogue",
    ),
    "errors": ("PbrlError",),
    "history": (
        "History",
        "Segments",
    ),
    "model": (
        "ParameterLibrary",
        "SimulatorOp",
        "Transition",
        "physics_model",
    ),
    "modes": ("joint_probabilities",),
    "parameters": ("Prior",),
    "physics": ("Simulator",),
    "planning": (
        "Action",
        "ActionSet",
        "Dynamics",
        "Goal",
        "Plan",
        "Target",
        "plan",
    ),
    "posterior": (
        "Identifiability",
        "identify",
        "learned_library",
        "load_posterior",
        "library_probabilities",
        "save_posterior",
        "uninformed",
        "updated_scene",
    ),
    "report": (
        "Loop",
        "close_loop",
    ),
    "sampling": (
        "fit",
        "update",
    ),
    "scene": (
        "Body",
        "Joint",
        "Scene",
        "Shape",
        "Wall",
    ),
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
