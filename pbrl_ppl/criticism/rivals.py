"""Rival models: each has one of several effects that a recording cannot tell apart."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.criticism.results import Added
from pbrl_ppl.criticism.score import rank_candidates
from pbrl_ppl.criticism.selection import refitted
from pbrl_ppl.effects import Attached, Effect, Noise
from pbrl_ppl.errors import EffectError, PosteriorError
from pbrl_ppl.likelihood import TransitionLikelihood
from pbrl_ppl.modes import Mode, trajectory_mode
from pbrl_ppl.posterior import likeliest_draw, parameter_draws, problem_of
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: The attribute of a posterior that names its inseparable effects.
_GROUPS = "not_separable"
_ON = " on "


@dataclass(frozen=True, eq=False)
class Rival:
    """A model with one effect of a group, fitted to the recording that they all explain.

    Parameters
    ----------
    attached : Attached
        The effect.
    mode : Mode
        Of whole trajectories, of the model with this effect and without the others.
    draws : ndarray
        Of its posterior, shape (draw, p).
    sigma : ndarray
        Noise parameters of the posterior that all rivals are from, shape (parameter,).
    """

    attached: Attached
    mode: Mode
    draws: Array
    sigma: Array

    @property
    def name(self) -> str:
        """Name of the effect and of its body."""
        return f"{self.attached.effect.name}{_ON}{self.attached.body}"


def keep_groups(posterior: Any, added: Iterable[Added]) -> None:
    """Note in a posterior's attributes which effects its recording cannot tell apart."""
    groups = [
        [_whole(name, one.body) for name in (one.effect, *one.not_separable_from)]
        for one in added
        if one.not_separable_from
    ]
    posterior.attrs[_GROUPS] = json.dumps(groups)


def kept_groups(posterior: Any) -> list[tuple[str, ...]]:
    """Groups of effects that a posterior's recording cannot tell apart, as ``effect on body``."""
    return [tuple(names) for names in json.loads(str(posterior.attrs.get(_GROUPS, "[]")))]


def _whole(name: str, body: str) -> str:
    return name if _ON in name else f"{name}{_ON}{body}"


def named_effects(
    names: Sequence[str], scene: Scene, catalogue: Iterable[Effect]
) -> list[Attached]:
    """Effects on bodies by names such as ``spring``, or ``spring on cart``.

    Raises
    ------
    EffectError
        If there are fewer than two, one is unknown, does not apply, or is of the noise; or where
        the body is left out and there are several.
    """
    by_name = {effect.name: effect for effect in catalogue}
    found: list[Attached] = []
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
            raise EffectError(f"effect {name} is of the noise, which no action makes clearer")
        if effect.on(body or bodies[0]) not in found:
            found.append(effect.on(body or bodies[0]))
    if len(found) < 2:
        raise EffectError(
            f"effects: got {list(names)}, expected two or more that are to be told apart, such as"
            " linear_drag and quadratic_drag"
        )
    return found


def likeliest_mode(posterior: Any, catalogue: Iterable[Effect]) -> Mode:
    """The mode of a posterior's model, from its likeliest draw on.

    Raises
    ------
    PosteriorError
        If the posterior is of single transitions.
    """
    problem = problem_of(posterior, catalogue).with_physics(threads=2)
    if isinstance(problem.likelihood, TransitionLikelihood):
        raise PosteriorError(
            "posterior: it is of single transitions, which do not tell errors of measuring from"
            " unexplained motion; take after.nc of close_loop, or fit with trajectories=True"
        )
    phi, sigma = parameter_draws(problem, posterior)
    best = likeliest_draw(posterior)
    return trajectory_mode(problem, phi[best], sigma[best])


def fit_rivals(
    posterior: Any, effects: Sequence[Attached], catalogue: Iterable[Effect], draws: int, seed: int
) -> list[Rival]:
    """Fit a model with each of several effects to the recording that a posterior holds.

    The posterior's own draws are those of the model that it is of; of the others, draws are from
    the Gaussian at the mode.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        Of whole trajectories.
    effects : sequence of Attached
        Of which each model has one.
    catalogue : iterable of Effect
        Where the names of the posterior's effects are looked up.
    draws : int
        Of each model.
    seed : int
        Of the draws.

    Raises
    ------
    PosteriorError
        If the posterior is of single transitions, or holds fewer draws.
    """
    own = likeliest_mode(posterior, catalogue)
    problem = own.problem
    phi, sigma = parameter_draws(problem, posterior)
    if not 1 <= draws <= len(phi):
        raise PosteriorError(f"posterior: {draws} draws were asked for, expected 1 to {len(phi)}")
    rng = np.random.default_rng(seed)
    present = [one for one in problem.physics.effects if one in effects]
    base = own
    if present:
        others = tuple(one for one in problem.physics.effects if one not in effects)
        without = problem.with_physics(effects=others)
        begin = without.layout.from_layout(problem.layout, own.phi)
        base = trajectory_mode(without, begin, own.sigma)
    usual = np.median(sigma, axis=0)
    found = []
    for attached in effects:
        if present == [attached]:
            chosen = phi[rng.choice(len(phi), draws, replace=False)]
            found.append(Rival(attached, own, chosen, usual))
            continue
        (signature,) = rank_candidates(base, [attached])
        mode = refitted(base, signature)
        found.append(Rival(attached, mode, mode.draws(rng, draws), usual))
    return found
