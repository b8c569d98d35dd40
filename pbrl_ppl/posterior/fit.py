"""Fitted model: the problem that was sampled and its posterior."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.posterior.completion import parameter_draws
from pbrl_ppl.posterior.data import problem_of
from pbrl_ppl.posterior.record import PosteriorRecord
from pbrl_ppl.posterior.store import Idata, best_draw
from pbrl_ppl.state import Floats


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Parameters
    ----------
    problem : Problem
        What was sampled; trajectories are linearised as in the posterior.
    posterior : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.
    """

    problem: Problem
    posterior: Idata

    @classmethod
    def of(cls, posterior: Fit | Idata, effects: Iterable[Effect] = catalogue) -> Fit:
        """Return the fit that a posterior holds; one that is a fit already is returned itself.

        Parameters
        ----------
        posterior : InferenceData, DataTree or Fit
            As made by :func:`pbrl_ppl.fit`.
        effects : iterable of Effect
            Where the names of its effects are looked up.

        Raises
        ------
        PosteriorError
            If it has another schema version or lacks a group.
        EffectError
            If an effect is not among ``effects``.
        """
        if isinstance(posterior, Fit):
            return posterior
        return cls(problem_of(posterior, effects), posterior)

    @cached_property
    def record(self) -> PosteriorRecord:
        """The record of the fit: model, data, method and diagnostics."""
        return PosteriorRecord.of(self.posterior)

    @cached_property
    def draws(self) -> tuple[Floats, Floats]:
        """Posterior draws as vectors: phi, shape (draw, p), and sigma, shape (draw, parameter)."""
        return parameter_draws(self.problem, self.posterior)

    @cached_property
    def best(self) -> tuple[Floats, Floats]:
        """The draw of the highest density: phi, shape (p,), and sigma, shape (parameter,)."""
        phi, sigma = self.draws
        place = best_draw(self.posterior)
        return phi[place], sigma[place]
