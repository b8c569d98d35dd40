"""Model criticism: residual, score, effect, refit, verdict, held-out error."""

from pbrl_ppl.criticism.findings import (
    ADEQUATE,
    UNEXPLAINED,
    Added,
    Candidate,
    Errors,
    Findings,
    Unexplained,
)
from pbrl_ppl.criticism.loop import revise
from pbrl_ppl.criticism.prior_check import PriorCheck, prior_predictive_check

__all__ = [
    "ADEQUATE",
    "UNEXPLAINED",
    "Added",
    "Candidate",
    "Errors",
    "Findings",
    "PriorCheck",
    "Unexplained",
    "prior_predictive_check",
    "revise",
]
