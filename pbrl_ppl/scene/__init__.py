"""Scenes: shapes, bodies, walls and joints as declared; TOML to `Scene` and back."""

from . import checks as checks
from .bodies import Body as Body
from .bodies import Shape as Shape
from .bodies import Wall as Wall
from .checks import CONTACT_NAMES as CONTACT_NAMES
from .checks import PLACES as PLACES
from .checks import Point as Point
from .checks import nearest as nearest
from .joints import NUMBERS as NUMBERS
from .joints import WORLD as WORLD
from .joints import Actuator as Actuator
from .joints import Joint as Joint
from .recording import SEPARATORS as SEPARATORS
from .recording import Recording as Recording
from .recording import column_of as column_of
from .scene import Scene as Scene
from .scene import toml_of as toml_of
from .units import MASS_PRIOR as MASS_PRIOR
from .units import Units as Units
from .units import body_sizes as body_sizes
from .units import check_product as check_product
from .units import motion_time as motion_time
from .units import smallest_radius as smallest_radius
from .units import state_sizes as state_sizes
from .units import units_of as units_of
