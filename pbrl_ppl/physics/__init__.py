"""The physics engine: worlds, joints and batched rollouts; the only room that imports pymunk."""

from pbrl_ppl.physics.coupling import Parts, independent_parts, joined_parts
from pbrl_ppl.physics.parts import Memory, OneWorld, Part, PartedSimulator
from pbrl_ppl.physics.physics import Physics
from pbrl_ppl.physics.placement import check_history, check_placement, overlap
from pbrl_ppl.physics.simulator import Simulator, after_recording
from pbrl_ppl.physics.solids import Scenery, circles, scenery, touching
from pbrl_ppl.physics.table1 import build_layout, index_priors
from pbrl_ppl.physics.transition import Transition
from pbrl_ppl.physics.trial import try_effect

__all__ = [
    "Memory",
    "OneWorld",
    "Part",
    "PartedSimulator",
    "Parts",
    "Physics",
    "Scenery",
    "Simulator",
    "Transition",
    "after_recording",
    "build_layout",
    "check_history",
    "check_placement",
    "circles",
    "independent_parts",
    "index_priors",
    "joined_parts",
    "overlap",
    "scenery",
    "touching",
    "try_effect",
]
