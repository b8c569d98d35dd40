"""Criticism during an episode: the package's search for missing laws, on single transitions.

There are few, which a declared model without a law may fit badly, far from where its parameters
are right. What :class:`pbrl_ppl.criticism.Search` proposes there to first order is judged by modes
that are found from many starts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from pbrl_ppl.criticism import DEFAULT, Evidence, Search
from pbrl_ppl.effects import Attached, Effect, Noise, Structure, candidates
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode, find_mode
from pbrl_ppl.state import Floats


@dataclass(frozen=True)
class Revision:
    """Effect that an agent added to its model during an episode.

    Parameters
    ----------
    attached : Attached
        The effect, and the body that it acts on.
    transitions : int
        Number of transitions observed when it was first added.
    nats : float
        Log-evidence that is lost without it, less its price.
    share : float
        Share of the prediction error (root mean square) that it takes away.
    not_separable_from : tuple of str
        Effects that the data cannot separate from it.
    """

    attached: Attached
    transitions: int
    nats: float
    share: float
    not_separable_from: tuple[str, ...] = ()

    @property
    def effect(self) -> str:
        """Return the name of the effect."""
        return self.attached.effect.name

    @property
    def body(self) -> str:
        """Return the name of the body."""
        return self.attached.body


def revise(
    problem: Problem,
    added: Iterable[Revision],
    catalogue: Iterable[Effect],
    level: float,
    floor: Floats,
    seed: int = 0,
) -> tuple[tuple[Revision, ...], Mode]:
    """Return the effects that a declared model lacks, and the mode with them.

    Parameters
    ----------
    problem : Problem
        Of the declared model and single transitions, whose starts are exact (Eq. 11).
    added : iterable of Revision
        Effects added before, which all data have to bear out.
    catalogue : iterable of Effect
        Candidates. Effects of the structure stage, whose search takes too long, and of the noise
        stage, which would take misfit for noise, are not tried.
    level : float
        Significance level, corrected for the candidates.
    floor : ndarray
        A model with errors up to this is exact, and lacks nothing, shape (body, 6), SI units.
    seed : int
        Of the searches for modes.

    Returns
    -------
    tuple of Revision
        Those of most evidence first.
    Mode
        Mode of the model with them.
    """
    tried = [effect for effect in catalogue if not isinstance(effect.stage, Structure | Noise)]
    least = max(DEFAULT.search.least_nats, -np.log(level))
    limits = replace(DEFAULT.search, least_nats=least, singles=len(tried), refits=8)

    def missing(mode: Mode) -> tuple[Attached, ...]:
        return candidates(problem.scene, mode.problem.physics.effects, tried)

    @cache
    def highest(*laws: Attached) -> Mode:
        return find_mode(problem.with_physics(effects=(*problem.physics.effects, *laws)), seed=seed)

    # priors are in units that the data show, and change with them
    every = {(law.effect.name, law.body): law for law in missing(highest())}
    laws = {every[one.effect, one.body]: one for one in added}
    rivals: Mapping[Attached, tuple[Attached, ...]] = {}
    mode = highest(*laws)
    error = abs(mode.problem.residual(mode.phi))
    if not (error <= floor[:, list(problem.observations.columns)]).all():
        found = Search(missing, replace(DEFAULT, search=limits))(highest())
        rivals = found.confounded
        for law, one in found.laws.items():
            since = laws[law].transitions if law in laws else problem.segments.n
            laws[law] = Revision(law, since, one.nats, one.share, one.confounded)
    laws = {law: laws[law] for law in every.values() if law in laws}
    while laws:
        for law, kept in laws.items():
            without = highest(*(other for other in laws if other != law))
            worth = _evidence(without, highest(*laws), np.log(len(every)) - law.effect.log_odds)
            laws[law] = replace(kept, attached=law, nats=worth.nats, share=worth.share)
        lowest = min(one.nats for one in laws.values())
        if lowest >= least:
            break
        # of laws that the data do not separate the earlier in the catalogue stays
        below = min(lowest + DEFAULT.search.least_nats, least)
        del laws[[law for law, one in laws.items() if one.nats < below][-1]]
    for law in [one for one in rivals if one in laws]:
        names = []
        for rival, name in zip(rivals[law], laws[law].not_separable_from, strict=True):
            swapped = (rival if one == law else one for one in laws)
            if rival not in laws and _evidence(highest(*swapped), highest(*laws)).nats < least:
                names.append(name)
        laws[law] = replace(laws[law], not_separable_from=tuple(names))
    return tuple(sorted(laws.values(), key=lambda law: -law.nats)), highest(*laws)


def _evidence(before: Mode, after: Mode, price: float = 0.0) -> Evidence:
    """Return the evidence of a model, of as many measurements as its parameters leave free."""
    evidence = Evidence.of(before, after, price)
    followed = np.einsum("ij,jk,ik", after.jacobian, after.covariance, after.jacobian)
    return replace(evidence, nats=evidence.nats + float(followed * np.log1p(-evidence.share)))
