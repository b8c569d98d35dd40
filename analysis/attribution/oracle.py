"""Oracle that knows the hidden effect and tests whether it is detectable."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

import pbrl_ppl as pp
from attribution.bodies import mh
from attribution.cases import OUTSIDE, Case
from attribution.outside import OUTSIDE_EFFECTS, parameters_of
from attribution.sizes import STRONGEST
from pbrl_ppl import Attached, Physics
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.held_out import HeldOut, forecast, longest_rollout, rollout_horizon
from pbrl_ppl.criticism.refinement import with_enough_substeps
from pbrl_ppl.criticism.table import share, weights
from pbrl_ppl.likelihood import Problem, bodies_acceleration, in_pieces
from pbrl_ppl.modes import Mode, find_mode, fit_pieces, piece_lengths, trajectory_mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.state import STATE

#: Chance alone gives what the oracle calls detected less often than this.
CERTAIN = 1e-4
#: An effect matters where the oracle's model forecasts better by this share, and where what it does
#: to the velocities is this share of what the bodies do.
MATTERS = 0.01
#: The strength of the first pilot recording, how many there are at most, between which statistics
#: one says where the limit is, and the statistic that the next one is to have.
_PILOT, _PILOTS, _BETWEEN, _AIM = 0.01, 3, (8.0, 60.0), 25.0
#: Process noise absorbs what is large: there the statistic grows more slowly than the square.
_ABSORBED = 0.75


@dataclass(frozen=True)
class Oracle:
    """Likelihood-ratio test of the hidden effect, its size free.

    Parameters
    ----------
    statistic : float
        Twice the gain in log-likelihood from adding it to the declared model.
    p_value : float
        With as many degrees of freedom as it has parameters.
    rollout_rmse : dict of str to float
        Errors of forecasts on the trajectories to judge by, of the model with the effect, as in
        ``report.json``.
    gain : float
        By what share that model's error of forecasts is below the declared model's; errors are in
        units of the true noise, root mean square over what is measured.
    share : float
        What the effect changes of a step's velocities, over the bodies' acceleration; the largest
        of the velocities'.
    main : float
        Share of the error of simulated trajectories, the longest pieces of the loop's search, that
        it takes off.
    """

    statistic: float
    p_value: float
    rollout_rmse: dict[str, float] = field(default_factory=dict)
    gain: float = 1.0
    share: float = 1.0
    main: float = 1.0

    @property
    def detects(self) -> bool:
        """Return whether the effect is detectable."""
        return self.p_value < CERTAIN

    @property
    def matters(self) -> bool:
        """Return whether the effect is not negligible and improves forecasts."""
        return min(self.gain, self.share) >= MATTERS

    @property
    def is_main(self) -> bool:
        """Return whether the effect takes off what the loop asks of a law that it names."""
        return self.main >= DEFAULT.search.main_share


def true_effect(case: Case) -> pp.Effect:
    """Return the hidden effect of a case."""
    if case.kind == OUTSIDE:
        return OUTSIDE_EFFECTS[str(case.effect)]
    (effect,) = (each for each in pp.catalogue if each.name == case.effect)
    return effect


def true_parameters(case: Case) -> dict[str, float]:
    """Return the hidden effect's parameters."""
    if case.value is None or case.on is None:
        return {}
    hidden = case.value
    setup = case.body.setups[case.body.names.index(case.on)]
    if case.effect == "actuator_lag":
        hidden = float(np.max(hidden)) / setup.time_step
    elif case.effect == "stiction_patch":
        hidden = float(np.max(hidden)) * setup.mass * mh.NORMAL_GRAVITY
    return parameters_of(true_effect(case), hidden)


def declared_mode(case: Case, train: pp.History, seed: int) -> Mode:
    """Fit the declared model to single transitions."""
    scene = case.body.scene
    return find_mode(Problem.of(Physics.declare(scene), train), seed=seed)


