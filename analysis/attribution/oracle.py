"""The oracle: knows what is hidden, and says whether the data show it at all."""

from __future__ import annotations

from dataclasses import dataclass, field

from scipy.stats import chi2

import pbrl_ppl as pp
from attribution.cases import OUTSIDE, Case
from attribution.outside import OUTSIDE_EFFECTS, parameters_of
from pbrl_ppl.criticism.forecast import forecast
from pbrl_ppl.criticism.held_out import HeldOut
from pbrl_ppl.criticism.resolution import with_enough_substeps
from pbrl_ppl.effects import Attached, attach
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import Mode, find_mode, trajectory_mode
from pbrl_ppl.parameters import inside

#: Chance alone gives what the oracle calls detected less often than this.
CERTAIN = 1e-4


@dataclass(frozen=True)
class Oracle:
    """Likelihood-ratio test of the effect that is hidden, its size free.

    Parameters
    ----------
    statistic : float
        Twice the gain in log-likelihood from adding it to the declared model.
    p_value : float
        With as many degrees of freedom as it has parameters.
    rollout_rmse : dict of str to float
        Errors of forecasts on the trajectories to judge by, of the model with the effect, as in
        ``report.json``.
    """

    statistic: float
    p_value: float
    rollout_rmse: dict[str, float] = field(default_factory=dict)

    @property
    def detects(self) -> bool:
        """Whether the data show the effect to one who knows it."""
        return self.p_value < CERTAIN


def true_effect(case: Case) -> pp.Effect:
    """The effect that is hidden in a case's data."""
    if case.kind == OUTSIDE:
        return OUTSIDE_EFFECTS[str(case.effect)]
    (effect,) = (each for each in pp.catalogue if each.name == case.effect)
    return effect


def true_parameters(case: Case) -> dict[str, float]:
    """What is hidden, as the effect's own parameters."""
    if case.value is None:
        return {}
    return parameters_of(true_effect(case), case.value)


def declared_mode(case: Case, train: pp.History, seed: int) -> Mode:
    """Fit the declared model to single transitions."""
    return find_mode(Problem.of(case.scene, train, attach(case.scene)), seed=seed)


def ask(case: Case, declared: Mode, test: pp.History, seed: int) -> Oracle:
    """Fit the declared model with the hidden effect and without, and compare the likelihoods."""
    without = trajectory_mode(declared.problem, declared.phi)
    without = with_enough_substeps(without, lambda stage: None)
    added = true_effect(case).on(case.scene.moving[0].name)
    best = _with(without, added, true_parameters(case))
    statistic = max(0.0, 2 * (_log_likelihood(best) - _log_likelihood(without)))
    held_out = HeldOut(test, seed)
    horizon = held_out.rollout_horizon(case.scene.time_step)
    errors = forecast(held_out.problem(best), best.phi, best.sigma, horizon).rmse()
    p_value = float(chi2.sf(statistic, len(added.effect.parameters)))
    return Oracle(statistic, p_value, errors)


def _with(mode: Mode, added: Attached, values: dict[str, float]) -> Mode:
    """Mode with the effect in the model, sought from the truth."""
    problem = mode.problem.with_physics(effects=(*mode.problem.physics.effects, added))
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    for name, value in values.items():
        phi[layout.index(f"{added.effect.name}_{name}", added.body)] = value
    return trajectory_mode(problem, inside(layout.priors, phi), mode.sigma)


def _log_likelihood(mode: Mode) -> float:
    residual = mode.problem.residual(mode.phi)
    return float(mode.problem.log_density(residual, mode.sigma, mode.phi).sum())
