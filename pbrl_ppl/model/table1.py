"""Table 1 in PyMC: one random variable a parameter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
from pytensor.tensor.variable import TensorVariable
from scipy.special import i0e

from pbrl_ppl.parameters import Prior
from pbrl_ppl.state import Floats

#: Above this concentration the von Mises density of PyMC 5 overflows; PyMC wants a concentration
#: above 0, and at this one the density is uniform to the last digit.
_SHARP, _LEVEL = 500.0, 1e-12


def random_variable(
    name: str,
    priors: tuple[Prior, ...],
    dims: str | tuple[str, ...],
    conditional: tuple[tuple[Prior, ...], ...] = (),
    index: TensorVariable | None = None,
) -> TensorVariable:
    """Declare priors of one family in the PyMC model of the context, one an owner.

    Parameters
    ----------
    name : str
        The variable's name.
    priors : tuple of Prior
        Same family, one a body or joint.
    dims : str or tuple of str
        The model's dimension over those bodies or joints.
    conditional : tuple of tuple of Prior
        For each owner its prior if its index is 0, 1, ...; see `Block`.
    index : tensor, optional
        Index variable of each owner, whole numbers, shape (owner,).
    """
    family = priors[0].family

    def hyper(key: str) -> Any:
        if index is None:
            return [getattr(prior, key) for prior in priors]
        table = np.array([[getattr(prior, key) for prior in row] for row in conditional])
        chosen = pm.math.eq(index[:, None], np.arange(table.shape[1]))
        return pm.math.where(chosen, table, 0.0).sum(axis=1)

    mu, sigma = hyper("mu"), hyper("sigma")
    if family == "log_normal":
        return pm.LogNormal(name, mu=mu, sigma=sigma, dims=dims)
    if family == "truncated_normal":
        lower, upper = hyper("lower"), hyper("upper")
        return pm.TruncatedNormal(name, mu=mu, sigma=sigma, lower=lower, upper=upper, dims=dims)
    if family == "von_mises":
        return _von_mises(name, np.array(mu), np.array(hyper("kappa")), dims)
    if family == "normal":
        return pm.Normal(name, mu=mu, sigma=sigma, dims=dims)
    if family == "half_normal":
        if any(mu):
            return pm.TruncatedNormal(name, mu=mu, sigma=sigma, lower=0.0, dims=dims)
        return pm.HalfNormal(name, sigma=sigma, dims=dims)
    p = np.stack([prior.probabilities for prior in priors])
    return pm.Categorical(name, p=p, dims=dims)


def _von_mises(name: str, mu: Floats, kappa: Floats, dims: str | tuple[str, ...]) -> TensorVariable:
    """Declare PyMC's von Mises, or an equal density that does not overflow if it is sharp."""
    kappa = np.maximum(kappa, _LEVEL)
    if kappa.max() <= _SHARP:
        return pm.VonMises(name, mu=mu, kappa=kappa, dims=dims)
    log_norm = np.log(2 * np.pi * i0e(kappa))
    return pm.CustomDist(
        name,
        mu,
        kappa,
        logp=lambda value, mu, kappa: kappa * (pm.math.cos(value - mu) - 1.0) - log_norm,
        dist=lambda mu, kappa, size: pm.VonMises.dist(mu, kappa, size=size),
        transform=pm.distributions.transforms.circular,
        dims=dims,
    )
