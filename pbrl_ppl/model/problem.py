"""(scene, history, effects) -> pm.Model: Table 1 prior, Eq. 11 likelihood, named coordinates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, Segments, fill_hinges
from pbrl_ppl.model.library import Modes
from pbrl_ppl.model.likelihood import (
    STATE,
    Observations,
    StartNoise,
    log_density,
    next_state_logp,
    next_state_random,
    whiten,
)
from pbrl_ppl.model.op import SimulatorOp
from pbrl_ppl.model.table1 import build_layout, random_variable
from pbrl_ppl.parameters import Block, Layout
from pbrl_ppl.physics import PartedSimulator, Parts, check_history, independent_parts
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Engine steps an interval where a rough answer will do.
COARSE = 4


@dataclass(frozen=True, eq=False)
class Problem:
    """An inference problem in plain numpy: what a model of :func:`physics_model` is made of.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    history : History
        Measured transitions.
    effects : tuple of Attached
        All effects of the model, declared and added.
    horizon : int
        Intervals predicted from one measured state; 1 is the paper's Eq. 11.
    substeps : int
        Engine steps an interval.
    scalar_sigma : bool
        One sigma for all state dimensions, as in the paper.
    noise : StartNoise or None
        Spread of the start state's noise over the predictions.
    threads : int
        Engine worlds that run side by side.
    extrapolate : bool
        Whether the engine's leading errors are cancelled.
    nu : float, optional
        Degrees of freedom of Student-t noise; Gaussian without it.
    sigma_prior : tuple or None
        Medians of sigma's prior, one a measured state dimension, and its log-scale; by default
        :func:`sigma_prior` takes them from the data.
    columns : tuple of int, optional
        State dimensions that the likelihood is over; those measured anywhere by default.
    modes : Modes, optional
        Parameter sets of which each body has one, in place of Table 1.
    checked : bool
        Whether the start states have passed already, as those of a scene that joins fewer bodies by
        name: one of its configurations must not refuse what the others explain.
    """

    scene: Scene
    history: History
    effects: tuple[Attached, ...]
    horizon: int
    substeps: int
    scalar_sigma: bool = False
    noise: StartNoise | None = None
    threads: int = 1
    extrapolate: bool = True
    nu: float | None = None
    sigma_prior: tuple[tuple[float, ...], float] | None = None
    columns: tuple[int, ...] | None = None
    modes: Modes | None = None
    checked: bool = False
    layout: Layout = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "layout", build_layout(self.scene, self.effects))

    @cached_property
    def segments(self) -> Segments:
        """Measured segments of the horizon's length."""
        segments = self.history.segments(self.horizon)
        if not segments.n:
            raise HistoryError(
                f"history: no trajectory is long enough for a horizon of {self.horizon} intervals;"
                " choose a shorter one"
            )
        if not self.checked:
            check_history(self.scene, self.history, segments)
        return segments

    @cached_property
    def observations(self) -> Observations:
        """What was measured at the segments' steps."""
        return Observations.of(self.segments, self.columns)

    @cached_property
    def noise_prior(self) -> tuple[Array, float]:
        """Medians of sigma's prior, shape (state,), and its log-scale; given, or from the data."""
        if self.sigma_prior is None:
            return sigma_prior(self.observations, self.segments)
        median, spread = self.sigma_prior
        return np.array(median), spread

    @cached_property
    def parts(self) -> Parts:
        """Moving bodies that have to do with each other, together."""
        return independent_parts(self.scene, self.history)

    @cached_property
    def simulator(self) -> PartedSimulator:
        """The engine for this scene with these effects."""
        return self.engine(self.substeps, threads=self.threads, extrapolate=self.extrapolate)

    @cached_property
    def coarse(self) -> PartedSimulator:
        """The same with few substeps: it costs little, and its derivative is nearly right."""
        substeps = min(COARSE, self.substeps)
        return self.engine(substeps, threads=self.threads, extrapolate=False)

    def engine(self, substeps: int, *, threads: int, extrapolate: bool) -> PartedSimulator:
        """A new engine for this scene with these effects; arguments as of the simulator."""
        return PartedSimulator(
            self.scene,
            self.layout,
            self.effects,
            self.parts,
            substeps=substeps,
            threads=threads,
            extrapolate=extrapolate,
        )

    def named(self, phi: Array, sigma: Array) -> dict[str, Array]:
        """The model's variables at phi, shape (p,), and sigma, shape (state,)."""
        noise = {"sigma": sigma[0] if self.scalar_sigma else sigma}
        return self.layout.to_dict(phi) | noise

    def predict(self, phi: Array, engine: PartedSimulator | None = None) -> Array:
        """Predicted states, shape (..., transition, H, body, 6), for phi of shape (..., p)."""
        return (engine or self.simulator)(phi, self.segments.start, self.segments.actions)

    def residual(self, phi: Array, engine: PartedSimulator | None = None) -> Array:
        """Measured minus predicted, shape (..., transition, H, body, state)."""
        return self.observations.residual(self.predict(phi, engine))

    def whitened(self, phi: Array, sigma: Array, engine: PartedSimulator | None = None) -> Array:
        """Residuals in units of their noise, shape (..., transition, cell)."""
        return whiten(self.residual(phi, engine), sigma, self.noise)

    def log_density(self, residual: Array, sigma: Array) -> Array:
        """Log-likelihood of each transition, shape (..., transition); see `likelihood`.

        Parameters
        ----------
        residual : ndarray
            Shape (..., transition, H, body, state).
        sigma : ndarray
            Shape (..., state).
        """
        return log_density(residual, sigma, self.noise, self.observations.measured, self.nu)

    def next_states(self, states: Array, sigma: Array, rng: np.random.Generator) -> Array:
        """Draw measured next states by Eq. 13 about predictions (..., transition, H, body, 6)."""
        predicted = states[..., self.observations.columns]
        return next_state_random(predicted, sigma, self.noise, rng, nu=self.nu)

    def sensitivity(self, phi: Array, steps: Array) -> Array:
        """Derivative of the predictions by the measured start state, F.

        Parameters
        ----------
        phi : ndarray
            Where to differentiate, shape (p,).
        steps : ndarray
            Finite-difference step of each measured state dimension, shape (state,), in its units;
            about the noise is right.

        Returns
        -------
        ndarray
            Shape (transition, cell, start cell): cells are H x body x state, start cells body x
            state. Cells that were not measured have no noise, and so no derivative.
        """
        start, columns = self.segments.start, self.observations.columns
        n, k = start.shape[:2]
        trajectory, step = self.segments.trajectory, self.segments.step
        raw = self.history.dataset["observed"].values[trajectory, step]
        result = []
        for body in range(k):
            for column, h in zip(columns, steps, strict=True):
                if self.scene.moving[body].kinematic:  # its path is given, not measured
                    result.append(np.zeros((n, self.observations.values[0].size)))
                    continue
                plus, minus = raw.copy(), raw.copy()
                plus[:, body, column] += h
                minus[:, body, column] -= h
                ends = []
                for moved in (plus, minus):
                    # what was not measured follows through the hinges, else stays
                    fill_hinges(moved[:, None], self.scene)
                    moved = np.where(np.isfinite(moved), moved, start)
                    ends.append(self.simulator(phi, moved, self.segments.actions))
                difference = (ends[0] - ends[1])[..., columns] / (2 * h)
                result.append(difference.reshape(n, -1))
        return np.stack(result, axis=-1)


