"""A wheel's four equal descriptions: draws brought to the one that is nearest to most of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.parameters.layout import Layout

Array = NDArray[np.float64]

#: The parameters that the symmetry mixes: w_theta and w_theta + pi/2 with mu_x, mu_y swapped.
MIXED = ("w_theta", "mu_x", "mu_y")
_ROUNDS = 20


def fold_draws(layout: Layout, draws: Mapping[str, Array]) -> dict[str, Array]:
    """Fold the draws of every wheel onto one description.

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown.
    draws : mapping of str to ndarray
        By label, such as ``w_theta[cart]``, shape (draw,) each; rad and 1.

    Returns
    -------
    dict of str to ndarray
        The same labels.

    Examples
    --------
    >>> from pbrl_ppl.model.table1 import build_layout
    >>> from pbrl_ppl.scene.scene import Body, Scene, Shape
    >>> cart = Body("cart", Shape.box(1.0, 0.6), wheel=True)
    >>> layout = build_layout(Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart,)))
    >>> equal = {"w_theta[cart]": np.array([0.0, np.pi / 2]), "mu_x[cart]": np.array([0.1, 0.4]),
    ...     "mu_y[cart]": np.array([0.4, 0.1])}
    >>> fold_draws(layout, equal)["mu_x[cart]"]
    array([0.1, 0.1])
    """
    folded = dict(draws)
    for owner in _owners(layout):
        labels = [f"{name}[{owner}]" for name in MIXED]
        # with one of them known there is no symmetry left
        if all(label in draws and label in layout.labels for label in labels):
            folded |= dict(zip(labels, _fold(*(draws[label] for label in labels)), strict=True))
    return folded


def fold_wheels(layout: Layout, phi: Array) -> Array:
    """Choose one of each wheel's four equal descriptions, whatever other draws there are.

    Namely mu_x <= mu_y and w_theta in (-pi/2, pi/2].

    Parameters
    ----------
    layout : Layout
        Says which bodies' wheels are unknown.
    phi : ndarray
        Parameters in the layout's order, shape (..., p), SI units.

    Returns
    -------
    ndarray
        The same shape.
    """
    phi = phi.copy()
    for owner in _owners(layout):
        labels = [f"{name}[{owner}]" for name in MIXED]
        if not all(label in layout.labels for label in labels):
            continue
        angle, x, y = (layout.labels.index(label) for label in labels)
        phi[..., angle] += np.where(phi[..., x] > phi[..., y], np.pi / 2, 0.0)
        phi[..., [x, y]] = np.sort(phi[..., [x, y]], axis=-1)
        phi[..., angle] = np.pi / 2 - np.mod(np.pi / 2 - phi[..., angle], np.pi)
    return phi


def _owners(layout: Layout) -> set[str]:
    """Bodies that have unknown parameters."""
    return {owner for block in layout.blocks if block.of == "body" for owner in block.owners}


def _fold(angle: Array, mu_x: Array, mu_y: Array) -> tuple[Array, Array, Array]:
    """Each draw's description that is nearest to the mean of them all; mu_x <= mu_y on average."""
    turns = np.arange(4)[:, None]
    odd = turns % 2 == 1
    theta = angle + turns * np.pi / 2
    points = np.stack(
        [np.cos(theta), np.sin(theta), np.where(odd, mu_y, mu_x), np.where(odd, mu_x, mu_y)]
    )
    every = np.arange(len(angle))
    chosen = np.where(mu_x <= mu_y, 0, 1)
    # half a turn changes nothing else: begin on the first draw's side
    chosen = chosen + np.where(np.cos(theta[chosen, every] - theta[chosen[0], 0]) < 0, 2, 0)
    for _ in range(_ROUNDS):
        centre = points[:, chosen, every].mean(axis=1)
        nearest = ((points - centre[:, None, None]) ** 2).sum(axis=0).argmin(axis=0)
        if (nearest == chosen).all():
            break
        chosen = nearest
    centre = points[:, chosen, every].mean(axis=1)
    if centre[2] > centre[3]:
        chosen = (chosen + 1) % 4
    if np.mean(np.cos(theta[chosen, every])) < 0:  # in (-pi/2, pi/2]
        chosen = (chosen + 2) % 4
    turned = theta[chosen, every]
    swapped = chosen % 2 == 1
    wrapped = np.pi - np.mod(np.pi - turned, 2 * np.pi)
    return wrapped, np.where(swapped, mu_y, mu_x), np.where(swapped, mu_x, mu_y)
