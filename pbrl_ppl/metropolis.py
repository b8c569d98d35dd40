"""Metropolis in blocks that learn the posterior's shape, with a cheap posterior to look ahead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.blocking import RaveledVars
from pymc.pytensorf import compile as compile_function
from pymc.pytensorf import join_nonshared_inputs
from pymc.step_methods.arraystep import ArrayStepShared
from pymc.step_methods.compound import StepMethodState
from pymc.step_methods.state import dataclass_state
from pymc.util import get_value_vars_from_user_vars
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]

#: Best acceptance rate of a random walk in many dimensions (Roberts, Gelman and Gilks, 1997).
TARGET_ACCEPTANCE = 0.234
#: The first guess of a covariance counts as much as this many steps.
_GUESS = 300
_LARGEST_BETA = float(np.log(0.95))


@dataclass(eq=False)
class Gaussian:
    """What is known of a block's posterior, in the sampler's unconstrained space, and its moves.

    Two proposals take turns at random: a random walk, which finds its way anywhere, and a
    Crank-Nicolson step that is reversible for this Gaussian (Rudolf and Sprungk, 2018), which makes
    large moves where the posterior is close to one. Mean, covariance and both step sizes learn as
    in algorithm 4 of Andrieu and Thoms (2008).

    Parameters
    ----------
    places : ndarray
        Places of the block's d entries in the vector of all variables, shape (d,).
    mean, covariance : ndarray
        First guess, shapes (d,) and (d, d).
    cheap : bool
        Whether moves cost nothing to speak of, as those of the noise do: then there is no need to
        look ahead.
    """

    places: NDArray[np.intp]
    mean: Array
    covariance: Array
    cheap: bool = False
    factor: Array = field(init=False)
    log_scale: float = field(init=False)
    log_beta: float = float(np.log(0.6))
    seen: int = 0

    def __post_init__(self) -> None:
        """Start from the best scale for a Gaussian."""
        self.factor = np.asarray(np.linalg.cholesky(self.covariance), dtype=float)
        self.log_scale = float(np.log(2.38 / np.sqrt(max(len(self.places), 1))))

    def depth(self, x: Array) -> Any:
        """Minus the log-density at points (..., d), up to a constant."""
        z = solve_triangular(self.factor, (x - self.mean).T, lower=True)
        return 0.5 * (z**2).sum(axis=0)

    def propose(self, x: Array, walk: bool, rng: np.random.Generator) -> tuple[Array, Any]:
        """A proposal from each point (..., d), and the logarithm of the Hastings ratio."""
        noise = rng.standard_normal(x.shape) @ self.factor.T
        if walk:
            return x + np.exp(self.log_scale) * noise, np.zeros(x.shape[:-1])
        beta = np.exp(self.log_beta)
        proposal = self.mean + np.sqrt(1 - beta**2) * (x - self.mean) + beta * noise
        return proposal, self.depth(proposal) - self.depth(x)

    def step(self, change: float, walk: bool) -> None:
        """Lengthen the moves of one kind by about this share, or shorten them."""
        if walk:
            self.log_scale += change
        else:
            self.log_beta = min(self.log_beta + change, _LARGEST_BETA)

    def learn(self, x: Array, rate: float, walk: bool) -> None:
        """Take account of where the chain is, and of the last proposal's acceptance rate."""
        self.seen += 1
        gain = 1.0 / (self.seen + _GUESS)
        self.step((rate - TARGET_ACCEPTANCE) * self.seen**-0.6, walk)
        off = x - self.mean
        self.mean = self.mean + gain * off
        self.covariance = self.covariance + gain * (np.outer(off, off) - self.covariance)
        if self.seen % 50 == 0:
            ridge = 1e-9 * np.diag(np.diag(self.covariance))
            factor = np.linalg.cholesky(self.covariance + ridge)
            self.factor = np.asarray(factor, dtype=float)


@dataclass_state
class AdaptiveState(StepMethodState):
    """What a chain must not inherit from the one before it."""

    tune: bool
    blocks: list[Gaussian]


