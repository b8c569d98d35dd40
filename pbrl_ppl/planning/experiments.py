"""Experiments: actions that separate effects which the data so far cannot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import EffectError, GoalError
from pbrl_ppl.files import write_atomically
from pbrl_ppl.history import segment_rows
from pbrl_ppl.planning.actions import ActionSet
from pbrl_ppl.planning.allowed import Allowed, Bounds, allowed_wrenches
from pbrl_ppl.planning.planner import start_state
from pbrl_ppl.planning.separation import Separation
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH, WRENCH_UNITS, Bools, Floats

#: A log Bayes factor from which one effect is named alone: half the score statistic's `DECISIVE`.
_NAMED = 5.0
#: Sequences of a generation, its parents, generations, and draws to rank them by.
_POPULATION, _PARENTS, _GENERATIONS, _ROUGH_DRAWS = 40, 10, 8, 3
#: Share of a child's pieces that are new; leaders that are ranked by all draws.
_NEW, _LEADERS = 0.2, 4
#: More than any separation (nats).
_MEETING = 1e9


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Experiment that is expected to separate rival effects.

    Attributes
    ----------
    scene : Scene
        Scene of the posterior.
    start : ndarray
        Initial state, shape (body, 6), SI units.
    wrenches : xarray.DataArray
        Dims (time, body, wrench), world frame, N and N m, each held for an interval.
    separation : xarray.DataArray
        Expected log Bayes factor of each effect, if it is the true one, over each rival: dims
        (true, rival), nats.
    at_random : float
        Mean over random sequences of the same set, for the weakest pair (nats).
    meeting : bool
        Whether bodies may meet, where models are rough.
    """

    scene: Scene
    start: Floats
    wrenches: xr.DataArray
    separation: xr.DataArray
    at_random: float
    meeting: bool

    @property
    def expected(self) -> float:
        """Expected log Bayes factor of the pair that is separated worst (nats)."""
        return float(_weakest(self.separation.to_numpy()))

    @property
    def decisive(self) -> bool:
        """Whether one effect alone is expected to be named afterwards."""
        return self.expected >= _NAMED

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the expected result."""
        time = self.scene.time_step * self.wrenches.sizes["time"]
        names = [str(name) for name in self.separation["true"].values]
        said = [
            f"if {true} is what is there, {time:g} s of these actions speak for it and against"
            f" {rival} with a log Bayes factor of {self.separation.values[i, j]:.3g} in the mean"
            for i, true in enumerate(names)
            for j, rival in enumerate(names)
            if i != j
        ]
        said.append(
            f"a random sequence of the same set: {self.at_random:.3g} in the mean, for the pair"
            " that is told apart worst"
        )
        if not self.decisive:
            times = int(np.ceil(_NAMED / max(self.expected, 1e-3)))
            more = f"repeat it {times} times, or " if times <= 20 else ""
            said.append(
                f"a factor of {_NAMED:g} names one effect alone, which is not to be expected:"
                f" {more}allow stronger actions, more steps or another start"
            )
        if self.meeting:
            said.append("bodies may meet on the way, where models are rough: keep them apart")
        return tuple(said)

    def to_dataframe(self) -> pd.DataFrame:
        """Return the experiment as rows of a history without measurements after the start."""
        wrenches = self.wrenches.to_numpy()[None]
        nothing = np.full((1, wrenches.shape[1], *self.start.shape), np.nan)
        return segment_rows(self.scene, self.start[None], wrenches, nothing)

    def to_csv(self, path: str | Path) -> None:
        """Write the experiment as a CSV file that a robot's script can play, whole or not at all.

        Raises
        ------
        OutputError
            If it cannot be written there.
        """
        table = self.to_dataframe()
        write_atomically(Path(path), lambda to: table.to_csv(to, index=False))


def suggest_actions(
    known: Any,
    start: Mapping[str, Sequence[float]] | ArrayLike,
    actions: ActionSet | Bounds | None = None,
    *,
    effects: Sequence[str] | None = None,
    steps: int = 20,
    hold: int | None = None,
    draws: int = 16,
    seed: int = 0,
    before: ArrayLike | None = None,
    catalogue: Iterable[Effect] = catalogue,
    progress: Callable[[str], None] | None = None,
) -> Suggestion:
    """Find the actions that best separate effects which the data so far cannot.

    Each rival effect is fitted to the recording that the posterior holds, so that it has the size
    that explains the data. Sequences from the allowed set are then ranked by the expected log Bayes
    factor: the Kullback-Leibler divergence between the predictions of two rivals, as a mean over
    posterior draws, in units of measurement and process noise, less what the rivals' parameters
    absorb. The worst of all pairs and both directions counts. The best sequence is found by a
    genetic algorithm. The noise is as in the posterior: a refit lets it take a part of the misfit,
    so that large factors come out smaller.

    Parameters
    ----------
    known : Loop, InferenceData or DataTree
        What :func:`pbrl_ppl.close_loop` found, or a posterior of whole trajectories, such as its
        ``after.nc``.
    start : mapping or array_like
        State of each body: ``{"cart": (x, y, theta)}`` at rest, or with ``vx, vy, omega``; or an
        array, shape (body, 6). SI units.
    actions : ActionSet or mapping, optional
        What is allowed: wrenches and durations, or bounds of each body such as
        ``{"cart": {"force_x": (-20, 20), "torque": (-2, 2)}}``, world frame, N and N m, where what
        is left out is 0. By default pushes as in the data; see :meth:`ActionSet.recorded`.
    effects : sequence of str, optional
        Two or more, such as ``spring`` or ``spring on cart``. By default the first group that the
        loop reported as not separable.
    steps : int
        Sampling intervals of the experiment.
    hold : int, optional
        Intervals for which a wrench within bounds is held; an eighth of ``steps`` by default.
    draws : int
        Posterior draws of each rival.
    seed : int
        The same seed gives the same sequence.
    before : array_like, optional
        Wrenches in the interval before the start, shape (body, 3), N and N m.
    catalogue : iterable of Effect
        Where the names of effects are looked up.
    progress : callable, optional
        Told how far the search is.

    Returns
    -------
    Suggestion
        The best sequence found, and what is to be expected of it.

    Raises
    ------
    EffectError
        If fewer than two effects are named, or one cannot be.
    GoalError
        If the start, the actions or the steps cannot be, or the engine diverges in all sequences.
    PosteriorError
        If the posterior is of single transitions, or holds fewer draws.

    Examples
    --------
    ::

        loop.added[0].not_separable_from  # ('quadratic_drag',)
        said = pp.suggest_actions(loop, {"cart": (0, 0, 0)}, {"cart": {"force_x": (-20, 20)}})
        said.sentences  # what is to be expected
        said.to_csv("next.csv")  # play it, record, and close the loop on both recordings
    """
    # with the samplers, which a plan does not need
    from pbrl_ppl.criticism import fit_rivals, kept_groups, named_effects
    from pbrl_ppl.posterior import scene_of

    say = progress or (lambda stage: None)
    posterior = getattr(known, "posterior_after", known)
    catalogue = tuple(getattr(known, "catalogue", catalogue))
    scene = scene_of(posterior)
    if effects is None:
        groups = kept_groups(posterior)
        if not groups:
            raise EffectError(
                "effects: the loop found none that its data cannot separate; name two or more,"
                " such as effects=('linear_drag', 'quadratic_drag')"
            )
        effects = groups[0]
    chosen = named_effects(effects, scene, catalogue)
    if steps < 1 or (hold is not None and hold < 1):
        raise GoalError(f"steps is {steps} and hold {hold}; both must be at least 1")
    first = start_state(scene, start)
    last = np.zeros((len(first), len(WRENCH)))
    if before is not None:
        last = np.asarray(before, dtype=float).reshape(last.shape)
    allowed = allowed_wrenches(
        scene, ActionSet.recorded(posterior) if actions is None else actions, steps, hold
    )
    # matrices are small: threads of linear algebra only get in each other's way
    with threadpool_limits(1, "blas"):
        say("fitting each effect to the recording")
        rivals = fit_rivals(posterior, chosen, catalogue, draws, seed)
        judge = Separation(rivals, first, last)
        genes, at_random = _bred(judge, allowed, np.random.default_rng(seed), say)
        say("judging the best sequences")
        wrenches = allowed.wrenches(genes, judge.path)
        found, meeting = judge(wrenches, draws)
    best = int(np.argmax(_value(found, meeting)))
    if not np.isfinite(found[..., best]).all():
        raise GoalError(
            "actions: the engine diverges in all sequences; allow weaker actions or fewer steps"
        )
    names = [rival.name for rival in rivals]
    return Suggestion(
        scene,
        first,
        xr.DataArray(
            wrenches[best],
            {
                "time": ("time", scene.time_step * np.arange(steps), {"units": "s"}),
                "body": [body.name for body in scene.moving],
                "wrench": list(WRENCH),
            },
            ("time", "body", "wrench"),
            attrs={"units": ", ".join(WRENCH_UNITS)},
        ),
        xr.DataArray(
            found[..., best], {"true": names, "rival": names}, ("true", "rival"),
            attrs={"units": "nats"},
        ),
        at_random,
        bool(meeting[best]),
    )  # fmt: skip


def _bred(
    judge: Separation, allowed: Allowed, rng: np.random.Generator, say: Callable[[str], None]
) -> tuple[Floats, float]:
    """Return the leading sequences of the last generation, and the mean value of the first.

    Children take pieces from two parents, and some from the allowed set.
    """
    genes = allowed.random(rng, _POPULATION)
    at_random, parents, values = np.nan, genes[:0], np.zeros(0)
    for generation in range(_GENERATIONS):
        say(f"looking for actions that tell them apart, {generation + 1} of {_GENERATIONS}")
        found, meeting = judge(allowed.wrenches(genes, judge.path), _ROUGH_DRAWS)
        if generation == 0:
            usable = _weakest(found)
            at_random = float(np.nanmean(usable)) if np.isfinite(usable).any() else np.nan
        genes = np.concatenate([parents, genes])
        values = np.concatenate([values, _value(found, meeting)])
        best = np.argsort(-values, kind="stable")[:_PARENTS]
        parents, values = genes[best], values[best]
        pairs = rng.integers(_PARENTS, size=(2, _POPULATION))
        shape = (_POPULATION, allowed.pieces)
        mixed = np.where(
            _wide(rng.random(shape) < 0.5, genes), parents[pairs[0]], parents[pairs[1]]
        )
        fresh = allowed.extreme(rng, _POPULATION)
        genes = np.where(_wide(rng.random(shape) < _NEW, genes), fresh, mixed)
    return parents[:_LEADERS], at_random


def _wide(mask: Bools, genes: Floats) -> Bools:
    return mask.reshape(*mask.shape, *(1,) * (genes.ndim - 2))


def _weakest(separation: Floats) -> Floats:
    """Return the least of all pairs and directions, (true, rival, ...) -> (...)."""
    off = ~np.eye(len(separation), dtype=bool)
    return np.asarray(separation[off].min(axis=0))


def _value(separation: Floats, meeting: Bools) -> Floats:
    """Return what sequences are ranked by: those in which bodies meet come last."""
    value = _weakest(separation)
    return np.where(np.isfinite(value), value - np.where(meeting, _MEETING, 0.0), -np.inf)
