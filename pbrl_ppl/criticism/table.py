"""Table of models on pieces of one length: each set of laws is fitted once and has one number."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pbrl_ppl.effects import Attached
from pbrl_ppl.likelihood import LikelihoodT, Problem, is_independent, is_simulated
from pbrl_ppl.modes import Mode, find_mode, fit_pieces, is_simulated_mode
from pbrl_ppl.parameters import inside, prior_residual, prior_slopes, stepped
from pbrl_ppl.scene import state_sizes
from pbrl_ppl.state import Bools, Floats
from pbrl_ppl.system.threads import Say, in_parallel, silent


def moving(mode: Mode, *, still: float = 1e-4) -> Bools:
    """Return which dimensions move by more than a share of their natural size, shape (state,)."""
    observations = mode.problem.observations
    natural = state_sizes(mode.problem.scene)[list(observations.columns)]
    return np.asarray(np.nanstd(observations.values, axis=(0, 1, 2)) > still * natural)


def weights(mode: Mode) -> Floats:
    """Return the effective number of measurements of each dimension, shape (state,).

    A dimension that does not move counts for none.
    """
    observations = mode.problem.observations
    counts = mode.problem.likelihood.counts(observations)
    if is_independent(mode.problem):  # few transitions can be followed by the parameters
        followed = np.einsum("ij,jk,ik", mode.jacobian, mode.covariance, mode.jacobian)
        counts = counts * max(1.0 - float(followed) / max(float(counts.sum()), 1.0), 1e-3)
    return np.where(moving(mode), counts, 0.0)


def log_error(mode: Mode) -> Floats:
    """Return the logarithm of a mode's errors, finite where nothing moves, shape (state,)."""
    return np.asarray(np.log(np.maximum(mode.sigma, 1e-300)))


def shown_fall(falls: Floats, weight: Floats, *, least: float = 0.01) -> Floats:
    """Return the mean fall of errors' logarithms over the dimensions that show one, shape (...).

    An angle at its noise does not count beside positions that a wind moves: where an error changes
    by less than the share ``least`` a dimension shows nothing. ``falls`` has shape (..., state),
    ``weight`` (state,).
    """
    shown = np.where(np.abs(falls) > least, weight, 0.0)
    mean: Floats = (shown * falls).sum(axis=-1) / np.maximum(shown.sum(axis=-1), 1.0)
    return mean


def share(before: Mode, after: Mode, weight: Floats) -> float:
    """Return the share of the error that a model takes off, over dimensions of some weights.

    Of the root mean square, where it is shown; ``weight`` has shape (state,).
    """
    return 1.0 - float(np.exp(-shown_fall(log_error(before) - log_error(after), weight)))


def informed(mode: Mode, *, most: float = 0.7) -> Bools:
    """Return which parameters have a posterior of less than a share of the prior's width, (p,)."""
    width = np.sqrt(np.maximum(np.diag(mode.covariance), 0.0))
    return np.asarray(width * np.abs(prior_slopes(mode.problem.layout.priors, mode.phi)) < most)


def sizes_of(mode: Mode, law: Attached) -> Floats:
    """Return the parameters of a law at a mode, shape (q,)."""
    return mode.phi[mode.problem.layout.places(law.labels)]


def far_out(mode: Mode, laws: Iterable[Attached]) -> float:
    """Return how many prior scales the sizes of laws lie from their priors' centres, at most.

    Of an angle that may be any, how many turns. A factor of nearly nothing is not far: what acts no
    more is a plain fault.
    """
    layout = mode.problem.layout
    places = [place for law in laws for place in layout.places(law.labels)]
    turns = [
        abs(mode.phi[place]) / (2.0 * np.pi)
        for place in places
        if layout.priors[place].family == "von_mises"
    ]
    off = prior_residual(layout.priors, mode.phi)[places]
    factor = np.array([layout.priors[place].family == "log_normal" for place in places], bool)
    return float(max(np.where(factor, off, np.abs(off)).max(initial=0.0), *turns, 0.0))


def with_effects(
    mode: Mode[LikelihoodT], effects: tuple[Attached, ...], begin: Mapping[str, float] | None = None
) -> tuple[Problem[LikelihoodT], Floats]:
    """Return a mode's problem with other effects, and where a search for its mode begins.

    Parameters
    ----------
    mode : Mode
        A mode of the model with the effects so far.
    effects : tuple of Attached
        All effects of the new model.
    begin : mapping of str to float, optional
        Where parameters begin, by their labels; by default at the mode, or the prior's centre.
    """
    problem = mode.problem.with_physics(effects=effects)
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    begin = begin or {}
    phi[layout.places(begin)] = [*begin.values()]
    return problem, inside(layout.priors, phi)


