"""Transition models for planning: Eq. 7 at posterior draws."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from copy import copy
from typing import TYPE_CHECKING, Any, Protocol, Self, runtime_checkable

import numpy as np

from pbrl_ppl.effects import Attached, Command, Effect, attach, catalogue, needs_inputs
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.physics import Physics, after_recording
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH, Floats

if TYPE_CHECKING:
    from pbrl_ppl.posterior import Idata


@runtime_checkable
class TransitionModel(Protocol):
    """Transition model that :func:`pbrl_ppl.plan` can plan with.

    :class:`pbrl_ppl.Dynamics` is one, and so are :class:`pbrl_ppl.LWR` and :class:`pbrl_ppl.OOLWR`.
    """

    #: Known geometry, with the order of the bodies.
    scene: Scene
    #: Wrenches that acted before the start, shape (body, 3) or more, N and N m: the last interval's
    #: first; three numbers more for each one before that a model remembers.
    before: Floats

    @property
    def draws(self) -> int:
        """Number of posterior draws that states are predicted for; 1 for a single model."""

    def single(self) -> Self:
        """Return one of the models, in the middle of all."""

    def after(self, before: Floats) -> Self:
        """Return the model after these previous wrenches, shape (body, 3), N and N m."""

    def acceleration(self, body: str, force: float, torque: float) -> tuple[Floats, Floats]:
        """Return a bound on what a push can do: m/s^2 and rad/s^2, shape (draw,) each."""

    def step(self, states: Floats, wrenches: Floats, previous: Floats | None = None) -> Floats:
        """Return the states after one sampling interval; NaN where the model has no answer.

        Parameters
        ----------
        states : ndarray
            Shape (draw, n, body, 6), SI units.
        wrenches : ndarray
            Shape (n, body, 3), world frame, N and N m.
        previous : ndarray, optional
            Those before, shape (n, body, 3) or more: as :attr:`before`.
        """


def remembered(wrenches: Floats, before: Floats) -> Floats:
    """Return the wrenches before the next interval: these, and those before but for the oldest.

    Examples
    --------
    >>> remembered(np.array([3.0, 0, 0]), np.array([2.0, 0, 0, 1.0, 0, 0]))
    array([3., 0., 0., 2., 0., 0.])
    """
    return np.concatenate([wrenches, before[..., : -len(WRENCH)]], axis=-1)


def predicted_path(model: TransitionModel, start: Floats, wrenches: Floats) -> Floats:
    """Play wrenches (..., time, body, 3) from a state (body, 6).

    Returns
    -------
    ndarray
        States, shape (draw, ..., time + 1, body, 6), SI units; the first is the start.
    """
    lead, in_time = wrenches.shape[:-3], np.moveaxis(wrenches, -3, 0)
    in_time = in_time.reshape(len(in_time), math.prod(lead), *wrenches.shape[-2:])
    states = np.broadcast_to(start, (model.draws, in_time.shape[1], *start.shape))
    path, last = [states], np.broadcast_to(model.before, (in_time.shape[1], *model.before.shape))
    for wrench in in_time:
        states, last = model.step(states, wrench, last), remembered(wrench, last)
        path.append(states)
    return np.stack(path, axis=2).reshape(model.draws, *lead, len(path), *start.shape)


#: Intervals that an actuator with a state of its own is followed back to.
PAST = 16


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
    substeps, threads, tolerance
        Settings of the engine: fields of :class:`pbrl_ppl.Physics`.
    declared : iterable of Effect
        Where the names of the effects that the scene declares are looked up.
    """

    def __init__(
        self,
        scene: Scene,
        phi: Floats,
        effects: Iterable[Effect | Attached] = (),
        *,
        substeps: int | None = None,
        threads: int = 2,
        tolerance: float = Physics.tolerance,
        declared: Iterable[Effect] = catalogue,
    ) -> None:
        attached = attach(scene, effects, declared)
        substeps = scene.substeps if substeps is None else substeps
        self._physics = Physics(scene, attached, substeps, threads, tolerance=tolerance)
        self.scene, self.layout = scene, self._physics.layout
        self.phi = np.atleast_2d(np.asarray(phi, dtype=float))
        self._whole = needs_inputs(attached)
        #: Wrenches that acted before the start, shape (body, 3); three more columns for each older
        #: one that an actuator remembers.
        stages = [one.effect.stage for one in attached if isinstance(one.effect.stage, Command)]
        past = PAST if any(s.memory + (s.remember is not None) > 1 for s in stages) else 1
        self.before = np.zeros((len(scene.moving), past * len(WRENCH)))

    @classmethod
    def known(
        cls,
        scene: Scene,
        parameters: Mapping[str, object],
        effects: Iterable[Effect | Attached] = (),
        **options: Any,
    ) -> Dynamics:
        """Return dynamics of named parameters, as :class:`pbrl_ppl.Transition` takes them."""
        layout = Physics.declare(scene, effects).layout
        return cls(scene, layout.to_vector(parameters), effects, **options)

    @classmethod
    def of(
        cls,
        idata: Idata,
        draws: int | None = None,
        *,
        seed: int = 0,
        effects: Iterable[Effect] = catalogue,
        threads: int = 2,
    ) -> Dynamics:
        """Return dynamics of a posterior's draws.

        Parameters
        ----------
        idata : InferenceData or DataTree
            As made by :func:`pbrl_ppl.fit`, or loaded.
        draws : int, optional
            Chosen at random without replacement; without it, the posterior's mode (MAP).
        seed : int
            Seed of the choice.
        effects : iterable of Effect
            Where the names of its effects are looked up.
        threads : int
            Engine worlds side by side; the plan does not depend on it.

        Raises
        ------
        PosteriorError
            If it has another schema version, holds fewer draws, or lacks its mode.
        """
        from pbrl_ppl.posterior import PosteriorRecord, vectors  # not for known dynamics

        record = PosteriorRecord.of(idata)
        physics = record.physics(effects)
        layout = physics.layout
        if draws is None:
            phi = record.mode_vectors(layout)[0][None]
        else:
            phi, _ = vectors(idata, layout, record.noise_variables)
            if not 1 <= draws <= len(phi):
                raise PosteriorError(
                    f"posterior: {draws} draws were asked for, expected 1 to {len(phi)}"
                )
            phi = phi[np.random.default_rng(seed).choice(len(phi), draws, replace=False)]
        return cls(
            record.scene,
            phi,
            substeps=physics.substeps,
            tolerance=physics.tolerance,
            threads=threads,
            declared=[law.effect for law in physics.effects],
        )

    @property
    def draws(self) -> int:
        """Number of parameter draws."""
        return len(self.phi)

    def single(self) -> Dynamics:
        """Return dynamics of the draw nearest to the mean of all, in units of their spread."""
        spread = self.phi.std(axis=0)
        offset = (self.phi - self.phi.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
        i = int(np.argmin((offset**2).sum(axis=1)))
        return self.at(self.phi[i : i + 1])

    def at(self, phi: Floats) -> Dynamics:
        """Return the same dynamics at other parameters, shape (draw, p), with the same worlds."""
        other = copy(self)
        other.phi = phi
        return other

    def after(self, before: Floats) -> Dynamics:
        """Return dynamics after previous wrenches, N and N m, as in :attr:`before`.

        Of shape (body, 3) they lasted.
        """
        later, given = copy(self), np.asarray(before, dtype=float)
        later.before = self._lasting(given.reshape(len(self.before), -1))
        return later

    def _lasting(self, before: Floats) -> Floats:
        """Return wrenches before as many as are remembered, shape (..., 3 or more)."""
        width = self.before.shape[-1]
        return np.asarray(np.tile(before, width)[..., :width])

    def mass(self, body: str) -> Floats:
        """Return a body's mass under each draw, shape (draw,), kg."""
        chosen = self.scene.body(body)
        known = dict(chosen.known)
        if "mass" in known:
            return np.full(self.draws, float(known["mass"]))
        return self.phi[:, self.layout.index("mass", chosen.owner)]

    def acceleration(self, body: str, force: float, torque: float) -> tuple[Floats, Floats]:
        """Return what a push can do without friction: m/s^2 and rad/s^2, shape (draw,) each."""
        shape, mass = self.scene.body(body).shape, self.mass(body)
        # a wheel or a contact at the rim turns the body as hard as it is pushed
        turning = torque + force * shape.bounding_radius
        linear = force / mass + np.hypot(*self.scene.gravity)
        return linear, turning / (mass * shape.unit_moment)

    def step(self, states: Floats, wrenches: Floats, previous: Floats | None = None) -> Floats:
        """Return the states after one sampling interval.

        Parameters
        ----------
        states : ndarray
            Shape (draw, n, body, 6), SI units.
        wrenches : ndarray
            Shape (n, body, 3), world frame, N and N m; the same under each draw.
        previous : ndarray, optional
            Wrenches before, shape (n, body, 3) or more as in :attr:`before`, which is the default.

        Returns
        -------
        ndarray
            Shape (draw, n, body, 6); NaN where the engine diverged.
        """
        actions = wrenches[:, None]
        if self._whole:  # the time is after the recording
            before = self.before if previous is None else self._lasting(previous)
            last = np.broadcast_to(before, (len(wrenches), *self.before.shape))
            each = np.split(last, last.shape[-1] // len(WRENCH), axis=-1)
            actions = after_recording(wrenches, *each)[:, None]
        # the engine refuses states that had diverged: they stay NaN
        lost = np.asarray(~np.isfinite(states).all(axis=(-2, -1)))
        begin = np.where(lost[..., None, None], 0.0, states) if lost.any() else states
        pairs = zip(self.phi, begin, strict=True)
        out = np.stack([self._physics.predict(p, s, actions)[:, 0] for p, s in pairs])
        out[lost] = np.nan
        return out
