"""Model criticism: residual, score, effect, refit, verdict, held-out error."""

from pbrl_ppl.criticism.findings import ADEQUATE, NOT_CONVERGED, UNEXPLAINED, Findings
from pbrl_ppl.criticism.loop import revise
from pbrl_ppl.criticism.prior_check import (
    PriorCheck,
    prior_predictive_check,
    telling_horizon,
)
from pbrl_ppl.criticism.ranking import Ranking, criticise
from pbrl_ppl.criticism.results import (
    Acceleration,
    Added,
    Candidate,
    Errors,
    ResidualTest,
    Unexplained,
)

__all__ = [
    "ADEQUATE",
    "NOT_CONVERGED",
    "UNEXPLAINED",
    "Acceleration",
    "Added",
    "Candidate",
    "Errors",
    "Findings",
    "PriorCheck",
    "Ranking",
    "ResidualTest",
    "Unexplained",
    "criticise",
    "prior_predictive_check",
    "revise",
    "telling_horizon",
]
