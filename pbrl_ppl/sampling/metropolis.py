"""Block-wise adaptive Metropolis with the surrogate transition method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pymc as pm
from pymc.blocking import RaveledVars
from pymc.pytensorf import compile as compile_function
from pymc.pytensorf import join_nonshared_inputs
from pymc.step_methods.arraystep import ArrayStepShared
from pymc.step_methods.compound import StepMethodState
from pymc.step_methods.state import dataclass_state
from pymc.util import get_value_vars_from_user_vars
from scipy.linalg.lapack import dtrtrs

from pbrl_ppl.state import Floats, Ints

#: Best acceptance rate of a random walk in many dimensions (Roberts, Gelman and Gilks, 1997).
TARGET_ACCEPTANCE = 0.234
#: Best step of a random walk in one dimension, in standard deviations.
_ALONE = 2.4
#: Weight of the first guess of a covariance, in steps.
_GUESS = 300
_LARGEST_BETA = float(np.log(0.95))


@dataclass(eq=False)
class Gaussian:
    """Gaussian approximation of a block's posterior, in the unconstrained space, and its moves.

    Two proposals take turns at random: a random walk, which finds its way anywhere, and a
    Crank-Nicolson step that is reversible for this Gaussian (Rudolf and Sprungk, 2018), which makes
    large moves where the posterior is close to one; a cheap block walks along one entry as often as
    along all. Mean, covariance and both step sizes learn as
    in algorithm 4 of Andrieu and Thoms (2008).

    Parameters
    ----------
    places : ndarray
        Places of the block's d entries in the vector of all variables, shape (d,).
    mean, covariance : ndarray
        First guess, shapes (d,) and (d, d).
    cheap : int
        Steps a round of a block whose steps cost little, as those of the noise do: it does not
        look ahead. 0 for other blocks.
    """

    places: Ints
    mean: Floats
    covariance: Floats
    cheap: int = 0
    factor: Floats = field(init=False)
    log_scale: float = field(init=False)
    log_beta: float = float(np.log(0.6))
    seen: int = 0

    def __post_init__(self) -> None:
        """Start from the best scale for a Gaussian."""
        self.factor = np.asarray(np.linalg.cholesky(self.covariance), dtype=float)
        self.log_scale = float(np.log(2.38 / np.sqrt(max(len(self.places), 1))))

    def depth(self, x: Floats) -> Any:
        """Return minus the log-density at points (..., d), up to a constant."""
        return 0.5 * (self.standardised(x) ** 2).sum(axis=0)

    def standardised(self, x: Floats) -> Floats:
        """Return points (..., d) in units of this Gaussian, shape (d, ...)."""
        # called for each step: scipy's `solve_triangular` takes ten times as long to check
        return np.asarray(dtrtrs(self.factor, (x - self.mean).T, lower=True)[0])

    def propose(self, x: Floats, walk: bool, rng: np.random.Generator) -> tuple[Floats, Any]:
        """Return a proposal from each point (..., d), and the logarithm of the Hastings ratio."""
        noise = rng.standard_normal(x.shape) @ self.factor.T
        if walk:
            return x + np.exp(self.log_scale) * noise, np.zeros(x.shape[:-1])
        beta = np.exp(self.log_beta)
        proposal = self.mean + np.sqrt(1 - beta**2) * (x - self.mean) + beta * noise
        return proposal, self.depth(proposal) - self.depth(x)

    def move(
        self,
        q: Floats,
        here: float,
        density: Callable[[Floats], Any],
        rng: np.random.Generator,
        tune: bool,
        shift: Any = None,
    ) -> tuple[Floats, float, float]:
        """Make a Metropolis step of the block in the vector q, whose log-density is ``here``.

        With several modes, ``shift`` is from this block's mode to that of the point, shape (d,):
        the shape of a mode is learned, and all proposals are random walks.

        Returns
        -------
        q : ndarray
            The vector after the step; the same one if the proposal was rejected.
        here : float
            The log-density there.
        rate : float
            Probability of acceptance.
        """
        alone = bool(self.cheap) and bool(rng.uniform() < 0.5)
        walk = shift is not None or bool(rng.uniform() < 0.5)
        moved = q.copy()
        correction: Any = 0.0
        if alone:  # an entry near zero needs another step than the others
            i = int(rng.integers(len(self.places)))
            step = _ALONE * np.sqrt(self.covariance[i, i])
            moved[self.places[i]] += step * rng.standard_normal()
        else:
            moved[self.places], correction = self.propose(q[self.places], walk, rng)
        there = float(density(moved))
        rate = _rate(there - here + correction)
        if rng.uniform() < rate:
            q, here = moved, there
        if tune:
            place = q[self.places] - (0.0 if shift is None else shift)
            self.learn(place, rate, None if alone else walk)
        return q, here, rate

    def lengthen(self, change: float, walk: bool) -> None:
        """Adapt the step size of one kind of move, by about this share."""
        if walk:
            self.log_scale += change
        else:
            self.log_beta = min(self.log_beta + change, _LARGEST_BETA)

    def learn(self, x: Floats, rate: float, walk: bool | None) -> None:
        """Adapt mean and covariance to the chain's place, and a kind of move to its acceptance."""
        self.seen += 1
        gain = 1.0 / (self.seen + _GUESS)
        if walk is not None:
            self.lengthen((rate - TARGET_ACCEPTANCE) * self.seen**-0.6, walk)
        off = x - self.mean
        self.mean = self.mean + gain * off
        self.covariance = self.covariance + gain * (np.outer(off, off) - self.covariance)
        if self.seen % 50 == 0:
            ridge = 1e-9 * np.diag(np.diag(self.covariance))
            factor = np.linalg.cholesky(self.covariance + ridge)
            self.factor = np.asarray(factor, dtype=float)


