"""Metropolis with a multivariate proposal that learns the posterior's shape while tuning."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.blocking import RaveledVars
from pymc.step_methods.metropolis import MetropolisState
from pymc.step_methods.state import dataclass_state
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]

#: Best acceptance rate of a random walk in many dimensions (Roberts, Gelman and Gilks, 1997).
TARGET_ACCEPTANCE = 0.234
#: The Laplace covariance counts as much as this many draws.
_PRIOR_DRAWS = 300
_LARGEST_BETA = float(np.log(0.95))


@dataclass_state
class AdaptiveState(MetropolisState):
    """What a chain must not inherit from the one before it."""

    factor: Array
    covariance: Array
    mean: Array
    log_scale: float
    log_beta: float
    seen: int


class AdaptiveMetropolis(pm.Metropolis):
    """Blocked Metropolis, adapted as in algorithm 4 of Andrieu and Thoms (2008).

    Two proposals take turns at random: a random walk, which finds its way anywhere, and a
    Crank-Nicolson step that is reversible for the Gaussian learned so far (Rudolf and Sprungk,
    2018), which makes large moves where the posterior is close to one. Mean, covariance and both
    step sizes learn from the chain while tuning and are fixed afterwards. One draw is the last of
    ``thin`` steps.

    Parameters
    ----------
    vars : list
        Random variables of the block.
    mean, covariance : ndarray
        First guess of the block's posterior in the sampler's unconstrained space.
    thin : int
        Metropolis steps a draw.
    **kwargs
        As for :class:`pymc.Metropolis`.
    """

    name = "adaptive_metropolis"
    default_blocked = True
    stats_dtypes_shapes: ClassVar[dict[str, tuple[type, list[int]]]] = {
        "accept": (np.float64, []),
        "accepted": (np.float64, []),
        "scaling": (np.float64, []),
        "beta": (np.float64, []),
    }
    _state_class = AdaptiveState

    def __init__(
        self, vars: Any, *, mean: Array, covariance: Array, thin: int = 1, **kwargs: Any
    ) -> None:
        super().__init__(vars, S=covariance, **{"blocked": True, **kwargs})
        self.elemwise_update = False  # all dimensions move together
        self.enum_dims = np.arange(1)
        self.accept_rate_iter = np.zeros(1)
        self.accepted_iter = np.zeros(1, dtype=bool)
        self.accepted_sum = np.zeros(1, dtype=int)
        self.thin = thin
        self.covariance = covariance.copy()
        self.factor = np.linalg.cholesky(covariance)
        self.mean = mean.copy()
        self.log_scale = float(np.log(2.38 / np.sqrt(len(covariance))))
        self.log_beta = float(np.log(0.6))
        self.seen = 0

    def astep(self, q0: RaveledVars) -> tuple[RaveledVars, list[dict[str, Any]]]:
        """Take ``thin`` Metropolis steps."""
        q = q0.data
        accepted = 0
        for _ in range(self.thin):
            walk = self.rng.uniform() < 0.5
            noise = self.factor @ self.rng.standard_normal(len(q))
            if walk:
                proposal = q + np.exp(self.log_scale) * noise
                correction = 0.0
            else:
                beta = np.exp(self.log_beta)
                proposal = self.mean + np.sqrt(1 - beta**2) * (q - self.mean) + beta * noise
                correction = self._depth(proposal) - self._depth(q)
            log_ratio = float(self.delta_logp(proposal, q)) + correction
            rate = float(np.exp(min(0.0, log_ratio))) if np.isfinite(log_ratio) else 0.0
            if self.rng.uniform() < rate:
                q = proposal
                accepted += 1
            if self.tune:
                self._learn(q, rate, walk)
        self.accept_rate_iter = np.array([rate])
        self.scaling = np.atleast_1d(np.exp(self.log_scale))
        stats = {
            "scaling": float(np.exp(self.log_scale)),
            "beta": float(np.exp(self.log_beta)),
            "accept": rate,
            "accepted": accepted / self.thin,
        }
        return RaveledVars(q, q0.point_map_info), [stats]

    def _depth(self, q: Array) -> float:
        """Minus the log-density of the learned Gaussian, up to a constant."""
        z = solve_triangular(self.factor, q - self.mean, lower=True)
        return float(0.5 * z @ z)

    def _learn(self, q: Array, rate: float, walk: bool) -> None:
        self.seen += 1
        gain = 1.0 / (self.seen + _PRIOR_DRAWS)
        change = (rate - TARGET_ACCEPTANCE) * self.seen**-0.6
        if walk:
            self.log_scale += change
        else:
            self.log_beta = min(self.log_beta + change, _LARGEST_BETA)
        off = q - self.mean
        self.mean = self.mean + gain * off
        self.covariance = self.covariance + gain * (np.outer(off, off) - self.covariance)
        if self.seen % 50 == 0:
            ridge = 1e-9 * np.diag(np.diag(self.covariance))
            self.factor = np.linalg.cholesky(self.covariance + ridge)
