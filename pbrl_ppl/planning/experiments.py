"""Experiments: rival models that a recording cannot separate, and actions that separate them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from pbrl_ppl.criticism import Loop, rank_candidates, with_effects
from pbrl_ppl.effects import Attached, Effect, Noise, catalogue
from pbrl_ppl.errors import EffectError, GoalError, PosteriorError
from pbrl_ppl.likelihood import is_independent
from pbrl_ppl.modes import FilteredMode, trajectory_mode
from pbrl_ppl.parameters import differentiate
from pbrl_ppl.physics import touching
from pbrl_ppl.planning.dynamics import Dynamics, predicted_path, remembered
from pbrl_ppl.planning.goals import ActionSet, Allowed, Bounds, allowed_wrenches
from pbrl_ppl.planning.planner import labelled, start_state, table_of_plan
from pbrl_ppl.posterior import Fit, Idata, scene_of, stored_fields
from pbrl_ppl.scene import Scene, body_sizes, nearest
from pbrl_ppl.state import WRENCH_UNITS, Bools, Floats
from pbrl_ppl.system.files import write_atomically
from pbrl_ppl.system.threads import Say, one_blas_thread, silent


@dataclass(frozen=True, eq=False)
class Rival:
    """A model with one effect of a group, fitted to the recording that they all explain.

    Parameters
    ----------
    mode : FilteredMode
        Of the model with this effect and without the others, fitted to whole trajectories.
    draws : ndarray
        Draws from its posterior, shape (draw, p).
    sigma : ndarray
        Noise parameters of the model that all rivals come from, shape (parameter,).
    """

    mode: FilteredMode
    draws: Floats
    sigma: Floats


def kept_groups(posterior: Idata) -> list[tuple[str, ...]]:
    """Return the groups of effects that a posterior's recording cannot separate."""
    return list(stored_fields(posterior, ("not_separable",)).get("not_separable", ()))


def named_effects(
    names: Sequence[str], scene: Scene, catalogue: Iterable[Effect]
) -> list[Attached]:
    """Return effects on bodies by names such as ``spring``, or ``spring on cart``.

    Raises
    ------
    EffectError
        If there are fewer than two, one is unknown, does not apply, or is an effect of the noise;
        or if the body is left out and there are several.
    """
    by_name = {effect.name: effect for effect in catalogue}
    named: list[Attached] = []
    for text in names:
        name, _, body = (part.strip() for part in text.partition(" on "))
        if name not in by_name:
            raise EffectError(f"effect {name!r} is not in the catalogue{nearest(name, by_name)}")
        effect = by_name[name]
        bodies = [one.name for one in scene.dynamic if effect.applies(scene, one)]
        if body and body not in bodies:
            raise EffectError(f"effect {name} does not apply to body {body!r}, only to {bodies}")
        if not body and len(bodies) != 1:
            raise EffectError(f"effect {name} may act on {bodies}; say which: '{name} on BODY'")
        if isinstance(effect.stage, Noise):
            raise EffectError(
                f"effect {name} is of the noise: experiments cannot identify noise effects"
            )
        attached = effect.on(body or bodies[0]).in_si(scene)
        if attached not in named:
            named.append(attached)
    if len(named) < 2:
        raise EffectError(
            f"effects: got {list(names)}, expected two or more to separate, such as"
            " linear_drag and quadratic_drag"
        )
    return named