def sized(case: Case, seed: int) -> Case:
    """Return the case with its strength: a multiple of the smallest that the oracle detects.

    Near the limit the statistic grows with the square of the strength; pilot recordings say how
    fast.
    """
    if case.factor is None:
        return case
    enough = chi2.isf(CERTAIN, len(true_effect(case).parameters))
    low, high = _BETWEEN
    strength, statistic = _PILOT, 0.0
    for attempt in range(_PILOTS):
        if attempt:
            power = 0.5 if statistic < low else _ABSORBED
            strength = min(STRONGEST, strength * (_AIM / max(statistic, 1.0)) ** power)
        pilot = case.at(strength)
        declared = declared_mode(pilot, pilot.histories(seed, coarse=True)[0], seed)
        statistic = _compared(pilot, declared)[2]
        if low < statistic < high:
            break
    return case.at(case.factor * strength * float(np.sqrt(enough / max(statistic, 1.0))))


def ask(case: Case, declared: Mode, test: pp.History, seed: int) -> Oracle:
    """Fit the declared model with the hidden effect and without, and compare the likelihoods."""
    without, best, statistic = _compared(case, declared)
    # what lasts lasts in what was recorded later
    test = test.numbered(case.body.setups[0].n_train)
    problem = without.problem
    horizon = longest_rollout(test, rollout_horizon(problem.data.history, problem.scene))
    plain, errors = (
        forecast(HeldOut.of(mode, test).problem, mode.phi, mode.sigma, horizon).rmse()
        for mode in (without, best)
    )
    noise = case.body.noise
    before, after = (np.hypot.reduce([e[d] / noise[d] for d in e]) for e in (plain, errors))
    p_value = float(chi2.sf(statistic, len(true_effect(case).parameters)))
    gain = float(1 - after / before)
    return Oracle(statistic, p_value, errors, gain, _share(best, case), _main(without, best))


def _main(without: Mode, best: Mode) -> float:
    """Return the share of the simulation error on the longest pieces that an effect takes off."""
    length = piece_lengths(without)[-1]
    simulated = [
        fit_pieces(in_pieces(mode.problem, length, mode.problem.data.smoothed_states), mode.phi)
        for mode in (without, best)
    ]
    return share(*simulated, weights(simulated[1]))


def _share(mode: Mode, case: Case) -> float:
    """Return the effect's change of velocities per step, relative to the bodies' acceleration."""
    problem, null = mode.problem, mode.phi.copy()
    added = true_effect(case).on(str(case.on))
    for label, value in zip(added.labels, added.effect.null, strict=True):
        if label in problem.layout.labels:
            null[problem.layout.labels.index(label)] = value
    coordinates = problem.likelihood.noise.coordinates
    change = coordinates.of((problem.predict(mode.phi) - problem.predict(null))[:, 0])
    velocity = coordinates.places % len(STATE)
    square = np.nanmean(change**2, axis=0) / problem.scene.time_step**2
    sizes = bodies_acceleration(problem)
    return max(
        float(np.sqrt(square[velocity == d].mean())) / max(float(size), 1e-300)
        for d, size in zip(coordinates.rates, sizes, strict=True)
    )


def _compared(case: Case, declared: Mode) -> tuple[Mode, Mode, float]:
    """Return the modes without the effect and with it, and twice the gain in log-likelihood."""
    without = trajectory_mode(declared.problem, declared.phi)
    without = with_enough_substeps(without, lambda stage: None)
    best = _with(without, true_effect(case).on(str(case.on)), true_parameters(case))
    return without, best, max(0.0, 2 * (_log_likelihood(best) - _log_likelihood(without)))


def _with(mode: Mode, added: Attached, values: dict[str, float]) -> Mode:
    """Return the mode with the effect in the model, starting from the truth."""
    problem = mode.problem.with_physics(effects=(*mode.problem.physics.effects, added))
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    for name, value in values.items():
        label = f"{added.effect.name}_{name}[{added.body}]"
        if label in layout.labels:  # a sensor's of what is measured
            phi[layout.labels.index(label)] = value
    return trajectory_mode(problem, inside(layout.priors, phi), mode.sigma)


def _log_likelihood(mode: Mode) -> float:
    residual = mode.problem.residual(mode.phi)
    return float(mode.problem.log_density(residual, mode.sigma, mode.phi).sum())
