"""Which trajectory a transition of a posterior is of, and when: coordinates beside `transition`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from pbrl_ppl.history import Segments
from pbrl_ppl.posterior.store import from_groups, groups
from pbrl_ppl.state import INPUT

#: Coordinates of the dimension ``transition`` that are no index.
_PLACES = ("trajectory", "time")
_NUMBER, _BEGIN = INPUT.index("trajectory"), INPUT.index("begin")


def places(segments: Segments) -> dict[str, xr.Variable]:
    """Coordinates ``trajectory`` and ``time`` of segments, for a posterior's groups.

    The first is the trajectory's number in its recording, from 0, in the second the clock of the
    row that the segment starts from (s).
    """
    first = segments.inputs[:, 0, 0]  # all bodies have the same clock
    return {
        "trajectory": xr.Variable("transition", first[:, _NUMBER].astype(np.int64)),
        "time": xr.Variable("transition", first[:, _BEGIN], {"units": "s"}),
    }


def both_places(held: xr.Dataset, segments: Segments) -> dict[str, xr.Variable]:
    """Coordinates of a posterior's transitions and, after them, of new ones.

    Trajectories are numbered on, so that those of two recordings stay apart. Empty where the
    posterior is of an older version, and does not say.
    """
    if not set(_PLACES) <= set(held.coords):
        return {}
    new = {name: variable.to_numpy() for name, variable in places(segments).items()}
    new["trajectory"] += int(held["trajectory"].max()) + 1 - new["trajectory"].min()
    return {
        name: xr.Variable("transition", np.concatenate([held[name], values]), held[name].attrs)
        for name, values in new.items()
    }


def placed(idata: Any, coords: Mapping[Any, Any]) -> Any:
    """The posterior with those of these coordinates that say trajectory and time, and no others."""
    own = {name: coords[name] for name in _PLACES if name in coords}
    data = {
        name: dataset.drop_vars(_PLACES, errors="ignore").assign_coords(own)
        if "transition" in dataset.dims
        else dataset
        for name, dataset in groups(idata).items()
    }
    return from_groups(data, idata.attrs)