def physics_model(
    scene: Scene,
    history: History,
    effects: Iterable[Effect | Attached] = (),
    *,
    horizon: int = 1,
    sigma: str = "per_dimension",
    nu: float | None = None,
    substeps: int | None = None,
    noise: StartNoise | None = None,
    threads: int = 1,
    modes: Modes | None = None,
) -> pm.Model:
    """Declare the model of the paper's section 3.2 for a scene and a history.

    Parameters
    ----------
    scene : Scene
        Known geometry, and which parameters are known.
    history : History
        Measured transitions.
    effects : iterable of Effect or Attached
        Effects beside those that the scene declares.
    horizon : int
        Intervals predicted from one measured state; 1 is Eq. 11.
    sigma : str
        ``per_dimension`` or ``scalar`` (the paper's Eq. 11).
    nu : float, optional
        Degrees of freedom of Student-t noise, for recordings full of contacts, whose residuals have
        heavy tails; 4 is usual. Sigma is then its scale. Gaussian without it.
    substeps : int, optional
        Engine steps an interval; the scene's by default.
    noise : StartNoise, optional
        Spread of the start state's noise over the predictions; without it the start counts as
        exact, as in the paper.
    threads : int
        Engine worlds that run side by side within one evaluation.
    modes : Modes, optional
        Pre-learned parameter sets of which each body has one, in place of Table 1: the variable
        ``mode`` holds the bodies' choices, and the parameters follow from it.

    Returns
    -------
    pymc.Model
        An ordinary model; its ``problem`` attribute is the :class:`Problem` it was made from.

    Raises
    ------
    EffectError
        If an effect is unknown or does not apply.
    HistoryError
        If the history has nothing to fit at this horizon.
    SimulationError
        If bodies start deep inside each other or a wall, or a hinge's bodies apart.
    ValueError
        If ``sigma`` is neither option, ``horizon`` is below 1 or ``nu`` is not above 0, or both
        ``modes`` and ``noise`` are given.
    ParameterError
        If ``modes`` do not fit the scene's bodies.

    Examples
    --------
    >>> import pandas as pd
    >>> from pbrl_ppl.scene.scene import Body, Shape
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> rows = pd.DataFrame({"trajectory": 0, "time": [0.0, 0.1], "body": "puck", "x": [0.0, 0.1],
    ...     "y": 0.0, "theta": 0.0, "vx": 1.0, "vy": 0.0, "omega": 0.0,
    ...     "force_x": 0.0, "force_y": 0.0, "torque": 0.0})
    >>> model = physics_model(scene, History.from_dataframe(rows, scene))
    >>> [variable.name for variable in model.free_RVs]
    ['mass', 'r', 'mu_c', 'sigma']
    """
    if sigma not in ("per_dimension", "scalar"):
        raise ValueError(f"sigma is {sigma!r}, expected 'per_dimension' or 'scalar'")
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected at least 1")
    if nu is not None and not 0 < nu < np.inf:
        raise ValueError(f"nu is {nu}, expected degrees of freedom above 0, or None for a Gaussian")
    if modes is not None and noise is not None:
        raise ValueError("modes and noise are given; modes take start states as exact: drop noise")
    longest = int(history.dataset["n_rows"].max()) - 1
    if horizon > longest:
        raise HistoryError(
            f"horizon is {horizon} intervals, and the longest trajectory has {longest}; use a"
            " shorter horizon"
        )
    problem = Problem(
        scene=scene,
        history=history,
        modes=modes,
        effects=attach(scene, effects),
        horizon=horizon,
        substeps=scene.substeps if substeps is None else substeps,
        scalar_sigma=sigma == "scalar",
        noise=noise,
        threads=threads,
        nu=nu,
    )
    return build_model(problem)


