"""Evidence for the added effects by state dimension and transition of the fitted recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism import Loop
from pbrl_ppl.effects import Effect
from pbrl_ppl.model import Problem
from pbrl_ppl.posterior import group, problem_of
from pbrl_ppl.report.motion import likeliest
from pbrl_ppl.state import STATE

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

#: Bins of a quantity, each with as many transitions, and the fewest transitions that a bin has.
_BINS, _LEAST = 10, 8


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for what was added, cell by cell of the recording that was fitted.

    Parameters
    ----------
    nats : ndarray
        Log-likelihood that each measured number gains given those before it, shape (transition,
        cell), each model with its own noise, at its likeliest draw.
    bodies, dimensions : tuple of str
        Of each cell.
    body : str
        On which the first effect was added: that of ``speed`` and ``position``.
    speed : ndarray
        Of the body at the transition's start (m/s), shape (transition,).
    position : ndarray
        Of the body (m), shape (transition, 2).
    time : ndarray
        Since the trajectory's first row (s), shape (transition,).
    touching : ndarray of bool
        Whether bodies touch, shape (transition,).
    trajectory : ndarray of str
        Label of the trajectory, shape (transition,).
    wrench : ndarray
        Command on the body (N, N, N m), shape (transition, 3).
    """

    nats: Array
    bodies: tuple[str, ...]
    dimensions: tuple[str, ...]
    body: str
    speed: Array
    position: Array
    time: Array
    touching: NDArray[np.bool_]
    trajectory: NDArray[np.str_]
    wrench: Array

    @property
    def by_transition(self) -> Array:
        """Sum over the cells, shape (transition,)."""
        return np.asarray(self.nats.sum(axis=1))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cells: dimension and, of several bodies, body."""
        if len(set(self.bodies)) == 1:
            return self.dimensions
        return tuple(f"{d} of {body}" for d, body in zip(self.dimensions, self.bodies, strict=True))

    @property
    def by_cell(self) -> dict[str, float]:
        """Sum over the transitions, by cell, largest first."""
        sums = zip(self.names, self.nats.sum(axis=0).tolist(), strict=True)
        return dict(sorted(sums, key=lambda item: -item[1]))

    def in_words(self) -> str:
        """Say where the gain is largest, for a reader."""
        total, sums = float(self.nats.sum()), self.by_cell
        first = next(iter(sums))
        carriers = len(self.carriers())
        said = (
            f"The revised model makes the recording that was fitted {total:,.0f} nats likelier."
            f" The largest share is in {first} ({100 * sums[first] / total:.0f} %), and {carriers}"
            f" of {len(self.nats)} transitions hold 80 % of the gains."
        )
        return said if total > 0 else "The recording that was fitted is no likelier."

    def carriers(self, share: float = 0.8) -> Ints:
        """The fewest transitions that hold this share of the gains, largest first."""
        gains = self.by_transition
        order = np.argsort(-gains, kind="stable")
        total = np.cumsum(np.maximum(gains[order], 0.0))
        if total[-1] <= 0:
            return order[:0]
        return order[: int(np.searchsorted(total, share * total[-1])) + 1]


def find_evidence(findings: Loop, effects: Iterable[Effect]) -> Evidence | None:
    """Trace the gain of the revised model to the measured numbers that it comes from.

    None where nothing was added, or a posterior does not hold its recording.
    """
    if not findings.added or not recorded(findings.posterior_before, findings.posterior_after):
        return None
    effects = tuple(effects)
    after = problem_of(findings.posterior_after, effects)
    before = problem_of(findings.posterior_before, effects)
    nats = _log_density(after, findings.posterior_after)
    nats = nats - _log_density(before, findings.posterior_before)
    noise, segments = after.trajectory_noise, after.segments
    moving = [body.name for body in after.scene.moving]
    body = findings.added[0].body
    own = moving.index(body)
    states = segments.start[:, own]
    labels = after.data.history.dataset["trajectory"].to_numpy().astype(str)
    return Evidence(
        nats=nats,
        bodies=tuple(moving[place // len(STATE)] for place in noise.cells.places),
        dimensions=tuple(STATE[place % len(STATE)] for place in noise.cells.places),
        body=body,
        speed=np.hypot(states[:, 3], states[:, 4]),
        position=states[:, :2],
        time=np.asarray(segments.step * after.scene.time_step),
        touching=noise.touching,
        trajectory=labels[segments.trajectory],
        wrench=segments.actions[:, 0, own],
    )


def recorded(*posteriors: object) -> bool:
    """Whether posteriors hold what was recorded, of whole trajectories."""
    for posterior in posteriors:
        attrs = getattr(posterior, "attrs", {})
        if "scene" not in attrs or "smoothed" not in group(posterior, "constant_data"):
            return False
    return True


def _log_density(problem: Problem, posterior: Any) -> Array:
    """Log-likelihood of each measured number given those before it, shape (transition, cell)."""
    phi, sigma = likeliest(problem, posterior)
    noise = problem.trajectory_noise
    cells = -0.5 * problem.robust(phi, sigma) ** 2 - np.log(noise.scale(sigma))
    whole = problem.log_density(problem.residual(phi), sigma, phi)
    # the norm of the density, which is the same for all
    rest = (whole - np.where(noise.seen, cells, 0.0).sum(axis=1))[:, None]
    rest = rest / np.maximum(noise.seen.sum(axis=1, keepdims=True), 1)
    return np.where(noise.seen, cells + rest, 0.0)


def binned(x: Array) -> tuple[Ints, int]:
    """Bin of each value, of about as many values each, and how many bins there are."""
    wanted = int(np.clip(len(x) // _LEAST, 1, _BINS))
    edges = np.unique(np.quantile(x, np.linspace(0, 1, wanted + 1)[1:-1]))
    # equal values share a bin, so that some may be empty
    _, which = np.unique(np.searchsorted(edges, x, side="left"), return_inverse=True)
    return which, int(which.max()) + 1
