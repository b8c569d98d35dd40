"""The physics engine: worlds, joints and batched rollouts; the only room that imports pymunk."""

from .parts import EnginePart as EnginePart
from .parts import Memory as Memory
from .parts import PartedSimulator as PartedSimulator
from .parts import independent_parts as independent_parts
from .physics import Physics as Physics
from .physics import Transition as Transition
from .physics import compile_for_search as compile_for_search
from .physics import compile_loops as compile_loops
from .physics import simulated_recording as simulated_recording
from .settings import Parts as Parts
from .settings import build_layout as build_layout
from .settings import index_priors as index_priors
from .simulator import Simulator as Simulator
from .simulator import after_recording as after_recording
from .solids import Scenery as Scenery
from .solids import check_history as check_history
from .solids import check_placement as check_placement
from .solids import circles as circles
from .solids import depth_of as depth_of
from .solids import overlap as overlap
from .solids import scenery as scenery
from .solids import touching as touching
from .trial import try_effect as try_effect