def build_model(problem: Problem) -> pm.Model:
    """Declare the pm.Model of a problem; see :func:`physics_model`."""
    observations, segments, layout = problem.observations, problem.segments, problem.layout
    simulate = SimulatorOp(
        problem.scene, layout, problem.effects, problem.substeps, problem.threads, problem.parts
    )
    with pm.Model(coords=_coords(problem)) as model:
        start = pm.Data("start", segments.start, dims=("transition", "body", "full_state"))
        actions = pm.Data(
            "actions", segments.actions, dims=("transition", "step", "body", "wrench")
        )
        # Table 1
        table1: dict[str, Any] = {}
        if problem.modes is not None:
            table1 = _chosen(problem, problem.modes)
        else:
            for block in layout.blocks:
                index = _index(block, layout, table1)
                table1[block.name] = random_variable(
                    block.name, block.priors, _dim(problem, block), block.conditional, index
                )
        phi = pt.concatenate(list(table1.values())) if table1 else pt.zeros(0)
        # P(sigma)
        median, spread = problem.noise_prior
        if problem.scalar_sigma:
            scalar = pm.LogNormal("sigma", mu=np.log(median).mean(), sigma=spread)
            sigma = pt.ones(len(median)) * scalar
        else:
            sigma = pm.LogNormal("sigma", mu=np.log(median), sigma=spread, dims="state")
        # Eq. 7: s' = f(s, a; Phi) + eps, and Eq. 11
        predicted = simulate(phi, start, actions)[..., list(observations.columns)]
        pm.CustomDist(
            "next_state",
            predicted,
            sigma,
            logp=partial(
                next_state_logp, observations=observations, noise=problem.noise, nu=problem.nu
            ),
            random=partial(_random, noise=problem.noise, nu=problem.nu),
            signature="(h,k,d),(d)->(h,k,d)",
            observed=np.nan_to_num(observations.values),
            dims=("transition", "step", "body", "state"),
        )
    model.problem = problem
    return model


