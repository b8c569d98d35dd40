"""Batched prediction: (parameters, start states, actions) -> next states."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects.base import Attached
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics import compiled, plain
from pbrl_ppl.physics.properties import Array, engine_properties
from pbrl_ppl.physics.world import World
from pbrl_ppl.scene import Scene

PATHS = ("compiled", "plain")


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
        self._worlds: list[compiled.CompiledWorld] = []
        self._lock = threading.Lock()  # the worlds serve one call at a time

    def __getstate__(self) -> dict[str, object]:
        """Leave the C objects behind: another process builds its own."""
        return {key: value for key, value in self.__dict__.items() if key != "_lock"} | {
            "_worlds": []
        }

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
            Wrenches, shape (transition, H, body, 3), N and N m.

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
        properties, values = engine_properties(self.scene, self.effects, self.layout, proposals)
        n, horizon, k = actions.shape[:3]
        out = np.full((len(proposals) * n, horizon, k, 6), np.nan)
        if self.path == "plain":
            self._run_plain(properties, values, start, actions, out)
        else:
            with self._lock:
                self._run_compiled(properties, values, start, actions, out)
        out = out.reshape(len(proposals), n, horizon, k, 6)
        return out if phi.ndim == 2 else out[0]

    def _check(self, phi: Array, start: Array, actions: Array) -> None:
        k, p = len(self.scene.dynamic), self.layout.size
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

    @property
    def levels(self) -> tuple[NDArray[np.int64], Array]:
        """Numbers of substeps to run, the finest first, and the weights of their results.

        The engine's error is a series in the substep (Richardson, 1911): two runs cancel its first
        term, three its second as well. Friction of a wheel has kinks that a third run amplifies.
        """
        wheels = any(body.wheel for body in self.scene.dynamic)
        runs = (2 if wheels else 3) if self.extrapolate else 1
        counts = [self.substeps >> i for i in range(runs) if self.substeps >> i]
        powers = np.vander(1.0 / np.array(counts), increasing=True).T
        weights = np.linalg.solve(powers, np.eye(len(counts))[0])
        return np.array(counts, dtype=np.int64), weights

    def _run_plain(
        self, properties: Array, values: Array, start: Array, actions: Array, out: Array
    ) -> None:
        for item in range(len(out)):
            p, t = divmod(item, len(start))
            model = (self.scene, self.effects, properties[p], values[p], start[t], actions[t])
            total = np.zeros_like(out[item])
            for level, (count, weight) in enumerate(zip(*self.levels, strict=True)):
                states, touched = plain.rollout(*model, int(count))
                if level == 0 or np.isnan(states).any():  # diverged
                    out[item] = states
                if touched:
                    break
                total += weight * states
            else:
                out[item] = total

    def _run_compiled(
        self, properties: Array, values: Array, start: Array, actions: Array, out: Array
    ) -> None:
        laws = [one for one in self.effects if one.effect.force is not None]
        names = [body.name for body in self.scene.dynamic]
        sizes = [len(one.effect.parameters) for one in laws]
        addresses = [compiled.law_address(one.effect.force) for one in laws if one.effect.force]
        shared = (
            np.array(addresses, dtype=np.int64),
            np.array([names.index(one.body) for one in laws], dtype=np.int64),
            np.cumsum([0, *sizes])[:-1].astype(np.int64),
            np.ascontiguousarray(values),
            start,
            actions,
            self.scene.time_step,
            self.scene.normal_gravity,
            *self.levels,
        )
        while len(self._worlds) < self.threads:
            self._worlds.append(compiled.CompiledWorld(World(self.scene)))

        def run(worker: int, first: int, last: int) -> None:
            while first < last:
                stop = compiled.rollout(
                    compiled.FUNCTIONS,
                    self._worlds[worker].arrays(),
                    properties,
                    *shared,
                    first,
                    last,
                    out,
                )
                if stop < last:  # diverged: that world is spoilt, and the item is lost
                    out[stop] = np.nan
                    self._worlds[worker] = compiled.CompiledWorld(World(self.scene))
                first = stop + 1

        # a chunk a thread; with few items a thread costs more than it gives
        workers = min(self.threads, max(1, len(out) // 8))
        edges = np.linspace(0, len(out), workers + 1).astype(int)
        if workers == 1:
            run(0, 0, len(out))
            return
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(run, range(workers), edges[:-1], edges[1:]))
