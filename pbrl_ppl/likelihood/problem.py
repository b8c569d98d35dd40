"""An inference problem in numpy: data, physics and likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Generic, Self, TypeGuard, cast

import numpy as np

from pbrl_ppl.effects import Noise, at_stage
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.likelihood.coordinates import ACCELERATION, CONTACT
from pbrl_ppl.likelihood.data import SPREAD, Data, Observations, least_noise
from pbrl_ppl.likelihood.likelihood import (
    LikelihoodT,
    TrajectoryLikelihood,
    TransitionLikelihood,
    noise_labels,
)
from pbrl_ppl.likelihood.trajectory_noise import Engine, TrajectoryNoise
from pbrl_ppl.parameters import Block, Layout, ParameterLibrary
from pbrl_ppl.physics import PartedSimulator, Physics
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import INPUT, STATE, Floats


def tail_places(physics: Physics) -> list[int]:
    """Return the places in phi of the parameters of the noise stage."""
    labels = physics.layout.labels
    return [
        labels.index(label)
        for attached in at_stage(physics.effects, Noise)
        for label in attached.labels
    ]


def degrees_of_freedom(physics: Physics, phi: Floats, nu: float | None) -> Floats:
    """Return the degrees of freedom of each body's noise.

    Parameters
    ----------
    physics : Physics
        Has the effects of the noise stage.
    phi : ndarray
        Parameters, shape (..., p).
    nu : float or None
        Those of the noise without the effects; None for a Gaussian.

    Returns
    -------
    ndarray
        Shape (..., 1, 1, body, 1), to go with (..., transition, H, body, state); infinite for a
        Gaussian.
    """
    labels, bodies = physics.layout.labels, [body.name for body in physics.scene.moving]
    tails = np.zeros((*phi.shape[:-1], 1, 1, len(bodies), 1))
    tails += 0.0 if nu is None else 1.0 / nu
    for attached in at_stage(physics.effects, Noise):
        if attached.body in bodies:
            values = (phi[..., labels.index(label)] for label in attached.labels)
            names = (parameter.name for parameter in attached.effect.parameters)
            stage = cast(Noise, attached.effect.stage)
            inverse = stage.tail(dict(zip(names, values, strict=True)))
            tails[..., 0, 0, bodies.index(attached.body), 0] += inverse
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.maximum(tails, 0.0))


#: Dimensions of the noise variables along trajectories.
_NOISE_DIMS = {"sigma": "sensor", ACCELERATION: "velocity", CONTACT: "velocity"}
#: Dimensions of measured next states, and of the data that they are predicted from.
NEXT_STATE_DIMS = ("transition", "step", "body", "state")
START_DIMS = ("transition", "body", "full_state")
ACTION_DIMS = ("transition", "step", "body", "wrench")


@dataclass(frozen=True, eq=False)
class Problem(Generic[LikelihoodT]):
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
        Added to predictions; see :func:`with_defect`. Shape (transition, H, body, 6).
    """

    data: Data
    physics: Physics
    likelihood: LikelihoodT
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
        likelihood: TransitionLikelihood | None = None,
        library: ParameterLibrary | None = None,
    ) -> Problem[TransitionLikelihood]:
        """Return the problem of a history, with the parts that it shows; Eq. 11 by default.

        ``horizon`` and ``columns`` are fields of :class:`Data`.
        """
        data = Data(physics.scene, history, horizon, columns)
        physics, likelihood = physics.in_parts(history), likelihood or TransitionLikelihood()
        return Problem(data, physics, likelihood, library)

    def with_data(self, **changes: Any) -> Problem[TransitionLikelihood]:
        """Return the same problem of other data, with the likelihood of single transitions.

        Arguments are fields of :class:`Data`. Independent parts are found again for another
        history; equal ones keep their engines.
        """
        data, physics = replace(self.data, **changes), self.physics
        if data.history is not self.data.history:
            physics = physics.in_parts(data.history)
        return Problem(data, physics, self.likelihood.of_data(), self.library)

    def with_states(self, states: Floats) -> Self:
        """Return the same problem with other smoothed states; the likelihood stays."""
        return replace(self, data=replace(self.data, states=states))

    def with_physics(self, **changes: Any) -> Self:
        """Return the same problem with other physics; arguments are fields of :class:`Physics`.

        Predictions have no correction of few engine steps then.
        """
        physics, likelihood = self.physics.changed(**changes), self.likelihood
        if "scene" in changes or "together" in changes:
            physics = physics.in_parts(self.data.history)
        if physics.layout.labels != self.layout.labels:
            likelihood = likelihood.of_parameters()
        return replace(self, physics=physics, likelihood=likelihood, defect=None)

    def with_likelihood(self, **changes: Any) -> Self:
        """Return the same problem with other noise; arguments are fields of its likelihood."""
        return replace(self, likelihood=replace(self.likelihood, **changes))

    def along(self, noise: TrajectoryNoise) -> FilteredProblem:
        """Return the same problem with the likelihood of whole trajectories."""
        nu, prior = self.likelihood.nu, self.likelihood.prior
        likelihood = TrajectoryLikelihood(noise=noise, nu=nu, prior=prior)
        return Problem(self.data, self.physics, likelihood, self.library, self.defect)

    @property
    def coarse(self) -> Self:
        """The same problem with the fewest engine steps; see ``Physics.coarse``."""
        return replace(self, physics=self.physics.coarse, defect=None)

    @property
    def medium(self) -> Self:
        """The same problem with at most a medium number of engine steps."""
        return replace(self, physics=self.physics.medium, defect=None)

    @property
    def scene(self) -> Scene:
        """The scene of the physics."""
        return self.physics.scene

    @property
    def layout(self) -> Layout:
        """Order of the unknown parameters in phi."""
        return self.physics.layout

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
        """Medians of sigma's prior, shape (parameter,), and its log-scale.

        Unless the likelihood has one it is weak, about a tenth of the states' change.
        """
        if self.likelihood.prior is None:
            change = self.observations.residual(self.segments.start[:, None])
            typical = self.observations.root_mean_square(change)
            return np.maximum(0.1 * typical, self.least_noise), SPREAD
        median, spread = self.likelihood.prior
        return np.array(median), spread

    @property
    def noise_variables(self) -> dict[str, tuple[str, ...]]:
        """Noise variables with their state dimensions, in the order of sigma."""
        return self.likelihood.variables(self.observations)

    def named(self, phi: Floats, sigma: Floats) -> dict[str, Floats]:
        """Return the model's variables by name at phi (..., p) and sigma (..., parameter)."""
        if self.likelihood.scalar:
            return self.layout.to_dict(phi) | {"sigma": sigma[..., 0]}
        ends = np.cumsum([len(labels) for labels in self.noise_variables.values()])[:-1]
        noise = dict(zip(self.noise_variables, np.split(sigma, ends, axis=-1), strict=True))
        return self.layout.to_dict(phi) | noise

    @property
    def noise_labels(self) -> tuple[str, ...]:
        """Labels of the inferred noise parameters, such as ``sigma[x]``."""
        return noise_labels(self.noise_variables, self.likelihood.scalar)

    @property
    def measured(self) -> Floats:
        """Measured next states, shape (transition, H, body, state), NaN where missing."""
        if not is_filtered(self):
            return self.observations.values
        segments = self.segments
        observed = self.data.history.dataset["observed"].to_numpy()
        raw = observed[segments.trajectory, segments.step + 1][:, None]
        return np.asarray(raw[..., self.observations.columns])

    def predict(self, phi: Floats, engine: Engine | None = None) -> Floats:
        """Return predicted states, shape (..., transition, H, body, 6), for phi (..., p)."""
        predict, sensitivity = engine or self.physics.simulator, self.likelihood.sensitivity
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