def _chosen(problem: Problem, modes: Modes) -> dict[str, Any]:
    """Which mode each body has, and the parameters that follow from that."""
    names = [body.name for body in problem.scene.moving]
    table = modes.table(problem.layout, problem.scene)
    mode = pm.Categorical("mode", p=np.stack([modes.prior(name) for name in names]), dims="body")
    result = {}
    for block, place in problem.layout.slices():
        own = mode[[names.index(owner) for owner in block.owners]]
        value = pt.as_tensor(table[place])[np.arange(len(block.owners)), own]
        result[block.name] = pm.Deterministic(block.name, value, dims=_dim(problem, block))
    return result


def _index(block: Block, layout: Layout, variables: dict[str, Any]) -> Any:
    """Whose bounds hold an anchor: the index variable, 0 where the body is given."""
    name = f"i_{block.name[0]}"
    if not block.conditional or name not in variables:
        return None
    free = next(each.owners for each in layout.blocks if each.name == name)
    held = [variables[name][free.index(each)] if each in free else 0 for each in block.owners]
    return pt.stack(held)


def _random(
    predicted: Any,
    sigma: Any,
    noise: StartNoise | None,
    nu: float | None,
    rng: np.random.Generator | None = None,
    size: Any = None,
) -> Any:
    return next_state_random(predicted, sigma, noise, rng or np.random.default_rng(), size, nu)


def sigma_prior(observations: Observations, segments: Segments) -> tuple[Array, float]:
    """Median and log-scale of the weak prior of sigma: a tenth of how much the state changes.

    Returns
    -------
    median : ndarray
        Shape (state,), in the units of the states.
    spread : float
        Standard deviation of the logarithm.
    """
    columns = observations.columns
    change = observations.residual(segments.start[:, None])
    seen = observations.measured
    typical = np.sqrt((change**2).sum((0, 1, 2)) / np.maximum(seen.sum((0, 1, 2)), 1))
    return np.maximum(0.1 * typical, 1e-9) * np.ones(len(columns)), 2.0


def _coords(problem: Problem) -> dict[str, Any]:
    """Coordinates by name: every dimension of the model says what it runs over."""
    segments = problem.segments
    coords: dict[str, Any] = {
        "body": [body.name for body in problem.scene.moving],
        "full_state": list(STATE),
        "state": list(problem.observations.names),
        "wrench": ["force_x", "force_y", "torque"],
        "transition": np.arange(segments.n),
        "step": np.arange(1, problem.horizon + 1),
    }
    for block in problem.layout.blocks:
        coords.setdefault(_dim(problem, block), list(block.owners))
    return coords


def _dim(problem: Problem, block: Block) -> str:
    """``body`` where all moving bodies have the parameter, else a dimension of its own."""
    if block.of == "joint":
        return "joint" if not block.name.startswith("i_") else "free_joint"
    if len(block.owners) == len(problem.scene.moving):
        return "body"
    return f"{block.effect or block.name}_body"
