"""Phi: priors as data, the layout of the parameter vector, the wheel's symmetry."""

from pbrl_ppl.parameters.layout import (
    BODY_PARAMETERS,
    JOINT_ANCHORS,
    JOINT_INDICES,
    WHEEL_PARAMETERS,
    Block,
    Layout,
)
from pbrl_ppl.parameters.priors import Prior, box, inside, prior_draws, prior_residual
from pbrl_ppl.parameters.wheel_symmetry import MIXED, fold_draws, fold_wheels

__all__ = [
    "BODY_PARAMETERS",
    "JOINT_ANCHORS",
    "JOINT_INDICES",
    "MIXED",
    "WHEEL_PARAMETERS",
    "Block",
    "Layout",
    "Prior",
    "box",
    "fold_draws",
    "fold_wheels",
    "inside",
    "prior_draws",
    "prior_residual",
]
