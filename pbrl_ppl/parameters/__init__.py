"""Phi: priors as data, the layout of the parameter vector, the wheel's symmetry."""

from pbrl_ppl.parameters.layout import (
    BODY_PARAMETERS,
    JOINT_ANCHORS,
    JOINT_INDICES,
    WHEEL_PARAMETERS,
    Block,
    Layout,
)
from pbrl_ppl.parameters.library import ParameterLibrary
from pbrl_ppl.parameters.priors import (
    Prior,
    box,
    differentiate,
    inside,
    prior_draws,
    prior_residual,
    prior_slopes,
)
from pbrl_ppl.parameters.wheel_symmetry import (
    Wheel,
    beside,
    change_from,
    evened,
    fold_draws,
    fold_wheels,
    gathered,
    likeliest,
    redescribed,
    wheels,
)

__all__ = [
    "BODY_PARAMETERS",
    "JOINT_ANCHORS",
    "JOINT_INDICES",
    "WHEEL_PARAMETERS",
    "Block",
    "Layout",
    "ParameterLibrary",
    "Prior",
    "Wheel",
    "beside",
    "box",
    "change_from",
    "differentiate",
    "evened",
    "fold_draws",
    "fold_wheels",
    "gathered",
    "inside",
    "likeliest",
    "prior_draws",
    "prior_residual",
    "prior_slopes",
    "redescribed",
    "wheels",
]
