"""Priors learned from posteriors: Table 1 with a posterior's moments, and parameter libraries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.stats import truncnorm, vonmises

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.modes import NONE, index_law
from pbrl_ppl.parameters import JOINT_INDICES, ParameterLibrary, Prior, folded
from pbrl_ppl.physics import index_priors
from pbrl_ppl.posterior.record import layout_of, scene_of, stored_fields
from pbrl_ppl.posterior.store import Idata, group, labelled_draws, scalars
from pbrl_ppl.scene import Joint, Scene
from pbrl_ppl.state import Floats

#: Variables of a posterior that are not parameters.
_OTHERS = ("library_index", "sigma")


def updated_scene(idata: Idata, *, effects: Iterable[Effect] = catalogue) -> Scene:
    """Return the posterior's scene with the posterior as its prior.

    A fit of new data can start from it. It keeps each parameter's marginal distribution, in
    Table 1's family, without the dependence between parameters. A joint of unknown bodies gets the
    posterior probabilities of its indices. Joints' anchors have no prior in a scene and sigma's is
    taken from the data: both start afresh.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.
    effects : iterable of Effect
        Where the names of the model's effects are looked up; add your own to the package's.

    Returns
    -------
    Scene
        Its bodies' ``prior`` holds the new hyper-parameters, the effects' among them, and that of a
        joint of unknown bodies the new probabilities.

    Raises
    ------
    PosteriorError
        If the posterior holds no scene, lacks a parameter, or its draws do not vary.

    Examples
    --------
    ::

        scene = pp.updated_scene(pp.load_posterior("monday.nc"))
        model = pp.physics_model(scene, pp.History.load("tuesday.csv", scene))
    """
    scene, layout = scene_of(idata), layout_of(idata, effects)
    draws = folded(layout, labelled_draws(idata))
    new: dict[tuple[str, str], tuple[tuple[str, float], ...]] = {}
    for label, (block, owner, prior) in zip(layout.labels, layout.entries, strict=True):
        if block.of != "body":
            continue
        if label not in draws:
            raise PosteriorError(f"posterior: it has no {label}, which its scene asks for")
        if not np.ptp(draws[label]) > 0:
            raise PosteriorError(
                f"posterior: the draws of {label} are all {draws[label][0]:g}, so that they give no"
                " width to a prior; fit again, with more draws"
            )
        matched = moment_matched(prior, draws[label])
        new[block.name, owner] = tuple((k, getattr(matched, k)) for k in matched.hyper_names)
    bodies = []
    for body in scene.bodies:  # with its class's and its effects' among them
        own = {name: new[name, owner] for name, owner in new if owner in (body.owner, body.name)}
        bodies.append(replace(body, prior=tuple((dict(body.prior) | own).items())))
    return scene.replace(bodies=tuple(bodies), joints=_joints(idata, scene))


def _joints(idata: Idata, scene: Scene) -> tuple[Joint, ...]:
    """Return the joints, those of unknown bodies with their indices' posterior probabilities."""
    rows = stored_fields(idata, ("configurations",)).get("configurations", ())
    joints = []
    for name, joint in zip(scene.joint_names, scene.joints, strict=True):
        if joint.bodies is None:
            p_a, p_b = (prior.probabilities for prior in index_priors(scene, joint))
            laws = [
                row["probability"] * index_law(row["joints"][name], scene, p_a, p_b)
                for row in rows
                if row["probability"] > 0
            ]
            if not laws:
                raise PosteriorError(
                    f"posterior: it does not say what {name} may join; make it with pbrl_ppl.fit"
                )
            law = np.sum(laws, axis=0)
            tables = (zip(scene.joinable, law.sum(axis=k).tolist(), strict=True) for k in (1, 0))
            of_indices = (tuple((name, p) for name, p in table if p) for table in tables)
            joint = replace(joint, prior=tuple(zip(JOINT_INDICES, of_indices, strict=True)))
        joints.append(joint)
    return tuple(joints)


def joint_probabilities(idata: Idata) -> dict[str, dict[str, float]]:
    """Return the posterior probabilities of the pairs that each joint connects.

    Parameters
    ----------
    idata : InferenceData or DataTree
        A posterior as made by :func:`pbrl_ppl.fit`, or as loaded from its file, of a scene with a
        joint whose bodies are unknown.

    Returns
    -------
    dict of str to dict of str to float
        For each such joint, the probability of each pair of bodies and of ``none``, the most
        probable first. They come from the evidences, and are finer than the draws can show.

    Raises
    ------
    PosteriorError
        If no joint of the posterior has unknown bodies.

    Examples
    --------
    ::

        idata = pp.fit(pp.physics_model(scene, history), seed=1)
        pp.joint_probabilities(idata)  # {'joint1': {'cart-trailer': 0.998, 'none': 0.002, ...}}
    """
    rows = stored_fields(idata, ("configurations",)).get("configurations")
    if rows is None:
        raise PosteriorError(
            "posterior: the bodies of all its joints were named in the scene; leave out bodies of a"
            " [[joint]], with known = false, and fit again"
        )
    table: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for row in rows:
        for joint, pair in row["joints"].items():
            table[joint][NONE if pair is None else "-".join(pair)] += row["probability"]
    return {joint: dict(sorted(p.items(), key=lambda item: -item[1])) for joint, p in table.items()}


