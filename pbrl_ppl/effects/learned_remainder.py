"""A learned force for the unexplained residual: a sum of Gaussian bumps over the velocity."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import final

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force, Law
from pbrl_ppl.parameters import Prior
from pbrl_ppl.state import Floats, Ints

#: Name of every learned remainder.
LEARNED_REMAINDER = "learned_remainder"


@final
@dataclass(frozen=True)
class LearnedRemainder(Effect):
    """Effect of the force stage with a tabulated law; see :func:`learned_remainder`.

    Parameters
    ----------
    table : str
        The table as JSON, as posterior files store it.
    """

    table: str = ""

    def __reduce__(self) -> tuple[Callable[[str], LearnedRemainder], tuple[str]]:
        """Return the table to pickle: the law is a closure, which cannot be pickled."""
        return learned_remainder, (self.table,)


@lru_cache(maxsize=64)
def learned_remainder(table: str) -> LearnedRemainder:
    """Return the effect of a table; the same object for the same table.

    The force is a sum of basis functions ("forms"), each times a parameter with a standard normal
    prior: a Gaussian process. Each form is a sum of Gaussian bumps over the body's velocity in its
    frame.

    Parameters
    ----------
    table : str
        JSON of ``centre`` (bump, 3) and ``width`` (bump, 3) in m/s, m/s and rad/s, ``output``
        (bump,), 0 for the force forward, 1 sideways, 2 for the torque, and ``forms`` (form, bump)
        in N and N m.
    """
    values = json.loads(table)
    forms = np.array(values["forms"], dtype=float)
    law = _law_of(
        np.array(values["centre"], dtype=float),
        1.0 / np.array(values["width"], dtype=float),
        np.array(values["output"], dtype=np.int64),
        forms,
    )
    prior = Prior("normal", sigma=1.0)
    return LearnedRemainder(
        LEARNED_REMAINDER,
        tuple(EffectParameter(f"form{k + 1}", "1", prior) for k in range(len(forms))),
        "a force learned from the unexplained residual, for which no law is known",
        "C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006)",
        Force(law),
        table=table,
    )


def _law_of(centre: Floats, sharpness: Floats, output: Ints, forms: Floats) -> Law:
    """Return the law, a closure over the table's arrays."""
    bumps = len(centre)
    # a bump is part of the forms of one process only, which are consecutive
    begin = np.argmax(forms != 0, axis=0)
    end = len(forms) - np.argmax(forms[::-1] != 0, axis=0)

    def law(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
        c, s = math.cos(state[2]), math.sin(state[2])
        forward = c * state[3] + s * state[4]
        sideways = c * state[4] - s * state[3]
        along, across, torque = 0.0, 0.0, 0.0
        for i in range(bumps):
            a = (forward - centre[i, 0]) * sharpness[i, 0]
            b = (sideways - centre[i, 1]) * sharpness[i, 1]
            d = (state[5] - centre[i, 2]) * sharpness[i, 2]
            size = 0.0
            for k in range(begin[i], end[i]):
                size += parameters[k] * forms[k, i]
            size *= math.exp(-0.5 * (a * a + b * b + d * d))
            if output[i] == 0:
                along += size
            elif output[i] == 1:
                across += size
            else:
                torque += size
        wrench[0] += c * along - s * across
        wrench[1] += s * along + c * across
        wrench[2] += torque

    return law
