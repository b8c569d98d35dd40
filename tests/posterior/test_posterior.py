"""Posterior files: the same after a round trip, whole or not there, and clear when they are bad."""

import dataclasses
import logging

import arviz as az
import h5py
import numpy as np
import pytest
import xarray as xr
from scipy import stats

from pbrl_ppl.effects import catalogue
from pbrl_ppl.errors import OutputError, PosteriorError
from pbrl_ppl.likelihood import Coordinates
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import PosteriorRecord, scene_of
from pbrl_ppl.posterior import store as posterior
from pbrl_ppl.posterior.record import LinearisationCheck, StoredMode
from pbrl_ppl.posterior.store import (
    DATATREE,
    convergence,
    draws,
    from_groups,
    group,
    groups,
    interval,
    load_posterior,
    save_posterior,
)
from pbrl_ppl.scene import Body, Scene, Shape

SCENE = Scene(
    time_step=0.1,
    normal_gravity=9.81,
    bodies=(Body("cart", Shape.box(1.0, 0.6), wheel=True, effects=("linear_drag",)),),
)


def datasets(seed: int = 0) -> dict[str, xr.Dataset]:
    rng = np.random.default_rng(seed)
    chain, draw = ("chain", np.arange(2)), ("draw", np.arange(50))
    both = {"chain": chain, "draw": draw}
    transition = {"transition": np.arange(4)}
    mass = xr.DataArray(
        rng.normal(6.0, 0.1, (2, 50, 1)), {**both, "body": ["cart"]}, ("chain", "draw", "body")
    ).assign_attrs(units="kg")
    sigma = xr.DataArray(
        rng.lognormal(size=(2, 50, 2)),
        {**both, "state": ["x", "omega"]},
        ("chain", "draw", "state"),
    )
    values = rng.normal(size=(4, 1))
    values[2] = np.nan
    return {
        "posterior": xr.Dataset({"mass": mass, "sigma": sigma}),
        "sample_stats": xr.Dataset(
            {
                "accepted": (("chain", "draw"), rng.random((2, 50))),
                "diverging": (("chain", "draw"), rng.random((2, 50)) < 0.5),
            },
            both,
        ),
        "log_likelihood": xr.Dataset(
            {"next_state": (("chain", "draw", "transition"), rng.normal(size=(2, 50, 4)))},
            {**both, **transition},
        ),
        "observed_data": xr.Dataset({"next_state": (("transition", "state"), values)}, transition),
        "constant_data": xr.Dataset({"start": ("transition", rng.normal(size=4))}, transition),
    }


def record(**more) -> PosteriorRecord:
    values = {
        "scene": SCENE,
        "effects": (("linear_drag", "cart"),),
        "horizon": 1,
        "substeps": 10,
        "together": (),
        "measured": ("x", "omega"),
        "scalar_sigma": False,
        "sigma_prior": ((0.1, 0.2), 2.0),
        "data_sha256": "0" * 64,
        "seed": 0,
        "versions": {"python": "3"},
        "method": "laplace",
    }
    return PosteriorRecord(**(values | more))


def made(seed: int = 0, **more):
    return from_groups(datasets(seed), record(seed=seed, **more).attributes())


@pytest.mark.parametrize("reader", ["arviz", "xarray"])
def test_arviz_reads_the_file(reader, tmp_path) -> None:
    """By its own reader, which the two generations call the same, and as a tree of datasets."""
    path = tmp_path / "cart.nc"
    save_posterior(made(), path)
    if reader == "arviz":
        found = az.from_netcdf(str(path))
    else:
        found = xr.open_datatree(path, engine="h5netcdf")
    for name, data in datasets().items():
        read = found[name] if reader == "arviz" and not DATATREE else found[name].to_dataset()
        xr.testing.assert_identical(read.load().drop_attrs(deep=False), data)
    if reader == "arviz":
        assert "mass[cart]" in az.summary(found).index
        assert scene_of(found) == SCENE
    (found.close if hasattr(found, "close") else list)()


def test_a_type_that_arviz_takes() -> None:
    idata = made()
    if DATATREE:
        assert isinstance(idata, xr.DataTree)
    else:
        assert isinstance(idata, az.InferenceData)
    assert "mass[cart]" in az.summary(idata).index