def fit_rivals(
    posterior: Idata,
    effects: Sequence[Attached],
    catalogue: Iterable[Effect],
    draws: int,
    seed: int,
) -> list[Rival]:
    """Fit a model with each of several effects to the recording that a posterior holds.

    The posterior's model keeps its draws; the others are drawn from the Gaussian at the mode.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        A posterior of whole trajectories.
    effects : sequence of Attached
        The effects; each model has one.
    catalogue : iterable of Effect
        Where the names of the posterior's effects are looked up.
    draws : int
        Number of draws from each model.
    seed : int
        Seed of the draws.

    Raises
    ------
    PosteriorError
        If the posterior is of single transitions, or holds fewer draws.
    """
    fit = Fit.of(posterior, catalogue)
    problem, phi = fit.problem.with_physics(threads=2), fit.draws[0]
    if is_independent(problem):
        raise PosteriorError(
            "posterior: it is of single transitions, which do not separate measurement noise from"
            " process noise; take after.nc of close_loop, or fit whole trajectories"
        )
    if not 1 <= draws <= len(phi):
        raise PosteriorError(f"posterior: {draws} draws were asked for, expected 1 to {len(phi)}")
    # found from the draw of the highest density
    declared, rng = trajectory_mode(problem, *fit.best), np.random.default_rng(seed)
    present = [one for one in problem.physics.effects if one in effects]
    base = declared
    if present:
        others = tuple(one for one in problem.physics.effects if one not in effects)
        base = trajectory_mode(*with_effects(declared, others), declared.sigma)
    fits = []
    for attached in effects:
        if present == [attached]:
            chosen = phi[rng.choice(len(phi), draws, replace=False)]
            fits.append(Rival(declared, chosen, declared.sigma))
            continue
        (signature,) = rank_candidates(base, [attached])
        sizes = dict(zip(attached.labels, signature.candidate.estimate.values(), strict=True))
        start = with_effects(base, (*base.problem.physics.effects, attached), sizes)
        mode = trajectory_mode(*start, base.sigma)
        fits.append(Rival(mode, mode.draws(rng, draws), declared.sigma))
    return fits


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

    @classmethod
    def of(cls, dynamics: Dynamics, start: Floats, wrenches: Floats) -> _Paths:
        """Return the paths of each draw from a state under wrenches (n, time, body, 3)."""
        states = predicted_path(dynamics, start, wrenches)
        lost = np.asarray(~np.isfinite(states).all(axis=(2, 3, 4)))
        states[lost] = start
        last = np.broadcast_to(dynamics.before, (len(wrenches), *dynamics.before.shape))
        earlier = np.moveaxis(wrenches, 1, 0)[:-1]
        past = accumulate(earlier, lambda last, wrench: remembered(wrench, last), initial=last)
        begin, end = (
            part.reshape(-1, *start.shape) for part in (states[:, :, :-1], states[:, :, 1:])
        )
        played, before = (
            np.tile(one, (dynamics.draws, 1, 1, 1)).reshape(-1, *one.shape[2:])
            for one in (wrenches, np.stack(list(past), axis=1))
        )
        return cls(begin, end, played, before, wrenches.shape[1], lost.ravel())


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

    Attributes
    ----------
    dynamics : list of Dynamics
        Those of each rival at its mode.
    """

    def __init__(self, rivals: Sequence[Rival], start: Floats) -> None:
        self.rivals, self.start = rivals, start
        # the rivals differ in the effects that bodies declare
        scene = rivals[0].mode.problem.scene
        self.scene = scene.replace(bodies=tuple(replace(body, effects=()) for body in scene.bodies))
        self.dynamics = []
        for mode in (rival.mode for rival in rivals):
            # steps an interval at most: models are compared with each other, in the same engine
            steps, effects = min(10, mode.problem.physics.substeps), mode.problem.physics.effects
            one = Dynamics(self.scene, mode.phi, effects, substeps=steps, declared=())
            self.dynamics.append(one)

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
            paths = _Paths.of(self.dynamics[i].at(true.draws[:draws]), self.start, wrenches)
            met = touching(self.scene, paths.begin, paths.end)
            meeting |= met.reshape(-1, n, paths.intervals).any(axis=(0, 2))
            misfit, widening = zip(*(self._explained(j, paths, met) for j in range(m)), strict=True)
            for j in set(range(m)) - {i}:
                value = 0.5 * (misfit[j] + widening[j] - widening[i])
                value[paths.lost] = np.nan
                result[i, j] = value.reshape(-1, n).mean(axis=0)
        return result, meeting

    def _explained(self, number: int, paths: _Paths, met: Bools) -> tuple[Floats, Floats]:
        """Return how a rival explains the paths of another, two arrays of shape (path,).

        Squared whitened residual less what the parameters absorb, in excess of what they absorb of
        noise; and log-determinant of the predictions' widening by the parameters.
        """
        rival = self.rivals[number]
        mode, problem = rival.mode, rival.mode.problem
        coordinates, bounds = problem.likelihood.noise.coordinates, problem.layout.bounds

        def predict(phi: Floats, states: Floats) -> Floats:
            """Return the states after an interval, shape (point, transition, body, 6)."""
            begin = np.broadcast_to(states, (len(phi), *paths.begin.shape))
            dynamics = self.dynamics[number].at(phi)
            return np.nan_to_num(dynamics.step(begin, paths.wrenches, paths.before))

        def by_phi(points: Floats) -> Floats:
            return coordinates.of(predict(points, paths.begin))

        def by_state(states: Floats) -> Floats:
            return predict(np.tile(mode.phi, (len(states), 1)), states)

        residual = coordinates.wrapped(coordinates.of(paths.end) - by_phi(mode.phi[None])[0])
        # in posterior standard deviations
        steps = 0.3 * np.sqrt(np.maximum(np.diag(mode.covariance), 0.0))
        slopes = differentiate(by_phi, mode.phi, steps, *bounds)
        natural = body_sizes(problem.scene).ravel()[coordinates.places]
        size = np.maximum(coordinates.errors(rival.sigma), 1e-6 * natural)
        slope = coordinates.slopes(problem.scene, paths.begin, size, by_state)
        nothing = np.zeros(residual.shape)
        noise = replace(
            problem.likelihood.noise,
            slope=np.ascontiguousarray(slope),
            first=np.arange(len(residual)) % paths.intervals == 0,
            seen=np.tile(problem.likelihood.noise.seen.any(axis=0), (len(residual), 1)),
            measured=nothing,
            begin=nothing,
            initial_variance=nothing,
            sigma=rival.sigma,
            touching=met,
            sensitivity=None,
        )
        rows = np.concatenate([residual[None], -np.moveaxis(slopes, -1, 0)])
        white = noise.filtered(rows, rival.sigma)[0].reshape(len(rows), len(paths.lost), -1)
        r, jacobian = white[0], np.moveaxis(white[1:], 0, -1)
        scaled = jacobian @ mode.factor  # by a posterior standard deviation of each direction
        precision = np.eye(len(mode.phi)) + scaled.transpose(0, 2, 1) @ scaled
        inverse = np.linalg.inv(precision)
        shared = np.einsum("nap,na->np", scaled, r)
        absorbed = np.einsum("np,npq,nq->n", shared, inverse, shared)
        of_noise = len(mode.phi) - np.trace(inverse, axis1=1, axis2=2)
        return (r**2).sum(axis=1) - absorbed - of_noise, np.linalg.slogdet(precision)[1]


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
    naming : float
        Log Bayes factor from which one effect is named alone: half the ``decisive`` score statistic
        of the criteria.
    """

    scene: Scene
    start: Floats
    wrenches: xr.DataArray
    separation: xr.DataArray
    at_random: float
    meeting: bool
    naming: float = 5.0

    @property
    def expected(self) -> float:
        """Expected log Bayes factor of the pair that is separated worst (nats)."""
        return float(_weakest(self.separation.to_numpy()))

    @property
    def decisive(self) -> bool:
        """Whether one effect alone is expected to be named afterwards."""
        return self.expected >= self.naming

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
            " that is separated worst"
        )
        if not self.decisive:
            times = int(np.ceil(self.naming / max(self.expected, 1e-3)))
            more = f"repeat it {times} times, or " if times <= 20 else ""
            said.append(
                f"a factor of {self.naming:g} names one effect alone, which is not to be expected:"
                f" {more}allow stronger actions, more steps or another start"
            )
        if self.meeting:
            said.append("bodies may meet on the way, where models are rough: keep them apart")
        return tuple(said)

    def to_dataframe(self) -> pd.DataFrame:
        """Return the experiment as rows of a history without measurements after the start."""
        return table_of_plan(self.scene, self.start, self.wrenches.to_numpy())

    def to_csv(self, path: str | Path) -> None:
        """Write the experiment as a CSV file that a robot's script can play, whole or not at all.

        Raises
        ------
        OutputError
            If it cannot be written there.
        """
        write_atomically(Path(path), lambda to: self.to_dataframe().to_csv(to, index=False))


