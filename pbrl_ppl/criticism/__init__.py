"""Model criticism: residual, score, effect, refit, verdict, held-out error."""

from pbrl_ppl.criticism.closing import revise
from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.cross_validation import Change, gain
from pbrl_ppl.criticism.dependence import PRODUCTS
from pbrl_ppl.criticism.loop import ADEQUATE, NOT_CONVERGED, UNEXPLAINED, Findings
from pbrl_ppl.criticism.prior_check import (
    PriorCheck,
    prior_predictive_check,
    telling_horizon,
)
from pbrl_ppl.criticism.ranking import Ranking, criticise
from pbrl_ppl.criticism.remainder import learn_remainder
from pbrl_ppl.criticism.results import (
    Acceleration,
    Added,
    Candidate,
    Errors,
    ResidualTest,
    Unexplained,
)
from pbrl_ppl.criticism.rivals import Rival, fit_rivals, kept_groups, named_effects
from pbrl_ppl.criticism.score import DECISIVE, Signature, inseparable, rank_candidates, twins
from pbrl_ppl.criticism.selection import TRIED

__all__ = [
    "ADEQUATE",
    "DECISIVE",
    "DEFAULT",
    "NOT_CONVERGED",
    "PRODUCTS",
    "TRIED",
    "UNEXPLAINED",
    "Acceleration",
    "Added",
    "Candidate",
    "Change",
    "Criteria",
    "Errors",
    "Findings",
    "PriorCheck",
    "Ranking",
    "ResidualTest",
    "Rival",
    "Signature",
    "Unexplained",
    "criticise",
    "fit_rivals",
    "gain",
    "inseparable",
    "kept_groups",
    "learn_remainder",
    "named_effects",
    "prior_predictive_check",
    "rank_candidates",
    "revise",
    "telling_horizon",
    "twins",
]
