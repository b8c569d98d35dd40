"""Identifiability: parameters that the data inform or not, combinations they cannot tell apart."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np
import pandas as pd

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.likelihood import Observations, TransitionLikelihood
from pbrl_ppl.modes import Mode, posterior_slopes
from pbrl_ppl.parameters import JOINT_INDICES, Layout, Prior, box, folded, inside, wheels
from pbrl_ppl.posterior.record import PosteriorRecord, layout_of
from pbrl_ppl.posterior.store import Idata, best_draw, group, labelled_draws
from pbrl_ppl.state import STATE, Floats

INFORMED, WEAK, PRIOR_ONLY = "informed", "weak", "prior only"
#: What to record to inform parameters, by part of their names; the first match counts.
_CURES = (
    ((" r[", " mu_c["), "record contacts (collisions with a wall or another body)"),
    (("torque", "inertia", "angular", "w_theta", "pivot"), "record the body turning"),
)


@dataclass(frozen=True)
class Width:
    """Prior against posterior width of one scalar parameter.

    Parameters
    ----------
    parameter : str
        Label, such as ``mass[cart]``.
    prior_sd, posterior_sd : float
        Of the logarithm for a log-normal prior (1); angular deviation for an angle (rad, at most
        the square root of 2); else in the parameter's unit.
    ratio : float
        Posterior over prior.
    verdict : str
        ``informed``, ``weak`` or ``prior only``.
    """

    parameter: str
    prior_sd: float
    posterior_sd: float
    ratio: float
    verdict: str


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the data constrain less than the prior does.

    Parameters
    ----------
    weights : tuple of (str, float)
        Parameters that move together, in prior sds, as a unit vector; the first is positive.
    effect : float
        Change of the predictions for one prior sd, in units of the noise; below 1.
    """

    weights: tuple[tuple[str, float], ...]
    effect: float

    @property
    def sentence(self) -> str:
        """Sentence that names the parameters and the cure."""
        names = [name for name, _ in self.weights]
        moves = [f"{name} {'up' if weight > 0 else 'down'}" for name, weight in self.weights]
        return (
            f"The data cannot tell {_listed(names)} apart: {moves[0]} with {_listed(moves[1:])}"
            " leaves the predictions as they are. Give one of them as known, or a tighter prior."
        )


