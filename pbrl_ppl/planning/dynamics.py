"""The transition model of a plan: Eq. 7 or 13 at posterior draws, each with its own states."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached, Effect, attach, catalogue, needs_inputs
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.likelihood import log_posterior
from pbrl_ppl.physics import Physics, after_recording
from pbrl_ppl.planning.noise import StepNoise, step_noise
from pbrl_ppl.planning.transition_model import rollout
from pbrl_ppl.posterior import draws as all_draws
from pbrl_ppl.posterior import group, known_effects, parameter_draws, problem_of, stored_mode
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH

Array = NDArray[np.float64]


class Dynamics:
    """Transition model under each of some parameter draws.

    All moving bodies are in one world, whether or not they met in the data: a plan may push one
    into another.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    phi : ndarray
        Parameter draws in the layout's order, shape (draw, p).
    effects : iterable of Effect or Attached
        Effects beside those that the scene declares.
    noise : StepNoise, optional
        What a step adds under each draw: then :meth:`noisy` works.
    substeps, threads : int
        Of the engine.
    declared : iterable of Effect
        Where the names of the effects that the scene declares are looked up.
    """

    def __init__(
        self,
        scene: Scene,
        phi: Array,
        effects: Iterable[Effect | Attached] = (),
        *,
        noise: StepNoise | None = None,
        substeps: int | None = None,
        threads: int = 2,
        declared: Iterable[Effect] = catalogue,
    ) -> None:
        attached = attach(scene, effects, declared)
        substeps = scene.substeps if substeps is None else substeps
        self._physics = Physics(scene, attached, substeps, threads)
        self.scene, self.layout, self._noise = scene, self._physics.layout, noise
        self.phi = np.atleast_2d(np.asarray(phi, dtype=float))
        self._whole = needs_inputs(attached)
        #: Wrenches that acted before the start, shape (body, 3); an actuator may remember them.
        self.before = np.zeros((len(scene.moving), len(WRENCH)))

    @classmethod
    def known(
        cls, scene: Scene, parameters: Mapping[str, object], effects: Any = (), **options: Any
    ) -> Dynamics:
        """Dynamics of named parameters, as of :class:`pbrl_ppl.Transition`: the true model, say."""
        layout = Physics.declare(scene, effects).layout
        return cls(scene, layout.to_vector(parameters), effects, **options)

    @classmethod
    def of(
        cls,
        idata: Any,
        draws: int | None = None,
        *,
        seed: int = 0,
        effects: Iterable[Effect] = catalogue,
        threads: int = 2,
    ) -> Dynamics:
        """Dynamics of a posterior's draws.

        Parameters
        ----------
        idata : InferenceData or DataTree
            As made by :func:`pbrl_ppl.fit`, or loaded.
        draws : int, optional
            Chosen at random without replacement; without it, the posterior's mode (MAP) as the
            posterior holds it, or else the draw of highest :func:`log_posterior`.
        seed : int
            Of the choice.
        effects : iterable of Effect
            Where the names of its effects are looked up.
        threads : int
            Engine worlds side by side; the plan does not depend on it.

        Raises
        ------
        PosteriorError
            If it holds fewer draws.
        """
        effects = known_effects(idata, effects)
        problem = problem_of(idata, effects)  # all of its effects are declared in its scene
        phi, sigma = parameter_draws(problem, idata)
        mode = stored_mode(problem, idata) if draws is None else None
        if mode is not None:
            phi, sigma, chosen = mode.phi[None], mode.sigma[None], np.array([0])
        elif draws is None:
            likelihood = group(idata, "log_likelihood")["next_state"].sum("transition")
            known = likelihood.transpose("chain", "draw").to_numpy().ravel()
            choice = None
            if problem.library is not None:
                choice = all_draws(idata)["library_index"].astype(np.intp)
            density = log_posterior(problem, phi, sigma, choice, log_likelihood=known)
            chosen = np.array([np.argmax(density)])
        elif not 1 <= draws <= len(phi):
            raise PosteriorError(
                f"posterior: {draws} draws were asked for, expected 1 to {len(phi)}"
            )
        else:
            chosen = np.random.default_rng(seed).choice(len(phi), draws, replace=False)
        return cls(
            problem.scene,
            phi[chosen],
            noise=step_noise(problem, phi[chosen], sigma[chosen]),
            substeps=problem.physics.substeps,
            threads=threads,
            declared=effects,
        )

    @property
    def draws(self) -> int:
        """Number of parameter draws."""
        return len(self.phi)

    def single(self) -> Dynamics:
        """Dynamics of one draw: the nearest to the mean of all, in units of their spread."""
        offset = (self.phi - self.phi.mean(axis=0)) / np.maximum(self.phi.std(axis=0), 1e-12)
        i = int(np.argmin((offset**2).sum(axis=1)))
        chosen = copy(self)
        chosen.phi = self.phi[i : i + 1]
        if self._noise is not None:
            chosen._noise = self._noise.single(i)
        return chosen

    def after(self, before: Array) -> Dynamics:
        """Dynamics after these previous wrenches, shape (body, 3), N and N m."""
        later = copy(self)
        later.before = np.asarray(before, dtype=float).reshape(self.before.shape)
        return later

    def mass(self, body: str) -> Array:
        """A body's mass under each draw, shape (draw,), kg."""
        own = self.scene.body(body)
        known = dict(own.known)
        if "mass" in known:
            return np.full(self.draws, float(known["mass"]))
        return self.phi[:, self.layout.index("mass", own.owner)]

    def acceleration(self, body: str, force: float, torque: float) -> tuple[Array, Array]:
        """The most that a push without friction can do: m/s^2 and rad/s^2, shape (draw,) each."""
        shape, mass = self.scene.body(body).shape, self.mass(body)
        # a wheel or a contact at the rim turns the body as hard as it is pushed
        turning = torque + force * shape.bounding_radius
        linear = force / mass + np.hypot(*self.scene.gravity)
        return linear, turning / (mass * shape.unit_moment)

    def step(self, states: Array, wrenches: Array, previous: Array | None = None) -> Array:
        """States after one sampling interval.

        Parameters
        ----------
        states : ndarray
            Shape (draw, n, body, 6), SI units.
        wrenches : ndarray
            Shape (n, body, 3), world frame, N and N m; the same under each draw.
        previous : ndarray, optional
            Those of the interval before, same shape; :attr:`before` without them.

        Returns
        -------
        ndarray
            Shape (draw, n, body, 6); NaN where the engine diverged.
        """
        actions = wrenches[:, None]
        if self._whole:  # the time is after the recording
            last = np.broadcast_to(self.before if previous is None else previous, wrenches.shape)
            actions = after_recording(wrenches, last)[:, None]
        # what had diverged stays so; the engine refuses it
        lost = np.asarray(~np.isfinite(states).all(axis=(-2, -1)))
        given = np.where(lost[..., None, None], 0.0, states) if lost.any() else states
        out = np.stack(
            [
                self._physics.predict(p, s, actions)[:, 0]
                for p, s in zip(self.phi, given, strict=True)
            ]
        )
        out[lost] = np.nan
        return out

    def noisy(self, states: Array, rng: np.random.Generator) -> Array:
        """Add Eq. 13's noise to states of shape (draw, n, body, 6).

        Raises
        ------
        PosteriorError
            If the dynamics are known, and so without noise.
        """
        if self._noise is None:
            raise PosteriorError("noise: these parameters are known, and have no sigma; leave it")
        return self._noise.add(states, rng)

    def rollout(
        self, start: Array, wrenches: Array, rng: np.random.Generator | None = None
    ) -> Array:
        """Play wrenches (time, body, 3) from a state (body, 6): shape (draw, time + 1, body, 6).

        With a generator, Eq. 13's noise is added after each interval.
        """
        return rollout(self, start, wrenches, rng)
