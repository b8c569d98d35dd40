"""Rival models, each with one of several effects that a recording cannot separate."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.criticism import rank_candidates, with_effects
from pbrl_ppl.effects import Attached, Effect, Noise
from pbrl_ppl.errors import EffectError, PosteriorError
from pbrl_ppl.likelihood import is_independent
from pbrl_ppl.modes import FilteredMode, trajectory_mode
from pbrl_ppl.posterior import Fit, Idata, stored_fields
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats

_ON = " on "


@dataclass(frozen=True, eq=False)
class Rival:
    """A model with one effect of a group, fitted to the recording that they all explain.

    Parameters
    ----------
    attached : Attached
        The effect.
    mode : FilteredMode
        Of the model with this effect and without the others, fitted to whole trajectories.
    draws : ndarray
        Draws from its posterior, shape (draw, p).
    sigma : ndarray
        Noise parameters of the model that all rivals come from, shape (parameter,).
    """

    attached: Attached
    mode: FilteredMode
    draws: Floats
    sigma: Floats

    @property
    def name(self) -> str:
        """Return the names of the effect and of its body."""
        return f"{self.attached.effect.name}{_ON}{self.attached.body}"


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
        name, _, body = (part.strip() for part in text.partition(_ON))
        if name not in by_name:
            near = difflib.get_close_matches(name, by_name, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise EffectError(f"effect {name!r} is not in the catalogue{hint}")
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


def posterior_mode(fit: Fit) -> FilteredMode:
    """Return the mode of a fitted model, found from its draw of the highest density.

    Raises
    ------
    PosteriorError
        If the posterior is of single transitions.
    """
    problem = fit.problem.with_physics(threads=2)
    if is_independent(problem):
        raise PosteriorError(
            "posterior: it is of single transitions, which do not separate measurement noise from"
            " process noise; take after.nc of close_loop, or fit whole trajectories"
        )
    return trajectory_mode(problem, *fit.best)


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
    declared = posterior_mode(fit)
    problem = declared.problem
    phi = fit.draws[0]
    if not 1 <= draws <= len(phi):
        raise PosteriorError(f"posterior: {draws} draws were asked for, expected 1 to {len(phi)}")
    rng = np.random.default_rng(seed)
    present = [one for one in problem.physics.effects if one in effects]
    base = declared
    if present:
        others = tuple(one for one in problem.physics.effects if one not in effects)
        base = trajectory_mode(*with_effects(declared, others), declared.sigma)
    fits = []
    for attached in effects:
        if present == [attached]:
            chosen = phi[rng.choice(len(phi), draws, replace=False)]
            fits.append(Rival(attached, declared, chosen, declared.sigma))
            continue
        (signature,) = rank_candidates(base, [attached])
        estimate = signature.candidate.estimate.values()
        sizes = dict(zip(attached.labels, estimate, strict=True))
        start = with_effects(base, (*base.problem.physics.effects, attached), sizes)
        mode = trajectory_mode(*start, base.sigma)
        fits.append(Rival(attached, mode, mode.draws(rng, draws), declared.sigma))
    return fits