def test_round_trip(tmp_path) -> None:
    idata = made(max_rhat=1.002)
    save_posterior(idata, tmp_path / "cart.nc")
    loaded = load_posterior(tmp_path / "cart.nc")
    assert type(loaded) is type(idata)
    assert dict(loaded.attrs) == dict(idata.attrs)
    before, after = groups(idata), groups(loaded)
    assert set(after) == set(before)
    for name, data in before.items():
        xr.testing.assert_identical(after[name], data)
        for variable in data.variables:
            assert after[name][variable].dims == data[variable].dims
    assert group(loaded, "posterior")["mass"].attrs["units"] == "kg"
    assert [path.name for path in tmp_path.iterdir()] == ["cart.nc"]


def test_loaded_data_need_the_file_no_more(tmp_path) -> None:
    save_posterior(made(), tmp_path / "cart.nc")
    loaded = load_posterior(tmp_path / "cart.nc")
    (tmp_path / "cart.nc").unlink()
    assert np.isfinite(draws(loaded)["mass"]).all()


def test_save_replaces_an_older_file(tmp_path) -> None:
    path = tmp_path / "cart.nc"
    save_posterior(made(seed=1), path)
    save_posterior(made(seed=2), str(path))
    assert load_posterior(path).attrs["seed"] == 2


def test_file_mode_is_an_ordinary_file_s(tmp_path) -> None:
    (tmp_path / "other").touch()
    save_posterior(made(), tmp_path / "cart.nc")
    modes = {name: (tmp_path / name).stat().st_mode for name in ("cart.nc", "other")}
    assert modes["cart.nc"] == modes["other"]


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("no space left on device")])
def test_an_interruption_leaves_nothing_half_written(tmp_path, monkeypatch, older, error) -> None:
    path = tmp_path / "cart.nc"
    if older:
        save_posterior(made(seed=1), path)
    write, calls = xr.Dataset.to_netcdf, []

    def interrupted(self, *args, **kwargs):
        calls.append(kwargs.get("group"))
        if len(calls) == 4:
            raise error
        return write(self, *args, **kwargs)

    monkeypatch.setattr(xr.Dataset, "to_netcdf", interrupted)
    with pytest.raises((KeyboardInterrupt, OutputError)):
        save_posterior(made(seed=2), path)
    monkeypatch.undo()
    assert len(calls) == 4
    assert [one.name for one in tmp_path.iterdir()] == (["cart.nc"] if older else [])
    if older:
        assert load_posterior(path).attrs["seed"] == 1


