"""Stages of the long calls in criticism, as progress callbacks receive them."""

from __future__ import annotations

from enum import StrEnum


class Stage(StrEnum):
    """A stage of closing the loop: a name for programs, and a sentence for people.

    Attributes
    ----------
    share : float or None
        Share of the whole time at which the stage usually begins (measured on a pendulum with four
        added effects); None for stages that are not always there.
    """

    share: float | None

    def __new__(cls, sentence: str, share: float | None = None) -> Stage:
        """Return a stage that is its sentence, with its share."""
        stage = str.__new__(cls, sentence)
        stage._value_, stage.share = sentence, share
        return stage

    CHECK_PRIOR = "comparing the data with the prior", 0.02
    FIT = "fitting the declared model", 0.03
    REPEAT = "measurement noise is correlated: going on with that"
    SCORE = "scoring what the model might lack", 0.04
    PRUNE = "checking that each added effect is still needed", 0.29
    TEST = "testing the residual", 0.38
    SIMULATE = "simulating whole trajectories with what the model might lack"
    SAMPLE = "sampling the posteriors", 0.5
    COMPARE = "comparing errors on held-out data", 0.99
    LEARN = "learning a force for the residual"
    REFIT = "fitting the model with the learned remainder"
