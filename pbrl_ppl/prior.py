"""Table 1: the univariate prior of each physical parameter, and phi's layout for a scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pymc as pm

from pbrl_ppl.effects.base import Attached
from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import BODY_PARAMETERS, WHEEL_PARAMETERS, Block, Layout, Prior
from pbrl_ppl.scene import Body, Scene


def table1(body: Body) -> dict[str, Prior]:
    """Table 1 for one body, uninformative by default; ``body.prior`` replaces hyper-parameters.

    Parameters
    ----------
    body : Body
        Its bounds (m) limit where the wheel can be.

    Returns
    -------
    dict of str to Prior
        One prior a parameter of Eq. 8.

    Raises
    ------
    ParameterError
        If a hyper-parameter does not belong to the parameter's family.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> table1(Body("cart", Shape.box(1.0, 0.6)))["w_x"].support
    (-0.5, 0.5)
    """
    x_min, x_max, y_min, y_max = body.shape.bounds
    share = Prior("truncated_normal", mu=0.5, sigma=1.0, lower=0.0, upper=1.0)
    priors = {
        "mass": Prior("log_normal", mu=1.0, sigma=1.5),
        "r": Prior("log_normal", mu=-1.5, sigma=1.0),
        "mu_c": share,
        "w_x": Prior("truncated_normal", sigma=x_max - x_min, lower=x_min, upper=x_max),
        "w_y": Prior("truncated_normal", sigma=y_max - y_min, lower=y_min, upper=y_max),
        "w_theta": Prior("von_mises", mu=0.0, kappa=0.5),
        "mu_x": share,
        "mu_y": share,
    }
    for name, hyper in body.prior:
        allowed = ("mu", "kappa") if priors[name].family == "von_mises" else ("mu", "sigma")
        for key, _ in hyper:
            if key not in allowed:
                raise ParameterError(
                    f"body {body.name!r}: prior of {name} has {key!r}, expected"
                    f" {' and '.join(allowed)} ({priors[name].family})"
                )
        values = dict(hyper)
        prior = priors[name]
        priors[name] = replace(
            prior,
            mu=values.get("mu", prior.mu),
            sigma=values.get("sigma", prior.sigma),
            kappa=values.get("kappa", prior.kappa),
        )
    return priors


def build_layout(scene: Scene, effects: tuple[Attached, ...] = ()) -> Layout:
    """Phi of a scene: Table 1's unknown parameters of every moving body, then the effects'.

    Parameters
    ----------
    scene : Scene
        Parameters that it names as known are left out, and a wheel's where there is none.
    effects : tuple of Attached
        All effects of the model.
    """
    blocks = []
    for name, unit in BODY_PARAMETERS.items():
        bodies = [
            body
            for body in scene.dynamic
            if name not in dict(body.known) and (body.wheel or name not in WHEEL_PARAMETERS)
        ]
        if bodies:
            priors = tuple(table1(body)[name] for body in bodies)
            blocks.append(Block(name, tuple(body.name for body in bodies), unit, priors))
    for effect in dict.fromkeys(one.effect for one in effects):
        on = tuple(one.body for one in effects if one.effect == effect)
        blocks += [
            Block(effect.variable(each), on, each.unit, (each.prior,) * len(on), effect=effect.name)
            for each in effect.parameters
        ]
    return Layout(tuple(blocks))


def random_variable(name: str, priors: tuple[Prior, ...], dims: str) -> Any:
    """Declare priors of one family in the PyMC model of the context, one a body.

    Parameters
    ----------
    name : str
        The variable's name.
    priors : tuple of Prior
        Same family, one a body.
    dims : str
        The model's dimension over those bodies.

    Raises
    ------
    ParameterError
        If the family is not one of Table 1 or a normal.
    """
    family = priors[0].family
    mu = [prior.mu for prior in priors]
    sigma = [prior.sigma for prior in priors]
    if family == "log_normal":
        return pm.LogNormal(name, mu=mu, sigma=sigma, dims=dims)
    if family == "truncated_normal":
        lower = [prior.lower for prior in priors]
        upper = [prior.upper for prior in priors]
        return pm.TruncatedNormal(name, mu=mu, sigma=sigma, lower=lower, upper=upper, dims=dims)
    if family == "von_mises":
        kappa = [prior.kappa for prior in priors]
        return pm.VonMises(name, mu=mu, kappa=kappa, dims=dims)
    if family == "normal":
        return pm.Normal(name, mu=mu, sigma=sigma, dims=dims)
    if family == "half_normal":
        return pm.HalfNormal(name, sigma=sigma, dims=dims)
    raise ParameterError(
        f"prior of {name}: family {family!r} is unknown; use log_normal, truncated_normal, normal,"
        " half_normal or von_mises"
    )
