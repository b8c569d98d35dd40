"""The PyMC model: Table 1, Eqs. 11 and 12, and the engine as a black-box pytensor Op."""

from .declaration import build_model as build_model
from .declaration import physics_model as physics_model
from .declaration import problem_in as problem_in
from .op import DensityOp as DensityOp
from .op import LazyProblem as LazyProblem
from .op import LogLikelihoodOp as LogLikelihoodOp
from .op import PredictionOp as PredictionOp
from .op import SimulatorOp as SimulatorOp
