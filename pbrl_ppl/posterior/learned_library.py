"""A parameter library from posteriors that were learned before, and what a posterior says of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.posterior.store import group, scalars, scene_of

Array = NDArray[np.float64]
#: Parameters that are angles, whose mean is a direction.
_ANGLES = ("w_theta",)
#: What a posterior holds beside parameters.
_OTHERS = ("library_index", "sigma")


def learned_library(
    posteriors: Mapping[str, Any], probabilities: Mapping[str, Any] | None = None
) -> ParameterLibrary:
    """The means of posteriors, each learned on its own, as parameter sets to choose among.

    Parameters
    ----------
    posteriors : mapping of str to InferenceData or DataTree
        By the name that the set will have; of one that has several bodies each is a set, called
        ``name.body``, or ``name.class`` where bodies share parameters. What its scene knew of a
        body goes into the set.
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
            found = {key: float(value) for key, value in body.known}
            for label, values in flat.data_vars.items():
                key, _, owner = str(label).rstrip("]").partition("[")
                if owner in (body.name, body.owner) and key not in _OTHERS:
                    found[key] = _mean(key, values.to_numpy())
            alone = len({body.owner for body in scene.dynamic}) == 1
            sets[name if alone else f"{name}.{body.owner}"] = found
    return ParameterLibrary(sets, probabilities)


def library_probabilities(idata: Any) -> pd.DataFrame:
    """Posterior probability of every parameter set: one row a body or class, one column a set.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit` from a model with a ``library``.

    Raises
    ------
    PosteriorError
        If it is of a model without a library.
    """
    if "library" not in idata.attrs:
        raise PosteriorError("posterior: its model has no library; pass library= to physics_model")
    names = ParameterLibrary.from_json(str(idata.attrs["library"])).names
    index = group(idata, "posterior")["library_index"].transpose("chain", "draw", ...)
    (dim,) = index.dims[2:]
    share = {name: (index == i).mean(("chain", "draw")) for i, name in enumerate(names)}
    return pd.DataFrame(
        {name: probability.to_numpy() for name, probability in share.items()},
        index=index[dim].to_numpy(),
    )


def _mean(name: str, values: Array) -> float:
    if name in _ANGLES:
        return float(np.angle(np.exp(1j * values).mean()))
    return float(values.mean())
