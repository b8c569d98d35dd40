"""Symmetry of the wheel: four descriptions of equal likelihood, and the choice of one of them.

``w_theta`` and ``w_theta + pi/2`` with ``mu_x`` and ``mu_y`` swapped are the same wheel, so the
likelihood is the same for both. The prior is the same only where it is uniform in the angle and
equal in both frictions: there, which description a draw has means nothing, and `nearest` brings
draws to one. Elsewhere each description keeps the probability that the prior gives it (`by_prior`),
unless the prior is `symmetrised`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pbrl_ppl.parameters.layout import Layout
from pbrl_ppl.parameters.priors import Prior
from pbrl_ppl.state import Floats, wrapped

#: The parameters that the symmetry mixes: w_theta and w_theta + pi/2 with mu_x, mu_y swapped.
MIXED = ("w_theta", "mu_x", "mu_y")
#: Prefixes of a wheel's parameters: Table 1's and the effect's.
_BEGINNINGS = ("", "wheel_")


@dataclass(frozen=True)
class Wheel:
    """A wheel with unknown angle and frictions; with one of them known there is no symmetry.

    Parameters
    ----------
    labels : tuple of str
        Of the angle and the two frictions.
    places : tuple of int
        Of the same in phi.
    priors : tuple of Prior
        Of the same.
    """

    labels: tuple[str, ...]
    places: tuple[int, ...]
    priors: tuple[Prior, ...]

    @property
    def period(self) -> int:
        """Period of the prior in quarter turns: 1, 2 (half a turn), or 4 (no symmetry)."""
        angle, mu_x, mu_y = self.priors
        if not angle.uniform:
            return 4
        return 1 if mu_x == mu_y else 2

    def turned(self, phi: Floats, turns: NDArray[np.intp] | int) -> Floats:
        """Return phi, shape (..., p), with the wheel described this many quarter turns on."""
        phi, (angle, x, y) = phi.copy(), self.places
        odd = np.asarray(turns) % 2 == 1
        phi[..., angle] = wrapped(phi[..., angle] + np.asarray(turns) * np.pi / 2)
        mu_x, mu_y = phi[..., x].copy(), phi[..., y].copy()
        phi[..., x], phi[..., y] = np.where(odd, mu_y, mu_x), np.where(odd, mu_x, mu_y)
        return phi

    def log_priors(self, phi: Floats, count: int = 4) -> Floats:
        """Return the wheel's log-prior 0, 1, ... quarter turns on, shape (count, ...)."""
        turned = np.array([self.turned(phi, turns) for turns in range(count)])
        pairs = zip(self.places, self.priors, strict=True)
        return np.asarray(sum(prior.log_density(turned[..., place]) for place, prior in pairs))


def wheels(layout: Layout) -> tuple[Wheel, ...]:
    """Return the wheels that have four descriptions of equal likelihood."""
    found, known = [], set(layout.labels)
    owners = {owner: None for b in layout.blocks if b.of == "body" for owner in b.owners}
    for begin, owner in product(_BEGINNINGS, owners):
        labels = tuple(f"{begin}{name}[{owner}]" for name in MIXED)
        if known.issuperset(labels):
            places = tuple(layout.places(labels))
            found.append(Wheel(labels, places, tuple(layout.priors[i] for i in places)))
    return tuple(found)


def nearest(
    layout: Layout, phi: Floats, centre: Floats | None = None, *, any_prior: bool = False
) -> Floats:
    """Return draws with each wheel in that of its equal descriptions that is nearest to a centre.

    Descriptions are equal where the prior is the same for them; `any_prior` takes all four.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Draws in the layout's order, shape (draw, p), SI units. Wheels with NaN are left alone.
    centre : ndarray, optional
        Draws whose mean is the centre, shape (other, p); by default the draws' own mean, which is
        then described by w_theta in (-pi/2, pi/2] and, if all four are equal, mu_x <= mu_y.
    any_prior : bool
        Whether descriptions count as equal that the prior tells apart.

    Returns
    -------
    ndarray
        The same shape.

    Examples
    --------
    >>> from pbrl_ppl.physics import build_layout
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> known = {"mass": 8.0, "r": 0.1, "mu_c": 0.2, "w_x": 0.0, "w_y": 0.0}
    >>> cart = Body("cart", Shape.box(1.0, 0.6), wheel=True, known=known)
    >>> layout = build_layout(Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart,)))
    >>> layout.labels
    ('w_theta[cart]', 'mu_x[cart]', 'mu_y[cart]')
    >>> nearest(layout, np.array([[0.0, 0.1, 0.4], [np.pi / 2, 0.4, 0.1]]))[:, 1]
    array([0.1, 0.1])
    """
    for wheel in wheels(layout):
        period = 1 if any_prior else wheel.period
        places = list(wheel.places)
        if period == 4 or np.isnan(phi[:, places]).any():
            continue
        equal = np.array([wheel.turned(phi, turns) for turns in range(0, 4, period)])
        points = _points(equal[..., places])
        if centre is None:
            chosen = _about_own_mean(points)
        else:
            middle = _points(centre[:, places]).mean(axis=0)
            chosen = ((points - middle) ** 2).sum(axis=-1).argmin(axis=0)
        phi = equal[chosen, np.arange(len(phi))]
    return phi


