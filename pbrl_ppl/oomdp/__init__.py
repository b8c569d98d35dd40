"""Object-oriented baselines: relations, conditions, LWR and OO-LWR."""

from .lwr import LWR as LWR
from .lwr import OOLWR as OOLWR
from .lwr import LocalRegression as LocalRegression
from .relations import Attributes as Attributes
from .relations import Pushed as Pushed
from .relations import Relation as Relation
from .relations import SectorContacts as SectorContacts
