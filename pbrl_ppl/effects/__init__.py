"""Physical effects: stages at which they act, catalogue by kind, attachment to bodies."""

from .catalogue import attach as attach
from .catalogue import candidates as candidates
from .catalogue import catalogue as catalogue
from .catalogue import check_names as check_names
from .effect import Attached as Attached
from .effect import Clock as Clock
from .effect import Command as Command
from .effect import Disc as Disc
from .effect import Effect as Effect
from .effect import EffectParameter as EffectParameter
from .effect import Force as Force
from .effect import Friction as Friction
from .effect import Law as Law
from .effect import Noise as Noise
from .effect import Properties as Properties
from .effect import Sensor as Sensor
from .effect import Structure as Structure
from .effect import Values as Values
from .effect import at_stage as at_stage
from .effect import hanging_body as hanging_body
from .effect import holder as holder
from .effect import is_pivoted as is_pivoted
from .effect import is_unpivoted as is_unpivoted
from .effect import needs_inputs as needs_inputs
