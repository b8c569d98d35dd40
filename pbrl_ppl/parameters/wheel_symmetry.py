"""Symmetry of the wheel: four descriptions of equal likelihood, and the folding onto one of them.

``w_theta`` and ``w_theta + pi/2`` with ``mu_x`` and ``mu_y`` swapped are the same wheel, so the
likelihood is the same for both. The prior is the same only where it is uniform in the angle and
equal in both frictions: there, which description a draw has means nothing, and draws are folded
onto one. Elsewhere each description keeps the probability that the prior gives it.
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
_ANGLES = tuple(f"{begin}w_theta[" for begin in _BEGINNINGS)
_ROUNDS = 20


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

    labels: tuple[str, str, str]
    places: tuple[int, int, int]
    priors: tuple[Prior, Prior, Prior]

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
        return np.array(
            [
                sum(
                    prior.log_density(turned[..., place])
                    for place, prior in zip(self.places, self.priors, strict=True)
                )
                for turned in (self.turned(phi, turns) for turns in range(count))
            ]
        )


def wheels(layout: Layout) -> tuple[Wheel, ...]:
    """Return the wheels that have four descriptions of equal likelihood."""
    places = {label: i for i, label in enumerate(layout.labels)}
    priors, found = layout.priors, []
    owners = {owner: None for b in layout.blocks if b.of == "body" for owner in b.owners}
    for begin, owner in product(_BEGINNINGS, owners):
        one, two, three = (f"{begin}{name}[{owner}]" for name in MIXED)
        at = places.get(one, -1), places.get(two, -1), places.get(three, -1)
        if min(at) >= 0:
            angle, x, y = at
            found.append(Wheel((one, two, three), at, (priors[angle], priors[x], priors[y])))
    return tuple(found)


def fold_draws(layout: Layout, draws: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return draws with every wheel folded onto one description of equal prior probability.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    draws : mapping of str to ndarray
        By label, such as ``w_theta[cart]``, shape (draw,) each; rad and 1.

    Returns
    -------
    dict of str to ndarray
        The same labels.

    Examples
    --------
    >>> from pbrl_ppl.physics import build_layout
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> cart = Body("cart", Shape.box(1.0, 0.6), wheel=True)
    >>> layout = build_layout(Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart,)))
    >>> equal = {"w_theta[cart]": np.array([0.0, np.pi / 2]), "mu_x[cart]": np.array([0.1, 0.4]),
    ...     "mu_y[cart]": np.array([0.4, 0.1])}
    >>> fold_draws(layout, equal)["mu_x[cart]"]
    array([0.1, 0.1])
    """
    folded = dict(draws)
    for wheel in wheels(layout):
        if wheel.period < 4 and all(label in draws for label in wheel.labels):
            angle, x, y = (draws[label] for label in wheel.labels)
            folded |= dict(zip(wheel.labels, _fold(angle, x, y, wheel.period), strict=True))
    return folded


def gathered(layout: Layout, phi: Floats) -> Floats:
    """Return draws (draw, p) with all wheels at one mode of the likelihood, for any prior."""
    phi = phi.copy()
    for wheel in wheels(layout):
        places = list(wheel.places)
        angle, x, y = phi[:, places].T
        phi[:, places] = np.stack(_fold(angle, x, y, 1), axis=1)
    return phi


def fold_wheels(layout: Layout, phi: Floats) -> Floats:
    """Return each draw in one of the descriptions of a wheel with equal prior probability.

    Namely the one with mu_x <= mu_y and w_theta in (-pi/2, pi/2]; the latter alone where the
    frictions' priors differ; none where that of w_theta is not uniform.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Parameters in the layout's order, shape (..., p), SI units.

    Returns
    -------
    ndarray
        The same shape.
    """
    phi = phi.copy()
    for wheel in wheels(layout):
        angle, x, y = wheel.places
        if wheel.period == 1:
            phi[..., angle] += np.where(phi[..., x] > phi[..., y], np.pi / 2, 0.0)
            phi[..., [x, y]] = np.sort(phi[..., [x, y]], axis=-1)
        if wheel.period < 4:
            phi[..., angle] = np.pi / 2 - np.mod(np.pi / 2 - phi[..., angle], np.pi)
    return phi


def most_probable_wheels(layout: Layout, phi: Floats) -> Floats:
    """Return each wheel in its most probable description; ties go as in `fold_wheels`.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Shape (..., p).
    """
    for wheel in wheels(layout):
        if wheel.period > 1:
            phi = wheel.turned(phi, wheel.log_priors(phi, wheel.period).argmax(axis=0))
    return fold_wheels(layout, phi)


