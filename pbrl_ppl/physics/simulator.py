"""Batched prediction: (parameters, initial states, actions) -> next states."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Clock, needs_inputs
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import fill_joints, joint_coordinates
from pbrl_ppl.parameters import Layout, differentiate
from pbrl_ppl.physics import calls, compiled, flow, lockstep
from pbrl_ppl.physics.calls import pointers, still
from pbrl_ppl.physics.laws import law_tables, laws_of
from pbrl_ppl.physics.motion import work_of
from pbrl_ppl.physics.properties import EngineInput, EngineProperties, on_rod
from pbrl_ppl.physics.settings import PhysicsSettings
from pbrl_ppl.physics.tree import MOST, tree_of
from pbrl_ppl.physics.world import JOINT, World
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import INPUT, STATE, THETA, VELOCITY, WRENCH, Bools, Floats, Ints
from pbrl_ppl.system.threads import in_worker

#: For each joint of unknown bodies, which of ``scene.joinable`` it holds.
Joined = tuple[tuple[int, int], ...]
#: And which rods there are: what worlds differ in.
Choice = tuple[Joined, tuple[bool, ...]]
#: Where there is nothing to choose.
_ONE_WORLD: Choice = ((), ())


class Batch(NamedTuple):
    """What the rollouts take: see `compiled.rollout_engine`."""

    given: tuple[Floats, ...]
    laws: NDArray[np.void]  # (proposal,), of dtype `laws.LAWS`
    follows: Bools
    start: Floats
    inputs: Floats
    time_step: float
    counts: Ints
    weights: Floats
    tolerance: float


class Engine:
    """A world of one thread, and where its C objects are.

    Parameters
    ----------
    build : callable
        Builds a world.
    name : str
        Which engine; see :class:`Physics`.
    """

    def __init__(self, build: Callable[[], World], name: str = "auto") -> None:
        self._build, self._name = build, name
        self._renew()

    def _renew(self) -> None:
        self.world = self._build()
        self.pointers = pointers(self.world)
        self._wheels = self._tree = None
        if self._name == "chipmunk":
            return
        self._wheels = lockstep.free_wheels(self.world)
        # a tree's step of half a radius that passes through the edge of a circle is to end in it
        self._still = still(self.world, 1.04 if self._wheels is None else 1.0)
        if self._wheels is None:
            self._tree = tree_of(self.world)
        if self._tree is not None:
            self._work = work_of(self._tree, self.world.size)

    def rollout(self, batch: Batch, first: int, last: int, out: Floats) -> None:
        """Predict the items ``first`` to ``last`` into ``out``, NaN where the engine diverges.

        Parameters
        ----------
        batch : Batch
            Of all bodies.
        first, last : int
            Of proposals x transitions.
        out : ndarray
            Shape (proposal * transition, H, body, 6).
        """
        items, horizon = np.arange(first, last), batch.inputs.shape[1]
        begins = np.zeros(len(items), dtype=np.int64)
        tree = self._tree
        if tree is not None and batch.laws["n_held"].max(initial=0) > max(0, MOST - 1 - tree.size):
            tree = None  # laws' own numbers have no place beside the coordinates
        whole = self._wheels is None and tree is None
        while len(items):
            if self._wheels is not None:
                lockstep.rollout_free(self._wheels, self._still, batch, items, begins, out)
            elif tree is not None:
                rollout = calls.compiled_beside(flow.rollout_tree)
                rollout(self._work, self._still, batch, items, begins, out)
            left = begins < horizon
            items, begins = items[left], begins[left]
            if len(items) and self._name == "contact-free":
                raise SimulationError(
                    f"engine 'contact-free': {len(items)} of {last - first} transitions have"
                    " contacts, or joints that the fast path lacks; use 'auto' or 'chipmunk'"
                )
            if len(items):
                self.world.check_steps()
            done = 0
            while done < len(items):
                done += compiled.rollout_engine(
                    calls.FUNCTIONS, self.pointers, batch, items[done:], begins[done:], whole, out
                )
                if done < len(items):  # diverged: that world is spoilt, and the item is lost
                    out[items[done]], begins[done] = np.nan, horizon
                    self._renew()
                    done += 1
            left = begins < horizon
            items, begins = items[left], begins[left]


class Simulator:
    """The deterministic f of Eq. 7 for a scene with effects, over batches.

    Runs with different numbers of substeps are combined to cancel the engine's first-order error
    (Richardson's extrapolation), which makes the result second order with a wheel and third order
    without; a transition in which shapes come close to each other is not extrapolated.

    Parameters
    ----------
    physics : PhysicsSettings
        Scene, effects and settings; its parts are not used.
    """

    def __init__(self, physics: PhysicsSettings) -> None:
        self.physics = physics
        self._properties = EngineProperties(physics.scene, physics.effects, physics.layout)
        self._worlds: OrderedDict[Choice, list[Engine]] = OrderedDict()
        self._lock = threading.Lock()  # the worlds serve one call at a time

    def __reduce__(self) -> tuple[type[Simulator], tuple[PhysicsSettings]]:
        """Return what to pickle, without C objects: another process builds its own."""
        return type(self), (self.physics,)

    def __call__(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Predict the states after each interval of each transition.

        Parameters
        ----------
        phi : ndarray
            Unknown parameters in the layout's order, SI units, shape (p,) or (proposal, p).
        start : ndarray
            Initial states, shape (transition, body, 6), or (proposal, transition, body, 6).
        actions : ndarray
            Wrenches, shape (transition, H, body, 3), N and N m; of a kinematic body its velocity
            over the interval, m/s and rad/s. Or all inputs, shape (transition, H, body, 9), as in
            :data:`pbrl_ppl.state.INPUT`: with wrenches alone, nothing acted before the first
            interval, and the time is after the recording.

        Returns
        -------
        ndarray
            As measured, shape (transition, H, body, 6), with a leading proposal axis if phi has
            one. A transition in which the engine diverged is NaN.

        Raises
        ------
        SimulationError
            If the shapes do not fit together, or an initial state is not finite.
        ParameterError
            If a parameter is impossible, such as a negative mass.
        """
        phi = np.asarray(phi, dtype=float)
        # of one kind, for numba recompiles the rollout for another
        start = np.require(start, float, ("C", "W"))
        actions = np.require(actions, float, ("C", "W"))
        check_shapes(self.physics.scene, self.physics.layout, phi, start, actions)
        proposals = np.atleast_2d(phi)
        inputs, clock = self._inputs(actions)
        numbers = self._properties(proposals, clock)
        n, horizon, k = actions.shape[:3]
        begin = None if clock is None else clock.begin.reshape(1, n, horizon)[..., 0]
        starts = self._on_rods(self._states(proposals, start, begin), numbers.joints)
        if (upright := self._properties.upright).any():
            starts = starts.copy()
            starts[..., upright, THETA] = self._properties.angles[upright]
            starts[..., upright, THETA + VELOCITY] = 0.0
        out = np.full((len(proposals), n, horizon, k, 6), np.nan)
        if not (self._properties.tied or numbers.indices.shape[1]):
            self._run(_ONE_WORLD, numbers, starts, inputs, out.reshape(-1, horizon, k, 6))
        else:
            for choice, rows in self._choices(numbers):
                begin = starts[rows] if len(starts) > 1 else starts
                count = int(rows.sum())
                part = np.full((count * n, horizon, k, 6), np.nan)
                chosen = EngineInput._make(array[rows] for array in numbers)
                self._run(choice, chosen, begin, inputs, part)
                out[rows] = part.reshape(count, n, horizon, k, 6)
        for i, sensor, values in self._properties.sensors(proposals):
            if sensor.timed and clock is not None:
                values = {**values, "time": clock.end.reshape(1, n, horizon)}
            out[..., i, :] = sensor.measure(out[..., i, :], values)
        return out if phi.ndim == 2 else out[0]

    def _choices(self, numbers: EngineInput) -> Iterator[tuple[Choice, Bools]]:
        """The worlds that proposals need, and which of them each is for.

        What bodies an inferred joint holds makes another world, and so does each rod that there is.
        Friction under bodies does not, where its coefficient is zero: a derivative there is not to
        see the difference of two solvers.
        """
        tied = numbers.joints[:, len(self.physics.scene.joints) :, JOINT.length] > 0
        proposals, joints, _ = numbers.indices.shape
        indices = numbers.indices.reshape(proposals, 2 * joints)
        keys = np.column_stack([tied, indices])
        choices, which = np.unique(keys, axis=0, return_inverse=True)
        for i, row in enumerate(choices.astype(int).tolist()):
            rods, pairs = row[: tied.shape[1]], row[tied.shape[1] :]
            joined = tuple(zip(pairs[::2], pairs[1::2], strict=True))
            yield (joined, tuple(map(bool, rods))), which.ravel() == i

    def _inputs(self, actions: Floats) -> tuple[Floats, Clock | None]:
        """Inputs of the rollout, and times of the intervals."""
        if not needs_inputs(self.physics.effects):
            return np.ascontiguousarray(actions[..., :3]), None
        if actions.shape[-1] == 3:
            previous = np.zeros_like(actions)
            previous[:, 1:] = actions[:, :-1]
            actions = after_recording(actions, previous)
        when = actions[:, :, 0, 6:9].reshape(1, -1, 3)
        return actions, Clock(*np.moveaxis(when, -1, 0))

    def _states(self, phi: Floats, measured: Floats, begin: Floats | None) -> Floats:
        """True states by the sensors' inverses, shape (1 or proposal, transition, body, 6).

        ``begin`` are the times at which transitions begin, shape (1, transition), s.
        """
        sensors = self._properties.sensors(phi)
        measured = measured if measured.ndim == 4 else measured[None]
        if not sensors:
            return measured
        states = _each(measured, len(phi))
        for i, sensor, values in reversed(sensors):
            flat = {name: value[..., 0] for name, value in values.items()}
            if sensor.timed and begin is not None:
                flat["time"] = begin
            states[:, :, i] = sensor.invert(states[:, :, i], flat)
        # of a body in joints all follows from one coordinate
        names = [body.name for body in self.physics.scene.moving]
        for name, column in joint_coordinates(self.physics.scene).items():
            others = [d for d in range(len(STATE)) if d % VELOCITY != column]
            states[:, :, names.index(name), others] = np.nan
        fill_joints(states, self.physics.scene)
        return states

    def _on_rods(self, states: Floats, joints: Floats) -> Floats:
        """Initial states with the bodies that effects tie on their rods."""
        if self._properties.tied:
            states = _each(states, len(joints))
        for i, position in self._properties.tied:
            moment = self.physics.scene.moving[i].shape.unit_moment
            rod = joints[:, position, : JOINT.length + 1]
            states[:, :, i] = on_rod(states[:, :, i], rod, moment)
        return states

    def jacobian(self, phi: Floats, start: Floats, actions: Floats, step: float = 1e-5) -> Floats:
        """Derivative of the predictions by phi, by central differences in one batched call.

        Parameters
        ----------
        phi : ndarray
            Where to differentiate, shape (p,).
        start, actions : ndarray
            As in a call.
        step : float
            Of the differences, as a share of a parameter's scale: about the cube root of the
            engine's rounding error.

        Returns
        -------
        ndarray
            Shape (transition, H, body, 6, p). The columns of discrete parameters are zero; where
            friction or a contact makes a kink it is the derivative of one side or a mean of both.
        """
        phi = np.asarray(phi, dtype=float)
        lower, upper = self.physics.layout.bounds
        # never on a bound, which may be infinite: a body has no mass of zero
        lower = np.where(phi > lower, 0.5 * (phi + np.maximum(lower, -1e300)), lower)
        upper = np.where(phi < upper, 0.5 * (phi + np.minimum(upper, 1e300)), upper)
        return differentiate(
            lambda points: self(points, start, actions),
            phi, step * self.physics.layout.scale(phi), lower, upper,
        )  # fmt: skip

    @cached_property
    def levels(self) -> tuple[Ints, Floats]:
        """Numbers of substeps to run, the finest first, and the weights of their results.

        The engine's error is a series in the substep (Richardson, 1911): two runs cancel its first
        term, three its second as well. Friction on the floor has kinks that a third run amplifies.
        """
        physics = self.physics
        kinks = any(body.wheel for body in physics.scene.moving) or any(self._properties.under)
        runs = (2 if kinks else 3) if physics.extrapolate else 1
        counts = [physics.substeps >> i for i in range(runs) if physics.substeps >> i]
        # in closed form: a solver's last digits differ between machines
        weights = [math.prod(n / (n - other) for other in counts if other != n) for n in counts]
        return np.array(counts, dtype=np.int64), np.array(weights, dtype=float)

    @cached_property
    def _laws(self) -> list[NDArray[np.void]]:
        return law_tables(self.physics.scene, self.physics.effects)

    def _new_world(self, choice: Choice) -> World:
        (joined, there), properties = choice, self._properties
        rods = tuple(compress(properties.tied, there))
        kinds, discs = properties.joints.kinds, properties.n_discs
        patches, wheels, turners = properties.under
        return World(self.physics.scene, kinds, joined, discs, patches, wheels, turners, rods)

    def _run(
        self, choice: Choice, numbers: EngineInput, starts: Floats, inputs: Floats, out: Floats
    ) -> None:
        """Run items in worlds of a choice; those of the last few choices are kept."""
        time_step = self.physics.scene.time_step
        batch = Batch(
            numbers[:3], laws_of(self._laws, numbers[3:6], inputs, time_step),
            continues_previous(inputs), starts, inputs, time_step, *self.levels,
            self.physics.tolerance,
        )  # fmt: skip
        steps = len(out) * inputs.shape[1] * int(self.levels[0].sum())
        threads = 1 if in_worker() else self.physics.threads
        workers = max(1, min(threads, len(out), steps // 5000))  # fewer steps are worth no thread
        with self._lock:
            self._worlds[choice] = engines = self._worlds.pop(choice, [])
            while len(self._worlds) > 64:
                self._worlds.popitem(last=False)
            while len(engines) < workers:
                engines.append(Engine(partial(self._new_world, choice), self.physics.engine))
            edges = np.linspace(0, len(out), workers + 1).astype(int)
            parts = zip(engines, edges[:-1], edges[1:], strict=False)
            if workers == 1:
                engines[0].rollout(batch, 0, len(out), out)
                return
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(lambda part: part[0].rollout(batch, *part[1:], out), parts))


def _each(states: Floats, proposals: int) -> Floats:
    """A copy of initial states for each proposal, in the layout that the rollouts take."""
    return np.array(np.broadcast_to(states, (proposals, *states.shape[1:])), order="C")


def continues_previous(inputs: Floats) -> Bools:
    """Return which transitions begin where the one before ends in the recording, (transition,)."""
    follows = np.zeros(len(inputs), dtype=bool)
    if inputs.shape[-1] > len(WRENCH):
        number, begin, end = np.moveaxis(inputs[:, :, 0, 6:9], -1, 0)
        follows[1:] = (number[1:, 0] == number[:-1, -1]) & (begin[1:, 0] == end[:-1, -1])
        follows[1:] &= np.isfinite(begin[1:, 0])
    return follows


def after_recording(wrenches: Floats, *past: Floats) -> Floats:
    """Inputs of intervals that begin when the recording has ended.

    Parameters
    ----------
    wrenches : ndarray
        Wrenches of each interval, shape (..., 3).
    *past : ndarray
        Those of the interval before, of that before it, and so on, same shape.

    Returns
    -------
    ndarray
        Shape (..., 9), as in :data:`pbrl_ppl.state.INPUT`, or more: the older wrenches come last.
    """
    when = np.full_like(wrenches, np.inf)
    return np.concatenate([wrenches, past[0], when, *past[1:]], axis=-1)


def check_shapes(scene: Scene, layout: Layout, phi: Floats, start: Floats, actions: Floats) -> None:
    """Refuse arrays of other shapes than a rollout takes, and what is not finite.

    Parameters
    ----------
    scene, layout : Scene, Layout
        How many bodies there are, and how many parameters.
    phi, start, actions : ndarray
        As in a call of `Simulator`.

    Raises
    ------
    SimulationError
        If the shapes do not fit together, or an initial state is not finite.
    """
    k, p = len(scene.moving), layout.size
    if phi.ndim not in (1, 2) or phi.shape[-1] != p:
        raise SimulationError(
            f"phi has shape {phi.shape}, expected ({p},) or (proposal, {p}):"
            f" {', '.join(layout.labels)}"
        )
    per_proposal = start.ndim == 4 and phi.ndim == 2 and len(start) == len(phi)
    if not (per_proposal or start.ndim == 3) or start.shape[-2:] != (k, 6):
        raise SimulationError(
            f"start has shape {start.shape}, expected (transition, {k}, 6), or with as many"
            " proposals first as phi has, in the order x, y, theta, vx, vy, omega"
        )
    shaped = actions.ndim == 4 and actions.shape[0] == start.shape[-3] and actions.shape[2] == k
    width = actions.shape[-1]
    if not shaped or not (width == 3 or (width >= len(INPUT) and width % 3 == 0)):
        raise SimulationError(
            f"actions have shape {actions.shape}, expected ({start.shape[-3]}, H, {k}, 3)"
            f" in the order force_x, force_y, torque, or {len(INPUT)} in place of 3:"
            f" {', '.join(INPUT)}"
        )
    if not (np.isfinite(start).all() and np.isfinite(actions[..., :6]).all()):
        raise SimulationError("initial states and actions must be finite; drop the missing rows")