def test_no_folder_to_write_in(tmp_path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        save_posterior(made(), tmp_path / "nowhere" / "cart.nc")


def test_no_such_file(tmp_path) -> None:
    with pytest.raises(PosteriorError, match=r"cart\.nc: there is no such file"):
        load_posterior(tmp_path / "cart.nc")


@pytest.mark.parametrize("content", [b"", b"x,y,theta\n1,2,3\n", b"\x89HDF\r\n\x1a\n" + b"0" * 64])
def test_not_a_netcdf_file(tmp_path, content) -> None:
    path = tmp_path / "cart.nc"
    path.write_bytes(content)
    with pytest.raises(PosteriorError, match=r"cart\.nc: this is not a NetCDF file"):
        load_posterior(path)


def test_a_truncated_file(tmp_path) -> None:
    path = tmp_path / "cart.nc"
    save_posterior(made(), path)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(PosteriorError, match=r"cart\.nc: "):
        load_posterior(path)


def test_a_foreign_netcdf_file(tmp_path) -> None:
    path = tmp_path / "rain.nc"
    xr.Dataset({"rain": ("day", [1.0, 2.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(PosteriorError, match=r"rain\.nc: this is no posterior of pbrl_ppl"):
        load_posterior(path)


def test_an_arviz_file_of_another_model(tmp_path) -> None:
    path = tmp_path / "other.nc"
    from_groups(datasets(), {}).to_netcdf(str(path), engine="h5netcdf")
    with pytest.raises(PosteriorError, match="no posterior of pbrl_ppl"):
        load_posterior(path)


@pytest.mark.parametrize("missing", ["posterior", "log_likelihood", "constant_data"])
def test_a_missing_group(tmp_path, missing) -> None:
    path = tmp_path / "cart.nc"
    save_posterior(made(), path)
    with h5py.File(path, "a") as file:
        del file[missing]
    with pytest.raises(PosteriorError, match=f"it lacks {missing}; save the whole fit again"):
        load_posterior(path)


def test_group_names_what_there_is() -> None:
    data = datasets()
    with pytest.raises(PosteriorError, match=r"no group 'prior', only posterior, .*sample_stats"):
        group(from_groups(data, {}), "prior")
    xr.testing.assert_identical(group(from_groups(data, {}), "posterior"), data["posterior"])


def test_all_draws_with_chains_joined() -> None:
    idata = made()
    values = group(idata, "posterior")
    found = draws(idata)
    assert set(found) == {"mass", "sigma"}
    np.testing.assert_array_equal(found["mass"], values["mass"].values.reshape(100, 1))
    np.testing.assert_array_equal(found["sigma"], values["sigma"].values.reshape(100, 2))


def test_scene_with_its_effects(tmp_path) -> None:
    scene = SCENE.with_effects("cart", "push_offset")
    save_posterior(made(scene=scene), tmp_path / "cart.nc")
    found = scene_of(load_posterior(tmp_path / "cart.nc"))
    assert found == scene
    assert found.body("cart").effects == ("linear_drag", "push_offset")


def test_no_scene() -> None:
    with pytest.raises(PosteriorError, match="it holds no scene"):
        scene_of(from_groups(datasets(), {}))


CELLS = Coordinates(
    places=np.array([0, 5]),
    columns=(0, 5),
    sensor=np.array([0, -1]),
    fixed=np.array([1e-6, 0.1 + 0.2]),
    push=np.array([[0.1 / 3, 0.0]]),
    pushed=np.array([1]),
    sensors=(0,),
    rates=(3,),
)
#: A value of each field that may be left out.
OPTIONAL = {
    "nu": 4.0,
    "library": ParameterLibrary({"light": {"mass": 1.0}, "heavy": {"mass": 2.0}}),
    "cells": CELLS,
    "mode": StoredMode({"mass[cart]": 0.1 + 0.2}, {"sigma[x]": 0.1}, -1.5, {"cart": "light"}),
    "linearisation": LinearisationCheck(16, 0.1, 0.2, 0),
    "configurations": ({"joints": {"joint1": None}, "probability": 1.0},),
    "updates": ({"did": "reweighted", "share": 0.3},),
    "max_rhat": 1.002,
    "min_ess": 401.0,
    "warnings": ("one", "two"),
    "interrupted": True,
}


@pytest.mark.parametrize("given", [{}, OPTIONAL], ids=["least", "whole"])
def test_a_record_is_the_same_from_its_file(tmp_path, given) -> None:
    whole = record(**given)
    attrs = whole.attributes()
    assert all(isinstance(value, (int, float, str)) for value in attrs.values())
    assert attrs["effects"] == '[["linear_drag", "cart"]]'
    save_posterior(from_groups(datasets(), attrs), tmp_path / "cart.nc")
    found = PosteriorRecord.of(load_posterior(tmp_path / "cart.nc"))
    assert found.attributes() == attrs
    for field in dataclasses.fields(PosteriorRecord):
        value, read = getattr(whole, field.name), getattr(found, field.name)
        if isinstance(value, Coordinates):
            for each in dataclasses.fields(Coordinates):
                np.testing.assert_array_equal(getattr(read, each.name), getattr(value, each.name))
        else:
            assert read == value, field.name
    assert not given or {field.name for field in dataclasses.fields(found)} >= set(OPTIONAL)


def test_another_schema_version_is_refused(tmp_path) -> None:
    other = from_groups(datasets(), record().attributes() | {"schema": 1})
    save_posterior(other, tmp_path / "old.nc")
    with pytest.raises(PosteriorError, match=r"old\.nc: .*schema version 1, expected 2; fit it"):
        load_posterior(tmp_path / "old.nc")
    with pytest.raises(PosteriorError, match="schema version 1, expected 2"):
        PosteriorRecord.of(other)


def test_a_missing_field_is_named() -> None:
    attrs = record().attributes()
    del attrs["substeps"]
    with pytest.raises(PosteriorError, match="does not say its substeps"):
        PosteriorRecord.of(from_groups(datasets(), attrs))


def test_the_tolerance_of_the_physics_is_kept() -> None:
    """Of a file that does not state it, the default."""
    stored = PosteriorRecord.of(from_groups(datasets(), record(tolerance=1e-8).attributes()))
    assert stored.physics(catalogue).tolerance == 1e-8
    older = PosteriorRecord.of(from_groups(datasets(), record().attributes()))
    assert older.physics(catalogue).tolerance == Physics(SCENE).tolerance
    assert older.physics(catalogue).substeps == 10


@pytest.mark.parametrize("prob", [0.5, 0.94])
def test_interval_of_a_normal(prob: float) -> None:
    """mu -+ sd z: a quantile's standard error is known, and 6 of them are wide enough."""
    n = 100_000
    values = np.random.default_rng(2).normal(3.0, 2.0, n)
    low, high = interval(values, prob)
    edge = stats.norm.ppf(0.5 + prob / 2)
    # the shortest interval's ends move with n^(-1/3) about the quantiles, its width hardly
    assert high - low == pytest.approx(4.0 * edge, rel=0.01)
    assert low == pytest.approx(3.0 - 2.0 * edge, abs=0.15)
    inside = ((values >= low) & (values <= high)).mean()
    assert inside == pytest.approx(prob, abs=1e-3)


def test_interval_is_the_shortest() -> None:
    """An exponential's highest-density interval begins at zero."""
    values = np.random.default_rng(2).exponential(1.0, 50_000)
    low, high = interval(values, 0.9)
    assert low == pytest.approx(0.0, abs=0.01)
    assert high == pytest.approx(-np.log(0.1), rel=0.03)


def test_interval_is_arviz_s() -> None:
    values = np.random.default_rng(5).gamma(2.0, 1.0, 1000)
    expected = az.hdi(values, **({"prob": 0.94} if DATATREE else {"hdi_prob": 0.94}))
    np.testing.assert_allclose(interval(values, 0.94), np.asarray(expected), rtol=0.05, atol=0.02)


def test_interval_of_few_draws() -> None:
    assert interval(np.array([2.0])) == (2.0, 2.0)
    low, high = interval(np.array([3.0, 1.0, 2.0]))
    assert 1.0 <= low < high <= 3.0


def test_convergence_is_arviz_s() -> None:
    idata = made()
    r_hat, ess = convergence(idata)
    assert list(r_hat) == list(ess) == ["mass[cart]", "sigma[x]", "sigma[omega]"]
    values = group(idata, "posterior")
    assert r_hat["mass[cart]"] == pytest.approx(float(az.rhat(values["mass"].values[..., 0])))
    bulk = az.ess(values, method="bulk")["sigma"].values
    # 5 % and 95 % in both generations, whose defaults differ
    tail = az.ess(values, method="tail", prob=(0.05, 0.95))["sigma"].values
    assert [ess["sigma[x]"], ess["sigma[omega]"]] == pytest.approx(list(np.minimum(bulk, tail)))


def test_convergence_sees_chains_apart() -> None:
    data = datasets()
    data["posterior"]["mass"][0] += 1.0
    r_hat, ess = convergence(from_groups(data, {}))
    assert r_hat["mass[cart]"] > 1.5
    assert ess["mass[cart]"] < 10
    assert r_hat["sigma[x]"] < 1.1


def test_one_chain_has_no_r_hat_and_its_own_effective_size(caplog, monkeypatch) -> None:
    log = getattr(az, "_log", logging.getLogger("arviz"))  # ArviZ 0.x has a logger of its own make
    monkeypatch.setattr(log, "handlers", [caplog.handler])
    idata = made()
    one = {"posterior": group(idata, "posterior").isel(chain=[0])}
    r_hat, ess = convergence(from_groups(one, {}))
    assert np.isnan(list(r_hat.values())).all()
    assert min(ess.values()) > 1
    assert caplog.records == []  # ArviZ need not complain of what is not asked


def test_scalar_parameters_have_plain_labels() -> None:
    data = datasets()
    data["posterior"]["sigma"] = data["posterior"]["sigma"].isel(state=0, drop=True)
    r_hat, _ = convergence(from_groups(data, {}))
    assert "sigma" in r_hat


def test_hdi_level_is_stated() -> None:
    assert posterior.HDI_PROB == 0.94