def folded(layout: Layout, draws: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return draws by label, shape (draw,) each, with wheels as :func:`nearest` describes them."""
    phi = nearest(layout, layout.columns(draws))
    return {label: phi[:, i] for i, label in enumerate(layout.labels) if label in draws}


def _about_own_mean(points: Floats, rounds: int = 20) -> NDArray[np.intp]:
    """Return which description each draw has about their mean, from points (description, draw, 4).

    Descriptions are as many equal turns apart.
    """
    n, draw = len(points), np.arange(points.shape[1])
    half = n // 2
    chosen = np.zeros(len(draw), dtype=np.intp)
    if n == 4:
        chosen[points[0, :, 2] > points[0, :, 3]] = 1
    # half a turn changes nothing else: begin on the first draw's side
    first = points[chosen[0], 0, :2]
    chosen = (chosen + np.where(points[chosen, draw, :2] @ first < 0, half, 0)) % n
    for _ in range(rounds):
        centre = points[chosen, draw].mean(axis=0)
        closest = ((points - centre) ** 2).sum(axis=-1).argmin(axis=0)
        if (closest == chosen).all():
            break
        chosen = closest
    centre = points[chosen, draw].mean(axis=0)
    if n == 4 and centre[2] > centre[3]:
        chosen = (chosen + 1) % n
    if points[chosen, draw, 0].mean() < 0:  # in (-pi/2, pi/2]
        chosen = (chosen + half) % n
    return chosen


def by_prior(
    layout: Layout,
    phi: Floats,
    rng: np.random.Generator | None = None,
    *,
    equal_alone: bool = False,
) -> Floats:
    """Return each wheel in its most probable description, or in one drawn by the prior.

    The likelihood being the same for all, drawing is a Gibbs step of the posterior: draws of it
    stay draws of it, and chains need not cross from one description to another by themselves.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Parameters in the layout's order, shape (..., p), SI units.
    rng : Generator, optional
        Of the draws, which leave descriptions alone that the prior cannot tell apart. Without it,
        of those the one with mu_x <= mu_y and w_theta in (-pi/2, pi/2] is taken.
    equal_alone : bool
        Whether descriptions stay as they are that the prior tells apart.

    Returns
    -------
    ndarray
        The same shape.
    """
    phi = phi.copy()
    for wheel in wheels(layout):
        if wheel.period > 1 and not equal_alone:
            score = wheel.log_priors(phi, wheel.period)
            # the largest of log-probabilities with Gumbel noise is a draw
            score = score if rng is None else score + rng.gumbel(size=score.shape)
            phi = wheel.turned(phi, score.argmax(axis=0))
        if rng is not None:
            continue
        angle, x, y = wheel.places
        if wheel.period == 1:
            phi[..., angle] += np.where(phi[..., x] > phi[..., y], np.pi / 2, 0.0)
            phi[..., [x, y]] = np.sort(phi[..., [x, y]], axis=-1)
        if wheel.period < 4:
            phi[..., angle] = np.pi / 2 - np.mod(np.pi / 2 - phi[..., angle], np.pi)
    return phi


def symmetrised(layout: Layout, phi: Floats) -> Floats:
    """Return the change of log-prior that makes a wheel's four descriptions equally probable.

    A chain then needs to see one of them only; `by_prior` draws each with its prior probability.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Shape (..., p).

    Returns
    -------
    ndarray
        Shape (..., p), at the place of each wheel's angle; zero where the prior is symmetric.
    """
    result = np.zeros(np.shape(phi))
    for wheel in wheels(layout):
        if wheel.period > 1:
            log_prior = wheel.log_priors(phi)
            with np.errstate(invalid="ignore"):  # outside the support, where there is no prior
                change = logsumexp(log_prior, axis=0) - np.log(4.0) - log_prior[0]
            result[..., wheel.places[0]] = np.nan_to_num(change)
    return result


def change_from(layout: Layout, phi: Floats, origin: Floats) -> Floats:
    """Return the change from an origin, with wheels and angles as near to it as possible.

    The engine predicts the same for all of these; their prior does not matter here.

    Parameters
    ----------
    layout : Layout
        Order of phi.
    phi : ndarray
        Shape (..., p), SI units.
    origin : ndarray
        Shape (p,).

    Returns
    -------
    ndarray
        Shape (..., p).
    """
    for wheel in wheels(layout):
        angle = wheel.places[0]
        turns = np.rint(wrapped(origin[angle] - phi[..., angle]) / (np.pi / 2)).astype(int)
        if turns.any():
            phi = wheel.turned(phi, turns)
    change = phi - origin
    angles = tuple(f"{begin}w_theta[" for begin in _BEGINNINGS)
    for i, (label, prior) in enumerate(zip(layout.labels, layout.priors, strict=True)):
        if label.startswith(angles):  # a wheel turned half way round is the same
            change[..., i] = wrapped(2.0 * change[..., i]) / 2.0
        elif prior.family == "von_mises":
            change[..., i] = wrapped(change[..., i])
    return change


def _points(values: Floats) -> Floats:
    """Return wheels (..., 3) as points (..., 4) that are close where the wheels are alike."""
    angle = values[..., 0]
    return np.stack([np.cos(angle), np.sin(angle), values[..., 1], values[..., 2]], axis=-1)
