"""Physical effects: stages at which they act, catalogue by kind, attachment to bodies."""

from pbrl_ppl.effects.bodies import hanging_body
from pbrl_ppl.effects.catalogue import attach, candidates, catalogue
from pbrl_ppl.effects.effect import Attached, Effect, EffectParameter, at_stage, needs_inputs
from pbrl_ppl.effects.learned_remainder import (
    LEARNED_REMAINDER,
    LearnedRemainder,
    learned_remainder,
)
from pbrl_ppl.effects.stages import (
    Clock,
    Command,
    Disc,
    Force,
    Law,
    Noise,
    Properties,
    Rod,
    Sensor,
    Structure,
    Values,
)

__all__ = [
    "LEARNED_REMAINDER",
    "Attached",
    "Clock",
    "Command",
    "Disc",
    "Effect",
    "EffectParameter",
    "Force",
    "Law",
    "LearnedRemainder",
    "Noise",
    "Properties",
    "Rod",
    "Sensor",
    "Structure",
    "Values",
    "at_stage",
    "attach",
    "candidates",
    "catalogue",
    "hanging_body",
    "learned_remainder",
    "needs_inputs",
]
