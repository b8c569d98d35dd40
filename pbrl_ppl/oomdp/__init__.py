"""Object-oriented baselines: contact predicates, conditions, LWR and OO-LWR."""

from pbrl_ppl.oomdp.contacts import Condition, SectorContacts
from pbrl_ppl.oomdp.lwr import LWR, OOLWR
from pbrl_ppl.oomdp.regression import Regression

__all__ = ["LWR", "OOLWR", "Condition", "Regression", "SectorContacts"]
