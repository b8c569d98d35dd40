"""Expected separation of rival models by an experiment: log Bayes factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pbrl_ppl.likelihood import TrajectoryNoise
from pbrl_ppl.parameters import differentiate
from pbrl_ppl.physics import touching
from pbrl_ppl.planning.dynamics import Dynamics
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Bools, Floats

if TYPE_CHECKING:  # with the samplers, which a plan does not need
    from pbrl_ppl.criticism import Rival


#: Engine steps an interval at most: models are compared with each other, in the same engine.
_SUBSTEPS = 10
#: Step of a finite difference, in posterior standard deviations.
_STEP = 0.3


@dataclass(frozen=True, eq=False)
class _Paths:
    """Transitions along the paths that one model predicts, one path after the other.

    Parameters
    ----------
    begin, end : ndarray
        States, shape (transition, body, 6).
    wrenches, before : ndarray
        Wrenches of the interval and of the one before, shape (transition, body, 3).
    intervals : int
        Number of intervals of each path.
    lost : ndarray of bool
        Whether the engine diverged on a path, shape (path,).
    """

    begin: Floats
    end: Floats
    wrenches: Floats
    before: Floats
    intervals: int
    lost: Bools


class Separation:
    """Expected log Bayes factors of experiments between rival models.

    The data that one model predicts are predicted by another step by step, and whitened by the
    latter's Kalman filter with both noises of the posterior. Both models are linear in their
    parameters about their modes, with the posterior as prior: a difference that a rival's
    parameters can absorb within their posterior does not separate.

    Parameters
    ----------
    rivals : sequence of Rival
        Two or more.
    start : ndarray
        Initial state of the experiment, shape (body, 6), SI units; known to measurement noise.
    before : ndarray
        Wrenches before it, shape (body, 3).
    threads : int
        Engine worlds side by side.
    """

    def __init__(
        self, rivals: Sequence[Rival], start: Floats, before: Floats, threads: int = 2
    ) -> None:
        self.rivals, self.start, self.before = rivals, start, before
        self.scene = bare(rivals[0].mode.problem.scene)
        self._engines = [self._engine(rival, threads) for rival in rivals]

    def path(self, wrenches: Floats) -> Floats:
        """Return the states (n, time + 1, body, 6) that the first rival's mode predicts."""
        first = self.rivals[0]
        return np.asarray(self._rolled(first, first.mode.phi[None], wrenches)[0])

    def __call__(self, wrenches: Floats, draws: int) -> tuple[Floats, Bools]:
        """Return the expected log Bayes factors of experiments.

        Parameters
        ----------
        wrenches : ndarray
            Wrenches of each experiment, shape (n, time, body, 3), N and N m.
        draws : int
            Number of posterior draws of the true model.

        Returns
        -------
        separation : ndarray
            Factor of the true model over its rival, nats, shape (true, rival, n); 0 on the
            diagonal, NaN where the engine diverged.
        meeting : ndarray of bool
            Whether bodies meet on any of the paths, shape (n,).
        """
        m, n = len(self.rivals), len(wrenches)
        result, meeting = np.zeros((m, m, n)), np.zeros(n, dtype=bool)
        for i, true in enumerate(self.rivals):
            paths = self._paths(true, true.draws[:draws], wrenches)
            met = touching(self.scene, paths.begin, paths.end)
            meeting |= met.reshape(-1, n, paths.intervals).any(axis=(0, 2))
            widening = self._explained(true, paths, met)[1]
            for j, rival in enumerate(self.rivals):
                if i == j:
                    continue
                misfit, spread, absorbed = self._explained(rival, paths, met)
                value = 0.5 * (misfit - absorbed + spread - widening)
                value[paths.lost] = np.nan
                result[i, j] = value.reshape(-1, n).mean(axis=0)
        return result, meeting

    def _engine(self, rival: Rival, threads: int) -> Dynamics:
        physics = rival.mode.problem.physics
        found = Dynamics(
            self.scene, rival.mode.phi, physics.effects, threads=threads, declared=(),
            substeps=min(_SUBSTEPS, physics.substeps),
        )  # fmt: skip
        return found.after(self.before)

    def _dynamics(self, rival: Rival, phi: Floats) -> Dynamics:
        """Return a rival's dynamics at parameters (draw, p)."""
        return self._engines[self.rivals.index(rival)].at(phi)

    def _rolled(self, rival: Rival, phi: Floats, wrenches: Floats) -> Floats:
        """Return the states predicted under each draw, shape (draw, n, time + 1, body, 6)."""
        dynamics = self._dynamics(rival, phi)
        n, intervals = wrenches.shape[:2]
        states = np.broadcast_to(self.start, (len(phi), n, *self.start.shape))
        every, last = [states], np.broadcast_to(self.before, (n, *self.before.shape))
        for t in range(intervals):
            states, last = dynamics.step(states, wrenches[:, t], last), wrenches[:, t]
            every.append(states)
        return np.stack(every, axis=2)

    def _paths(self, rival: Rival, phi: Floats, wrenches: Floats) -> _Paths:
        states = self._rolled(rival, phi, wrenches)
        before = np.concatenate(
            [np.broadcast_to(self.before, wrenches[:, :1].shape), wrenches[:, :-1]], axis=1
        )
        lost = np.asarray(~np.isfinite(states).all(axis=(2, 3, 4)))
        states = np.where(lost[:, :, None, None, None], self.start, states)
        body = states.shape[3:]

        def along(values: Floats) -> Floats:
            return np.tile(values, (len(phi), 1, 1, 1)).reshape(-1, *values.shape[2:])

        return _Paths(
            states[:, :, :-1].reshape(-1, *body), states[:, :, 1:].reshape(-1, *body),
            along(wrenches), along(before), wrenches.shape[1], lost.ravel(),
        )  # fmt: skip

    def _explained(self, rival: Rival, paths: _Paths, met: Bools) -> tuple[Floats, Floats, Floats]:
        """Return how a model explains the paths of another, three arrays of shape (path,).

        Squared whitened residual less what the parameters absorb, log-determinant of the
        predictions' widening by the parameters, and number of parameters that the data inform.
        """
        mode = rival.mode
        cells = mode.problem.trajectory_noise.cells
        seen = mode.problem.trajectory_noise.seen.any(axis=0)
        spread = np.sqrt(np.maximum(np.diag(mode.covariance), 0.0))
        lower, upper = mode.problem.layout.bounds

        def steps(phi: Floats, begin: Floats) -> Floats:
            """Return the cells after an interval, shape (point, transition, cell)."""
            dynamics = self._dynamics(rival, phi)
            ends = dynamics.step(begin, paths.wrenches, paths.before)
            return np.nan_to_num(cells.of(ends))

        def of_phi(points: Floats) -> Floats:
            return steps(points, np.broadcast_to(paths.begin, (len(points), *paths.begin.shape)))

        residual = cells.wrapped(cells.of(paths.end) - of_phi(mode.phi[None])[0])
        by_phi = differentiate(of_phi, mode.phi, _STEP * spread, lower, upper)
        c, n = len(cells.places), len(paths.begin)
        size = np.maximum(cells.errors(rival.sigma), 1e-6)
        moved = np.tile(paths.begin, (2 * c, 1, 1, 1))
        flat = moved.reshape(2 * c, n, -1)
        for i, place in enumerate(cells.places):
            flat[i, :, place] += size[i]
            flat[c + i, :, place] -= size[i]
        moved = cells.completed(mode.problem.scene, moved)
        ends = steps(np.tile(mode.phi, (2 * c, 1)), moved)
        slope = np.moveaxis((ends[:c] - ends[c:]) / (2 * size[:, None, None]), 0, -1)
        nothing = np.zeros((n, c))
        noise = TrajectoryNoise(
            cells=cells,
            slope=np.ascontiguousarray(slope),
            first=np.arange(n) % paths.intervals == 0,
            seen=np.tile(seen, (n, 1)),
            measured=nothing,
            begin=nothing,
            wide=nothing,
            sigma=rival.sigma,
            touching=met,
        )
        rows = np.concatenate([residual[None], -np.moveaxis(by_phi, -1, 0)])
        white, _ = noise.filtered(rows, rival.sigma)
        white = white.reshape(len(rows), -1, paths.intervals * c)
        r, jacobian = white[0], np.moveaxis(white[1:], 0, -1)
        scaled = jacobian @ mode.factor  # by a posterior standard deviation of each direction
        inner = np.eye(len(mode.phi)) + scaled.transpose(0, 2, 1) @ scaled
        shared = np.einsum("nap,na->np", scaled, r)
        solved = np.linalg.solve(inner, np.concatenate(
            [shared[..., None], np.broadcast_to(np.eye(len(mode.phi)), inner.shape)], axis=-1
        ))  # fmt: skip
        misfit = (r**2).sum(axis=1) - (shared * solved[..., 0]).sum(axis=1)
        absorbed = len(mode.phi) - np.trace(solved[..., 1:], axis1=1, axis2=2)
        return misfit, np.linalg.slogdet(inner)[1], absorbed


def bare(scene: Scene) -> Scene:
    """Return a scene without the effects that its bodies declare: the rivals differ in them."""
    return scene.replace(bodies=tuple(replace(body, effects=()) for body in scene.bodies))
