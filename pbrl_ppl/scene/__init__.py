"""Scenes: shapes, bodies, walls and joints as declared; TOML to `Scene` and back."""

from .checks import CONTACT_NAMES as CONTACT_NAMES
from .checks import nearest as nearest
from .scene import WORLD as WORLD
from .scene import Body as Body
from .scene import Joint as Joint
from .scene import Point as Point
from .scene import Scene as Scene
from .scene import Shape as Shape
from .scene import Wall as Wall
