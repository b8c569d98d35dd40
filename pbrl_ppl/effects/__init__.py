"""Physical effects: stages at which they act, catalogue by kind, attachment to bodies."""

from .catalogue import attach as attach
from .catalogue import candidates as candidates
from .catalogue import catalogue as catalogue
from .catalogue import check_names as check_names
from .effect import Attached as Attached
from .effect import Effect as Effect
from .effect import EffectParameter as EffectParameter
from .effect import at_stage as at_stage
from .effect import hanging_body as hanging_body
from .effect import holder as holder
from .effect import is_pivoted as is_pivoted
from .effect import needs_inputs as needs_inputs
from .learned_remainder import LEARNED_REMAINDER as LEARNED_REMAINDER
from .learned_remainder import LearnedRemainder as LearnedRemainder
from .learned_remainder import learned_remainder as learned_remainder
from .stages import Clock as Clock
from .stages import Command as Command
from .stages import Disc as Disc
from .stages import Force as Force
from .stages import Friction as Friction
from .stages import Law as Law
from .stages import Noise as Noise
from .stages import Properties as Properties
from .stages import Sensor as Sensor
from .stages import Structure as Structure
from .stages import Values as Values
