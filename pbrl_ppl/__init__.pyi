"""The public names, each with the room that it comes from."""

from .agents import Acted as Acted
from .agents import act as act
from .calibration import Calibration as Calibration
from .calibration import calibrate as calibrate
from .criticism import Findings as Findings
from .criticism import PriorCheck as PriorCheck
from .criticism import prior_predictive_check as prior_predictive_check
from .effects import Attached as Attached
from .effects import Effect as Effect
from .effects import EffectParameter as EffectParameter
from .effects import catalogue as catalogue
from .errors import PbrlError as PbrlError
from .history import History as History
from .history import Segments as Segments
from .model import ParameterLibrary as ParameterLibrary
from .model import SimulatorOp as SimulatorOp
from .model import Transition as Transition
from .model import physics_model as physics_model
from .modes import joint_probabilities as joint_probabilities
from .parameters import Prior as Prior
from .physics import Simulator as Simulator
from .planning import Action as Action
from .planning import ActionSet as ActionSet
from .planning import Dynamics as Dynamics
from .planning import Goal as Goal
from .planning import Plan as Plan
from .planning import Target as Target
from .planning import plan as plan
from .posterior import Identifiability as Identifiability
from .posterior import identify as identify
from .posterior import learned_library as learned_library
from .posterior import library_probabilities as library_probabilities
from .posterior import load_posterior as load_posterior
from .posterior import loo_pit as loo_pit
from .posterior import save_posterior as save_posterior
from .posterior import uninformed as uninformed
from .posterior import updated_scene as updated_scene
from .report import Loop as Loop
from .report import close_loop as close_loop
from .sampling import fit as fit
from .sampling import update as update
from .scene import Body as Body
from .scene import Joint as Joint
from .scene import Scene as Scene
from .scene import Shape as Shape
from .scene import Wall as Wall

__version__: str
__all__: list[str]
from .effects import Command as Command
from .effects import Disc as Disc
from .effects import Force as Force
from .effects import Noise as Noise
from .effects import Properties as Properties
from .effects import Sensor as Sensor
from .effects import Structure as Structure