def beside(layout: Layout, phi: Floats, others: Floats) -> Floats:
    """Map each draw to the same symmetry branch as other draws, where the prior is symmetric.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Draws to be described, shape (draw, p).
    others : ndarray
        Draws whose mean each is to be nearest to, shape (other, p).
    """
    for wheel in wheels(layout):
        if wheel.period < 4:
            centre = _points(others[:, list(wheel.places)]).mean(axis=0)
            equal = np.array([wheel.turned(phi, turns) for turns in range(0, 4, wheel.period)])
            off = ((_points(equal[..., list(wheel.places)]) - centre) ** 2).sum(axis=-1)
            phi = equal[off.argmin(axis=0), np.arange(len(phi))]
    return phi


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
    for i, (label, prior) in enumerate(zip(layout.labels, layout.priors, strict=True)):
        if label.startswith(_ANGLES):  # a wheel turned half way round is the same
            change[..., i] = wrapped(2.0 * change[..., i]) / 2.0
        elif prior.family == "von_mises":
            change[..., i] = wrapped(change[..., i])
    return change


def _points(values: Floats) -> Floats:
    """Return wheels (..., 3) as points (..., 4) that are close where the wheels are alike."""
    angle = values[..., 0]
    return np.stack([np.cos(angle), np.sin(angle), values[..., 1], values[..., 2]], axis=-1)


def redescribed(layout: Layout, phi: Floats, rng: np.random.Generator) -> Floats:
    """Return draws with each wheel's description drawn from its conditional prior.

    The likelihood being the same for all, that is a Gibbs step of the posterior: draws of it stay
    draws of it, and chains need not cross from one description to another by themselves. Where
    the prior cannot tell any apart, nothing is changed.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Shape (draw, p).
    rng : Generator
        Of the choices.
    """
    for wheel in wheels(layout):
        if wheel.period > 1:
            log_prior = wheel.log_priors(phi, wheel.period)
            # the largest of log-probabilities with Gumbel noise is a draw
            phi = wheel.turned(phi, (log_prior + rng.gumbel(size=log_prior.shape)).argmax(axis=0))
    return phi


def evened(layout: Layout, phi: Floats) -> Floats:
    """Return the change of log-prior that makes a wheel's four descriptions equally probable.

    A chain then needs to see one of them only; `redescribed` draws each with its prior probability.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown, and their prior.
    phi : ndarray
        Shape (..., p).

    Returns
    -------
    ndarray
        Shape (..., p), at the place of each wheel's angle; zero where the prior is even.
    """
    result = np.zeros(np.shape(phi))
    for wheel in wheels(layout):
        if wheel.period > 1:
            log_prior = wheel.log_priors(phi)
            with np.errstate(invalid="ignore"):  # outside the support, where there is no prior
                change = logsumexp(log_prior, axis=0) - np.log(4.0) - log_prior[0]
            result[..., wheel.places[0]] = np.nan_to_num(change)
    return result


def _fold(angle: Floats, mu_x: Floats, mu_y: Floats, period: int) -> tuple[Floats, Floats, Floats]:
    """Return each draw in the description nearest to the mean, of those ``period`` apart.

    Where all four may be chosen, mu_x <= mu_y on average.
    """
    turns = np.arange(4)[:, None]
    odd = turns % 2 == 1
    theta = angle + turns * np.pi / 2
    points = np.stack(
        [np.cos(theta), np.sin(theta), np.where(odd, mu_y, mu_x), np.where(odd, mu_x, mu_y)]
    )
    barred = np.where(turns % period == 0, 0.0, np.inf)
    draw = np.arange(len(angle))
    chosen = np.where((mu_x <= mu_y) | (period > 1), 0, 1)
    # half a turn changes nothing else: begin on the first draw's side
    chosen = chosen + np.where(np.cos(theta[chosen, draw] - theta[chosen[0], 0]) < 0, 2, 0)
    for _ in range(_ROUNDS):
        centre = points[:, chosen, draw].mean(axis=1)
        off = ((points - centre[:, None, None]) ** 2).sum(axis=0) + barred
        nearest = off.argmin(axis=0)
        if (nearest == chosen).all():
            break
        chosen = nearest
    centre = points[:, chosen, draw].mean(axis=1)
    if period == 1 and centre[2] > centre[3]:
        chosen = (chosen + 1) % 4
    if np.mean(np.cos(theta[chosen, draw])) < 0:  # in (-pi/2, pi/2]
        chosen = (chosen + 2) % 4
    swapped = chosen % 2 == 1
    return (
        wrapped(theta[chosen, draw]),
        np.where(swapped, mu_y, mu_x),
        np.where(swapped, mu_x, mu_y),
    )
