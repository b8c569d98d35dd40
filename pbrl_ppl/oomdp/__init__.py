"""Object-oriented baselines: relations, conditions, LWR and OO-LWR."""

from pbrl_ppl.oomdp.contacts import SectorContacts
from pbrl_ppl.oomdp.lwr import LWR, OOLWR
from pbrl_ppl.oomdp.regression import Regression
from pbrl_ppl.oomdp.relations import Attributes, Condition, Pushed, Relation

__all__ = [
    "LWR",
    "OOLWR",
    "Attributes",
    "Condition",
    "Pushed",
    "Regression",
    "Relation",
    "SectorContacts",
]