def refit(
    mode: Mode, effects: tuple[Attached, ...], begin: Mapping[str, float], rounds: int = 8
) -> Mode:
    """Return the mode with other effects, under the same likelihood, by so many ``rounds``.

    It is climbed from where parameters may ``begin``, by their labels, from there with new ones
    alone, or from a part of the way: the best of these.
    """
    known = {*mode.problem.layout.labels}
    # where the engine diverges a regression has no size
    begin = {label: value for label, value in begin.items() if np.isfinite(value)}
    new = {label: value for label, value in begin.items() if label not in known}
    problem, phi = with_effects(mode, effects, new)
    if is_simulated(problem):
        return fit_pieces(problem, _best_start(mode, effects, phi, begin), rounds, **_CLIMB)
    # what a lacking model's parameters have made up for is far from where they are with the law
    centre = np.array([prior.centre for prior in problem.layout.priors])
    centre[problem.layout.places(new)] = [*new.values()]
    modes = [find_mode(problem, initial=first) for first in (phi, centre)]
    return max(modes, key=lambda one: one.log_posterior)


def _best_start(
    mode: Mode, effects: tuple[Attached, ...], phi: Floats, begin: Mapping[str, float]
) -> Floats:
    """Return the best of some points to begin a climb at, shape (p,)."""
    layout = mode.problem.layout
    step = [begin.get(label, now) - now for label, now in zip(layout.labels, mode.phi, strict=True)]
    known = zip(layout.labels, stepped(layout.priors, mode.phi, np.array(step)), strict=True)
    moved = {**begin, **{label: float(value) for label, value in known if label in begin}}
    problem, joint = with_effects(mode, effects, moved)
    if np.array_equal(phi, joint):
        return phi
    nothing = {
        label: value
        for one in effects
        if one.effect.scan is None and not {*one.labels} <= {*layout.labels}
        for label, value in zip(one.labels, one.effect.null, strict=True)
    }
    _, least = with_effects(mode, effects, nothing)
    points = np.array([phi, joint, *(least + part * (joint - least) for part in (0.3, 0.1))])
    left = np.nan_to_num(problem.medium.whitened(points, mode.sigma), nan=1e6)
    prior_cost = np.array([prior_residual(problem.layout.priors, point) for point in points])
    cost = (left**2).reshape(len(points), -1).sum(axis=1) + (prior_cost**2).sum(axis=1)
    return np.asarray(points[int(np.argmin(cost))])


#: A climb of a refit: it ends at a gain of 1 nat.
_CLIMB: dict[str, Any] = {"tolerance": 1.0, "n_steps": 1, "dampings": (0.1, 10.0, 1e3)}


