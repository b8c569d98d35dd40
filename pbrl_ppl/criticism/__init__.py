"""Model criticism: residual, score, effect, refit, verdict, held-out error."""

from pbrl_ppl.criticism.closing import close_loop
from pbrl_ppl.criticism.criteria import DECISIVE, DEFAULT, TRIED, Criteria
from pbrl_ppl.criticism.cross_validation import Change, gain
from pbrl_ppl.criticism.dependence import QUANTITIES, recorded_quantities
from pbrl_ppl.criticism.loop import ADEQUATE, NOT_CONVERGED, UNEXPLAINED, Loop, check_folder
from pbrl_ppl.criticism.prior_check import PriorCheck, prior_predictive_check, telling_horizon
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
from pbrl_ppl.criticism.score import Signature, inseparable, rank_candidates, twins
from pbrl_ppl.criticism.stages import Stage

__all__ = [
    "ADEQUATE",
    "DECISIVE",
    "DEFAULT",
    "NOT_CONVERGED",
    "QUANTITIES",
    "TRIED",
    "UNEXPLAINED",
    "Acceleration",
    "Added",
    "Candidate",
    "Change",
    "Criteria",
    "Errors",
    "Loop",
    "PriorCheck",
    "Ranking",
    "ResidualTest",
    "Rival",
    "Signature",
    "Stage",
    "Unexplained",
    "check_folder",
    "close_loop",
    "criticise",
    "fit_rivals",
    "gain",
    "inseparable",
    "kept_groups",
    "learn_remainder",
    "named_effects",
    "prior_predictive_check",
    "rank_candidates",
    "recorded_quantities",
    "telling_horizon",
    "twins",
]