@dataclass(frozen=True, eq=False)
class Jumps:
    """Mode jumping: moves between modes of the posterior that a random walk would not cross.

    A point keeps its coordinates in units of the mode's Gaussian, so that the same jump leads back
    (Tjelmeland and Hegstad, 2001, without their local search).

    Parameters
    ----------
    modes : tuple of Gaussian
        At least two, of the same places.
    """

    modes: tuple[Gaussian, ...]

    def shift(self, q: Floats) -> Floats:
        """Return the shift from the first mode to that of the vector q, shape (d,)."""
        depths = [float(h.depth(q[h.places]) + np.log(np.diag(h.factor)).sum()) for h in self.modes]
        return np.asarray(self.modes[int(np.argmin(depths))].mean - self.modes[0].mean)

    def move(
        self, q: Floats, here: float, density: Callable[[Floats], Any], rng: np.random.Generator
    ) -> tuple[Floats, float]:
        """Jump from the vector q, whose log-density is ``here``; return both after the jump."""
        first, second = (self.modes[i] for i in rng.choice(len(self.modes), 2, replace=False))
        moved = q.copy()
        moved[first.places] = second.mean + second.factor @ first.standardised(q[first.places])
        there = float(density(moved))
        stretch = np.log(np.diag(second.factor) / np.diag(first.factor)).sum()
        if rng.uniform() < _rate(there - here + float(stretch)):
            return moved, there
        return q, here


@dataclass_state
class AdaptiveState(StepMethodState):
    """Adapted state of the sampler, with which every chain starts."""

    tune: bool
    blocks: list[Gaussian]


@dataclass(frozen=True)
class Schedule:
    """Numbers of steps of the adaptive sampler.

    Parameters
    ----------
    inner : int
        Steps of a block a round: with a surrogate, those under it for each exact decision.
    plain : float
        Probability of one more step without the surrogate: it frees a chain from where that is far
        too low.
    thin : int
        Rounds over the blocks a draw.
    """

    inner: int = 10
    plain: float = 0.0
    thin: int = 1


