"""What the data say: informed parameters, silent ones, inseparable combinations, in words."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import pandas as pd

INFORMED, WEAK, PRIOR_ONLY = "informed", "weak", "prior only"
#: What to record so that parameters show, by what their names hold; the first that fits.
_CURES = (
    ((" r[", " mu_c["), "record contacts (collisions with a wall or another body)"),
    (("torque", "inertia", "angular", "w_theta", "pivot"), "record the body turning"),
)
_ANY_CURE = "record motion in which that matters"


@dataclass(frozen=True)
class Width:
    """Prior against posterior width of one scalar parameter.

    Parameters
    ----------
    parameter : str
        Its label, such as ``mass[cart]``.
    prior_sd, posterior_sd : float
        Of the logarithm for a log-normal prior (1); angular deviation for an angle (rad, at most
        the square root of 2); else in the parameter's unit.
    ratio : float
        Posterior over prior.
    verdict : str
        ``informed``, ``weak`` or ``prior only``.
    """

    parameter: str
    prior_sd: float
    posterior_sd: float
    ratio: float
    verdict: str


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the data constrain less than the prior does.

    Parameters
    ----------
    weights : tuple of (str, float)
        Parameters that move together, in prior sds, as a unit vector; the first is positive.
    effect : float
        How far one prior sd along it moves the predictions, in units of the noise; below 1.
    """

    weights: tuple[tuple[str, float], ...]
    effect: float

    @property
    def sentence(self) -> str:
        """The same in words."""
        names = [name for name, _ in self.weights]
        moves = [f"{name} {'up' if weight > 0 else 'down'}" for name, weight in self.weights]
        return (
            f"The data cannot tell {_listed(names)} apart: {moves[0]} with {_listed(moves[1:])}"
            " leaves the predictions as they are. Give one of them as known, or a tighter prior."
        )


@dataclass(frozen=True)
class Identifiability:
    """Which parameters the data inform.

    Parameters
    ----------
    parameters : tuple of Width
        One a continuous parameter, in the layout's order.
    silent : tuple of str
        Parameters of which the data say nothing: predictions do not depend on them.
    directions : tuple of Direction
        Combinations that the data do not constrain though each parameter has an effect.
    """

    parameters: tuple[Width, ...]
    silent: tuple[str, ...]
    directions: tuple[Direction, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """What the data do not say, in words; none where they inform all."""
        cures: dict[str, list[str]] = {}
        for name in self.silent:
            found = (cure for words, cure in _CURES if any(word in f" {name}" for word in words))
            cures.setdefault(next(found, _ANY_CURE), []).append(name)
        silent = (
            f"The data say nothing about {_listed(names)}: {cure}, or give the value as known."
            for cure, names in cures.items()
        )
        return (*silent, *(direction.sentence for direction in self.directions))

    def table(self) -> pd.DataFrame:
        """One row a parameter: prior_sd, posterior_sd, ratio, verdict."""
        rows = [asdict(each) for each in self.parameters]
        columns = [field.name for field in fields(Width)]
        return pd.DataFrame(rows, columns=columns).set_index("parameter")

    def to_dict(self) -> dict[str, Any]:
        """Plain values for ``report.json``."""
        return {
            "parameters": [asdict(each) for each in self.parameters],
            "directions": [
                {"weights": dict(each.weights), "effect": each.effect} for each in self.directions
            ],
            "sentences": list(self.sentences),
        }


def _listed(names: list[str]) -> str:
    """``a, b and c``."""
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last
