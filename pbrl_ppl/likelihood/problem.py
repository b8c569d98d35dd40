"""An inference problem in numpy: data, physics and likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.likelihood.coordinates import ACCELERATION, CONTACT
from pbrl_ppl.likelihood.data import Data, Observations, least_noise, sigma_prior
from pbrl_ppl.likelihood.likelihood import (
    Likelihood,
    TrajectoryLikelihood,
    TransitionLikelihood,
    noise_labels,
)
from pbrl_ppl.likelihood.tails import degrees_of_freedom, tail_places
from pbrl_ppl.likelihood.trajectory_noise import TrajectoryNoise
from pbrl_ppl.parameters import Block, Layout, ParameterLibrary
from pbrl_ppl.physics import OneWorld, PartedSimulator, Physics
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import INPUT, STATE, Floats

#: Dimensions of the noise variables along trajectories.
_NOISE_DIMS = {
    "sigma": "sensor", ACCELERATION: "velocity", CONTACT: "velocity",
}  # fmt: skip
#: Dimensions of measured next states, and of the data that they are predicted from.
NEXT_STATE_DIMS = ("transition", "step", "body", "state")
START_DIMS = ("transition", "body", "full_state")
ACTION_DIMS = ("transition", "step", "body", "wrench")
#: Phi, initial states and wrenches in, next states out.
Engine = Callable[[Floats, Floats, Floats], Floats]


@dataclass(frozen=True, eq=False)
class Problem:
    """An inference problem in numpy, from which :func:`physics_model` declares a PyMC model.

    A change of one part keeps the others, with their engines and segments.

    Parameters
    ----------
    data : Data
        Measured segments.
    physics : Physics
        What predicts them.
    likelihood : Likelihood
        How measurements scatter about the predictions.
    library : ParameterLibrary, optional
        Parameter sets of which each body has one, in place of Table 1.
    defect : ndarray, optional
        Added to predictions; see :meth:`corrected`. Shape (transition, H, body, 6).
    """

    data: Data
    physics: Physics
    likelihood: Likelihood
    library: ParameterLibrary | None = None
    defect: Floats | None = None

    @classmethod
    def of(
        cls,
        physics: Physics,
        history: History,
        *,
        horizon: int = 1,
        columns: tuple[int, ...] | None = None,
        likelihood: Likelihood | None = None,
        library: ParameterLibrary | None = None,
    ) -> Problem:
        """Return the problem of a history, with the parts that it shows; Eq. 11 by default.

        ``horizon`` and ``columns`` are fields of :class:`Data`.
        """
        data = Data(physics.scene, history, horizon, columns)
        return cls(data, physics.in_parts(history), likelihood or TransitionLikelihood(), library)

    def with_data(self, **changes: Any) -> Problem:
        """Return the same problem of other data; arguments are fields of :class:`Data`."""
        return self.on(replace(self.data, **changes))

    def on(self, data: Data) -> Problem:
        """Return the same problem of other data, with the likelihood of single transitions.

        Independent parts are found again for another history; equal ones keep their engines.
        """
        physics = self.physics
        if data.history is not self.data.history:
            physics = physics.in_parts(data.history)
        likelihood = self.likelihood.of_data()
        return replace(self, data=data, physics=physics, likelihood=likelihood, defect=None)

    def with_states(self, states: Floats) -> Problem:
        """Return the same problem with other smoothed states; the likelihood stays."""
        return replace(self, data=replace(self.data, states=states))

    def with_physics(self, **changes: Any) -> Problem:
        """Return the same problem with other physics; arguments are fields of :class:`Physics`."""
        physics, likelihood = self.physics.changed(**changes), self.likelihood
        if "scene" in changes or "together" in changes:
            physics = physics.in_parts(self.data.history)
        if physics.layout.labels != self.layout.labels:
            likelihood = likelihood.of_parameters()
        return replace(self, physics=physics, likelihood=likelihood, defect=None)

    def with_likelihood(self, **changes: Any) -> Problem:
        """Return the same problem with other noise; arguments are fields of its likelihood."""
        return replace(self, likelihood=replace(self.likelihood, **changes))

    def along(self, noise: TrajectoryNoise, **changes: Any) -> Problem:
        """Return the same problem with the likelihood of whole trajectories.

        ``changes`` are other fields of :class:`TrajectoryLikelihood`.
        """
        settings = {"nu": self.likelihood.nu, "prior": self.likelihood.prior, **changes}
        return replace(self, likelihood=TrajectoryLikelihood(noise=noise, **settings))

    @property
    def coarse(self) -> Problem:
        """The same problem with the fewest engine steps; see ``Physics.coarse``."""
        return replace(self, physics=self.physics.coarse, defect=None)

    @property
    def medium(self) -> Problem:
        """The same problem with at most a medium number of engine steps."""
        return replace(self, physics=self.physics.medium, defect=None)

    def corrected(self, phi: Floats, *, worth: int = 3) -> Problem:
        """Return the problem with few engine steps, its predictions corrected at phi, shape (p,).

        The error of few steps hardly depends on the parameters: the difference between both engines
        at phi is added to every prediction (defect correction: P. Zadunaisky, On the estimation of
        errors propagated in the numerical integration of differential equations, 1976).

        ``worth``: ratio of engine steps from which a correction saves time.
        """
        medium = self.medium
        if medium.physics.substeps * worth > self.physics.substeps:
            return self
        return medium.corrected_to(self, phi)

    def corrected_to(self, exact: Problem, phi: Floats) -> Problem:
        """Return the problem with predictions corrected to those of more engine steps at phi."""
        return replace(self, defect=np.nan_to_num(exact.predict(phi) - self.predict(phi)))

    def joined(self, phi: Floats, sigma: Floats, most: int = 50, *, same: float = 0.01) -> Problem:
        """Return the problem with bodies that meet at these draws in one part; itself if none do.

        Parameters
        ----------
        phi, sigma : ndarray
            Draws, shapes (n, p) and (n, parameter).
        most : int
            Of more draws so many are simulated, evenly spread.
        same : float
            How far predictions may differ and be the same to the likelihood, in units of the noise.
        """
        if len(self.simulator.parts) == 1:
            return self
        rows = np.linspace(0, len(phi) - 1, min(most, len(phi))).astype(int)
        phi, sigma = phi[rows], sigma[rows]
        segments, columns = self.segments, list(self.observations.columns)
        states, met = self.one_world.meetings(phi, segments.start, self.inputs)
        if not met.any():
            return self
        apart = self.simulator(phi, segments.start, self.inputs)
        off = abs(self.observations.wrapped((states - apart)[..., columns]))
        if isinstance(self.likelihood, TrajectoryLikelihood):  # errors of measurement alone
            sensors, stated = self.likelihood.noise.coordinates.sensors, dict(self.scene.noise)
            known = np.tile([stated.get(name, np.inf) for name in STATE], (len(phi), 1))
            known[:, list(sensors)] = sigma[:, : len(sensors)]
            sigma = known[:, columns]
        matters = np.any(~(off <= same * sigma[:, None, None, None]), axis=(2, 3, 4))
        meet = (met & matters[..., None]).any(axis=(0, 1))
        meeting = [body.name for body, one in zip(self.scene.moving, meet, strict=True) if one]
        if not meeting:
            return self
        return self.with_physics(together=tuple(dict.fromkeys((*self.physics.together, *meeting))))

    @property
    def scene(self) -> Scene:
        """The scene of the physics."""
        return self.physics.scene

    @property
    def layout(self) -> Layout:
        """Order of the unknown parameters in phi."""
        return self.physics.layout

    @property
    def simulator(self) -> PartedSimulator:
        """The engine of the likelihood, in parts."""
        return self.physics.simulator

    @property
    def one_world(self) -> OneWorld:
        """The engine of predictions, in which bodies that were apart in the data may meet."""
        return self.physics.one_world

    @property
    def segments(self) -> Segments:
        """The measured segments."""
        return self.data.segments

    @property
    def inputs(self) -> Floats:
        """Inputs of the segments' intervals; see :meth:`Physics.inputs`.

        Shape (transition, H, body, 3), or (transition, H, body, 9) as in
        :data:`pbrl_ppl.state.INPUT`.
        """
        return self.physics.inputs(self.segments)

    @property
    def observations(self) -> Observations:
        """Observations at the segments' steps."""
        return self.data.observations

    @cached_property
    def least_noise(self) -> Floats:
        """Least sigma of each observed dimension, shape (state,)."""
        return least_noise(self.scene, self.observations.columns)

    @cached_property
    def noise_prior(self) -> tuple[Floats, float]:
        """Medians of sigma's prior, shape (parameter,), and its log-scale."""
        if self.likelihood.prior is None:
            return sigma_prior(self.observations, self.segments, self.scene)
        median, spread = self.likelihood.prior
        return np.array(median), spread

    @property
    def trajectory_noise(self) -> TrajectoryNoise:
        """The noise along whole trajectories.

        Raises
        ------
        TypeError
            If the likelihood is of single transitions.
        """
        if isinstance(self.likelihood, TrajectoryLikelihood):
            return self.likelihood.noise
        raise TypeError(
            f"the problem's likelihood is of {self.likelihood.name}, expected trajectories"
        )

    def with_small_process_noise(self, sigma: Floats, share: float) -> Floats:
        """Return sigma with unexplained accelerations of at most a share of their prior median."""
        steps, sigma = self.trajectory_noise.coordinates.accelerations, sigma.copy()
        sigma[steps] = np.minimum(sigma[steps], share * self.noise_prior[0][steps])
        return sigma

    @property
    def noise_variables(self) -> dict[str, tuple[str, ...]]:
        """Noise variables with their state dimensions, in the order of sigma."""
        return self.likelihood.variables(self.observations)

    def named(self, phi: Floats, sigma: Floats) -> dict[str, Floats]:
        """Return the model's variables by name at phi (..., p) and sigma (..., parameter)."""
        if self.scalar_sigma:
            return self.layout.to_dict(phi) | {"sigma": sigma[..., 0]}
        ends = np.cumsum([len(labels) for labels in self.noise_variables.values()])[:-1]
        noise = dict(zip(self.noise_variables, np.split(sigma, ends, axis=-1), strict=True))
        return self.layout.to_dict(phi) | noise

    @property
    def scalar_sigma(self) -> bool:
        """Whether one sigma serves all state dimensions."""
        return self.likelihood.scalar

    @property
    def noise_labels(self) -> tuple[str, ...]:
        """Labels of the inferred noise parameters, such as ``sigma[x]``."""
        return noise_labels(self.noise_variables, self.scalar_sigma)

    @property
    def measured(self) -> Floats:
        """Measured next states, shape (transition, H, body, state), NaN where missing."""
        if not isinstance(self.likelihood, TrajectoryLikelihood):
            return self.observations.values
        segments = self.segments
        observed = self.data.history.dataset["observed"].to_numpy()
        raw = observed[segments.trajectory, segments.step + 1][:, None]
        return np.asarray(raw[..., self.observations.columns])

    def predict(self, phi: Floats, engine: Engine | None = None) -> Floats:
        """Return predicted states, shape (..., transition, H, body, 6), for phi (..., p)."""
        predict, sensitivity = engine or self.simulator, self.likelihood.sensitivity
        if sensitivity is not None:
            predict = partial(sensitivity.predicted, predict)
        states = predict(phi, self.segments.start, self.inputs)
        return states if self.defect is None else states + self.defect

    def residual(self, phi: Floats, engine: Engine | None = None) -> Floats:
        """Return measured minus predicted states, shape (..., transition, H, body, state)."""
        return self.observations.residual(self.predict(phi, engine))

    def whitened(self, phi: Floats, sigma: Floats, engine: Engine | None = None) -> Floats:
        """Return the whitened residuals, shape (..., transition, coordinate)."""
        return self.likelihood.whiten(self.residual(phi, engine), sigma)

    @cached_property
    def tails(self) -> tuple[int, ...]:
        """Places in phi of the parameters of the noise's tails."""
        return tuple(tail_places(self.physics))

    def nu(self, phi: Floats | None = None) -> float | Floats | None:
        """Return the degrees of freedom of the noise at phi; None for a Gaussian.

        Shape (..., 1, 1, body, 1) where an effect of the noise stage says so.

        Raises
        ------
        ParameterError
            If they depend on phi, and there is none.
        """
        if not self.tails:
            return self.likelihood.nu
        if phi is None:
            raise ParameterError("the noise's tails depend on the parameters; give phi")
        return degrees_of_freedom(self.physics, phi, self.likelihood.nu)

    def robust(self, phi: Floats, sigma: Floats, engine: PartedSimulator | None = None) -> Floats:
        """Return residuals whose half squares are the negative log-density up to a constant.

        Shape (..., transition, coordinate).
        """
        return self.likelihood.robust(self.residual(phi, engine), sigma, self.nu(phi))

    def log_density(self, residual: Floats, sigma: Floats, phi: Floats | None = None) -> Floats:
        """Return the log-likelihood of each transition, shape (..., transition).

        Parameters
        ----------
        residual : ndarray
            Shape (..., transition, H, body, state).
        sigma : ndarray
            Shape (..., state).
        phi : ndarray, optional
            Shape (..., p); needed where the noise's tails are inferred.
        """
        measured = self.observations.measured
        return self.likelihood.log_density(residual, sigma, measured, self.nu(phi))

    def next_states(
        self, states: Floats, sigma: Floats, rng: np.random.Generator, phi: Floats | None = None
    ) -> Floats:
        """Draw measured next states by Eq. 13 about predictions (..., transition, H, body, 6)."""
        predicted = states[..., self.observations.columns]
        values = self.observations.values
        return self.likelihood.random(predicted, values, sigma, rng, self.nu(phi))


