"""The hash of what a history measured."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import xarray as xr


def hashed(dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the hash of its measured arrays among its attributes."""
    digest = hashlib.sha256()
    for name in ("trajectory", "body"):
        digest.update("\0".join(str(label) for label in dataset[name].to_numpy()).encode())
        digest.update(b"\1")
    digest.update(dataset["n_rows"].to_numpy().astype("<i8").tobytes())
    for name in ("clock", "observed", "action"):
        values: Any = dataset[name].to_numpy()
        # One NaN and one zero: both have several bit patterns.
        canonical = np.where(np.isnan(values), np.nan, values + 0.0)
        digest.update(np.ascontiguousarray(canonical, dtype="<f8").tobytes())
    return dataset.assign_attrs(data_sha256=digest.hexdigest())