@dataclass(eq=False)
class Table:
    """Models of one recording on pieces of one length, by their laws; each is fitted once.

    Parameters
    ----------
    declared : tuple of Attached
        Effects that the scene declares: all others are laws.
    tried : int
        Candidates that a law is chosen from.
    points : dict of Attached to int
        Grid points that a law was chosen from, where it has a scan.
    modes : dict of frozenset to Mode
        The models by their laws.
    behind : dict of frozenset to Mode
        Models that were given up in a race.
    """

    declared: tuple[Attached, ...]
    tried: int
    points: dict[Attached, int] = field(default_factory=dict)
    modes: dict[frozenset[Attached], Mode] = field(default_factory=dict)
    behind: dict[frozenset[Attached], Mode] = field(default_factory=dict)

    def laws(self, mode: Mode) -> tuple[Attached, ...]:
        """Return the laws of a model."""
        return tuple(one for one in mode.problem.physics.effects if one not in self.declared)

    def fitted(
        self, near: Mode, laws: Collection[Attached], begin: Mapping[str, float] | None = None
    ) -> Mode:
        """Return the model with these laws alone, fitted from another model if it is new.

        ``begin``: where its parameters begin, by their labels; by default where they are.
        """
        key = frozenset(laws)
        if key not in self.modes:
            self.modes[key] = self._refitted(near, laws, begin or {})
        return self.modes[key]

    def _refitted(
        self, near: Mode, laws: Collection[Attached], begin: Mapping[str, float], rounds: int = 8
    ) -> Mode:
        """Return a model, climbed on where it was given up."""
        behind = self.behind.pop(frozenset(laws), None)
        if behind is not None and is_simulated_mode(behind):
            return fit_pieces(behind.problem, behind.phi, rounds, **_CLIMB)
        effects = tuple(one for one in near.problem.physics.effects if one in laws)
        # not in the order of a set, which differs from run to run
        new = sorted((one for one in laws if one not in effects), key=lambda one: one.labels)
        return refit(near, (*self.declared, *effects, *new), begin, rounds)

    def race(
        self,
        near: Mode,
        moves: Mapping[frozenset[Attached], Mapping[str, float]],
        say: Say = silent,
    ) -> None:
        """Fit models at once, from where their parameters begin, by their labels.

        Those that are 30 nats behind the best after two rounds are given up, others take at most
        eight.
        """
        told = f"refitting models on pieces of {near.problem.data.horizon} rows", say

        def fits(keys: list[frozenset[Attached]], most: int) -> dict[frozenset[Attached], Mode]:
            """Return models in the order of their keys, not that in which threads end."""
            modes = in_parallel(
                lambda key: self._refitted(near, key, moves[key], most), keys, *told
            )
            return dict(zip(keys, modes, strict=True))

        new = [key for key in moves if key not in self.modes]
        if not is_simulated_mode(near) or len(new) < 2:
            self.modes |= fits(new, 8)
            return
        self.behind |= fits([key for key in new if key not in self.behind], 2)
        self.modes |= (tried := {key: self.behind[key] for key in new})
        values = {key: self.value(mode) for key, mode in tried.items()}
        least = max(*values.values(), self.value(near)) - 30.0
        for key in new:
            del self.modes[key]
        self.modes |= fits([key for key in new if values[key] >= least], 8)

    def without(self, mode: Mode, law: Attached) -> Mode:
        """Return a model without a law."""
        return self.fitted(mode, [one for one in self.laws(mode) if one != law])

    @property
    def weight(self) -> Floats:
        """Measurements over the autocorrelation times of the best model, shape (state,)."""
        moves = moving(next(iter(self.modes.values())))
        best = min(self.modes.values(), key=lambda mode: float(log_error(mode)[moves].sum()))
        return weights(best)

    def value(self, mode: Mode) -> float:
        """Return the log-evidence of a model at its mode with the prior odds of its laws (nats).

        Half a log n is paid for each parameter of a law that the data inform or that is scanned.
        """
        weight, laws, layout = self.weight, self.laws(mode), mode.problem.layout
        narrow = informed(mode)
        count = sum(
            law.effect.scan is not None or bool(narrow[place])
            for law in laws
            for place in layout.places(law.labels)
        )
        prior = 0.5 * float((prior_residual(layout.priors, mode.phi) ** 2).sum())
        odds = sum(
            law.effect.log_odds - np.log(self.tried * self.points.get(law, 1)) for law in laws
        )
        fit = -float((weight * log_error(mode)).sum())
        return float(fit - 0.5 * count * np.log(max(weight.sum(), 2.0)) - prior + odds)

    def shares(self, mode: Mode, large: float) -> Iterator[tuple[Attached, float]]:
        """Yield each law and the share of the error that it takes off, about the smallest first.

        Two laws that replace each other in part are missed little alone: what both take off
        together is divided in proportion. That is asked of laws with less than a ``large`` share.
        """
        weight, laws = self.weight, self.laws(mode)

        def fall(*gone: Attached) -> float:
            rest = self.fitted(mode, [one for one in laws if one not in gone])
            return max(-float(np.log1p(-min(share(rest, mode, weight), 1.0 - 1e-9))), 1e-6)

        alone = {law: fall(law) for law in laws}
        for law, own in sorted(alone.items(), key=lambda one: one[1]):
            most = own
            if own < -np.log1p(-large):
                parts = (
                    fall(law, other) * own / (own + alone[other]) for other in laws if other != law
                )
                most = max(own, *parts, 0.0)
            yield law, -float(np.expm1(-most))

    def rivals(self, mode: Mode, law: Attached, within: float) -> tuple[Attached, ...]:
        """Return laws with which, in the place of one, a model is as good within some nats."""
        rest, least = {*self.laws(mode)} - {law}, self.value(mode) - within
        return tuple(
            other
            for key, fitted in self.modes.items()
            if len(key) == len(rest) + 1 and rest < key and law not in key
            for other in key - rest
            if self.value(fitted) > least
        )
