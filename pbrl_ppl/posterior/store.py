"""Posteriors as files and draws; the one module that tells ArviZ 0.x from 1.x.

Files are written by xarray through h5netcdf, one NetCDF group a dataset, and not by ArviZ: its
generations have a writer each (``InferenceData.to_netcdf``, ``DataTree.to_netcdf``), with
different engines, compression and coordinates. Written here, a file has the same layout in both
and needs no netCDF4. ``arviz.from_netcdf`` of either and ``xarray.open_datatree`` read it.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, cast

import numpy as np
import xarray as xr

from pbrl_ppl.errors import OutputError, PosteriorError
from pbrl_ppl.state import Floats
from pbrl_ppl.system.files import check_hdf5, is_as_sealed, seal, write_atomically

#: ArviZ 1.x stores groups in an xarray.DataTree, 0.x in an InferenceData.
DATATREE = not version("arviz").startswith("0.")

#: Level of the intervals in reports, as in ArviZ 0.x.
HDI_PROB = 0.94
#: Attribute of resampled draws: their effective sample size by their weights.
SIZE = "importance_ess"

#: Version of the attributes of a posterior file, see `PosteriorRecord`.
SCHEMA = 2

#: Attribute of a file alone: it has a seal.
_SEALED = "sealed"

_NEEDED = ("posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data")


class Idata(Protocol):
    """A posterior or a trace: an InferenceData of ArviZ 0.x, or a DataTree of ArviZ 1.x."""

    attrs: dict[str, Any]

    def __getitem__(self, name: str) -> Any:
        """Return a group, in 1.x a node of the tree."""


def arviz() -> ModuleType:
    """Return ArviZ, imported without the warning by which 0.23 announces 1.0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    module: ModuleType = arviz
    return module


def groups(idata: Idata) -> dict[str, xr.Dataset]:
    """Return all groups of an InferenceData or DataTree as plain datasets."""
    if isinstance(idata, xr.DataTree):
        return {name: node.to_dataset() for name, node in idata.children.items()}
    return {name: idata[name] for name in idata.groups()}  # type: ignore[attr-defined]  # ArviZ 0.x


def best_draw(idata: Idata) -> int:
    """Return the index of the draw of highest likelihood, in the order of :func:`draws`."""
    likelihood = group(idata, "log_likelihood")["next_state"].sum("transition")
    return int(likelihood.transpose("chain", "draw").to_numpy().argmax())


def group(idata: Idata, name: str) -> xr.Dataset:
    """Return one group as a plain dataset.

    Raises
    ------
    PosteriorError
        If there is no such group.
    """
    stored = groups(idata)
    if name not in stored:
        raise PosteriorError(
            f"posterior: it has no group {name!r}, only {', '.join(stored)}; save it with"
            " save_posterior after fit"
        )
    return stored[name]


def from_groups(datasets: Mapping[str, xr.Dataset], attrs: Mapping[str, object]) -> Idata:
    """Build an InferenceData (ArviZ 0.x) or DataTree (1.x) from datasets by name."""
    if DATATREE:
        tree = xr.DataTree.from_dict({f"/{name}": data for name, data in datasets.items()})
        tree.attrs.update(attrs)
        return cast(Idata, tree)
    idata: Idata = arviz().InferenceData(**datasets)
    idata.attrs.update(attrs)
    return idata