@one_blas_thread
def suggest_actions(
    known: Loop | Idata,
    start: Mapping[str, Sequence[float]] | ArrayLike,
    actions: ActionSet | Bounds | None = None,
    *,
    effects: Sequence[str] | None = None,
    steps: int = 20,
    draws: int = 16,
    seed: int = 0,
    catalogue: Iterable[Effect] = catalogue,
    progress: Say | None = None,
) -> Suggestion:
    """Find the actions that best separate effects that are confounded in the data so far.

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
        Sampling intervals of the experiment; a wrench within bounds is held for an eighth of them.
    draws : int
        Posterior draws of each rival.
    seed : int
        The same seed gives the same sequence.
    catalogue : iterable of Effect
        Where the names of effects are looked up.
    progress : callable, optional
        Called with a text on the progress of the search.

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
    if isinstance(known, Loop):
        catalogue, known = known.catalogue, known.posterior_after
    posterior, catalogue, progress = known, tuple(catalogue), progress or silent
    scene = scene_of(posterior)
    if effects is None and not (groups := kept_groups(posterior)):
        raise EffectError(
            "effects: the loop found none that its data cannot separate; name two or more,"
            " such as effects=('linear_drag', 'quadratic_drag')"
        )
    effects = groups[0] if effects is None else effects
    chosen = named_effects(effects, scene, catalogue)
    if steps < 1:
        raise GoalError(f"steps is {steps}; it must be at least 1")
    first = start_state(scene, start)
    actions = ActionSet.recorded(posterior) if actions is None else actions
    allowed = allowed_wrenches(scene, actions, steps)
    progress("fitting each effect to the recording")
    rivals = fit_rivals(posterior, chosen, catalogue, draws, seed)
    judge = Separation(rivals, first)
    genes, at_random = _evolved(judge, allowed, np.random.default_rng(seed), progress)
    progress("judging the best sequences")
    wrenches = allowed.wrenches(genes, judge.dynamics[0], judge.start)
    separation, meeting = judge(wrenches, draws)
    best = int(np.argmax(_value(separation, meeting)))
    if not np.isfinite(separation[..., best]).all():
        raise GoalError(
            "actions: the engine diverges in all sequences; allow weaker actions or fewer steps"
        )
    names = [f"{one.effect.name} on {one.body}" for one in chosen]
    pairs = {"true": names, "rival": names}
    nats = xr.DataArray(separation[..., best], pairs, (*pairs,), attrs={"units": "nats"})
    played = labelled(scene, wrenches[best], ("time", "body", "wrench"))
    played.attrs["units"] = ", ".join(WRENCH_UNITS)
    return Suggestion(scene, first, played, nats, at_random, bool(meeting[best]))


def _evolved(
    judge: Separation, allowed: Allowed, rng: np.random.Generator, progress: Say
) -> tuple[Floats, float]:
    """Return the leading sequences of the last generation, and the mean value of the first.

    Children take pieces from two parents, and a fifth of them new from the allowed set.
    """
    population, n_parents, generations = 40, 10, 8
    genes = allowed.random(rng, population)
    at_random, parents, values = np.nan, genes[:0], np.zeros(0)
    # a piece of a sequence is taken whole
    shape = (population, allowed.pieces, *(1,) * (genes.ndim - 2))
    for generation in range(generations):
        progress(f"looking for actions that tell them apart, {generation + 1} of {generations}")
        wrenches = allowed.wrenches(genes, judge.dynamics[0], judge.start)
        separation, meeting = judge(wrenches, draws=3)
        if generation == 0:
            usable = _weakest(separation)
            at_random = float(np.nanmean(usable)) if np.isfinite(usable).any() else np.nan
        genes = np.concatenate([parents, genes])
        values = np.concatenate([values, _value(separation, meeting)])
        best = np.argsort(-values, kind="stable")[:n_parents]
        parents, values = genes[best], values[best]
        pairs = rng.integers(n_parents, size=(2, population))
        mixed = np.where(rng.random(shape) < 0.5, parents[pairs[0]], parents[pairs[1]])
        fresh = allowed.extreme(rng, population)
        genes = np.where(rng.random(shape) < 0.2, fresh, mixed)
    return parents[:4], at_random


def _weakest(separation: Floats) -> Floats:
    """Return the least of all pairs and directions, (true, rival, ...) -> (...)."""
    off = ~np.eye(len(separation), dtype=bool)
    return np.asarray(separation[off].min(axis=0))


def _value(separation: Floats, meeting: Bools) -> Floats:
    """Return what sequences are ranked by: those in which bodies meet come last."""
    value = _weakest(separation)
    return np.where(np.isfinite(value), value - 1e9 * meeting, -np.inf)