def moment_matched(prior: Prior, draws: Floats) -> Prior:
    """Return the member of a prior's family with the draws' mean and standard deviation.

    These are of the logarithm for ``log_normal``, mean direction and resultant length for
    ``von_mises``.
    A truncated normal's moments are those of its truncated density; where no member has the draws'
    (piled on both bounds, say), the nearest is taken.

    Parameters
    ----------
    prior : Prior
        Gives the family and the support.
    draws : ndarray
        Inside the support, shape (draw,), at least two different ones.

    Examples
    --------
    >>> draws = np.exp(np.random.default_rng(0).normal(2.0, 0.1, 4000))
    >>> new = moment_matched(Prior("log_normal", mu=1.0, sigma=1.5), draws)
    >>> round(new.mu, 2), round(new.sigma, 2)
    (2.0, 0.1)
    """
    if prior.family == "von_mises":
        kappa, mu, _ = vonmises.fit(draws)
        # below 0.001 nearly uniform; at most of 0.001 rad
        return replace(prior, mu=float(mu), kappa=min(float(kappa), 1e6) if kappa > 1e-3 else 0.0)
    values = np.log(draws) if prior.family == "log_normal" else draws
    mean, sd = float(values.mean()), float(values.std())
    if prior.family in ("truncated_normal", "half_normal"):
        mean, sd = _parent(mean, sd, *prior.support)
    return replace(prior, mu=mean, sigma=sd)


def _parent(mean: float, sd: float, lower: float, upper: float) -> tuple[float, float]:
    """Return mu and sigma of the normal that has this mean and sd once it is truncated."""
    # sigmas that mu is outside the support at most, where it is exponential; sigma at most, as a
    # multiple of the width of what it covers, where it is uniform
    outside, level = 5.0, 5.0
    reach = min(upper - lower, mean - lower + sd, upper - mean + sd)
    reach = reach if np.isfinite(upper - lower) else 10 * reach

    def hyper(point: Floats) -> tuple[float, float]:
        sigma = float(np.exp(point[1]))
        mu = np.clip(mean + sd * point[0], lower - outside * sigma, upper + outside * sigma)
        return float(mu), sigma

    def error(point: Floats) -> Floats:
        mu, sigma = hyper(point)
        law = truncnorm((lower - mu) / sigma, (upper - mu) / sigma, mu, sigma)
        return np.array([(law.mean() - mean) / sd, np.log(law.std() / sd)])

    # far from the bounds, the moments are those of the normal itself
    begin = np.array([0.0, np.log(min(sd, 0.9 * level * reach))])
    far = level * reach / sd * (outside + 1)
    limits = ([-far, np.log(0.5 * sd)], [far, np.log(level * reach)])
    return hyper(least_squares(error, begin, bounds=limits, x_scale="jac").x)


def learned_library(
    posteriors: Mapping[str, Idata], probabilities: Mapping[str, object] | None = None
) -> ParameterLibrary:
    """Return the means of posteriors as parameter sets to choose among.

    Parameters
    ----------
    posteriors : mapping of str to InferenceData or DataTree
        By the name of the set. Where a posterior has several bodies, each is a set, called
        ``name.body``, or ``name.class`` where bodies share parameters. Known parameters of the
        scene go into the set.
    probabilities : mapping, optional
        As for :class:`pbrl_ppl.ParameterLibrary`.

    Examples
    --------
    ::

        learned = {name: pp.load_posterior(f"{name}.nc") for name in ("cart", "table")}
        model = pp.physics_model(scene, history, library=pp.learned_library(learned))
    """
    sets: dict[str, dict[str, float]] = {}
    for name, idata in posteriors.items():
        scene, flat = scene_of(idata), scalars(idata)
        for body in scene.dynamic:
            parameters = {key: float(value) for key, value in body.known}
            for label, values in flat.data_vars.items():
                key, _, owner = str(label).rstrip("]").partition("[")
                if owner in (body.name, body.owner) and key not in _OTHERS:
                    x = values.to_numpy()
                    angle = key == "w_theta"  # its mean is a direction
                    parameters[key] = float(np.angle(np.exp(1j * x).mean()) if angle else x.mean())
            alone = len({body.owner for body in scene.dynamic}) == 1
            sets[name if alone else f"{name}.{body.owner}"] = parameters
    return ParameterLibrary(sets, probabilities)


def library_probabilities(idata: Idata) -> pd.DataFrame:
    """Return the probability of every parameter set: one row a body or class, one column a set.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit` from a model with a ``library``.

    Raises
    ------
    PosteriorError
        If it is of a model without a library.
    """
    library = stored_fields(idata, ("library",)).get("library")
    if library is None:
        raise PosteriorError(
            "posterior: its model has no library; pass its library to physics_model"
        )
    index = group(idata, "posterior")["library_index"].transpose("chain", "draw", ...)
    (dim,) = index.dims[2:]
    shares = [(index == i).mean(("chain", "draw")).to_numpy() for i in range(len(library.names))]
    return pd.DataFrame(dict(zip(library.names, shares, strict=True)), index[dim].to_numpy())