def variable_dims(problem: Problem) -> dict[str, tuple[str, ...]]:
    """Return the dimensions of each parameter and noise variable by name."""
    dims: dict[str, tuple[str, ...]] = {
        block.name: (_block_dim(problem, block),) for block in problem.layout.blocks
    }
    if problem.library is not None:
        dims["library_index"] = (_owner_dim(problem, tuple(problem.scene.owners), "library"),)
    for name in problem.noise_variables:
        if problem.scalar_sigma:
            dims[name] = ()
        else:
            dims[name] = (_NOISE_DIMS[name] if problem.likelihood.filtered else "state",)
    return dims


def variable_coords(problem: Problem) -> dict[str, list[Any]]:
    """Return the labels of each dimension by name."""
    coords: dict[str, list[Any]] = {
        "body": [body.name for body in problem.scene.moving],
        "full_state": list(STATE),
        "state": list(problem.observations.names),
        "wrench": list(INPUT[: problem.inputs.shape[-1]]),
        "transition": list(range(problem.segments.n)),
        "step": list(range(1, problem.data.horizon + 1)),
    }
    if problem.likelihood.filtered:
        coords |= {
            _NOISE_DIMS[name]: list(names) for name, names in problem.noise_variables.items()
        }
    owners = tuple(problem.scene.owners)
    coords.setdefault(_owner_dim(problem, owners, ""), list(owners))
    for block in problem.layout.blocks:
        coords.setdefault(_block_dim(problem, block), list(block.owners))
    return coords


def _block_dim(problem: Problem, block: Block) -> str:
    """Return the dimension of a parameter: joints, or the bodies or classes that have it."""
    if block.of == "joint":
        return "joint" if not block.name.startswith("i_") else "free_joint"
    return _owner_dim(problem, block.owners, block.effect or block.name)


def _owner_dim(problem: Problem, owners: tuple[str, ...], name: str) -> str:
    """Return ``body`` for all moving bodies, ``owner`` for all owners, or a name of its own."""
    if set(owners) == {body.name for body in problem.scene.moving}:
        return "body"
    return "owner" if owners == tuple(problem.scene.owners) else f"{name}_body"