class AdaptiveMetropolis(ArrayStepShared):
    """Adaptive Metropolis, block by block, that looks ahead with a cheap posterior.

    With ``rough``, a block makes ``inner`` steps under that cheap posterior, and where they end is
    accepted or not by the exact one
    (while tuning, always): the surrogate transition method (Liu, 2001, section 9.4.3;
    delayed acceptance, Christen and Fox, 2005, is the case of one step). The result is exact
    whatever ``rough`` is; a good one gives nearly independent draws.

    Parameters
    ----------
    vars : list
        The model's random variables, all of them.
    blocks : list of Gaussian
        What moves together, and a first guess of its posterior; together they hold every entry.
    rough : callable, optional
        Log-density of the cheap posterior, up to a constant, at a vector of all variables in the
        sampler's unconstrained space.
    inner : int
        Steps under it for each one that is judged exactly.
    thin : int
        Rounds over the blocks a draw.
    model : pymc.Model, optional
        The context's by default.
    initial_point : dict, optional
        As PyMC's samplers pass it.
    rng : Generator or int, optional
        Source of randomness.
    **kwargs
        What else PyMC passes to step methods.
    """

    name = "adaptive_metropolis"
    default_blocked = True
    stats_dtypes_shapes: ClassVar[dict[str, tuple[type, list[int]]]] = {
        "accept": (np.float64, []),
        "look_ahead_accept": (np.float64, []),
        "tune": (bool, []),
    }
    _state_class = AdaptiveState

    def __init__(
        self,
        vars: Any,
        *,
        blocks: list[Gaussian],
        rough: Callable[[Array], float] | None = None,
        inner: int = 10,
        thin: int = 1,
        model: pm.Model | None = None,
        initial_point: dict[str, Array] | None = None,
        rng: Any = None,
        **kwargs: Any,
    ) -> None:
        model = pm.modelcontext(model)
        point = model.initial_point() if initial_point is None else initial_point
        values = get_value_vars_from_user_vars(vars, model)
        self.tune = True
        self.blocks, self.rough, self.inner, self.thin = blocks, rough, inner, thin
        (logp,), joined = join_nonshared_inputs(
            point=point, outputs=[model.logp()], inputs=values, shared_inputs={}
        )
        self.logp = compile_function([joined], logp)
        self.logp.trust_input = True
        super().__init__(values, {}, blocked=True, rng=rng)

    def astep(self, q0: RaveledVars) -> tuple[RaveledVars, list[dict[str, Any]]]:
        """Go ``thin`` times over the blocks."""
        q = q0.data.copy()
        # the exact posterior is for the draws that are kept: tuning makes do with the rough one
        near = self.logp if self.rough is None or not self.tune else self.rough
        here = float(near(q))
        rates, exact = [], []
        for _ in range(self.thin):
            for block in self.blocks:
                if self.rough is None or block.cheap:
                    q, here, rate = self._move(block, q, here, near)
                    rates.append(rate)
                    continue
                begin = rough = here if near is self.rough else self.rough(q)
                y = q
                for _ in range(self.inner):
                    y, rough, rate = self._move(block, y, rough, self.rough)
                    rates.append(rate)
                if near is self.rough:
                    q, here = y, rough
                elif y is not q:
                    there = float(self.logp(y))
                    exact.append(_rate((there - here) - (rough - begin)))
                    if self.rng.uniform() < exact[-1]:
                        q, here = y, there
        stats = {
            "accept": float(np.mean(rates)),
            "look_ahead_accept": float(np.mean(exact)) if exact else np.nan,
            "tune": self.tune,
        }
        return RaveledVars(q, q0.point_map_info), [stats]

    def _move(
        self, block: Gaussian, q: Array, here: float, density: Callable[[Array], Any]
    ) -> tuple[Array, float, float]:
        """One Metropolis step of a block: where it ends, the density there, the acceptance rate."""
        walk = bool(self.rng.uniform() < 0.5)
        moved = q.copy()
        moved[block.places], correction = block.propose(q[block.places], walk, self.rng)
        there = float(density(moved))
        rate = _rate(there - here + correction)
        if self.rng.uniform() < rate:
            q, here = moved, there
        if self.tune:
            block.learn(q[block.places], rate, walk)
        return q, here, rate


def _rate(log_ratio: float) -> float:
    """Probability to accept; none where a density is not a number."""
    return float(np.exp(min(0.0, log_ratio))) if not np.isnan(log_ratio) else 0.0