#: A problem whose trajectories are filtered.
FilteredProblem = Problem[TrajectoryLikelihood]


def is_independent(problem: Problem) -> TypeGuard[Problem[TransitionLikelihood]]:
    """Return whether transitions are independent given measured initial states (Eq. 11)."""
    return problem.likelihood.name == TransitionLikelihood.name


def is_filtered(problem: Problem) -> TypeGuard[FilteredProblem]:
    """Return whether the problem's trajectories are filtered, with process noise."""
    return problem.likelihood.name == TrajectoryLikelihood.name


def with_defect(problem: Problem[LikelihoodT], exact: Problem, phi: Floats) -> Problem[LikelihoodT]:
    """Return a problem of few engine steps, predictions corrected at phi (p,) to an exact one's.

    The error of few steps hardly depends on the parameters: the difference between both engines at
    phi is added to every prediction (defect correction: P. Zadunaisky, On the estimation of errors
    propagated in the numerical integration of differential equations, 1976).
    """
    return replace(problem, defect=np.nan_to_num(exact.predict(phi) - problem.predict(phi)))


def corrected(problem: Problem[LikelihoodT], phi: Floats) -> Problem[LikelihoodT]:
    """Return the problem with fewer engine steps, corrected at phi, where that saves time."""
    medium = problem.medium
    if medium.physics.substeps * 3 > problem.physics.substeps:
        return problem
    return with_defect(medium, problem, phi)


def variable_dims(problem: Problem) -> dict[str, tuple[str, ...]]:
    """Return the dimensions of each parameter and noise variable by name."""
    dims: dict[str, tuple[str, ...]] = {
        block.name: (_block_dim(problem, block),) for block in problem.layout.blocks
    }
    if problem.library is not None:
        dims["library_index"] = (_owner_dim(problem, tuple(problem.scene.owners), "library"),)
    of_noise = _NOISE_DIMS if is_filtered(problem) else {"sigma": "state"}
    for name in problem.noise_variables:
        dims[name] = () if problem.likelihood.scalar else (of_noise[name],)
    return dims


def variable_coords(problem: Problem) -> dict[str, list[str] | list[int]]:
    """Return the labels of each dimension by name."""
    coords: dict[str, list[str] | list[int]] = {
        "body": [body.name for body in problem.scene.moving],
        "full_state": list(STATE),
        "state": list(problem.observations.names),
        "wrench": list(INPUT[: problem.inputs.shape[-1]]),
        "transition": list(range(problem.segments.n)),
        "step": list(range(1, problem.data.horizon + 1)),
    }
    if is_filtered(problem):
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
