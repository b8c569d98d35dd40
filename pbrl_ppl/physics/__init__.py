"""The engine: world building, wheel, joints and the batched rollout; alone in importing pymunk."""

from pbrl_ppl.physics.parts import PartedSimulator
from pbrl_ppl.physics.placement import check_history, check_placement, overlap
from pbrl_ppl.physics.simulator import Simulator

__all__ = ["PartedSimulator", "Simulator", "check_history", "check_placement", "overlap"]
