"""Phi: priors as data, the layout of the parameter vector, the wheel's symmetry."""

from .layout import BODY_PARAMETERS as BODY_PARAMETERS
from .layout import JOINT_ANCHORS as JOINT_ANCHORS
from .layout import JOINT_INDICES as JOINT_INDICES
from .layout import WHEEL_PARAMETERS as WHEEL_PARAMETERS
from .layout import Block as Block
from .layout import Layout as Layout
from .layout import ParameterLibrary as ParameterLibrary
from .priors import Prior as Prior
from .priors import box as box
from .priors import covariance_factor as covariance_factor
from .priors import differentiate as differentiate
from .priors import inside as inside
from .priors import prior_draws as prior_draws
from .priors import prior_residual as prior_residual
from .priors import prior_slopes as prior_slopes
from .priors import stepped as stepped
from .wheel_symmetry import by_prior as by_prior
from .wheel_symmetry import change_from as change_from
from .wheel_symmetry import folded as folded
from .wheel_symmetry import nearest as nearest
from .wheel_symmetry import symmetrised as symmetrised
from .wheel_symmetry import wheels as wheels