@dataclass(frozen=True)
class Identifiability:
    """Which parameters the data inform.

    Parameters
    ----------
    parameters : tuple of Width
        One for each continuous parameter, in the layout's order.
    uninformed : tuple of str
        Parameters that the data say nothing about: predictions do not depend on them.
    directions : tuple of Direction
        Combinations that the data do not constrain, though each parameter has an effect.
    """

    parameters: tuple[Width, ...]
    uninformed: tuple[str, ...]
    directions: tuple[Direction, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on what the data do not inform; none where they inform all."""
        cures: dict[str, list[str]] = {}
        for name in self.uninformed:
            matching = (cure for words, cure in _CURES if any(word in f" {name}" for word in words))
            cures.setdefault(next(matching, "record motion in which that matters"), []).append(name)
        sentences = (
            f"The data say nothing about {_listed(names)}: {cure}, or give the value as known."
            for cure, names in cures.items()
        )
        return (*sentences, *(direction.sentence for direction in self.directions))

    def table(self) -> pd.DataFrame:
        """Return one row a parameter: prior_sd, posterior_sd, ratio, verdict."""
        columns = [field.name for field in fields(Width)]
        return pd.DataFrame(map(asdict, self.parameters), columns=columns).set_index("parameter")

    def to_dict(self) -> dict[str, object]:
        """Return plain values for ``report.json``."""
        return {
            "parameters": [asdict(width) for width in self.parameters],
            "directions": [vars(d) | {"weights": dict(d.weights)} for d in self.directions],
            "sentences": list(self.sentences),
        }


def identify(
    fitted: Idata | Mode, *, mode: Mode | None = None, effects: Iterable[Effect] = catalogue
) -> Identifiability:
    """Return which parameters the data inform, and which combinations they cannot tell apart.

    Widths are compared on the prior's natural scale. Directions are the eigenvectors of ``J^T J``
    with eigenvalues below 1, ``J`` being the derivative of the whitened residual by the parameters
    in units of their prior sds.

    Parameters
    ----------
    fitted : InferenceData, DataTree or Mode
        A posterior as made by :func:`pbrl_ppl.fit`, or a mode; a mode's widths are those of the
        linearised posterior.
    mode : Mode, optional
        Where ``J`` is taken for a posterior. Without it, it is computed at the draw with the
        highest likelihood, with measured initial states taken as exact.
    effects : iterable of Effect
        Where the names of a posterior's effects are looked up; add your own to the package's.

    Returns
    -------
    Identifiability
        A joint whose bodies are unknown is left out: what it joins is in
        :func:`pbrl_ppl.joint_probabilities`, and its anchors depend on that.

    Raises
    ------
    PosteriorError
        If the posterior holds no scene or lacks a group.
    EffectError
        If an effect of the posterior is not among ``effects``.

    Examples
    --------
    ::

        said = pp.identify(pp.load_posterior("cart.nc"))
        said.table()
        said.sentences  # ('The data say nothing about r[cart] and mu_c[cart]: record ...',)
    """
    posterior: dict[str, Floats] | None = None
    if isinstance(fitted, Mode):
        layout, phi, jacobian = _of_mode(fitted)
    else:
        posterior = labelled_draws(fitted)
        layout, phi, jacobian = _of_mode(mode) if mode else _linearised(fitted, effects)
    prior = _prior_draws(layout)
    kept = [i for i, label in enumerate(layout.labels) if label in prior]
    labels, priors = [layout.labels[i] for i in kept], [layout.priors[i] for i in kept]
    spread = np.array([_spread(p, prior[label]) for p, label in zip(priors, labels, strict=True)])
    # d phi / d its natural scale
    slope = [phi[i] if layout.priors[i].family == "log_normal" else 1.0 for i in kept]
    scaled = jacobian[:, kept] * np.array(slope) * spread
    gram = scaled.T @ scaled
    if posterior is None:
        shrink = np.sqrt(np.diag(np.linalg.inv(gram + np.eye(len(kept)))))
        pairs = zip(labels, spread, spread * shrink, strict=True)
        widths = tuple(_width(label, float(a), float(b), moved=0.0) for label, a, b in pairs)
    else:
        widths = _widths(layout, prior, posterior)
    informed = {width.parameter for width in widths if width.verdict == INFORMED}
    # squared column norm in prior sds: the data's precision is below a tenth of the prior's
    little = [labels[i] for i in np.flatnonzero(np.diag(gram) < 0.1)]
    without = tuple(label for label in little if label not in informed)
    return Identifiability(widths, without, _directions(gram, labels))


def uninformed(idata: Idata, *, effects: Iterable[Effect] = catalogue) -> tuple[str, ...]:
    """Return labels of the parameters that a posterior knows no better than the prior.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`; the engine is not run.
    effects : iterable of Effect
        As for :func:`identify`.

    Raises
    ------
    PosteriorError
        If the posterior holds no scene.
    """
    layout = layout_of(idata, effects)
    widths = _widths(layout, _prior_draws(layout), labelled_draws(idata))
    return tuple(width.parameter for width in widths if width.verdict == PRIOR_ONLY)


def _prior_draws(layout: Layout) -> dict[str, Floats]:
    """Return 20,000 prior draws by label, wheels folded as the posterior's are."""
    rng = np.random.default_rng(0)
    # anchors in different bodies cannot be compared
    free = {owner for b in layout.blocks if b.name in JOINT_INDICES for owner in b.owners}
    draws = {
        f"{block.name}[{owner}]": prior.sample(rng, 20_000)
        for block, owner, prior in layout.entries
        if owner not in free or block.of != "joint"
    }
    return folded(layout, draws)


def _natural(prior: Prior, x: Floats) -> Floats:
    """Return values on the prior's natural scale: the logarithm for ``log_normal``."""
    return np.log(x) if prior.family == "log_normal" else x


def _spread(prior: Prior, draws: Floats) -> float:
    """Return the standard deviation on the natural scale; angular deviation of an angle (rad)."""
    if prior.family == "von_mises":
        resultant = min(float(np.abs(np.exp(1j * draws).mean())), 1.0)  # of equal ones just over 1
        return math.sqrt(2.0 * (1.0 - resultant))
    return float(_natural(prior, draws).std())


def _width(label: str, prior_sd: float, posterior_sd: float, moved: float) -> Width:
    """Return how much narrower a parameter's posterior is than its prior, and the verdict.

    Below the ratio 0.5 of their sds the data inform; above 0.85, which allows for the error of an
    sd from a hundred effective draws (7 %), they do not, unless the mean has moved by 0.3 prior
    sds.
    """
    ratio = posterior_sd / prior_sd
    verdict = INFORMED if ratio < 0.5 else WEAK
    if ratio >= 0.85 and moved < 0.3:
        verdict = PRIOR_ONLY
    return Width(label, prior_sd, posterior_sd, ratio, verdict)


def _widths(
    layout: Layout, prior: Mapping[str, Floats], posterior: Mapping[str, Floats]
) -> tuple[Width, ...]:
    """Return the widths of all parameters with prior draws."""
    posterior = folded(layout, posterior)
    turned = {x for wheel in wheels(layout) if wheel.period == 1 for x in wheel.labels}
    widths = []
    for label, law in zip(layout.labels, layout.priors, strict=True):
        if label not in prior:
            continue
        before, after, moved = _spread(law, prior[label]), _spread(law, posterior[label]), 0.0
        if label not in turned and not law.uniform:  # where a fold put it says nothing
            mean = _natural(law, posterior[label]).mean() - _natural(law, prior[label]).mean()
            moved = float(abs(mean)) / before
        widths.append(_width(label, before, after, moved))
    return tuple(widths)


def _directions(gram: Floats, labels: list[str], *, minor: float = 0.2) -> tuple[Direction, ...]:
    """Return combinations that move predictions by less than the noise, unlike their parameters.

    ``minor``: parameters with less than this share of the strongest effect in a direction are left
    out of it.
    """
    active = np.flatnonzero(np.diag(gram) >= 1.0)
    part = gram[np.ix_(active, active)]
    alone = np.sqrt(np.diag(part))
    values, vectors = np.linalg.eigh(part)
    directions = []
    for row in _sparse(vectors[:, values < 1.0].T):
        weight = row / np.linalg.norm(row)
        cancelled = np.abs(weight) * alone
        members = np.flatnonzero(cancelled >= max(1.0, minor * cancelled.max()))
        if len(members) < 2:
            continue
        weight = weight * np.sign(weight[members[0]])
        named = tuple((labels[active[i]], float(weight[i])) for i in members)
        directions.append(Direction(named, float(np.sqrt(max(weight @ part @ weight, 0.0)))))
    return tuple(directions)


def _sparse(rows: Floats) -> Floats:
    """Return the row-reduced basis, which does not mix separate ambiguities."""
    rows = rows.copy()
    for k in range(len(rows)):
        i, j = divmod(int(np.abs(rows[k:]).argmax()), rows.shape[1])
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, j][:, None] * rows[k]
    return rows


def _of_mode(mode: Mode) -> tuple[Layout, Floats, Floats]:
    """Return the layout, the mode, and the whitened residual's derivative there."""
    return mode.problem.layout, mode.phi, mode.jacobian


def _linearised(idata: Idata, effects: Iterable[Effect]) -> tuple[Layout, Floats, Floats]:
    """Return the layout, the best draw, and the whitened residual's derivative there."""
    record = PosteriorRecord.of(idata)
    physics = record.physics(effects, threads=2)
    layout = physics.layout
    data, measured = group(idata, "constant_data"), group(idata, "observed_data")["next_state"]
    columns = tuple(STATE.index(name) for name in record.measured)
    observations = Observations(measured.to_numpy(), columns)
    best, draws = best_draw(idata), labelled_draws(idata)
    phi = inside(layout.priors, np.array([draws[label][best] for label in layout.labels]))
    stated = dict.fromkeys(observations.names, np.inf) | dict(record.scene.noise)
    inferred = {n: draws.get("sigma", draws.get(f"sigma[{n}]")) for n in observations.names}
    sigma = np.array([stated[n] if x is None else x[best] for n, x in inferred.items()])

    def residual(points: Floats) -> Floats:
        states = physics.predict(points, data["start"].to_numpy(), data["actions"].to_numpy())
        z = TransitionLikelihood().whiten(observations.residual(states), sigma)
        return np.nan_to_num(z.reshape(len(points), math.prod(z.shape[1:])))

    jacobian = posterior_slopes(residual, phi, *box(layout.priors), 1e-3 * layout.scale(phi))
    return layout, phi, jacobian


def _listed(names: list[str]) -> str:
    """Return ``a, b and c``."""
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last
