"""Stages of the long calls in criticism, as progress callbacks receive them."""

from enum import StrEnum


class Stage(StrEnum):
    """A stage of closing the loop: a name for programs, and a sentence for people."""

    CHECK_PRIOR = "comparing the data with the prior"
    FIT = "fitting the declared model"
    REPEAT = "measurement noise is correlated: starting again with that"
    SCORE = "scoring what the model might lack"
    PRUNE = "checking that each added effect is still needed"
    TEST = "testing the residual"
    WITHDRAW = "no effect of the catalogue explains what is missing"
    SAMPLE_DECLARED = "sampling the posterior of the declared model"
    SAMPLE_REVISED = "sampling the posterior of the revised model"
    COMPARE = "comparing errors on held-out data"
    LEARN = "learning a force for the residual"
    REFIT = "fitting the model with the learned remainder"