class AdaptiveMetropolis(ArrayStepShared):
    """Block-wise adaptive Metropolis that looks ahead with a surrogate of the posterior.

    With ``rough``, a block makes steps under that cheap posterior, and their end is accepted or
    rejected by the exact one (while tuning, always accepted): the surrogate transition method (Liu,
    2001, section 9.4.3; delayed acceptance, Christen and Fox, 2005, is the case of one step). The
    result is exact whatever ``rough`` is; a good one gives nearly independent draws.

    Parameters
    ----------
    vars : list
        The model's random variables, all of them.
    blocks : list of Gaussian
        Entries that move together, and a first guess of their posterior; together they are all.
    rough : callable, optional
        Log-density of the cheap posterior, up to a constant, at a vector of all variables in the
        sampler's unconstrained space.
    schedule : Schedule
        Numbers of steps.
    jumps : Jumps, optional
        Between modes, one a round; of one block that is not cheap, whose mode is the first.
    extra : tensor, optional
        Added to the model's log-density, in terms of its value variables.
    initial_point : dict, optional
        As PyMC's samplers pass it.
    rng : Generator or int, optional
        Source of randomness.
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
        rough: Callable[[Floats], float] | None = None,
        schedule: Schedule = Schedule(),
        jumps: Jumps | None = None,
        extra: Any = 0.0,
        initial_point: dict[str, Floats] | None = None,
        rng: Any = None,
    ) -> None:
        model = pm.modelcontext(None)
        point = model.initial_point() if initial_point is None else initial_point
        values = get_value_vars_from_user_vars(vars, model)
        self.tune = True
        self.blocks, self.rough, self.schedule, self.jumps = blocks, rough, schedule, jumps
        (logp,), joined = join_nonshared_inputs(
            point=point, outputs=[model.logp() + extra], inputs=values, shared_inputs={}
        )
        self.logp = compile_function([joined], logp)
        self.logp.trust_input = True
        super().__init__(values, {}, blocked=True, rng=rng)

    def astep(self, q0: RaveledVars) -> tuple[RaveledVars, list[dict[str, Any]]]:
        """Go ``thin`` times over the blocks."""
        q = q0.data.copy()
        # tuning draws are discarded, so the rough posterior is enough for them
        near = self.logp if self.rough is None or not self.tune else self.rough
        here = float(near(q))
        rates, exact = [], []
        for _ in range(self.schedule.thin):
            shift: Any = None
            if self.jumps is not None and near is self.logp:
                q, here = self.jumps.move(q, here, near, self.rng)
                shift = self.jumps.shift(q) if self.tune else 0.0
            for block in self.blocks:
                if self.rough is None or block.cheap or self.tune:
                    for _ in range(block.cheap or self.schedule.inner):
                        q, here, rate = block.move(q, here, near, self.rng, self.tune, shift)
                        rates.append(rate)
                    continue
                begin = rough = self.rough(q)
                y = q
                for _ in range(self.schedule.inner):
                    y, rough, rate = block.move(y, rough, self.rough, self.rng, tune=False)
                    rates.append(rate)
                if y is not q:
                    there = float(self.logp(y))
                    exact.append(_rate((there - here) - (rough - begin)))
                    if self.rng.uniform() < exact[-1]:
                        q, here = y, there
                if self.rng.uniform() < self.schedule.plain:
                    q, here, _ = block.move(q, here, near, self.rng, tune=False)
        stats = {
            "accept": float(np.mean(rates)),
            "look_ahead_accept": float(np.mean(exact)) if exact else np.nan,
            "tune": self.tune,
        }
        return RaveledVars(q, q0.point_map_info), [stats]


def explore(
    blocks: list[Gaussian],
    density: Callable[[Floats], float],
    q: Floats,
    rounds: int,
    rng: np.random.Generator,
) -> Floats:
    """Return the states of a chain of rounds over the blocks, which adapt.

    Parameters
    ----------
    blocks : list of Gaussian
        Changed in place.
    density : callable
        Log-density.
    q : ndarray
        Start, shape (d,).
    rounds : int
        Steps of each block.
    rng : Generator
        Source of randomness.

    Returns
    -------
    ndarray
        Shape (rounds, d).
    """
    here, chain = density(q), np.empty((rounds, len(q)))
    for i in range(rounds):
        for block in blocks:
            q, here, _ = block.move(q, here, density, rng, tune=True)
        chain[i] = q
    return chain


def _rate(log_ratio: float) -> float:
    """Return the probability of acceptance; 0 where a density is not a number."""
    return float(np.exp(min(0.0, log_ratio))) if not np.isnan(log_ratio) else 0.0