def save_posterior(idata: Idata, path: str | Path) -> None:
    """Write a posterior to a NetCDF file, whole or not at all.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.
    path : str or Path
        Ends in ``.nc``.

    Raises
    ------
    OutputError
        If the folder does not exist or cannot be written.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise OutputError(
            f"{path}: cannot be written: no such folder; choose an existing, writable folder"
        )
    write_atomically(path, lambda temporary: _write(idata, temporary))


def _write(idata: Idata, path: Path) -> None:
    """Write NetCDF 4 with one group a dataset: the same file from both stacks."""
    xr.Dataset(attrs={**idata.attrs, _SEALED: 1}).to_netcdf(path, mode="w", engine="h5netcdf")
    for name, data in groups(idata).items():
        encoding = {key: {"zlib": True} for key, v in data.variables.items() if v.dtype.kind == "f"}
        data.to_netcdf(path, mode="a", group=name, engine="h5netcdf", encoding=encoding)
    seal(path)


def load_posterior(path: str | Path) -> Idata:
    """Read a posterior file, written by either stack.

    Parameters
    ----------
    path : str or Path
        A file written by :func:`save_posterior`.

    Returns
    -------
    InferenceData or DataTree
        With all data in memory; its ``attrs`` hold the scene, effects, versions and seed.

    Raises
    ------
    PosteriorError
        If the file is missing, damaged or no posterior of this package, or lacks a group.
    """
    path = Path(path)
    if not path.is_file():
        raise PosteriorError(f"{path}: there is no such file")
    try:
        # first: HDF5 may read some damaged files for ever
        if (as_sealed := is_as_sealed(path)) is False:
            raise PosteriorError(f"{path}: it is damaged; copy it again, or fit again")
        check_hdf5(path)
        with contextlib.closing(xr.open_datatree(path, engine="h5netcdf")) as tree:
            loaded = {name: node.to_dataset().load() for name, node in tree.children.items()}
            attrs = {str(name): value for name, value in tree.attrs.items()}
    except PosteriorError:
        raise
    except Exception as error:  # HDF5 raises many kinds on a damaged file
        raise PosteriorError(
            f"{path}: this is not a NetCDF file, or it is damaged; pass one that fit saved"
        ) from error
    changed = attrs.pop(_SEALED, 0) and not as_sealed
    check_schema(attrs, str(path))
    if missing := [name for name in _NEEDED if name not in loaded]:
        raise PosteriorError(f"{path}: it lacks {', '.join(missing)}; save the whole fit again")
    if changed:
        raise PosteriorError(
            f"{path}: it is damaged, or another program changed it; copy it again, or save what"
            " arviz.from_netcdf reads by save_posterior"
        )
    return from_groups(loaded, attrs)


def check_schema(attrs: Mapping[str, object], where: str) -> None:
    """Refuse attributes that are not a posterior's, or of another schema version.

    Raises
    ------
    PosteriorError
        It says what was got and what was expected.
    """
    if "pbrl_ppl" not in attrs:
        raise PosteriorError(
            f"{where}: this is no posterior of pbrl_ppl; make it with fit, save it with"
            " save_posterior"
        )
    if attrs.get("schema") != SCHEMA:
        raise PosteriorError(
            f"{where}: the posterior has schema version {attrs.get('schema')}, expected {SCHEMA};"
            " fit it again with this version of pbrl_ppl"
        )


def draws(idata: Idata) -> dict[str, Floats]:
    """Return posterior draws by name, chains joined.

    Parameters
    ----------
    idata : InferenceData or DataTree
        A posterior.

    Returns
    -------
    dict of str to ndarray
        Shape (draw, ...), SI units.
    """
    stacked = group(idata, "posterior").stack(sample=("chain", "draw")).transpose("sample", ...)
    return {str(name): stacked[name].to_numpy() for name in stacked.data_vars}


def scalars(posterior: Idata) -> xr.Dataset:
    """Return one variable per scalar parameter, called ``name[coordinate]``.

    Parameters
    ----------
    posterior : InferenceData or DataTree
        With a group ``posterior``.

    Returns
    -------
    xarray.Dataset
        Variables of dims (chain, draw).
    """
    flat: dict[str, xr.DataArray] = {}
    for name, variable in group(posterior, "posterior").data_vars.items():
        others = [dim for dim in variable.dims if dim not in ("chain", "draw")]
        for place in np.ndindex(*(variable.sizes[dim] for dim in others)):
            scalar = variable.isel(dict(zip(others, place, strict=True)))
            labels = [
                str(scalar.coords[d].item()) if d in scalar.coords else str(i)
                for d, i in zip(others, place, strict=True)
            ]
            label = f"{name}[{', '.join(labels)}]" if labels else str(name)
            flat[label] = scalar.reset_coords(drop=True).transpose("chain", "draw")
    return xr.Dataset(flat)


def labelled_draws(idata: Idata) -> dict[str, Floats]:
    """Return posterior draws by label, such as ``mass[cart]``, shape (draw,), chains joined."""
    return {str(name): variable.to_numpy().ravel() for name, variable in scalars(idata).items()}


def convergence(idata: Idata) -> tuple[dict[str, float], dict[str, float]]:
    """Return R-hat, and the smaller of bulk and tail effective size, of every scalar parameter.

    Parameters
    ----------
    idata : InferenceData or DataTree
        A posterior.

    Returns
    -------
    r_hat, ess : dict of str to float
        By label, such as ``mass[cart]``. One that is the same in all draws, as the index of a joint
        that is certain, has converged: 1, and the number of draws. R-hat of one chain is NaN. Draws
        by importance sampling have an ESS of at most ``attrs["importance_ess"]``.
    """
    variables = scalars(idata)
    constant = {str(n): float(v.size) for n, v in variables.items() if v.min() == v.max()}
    flat = variables.drop_vars(list(constant))
    if not flat.data_vars:
        return dict.fromkeys(constant, 1.0), constant
    az = arviz()
    # constant chains with different values have an infinite R-hat
    with np.errstate(divide="ignore", invalid="ignore"):
        # the tail's default quantiles differ between the generations
        hat, bulk, tail = (
            _dataset(measure)
            for measure in (
                # undefined for one chain: ArviZ would warn for each parameter
                az.rhat(flat) if flat.sizes["chain"] > 1 else flat.max() * np.nan,
                az.ess(flat, method="bulk"),
                az.ess(flat, method="tail", prob=(0.05, 0.95)),
            )
        )
    r_hat = {str(name): float(hat[name]) for name in flat.data_vars}
    ess = {str(name): float(min(bulk[name], tail[name])) for name in flat.data_vars}
    most = float(idata.attrs.get(SIZE, np.inf))  # resampled draws look independent
    ess = {name: min(value, most) for name, value in ess.items()}
    return r_hat | dict.fromkeys(constant, 1.0), ess | constant


def smoothed(log_weights: Floats) -> tuple[Floats, float]:
    """Return Pareto-smoothed importance weights that sum to one, and the shape k of their tail.

    Parameters
    ----------
    log_weights : ndarray
        Shape (draw,), up to a constant.

    Returns
    -------
    weights : ndarray
        Shape (draw,).
    k : float
        Above 0.7 the weights are not to be relied on (Vehtari et al., 2024); infinite where there
        are too few different ones to say.
    """
    result, k = log_weights, np.inf
    # ArviZ refuses a tail of equal values; a very long tail overflows, and a tail of few different
    # values makes its fit divide by zero
    with (
        contextlib.suppress(ValueError),
        np.errstate(over="ignore", divide="ignore", invalid="ignore"),
    ):
        if DATATREE:
            from arviz_stats.base import array_stats

            # it takes log-likelihoods, the negative log-weights of leave-one-out
            result, k = array_stats.psislw(-log_weights, axis=-1)
        else:
            result, k = arviz().psislw(log_weights)
    weights = np.exp(np.asarray(result) - np.max(result))
    return weights / weights.sum(), np.inf if np.isnan(k) else float(k)


def gain_of(first: Any, second: Any) -> tuple[float, float]:
    """Return the difference of two ``az.loo``, second less first, and its standard error (nats)."""
    exact = {"round_to": "none"} if DATATREE else {}
    table = arviz().compare({"before": first, "after": second}, **exact)
    worse = table.iloc[-1]
    sign = 1.0 if worse.name == "before" else -1.0
    return sign * abs(float(worse["elpd_diff"])), float(worse["dse"])


def elpd_of(loo: Any) -> tuple[float, float]:
    """Return the ``elpd`` and effective number of parameters of an ``az.loo``."""
    elpd, p = (loo.elpd, loo.p) if DATATREE else (loo["elpd_loo"], loo["p_loo"])
    return float(elpd), float(p)


def _dataset(value: xr.Dataset | xr.DataTree) -> xr.Dataset:
    """Return the result of a diagnostic as a dataset, in both generations."""
    if isinstance(value, xr.Dataset):
        return value
    return value.children.get("posterior", value).to_dataset()


def interval(values: Floats, prob: float = HDI_PROB) -> tuple[float, float]:
    """Return the highest-density interval of draws: the shortest that holds ``prob`` of them."""
    ordered = np.sort(np.asarray(values).ravel())
    count = min(max(1, int(np.floor(prob * len(ordered)))), len(ordered) - 1)
    widths = ordered[count:] - ordered[: len(ordered) - count]
    best = int(np.argmin(widths))
    return float(ordered[best]), float(ordered[best + count])
