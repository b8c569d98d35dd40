"""Batched prediction: (parameters, start states, actions) -> next states."""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from queue import SimpleQueue

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects.base import Attached
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.numerics import differentiate
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics import compiled, plain
from pbrl_ppl.physics.properties import Array, EngineInput, EngineProperties
from pbrl_ppl.physics.world import World
from pbrl_ppl.scene import Scene

PATHS = ("compiled", "plain")
#: Step of a finite difference as a share of a parameter's scale: about the cube root of the
#: engine's rounding error. And what stands for an infinite bound.
_STEP, _FAR = 1e-5, 1e300
#: Worlds kept, of different choices of the bodies that inferred joints hold.
_KEPT = 64
#: Engine steps worth a thread of their own.
_A_THREAD = 1000
#: For each joint of unknown bodies, which of ``scene.joinable`` it holds.
Joined = tuple[tuple[int, int], ...]


class Simulator:
    """The deterministic f of Eq. 7 for a scene with effects, over batches.

    Runs with different numbers of substeps are combined to cancel the engine's first-order error
    (Richardson's extrapolation), which makes the result second order with a wheel and third order
    without; a transition in which shapes come close to each other is not extrapolated.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    layout : Layout
        Order of the unknown parameters in phi.
    effects : tuple of Attached
        All effects of the model.
    substeps : int, optional
        Engine steps a sampling interval; the scene's by default.
    threads : int
        Worlds that run side by side. The result does not depend on it.
    path : str, optional
        ``compiled`` or ``plain``; the fastest available by default. The results agree.
    extrapolate : bool
        Whether to cancel the leading errors.

    Raises
    ------
    SimulationError
        If substeps or threads are below 1, or the path is unknown or not available.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        effects: tuple[Attached, ...] = (),
        *,
        substeps: int | None = None,
        threads: int = 1,
        path: str | None = None,
        extrapolate: bool = True,
    ) -> None:
        substeps = scene.substeps if substeps is None else substeps
        if substeps < 1 or threads < 1:
            raise SimulationError(
                f"substeps is {substeps} and threads is {threads}; both must be at least 1"
            )
        path = path or ("compiled" if compiled.AVAILABLE else "plain")
        if path not in PATHS or (path == "compiled" and not compiled.AVAILABLE):
            raise SimulationError(f"path {path!r} is not available; use one of {PATHS}")
        self.scene, self.layout, self.effects = scene, layout, effects
        self.substeps, self.threads, self.path = substeps, threads, path
        self.extrapolate = extrapolate
        self._properties = EngineProperties(scene, effects, layout)
        self._worlds: OrderedDict[Joined, list[_Engine]] = OrderedDict()
        self._lock = threading.Lock()  # the worlds serve one call at a time

    def __getstate__(self) -> dict[str, object]:
        """Leave the C objects behind: another process builds its own."""
        return {
            key: value for key, value in self.__dict__.items() if key not in ("_lock", "_forces")
        } | {"_worlds": OrderedDict()}

    def __setstate__(self, state: dict[str, object]) -> None:
        """Build what was left behind."""
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def __call__(self, phi: Array, start: Array, actions: Array) -> Array:
        """Predict the states after each interval of each transition.

        Parameters
        ----------
        phi : ndarray
            Unknown parameters in the layout's order, SI units, shape (p,) or (proposal, p).
        start : ndarray
            Start states, shape (transition, body, 6).
        actions : ndarray
            Wrenches, shape (transition, H, body, 3), N and N m; of a kinematic body its velocity
            over the interval, m/s and rad/s.

        Returns
        -------
        ndarray
            Shape (transition, H, body, 6), with a leading proposal axis if phi has one. A
            transition in which the engine diverged is NaN.

        Raises
        ------
        SimulationError
            If the shapes do not fit together, or a start state is not finite.
        ParameterError
            If a parameter is impossible, such as a negative mass.
        """
        phi = np.asarray(phi, dtype=float)
        start = np.ascontiguousarray(start, dtype=float)
        actions = np.ascontiguousarray(actions, dtype=float)
        self._check(phi, start, actions)
        proposals = np.atleast_2d(phi)
        given = self._properties(proposals)
        n, horizon, k = actions.shape[:3]
        out = np.full((len(proposals), n, horizon, k, 6), np.nan)
        run = self._run_plain if self.path == "plain" else self._run_compiled
        if not given.indices.shape[1]:
            run((), given, start, actions, out.reshape(-1, horizon, k, 6))
            return out if phi.ndim == 2 else out[0]
        # each choice of the bodies that joints hold is a world of its own
        choices, which = np.unique(given.indices, axis=0, return_inverse=True)
        for i, choice in enumerate(choices):
            joined = tuple((int(a), int(b)) for a, b in choice)
            rows = which.ravel() == i
            part = np.full((int(rows.sum()) * n, horizon, k, 6), np.nan)
            run(joined, EngineInput(*(each[rows] for each in given)), start, actions, part)
            out[rows] = part.reshape(-1, n, horizon, k, 6)
        return out if phi.ndim == 2 else out[0]

    def jacobian(self, phi: Array, start: Array, actions: Array) -> Array:
        """Derivative of the predictions by phi, by central differences in one batched call.

        Parameters
        ----------
        phi : ndarray
            Where to differentiate, shape (p,).
        start, actions : ndarray
            As in a call.

        Returns
        -------
        ndarray
            Shape (transition, H, body, 6, p). The columns of discrete parameters are zero; where
            friction or a contact makes a kink it is the derivative of one side or a mean of both.
        """
        phi = np.asarray(phi, dtype=float)
        lower, upper = self.layout.bounds
        # never on a bound: a body has no mass of zero
        lower = np.where(phi > lower, 0.5 * (phi + np.maximum(lower, -_FAR)), lower)
        upper = np.where(phi < upper, 0.5 * (phi + np.minimum(upper, _FAR)), upper)
        return differentiate(
            lambda points: self(points, start, actions), phi, _STEP * self.layout.scale(phi),
            lower, upper,
        )  # fmt: skip

    def _check(self, phi: Array, start: Array, actions: Array) -> None:
        k, p = len(self.scene.moving), self.layout.size
        if phi.ndim not in (1, 2) or phi.shape[-1] != p:
            raise SimulationError(
                f"phi has shape {phi.shape}, expected ({p},) or (proposal, {p}):"
                f" {', '.join(self.layout.labels)}"
            )
        if start.ndim != 3 or start.shape[1:] != (k, 6):
            raise SimulationError(
                f"start has shape {start.shape}, expected (transition, {k}, 6)"
                " in the order x, y, theta, vx, vy, omega"
            )
        if actions.ndim != 4 or actions.shape[0] != len(start) or actions.shape[2:] != (k, 3):
            raise SimulationError(
                f"actions have shape {actions.shape}, expected ({len(start)}, H, {k}, 3)"
                " in the order force_x, force_y, torque"
            )
        if not (np.isfinite(start).all() and np.isfinite(actions).all()):
            raise SimulationError("start states and actions must be finite; drop the missing rows")

    @cached_property
    def levels(self) -> tuple[NDArray[np.int64], Array]:
        """Numbers of substeps to run, the finest first, and the weights of their results.

        The engine's error is a series in the substep (Richardson, 1911): two runs cancel its first
        term, three its second as well. Friction on the floor has kinks that a third run amplifies.
        """
        kinks = any(body.wheel for body in self.scene.moving) or self._properties.patches
        runs = (2 if kinks else 3) if self.extrapolate else 1
        counts = [self.substeps >> i for i in range(runs) if self.substeps >> i]
        powers = np.vander(1.0 / np.array(counts), increasing=True).T
        weights = np.linalg.solve(powers, np.eye(len(counts))[0])
        return np.array(counts, dtype=np.int64), weights

    @cached_property
    def _forces(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Address, body and first parameter of each force law."""
        attached = [one for one in self.effects if one.effect.force is not None]
        names = [body.name for body in self.scene.moving]
        sizes = [len(one.effect.parameters) for one in attached]
        addresses = [compiled.law_address(one.effect.force) for one in attached if one.effect.force]
        return (
            np.array(addresses, dtype=np.int64),
            np.array([names.index(one.body) for one in attached], dtype=np.int64),
            np.cumsum([0, *sizes])[:-1].astype(np.int64),
        )

    def _new_world(self, joined: Joined) -> World:
        return World(self.scene, self._properties.hinges, joined, self._properties.patches)

    def _run_plain(
        self, joined: Joined, given: EngineInput, start: Array, actions: Array, out: Array
    ) -> None:
        for item in range(len(out)):
            p, t = divmod(item, len(start))
            properties = given.bodies[p], given.joints[p], given.laws[p]
            total = np.zeros_like(out[item])
            for level, (count, weight) in enumerate(zip(*self.levels, strict=True)):
                states, touched = plain.rollout(
                    self._new_world(joined), self.effects, *properties, start[t], actions[t],
                    int(count),
                )  # fmt: skip
                if level == 0 or np.isnan(states).any():  # diverged
                    out[item] = states
                if touched:
                    break
                total += weight * states
            else:
                out[item] = total

    def _run_compiled(
        self, joined: Joined, given: EngineInput, start: Array, actions: Array, out: Array
    ) -> None:
        shared = (
            given.bodies, given.joints, given.laws, *self._forces, start, actions,
            self.scene.time_step, self.scene.normal_gravity, *self.levels,
        )  # fmt: skip

        def run(engine: _Engine, first: int, last: int) -> None:
            while first < last:
                stop = compiled.rollout(
                    compiled.FUNCTIONS, engine.pointers, *shared, first, last, out
                )
                if stop < last:  # diverged: that world is spoilt, and the item is lost
                    out[stop] = np.nan
                    engine.renew(self._new_world(joined))
                first = stop + 1

        steps = len(out) * actions.shape[1] * int(self.levels[0].sum())
        workers = max(1, min(self.threads, len(out), steps // _A_THREAD))
        with self._lock:
            engines = self._worlds.setdefault(joined, [])
            self._worlds.move_to_end(joined)
            while len(self._worlds) > _KEPT:
                self._worlds.popitem(last=False)
            while len(engines) < workers:
                engines.append(_Engine(self._new_world(joined)))
            if workers == 1:
                run(engines[0], 0, len(out))
                return
            # chunks, so that a thread which the machine slows down takes fewer of them
            chunks = min(8 * workers, max(workers, len(out) // 64))
            edges = np.linspace(0, len(out), chunks + 1).astype(int)
            idle: SimpleQueue[_Engine] = SimpleQueue()
            for engine in engines[:workers]:
                idle.put(engine)

            def serve(first: int, last: int) -> None:
                engine = idle.get()
                try:
                    run(engine, first, last)
                finally:
                    idle.put(engine)

            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(serve, edges[:-1], edges[1:]))


class _Engine:
    """A world of one thread, and where its C objects are."""

    def __init__(self, world: World) -> None:
        self.renew(world)

    def renew(self, world: World) -> None:
        """Take another world."""
        self.world, self.pointers = world, compiled.pointers(world)
