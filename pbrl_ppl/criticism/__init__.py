"""What a model lacks: residual, score, effect, refit, verdict, held-out error."""

from pbrl_ppl.criticism.findings import ADEQUATE, UNEXPLAINED, Findings
from pbrl_ppl.criticism.loop import revise
from pbrl_ppl.criticism.prior_check import PriorCheck, prior_predictive_check

__all__ = ["ADEQUATE", "UNEXPLAINED", "Findings", "PriorCheck", "prior_predictive_check", "revise"]
