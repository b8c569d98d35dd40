"""The physics engine: worlds, joints and batched rollouts; the only room that imports pymunk."""

from pbrl_ppl.physics.coupling import Parts as Parts
from pbrl_ppl.physics.coupling import independent_parts as independent_parts
from pbrl_ppl.physics.coupling import joined_parts as joined_parts
from pbrl_ppl.physics.parts import Memory as Memory
from pbrl_ppl.physics.parts import OneWorld as OneWorld
from pbrl_ppl.physics.parts import Part as Part
from pbrl_ppl.physics.parts import PartedSimulator as PartedSimulator
from pbrl_ppl.physics.physics import Physics as Physics
from pbrl_ppl.physics.placement import check_history as check_history
from pbrl_ppl.physics.placement import check_placement as check_placement
from pbrl_ppl.physics.placement import overlap as overlap
from pbrl_ppl.physics.simulator import Simulator as Simulator
from pbrl_ppl.physics.simulator import after_recording as after_recording
from pbrl_ppl.physics.solids import Scenery as Scenery
from pbrl_ppl.physics.solids import circles as circles
from pbrl_ppl.physics.solids import scenery as scenery
from pbrl_ppl.physics.solids import touching as touching
from pbrl_ppl.physics.table1 import build_layout as build_layout
from pbrl_ppl.physics.table1 import index_priors as index_priors
from pbrl_ppl.physics.transition import Transition as Transition
from pbrl_ppl.physics.trial import try_effect as try_effect
