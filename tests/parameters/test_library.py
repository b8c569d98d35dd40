"""Parameter libraries: a choice among parameter sets for each body, summed over exactly."""

import json
import warnings
from dataclasses import replace
from itertools import product

import arviz as az
import numpy as np
import pandas as pd
import pymc as pm
import pytest
from scipy import stats
from scipy.special import logsumexp

import pbrl_ppl as pp
from pbrl_ppl.errors import FitError, ParameterError, PosteriorError, RefitWarning
from pbrl_ppl.model import build_model, physics_model, problem_in
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.posterior import learned_library, library_probabilities, problem_of
from pbrl_ppl.posterior import save_posterior as save
from pbrl_ppl.posterior.store import convergence, draws, from_groups, group, load_posterior
from pbrl_ppl.sampling import fit, update
from pbrl_ppl.scene import Body, Joint, Scene, Shape
from tests.helpers.histories import simulated_history
from tests.helpers.marks import OBJECT_MODE
from tests.helpers.places import MODELS

KNOWN = {"r": 0.2, "mu_c": 0.3}
NOISE = (0.002, 0.002, 0.004, 0.01, 0.01, 0.02)
WHEEL = {"w_x": 0.0, "w_y": 0.0, "w_theta": 0.0}
FURNITURE = {
    "light": {"mass": 9.0, "r": 0.2, "mu_c": 0.3, "mu_x": 0.05, "mu_y": 0.3} | WHEEL,
    "heavy": {"mass": 40.0, "r": 0.2, "mu_c": 0.3, "mu_x": 0.05, "mu_y": 0.3} | WHEEL,
    "gripping": {"mass": 12.0, "r": 0.2, "mu_c": 0.3, "mu_x": 0.3, "mu_y": 0.5} | WHEEL,
    "turned": {"mass": 9.0, "r": 0.2, "mu_c": 0.3, "mu_x": 0.05, "mu_y": 0.3} | WHEEL
    | {"w_theta": 1.0},
}  # fmt: skip


def pucks(names="ab", **options) -> Scene:
    shape = Shape.circle(0.1)
    bodies = tuple(Body(name, shape, **({"known": KNOWN} | options)) for name in names)
    return Scene(time_step=0.1, substeps=4, bodies=bodies)


def quick(model, **options):
    return fit(model, seed=1, progress=False, **options)


def brute_force(problem, library: ParameterLibrary) -> np.ndarray:
    """Probability of each combination of sets: sigma, a scalar, on a grid."""
    names = [body.name for body in problem.scene.dynamic]
    table = library.table(problem.layout, problem.scene)
    median, spread = problem.noise_prior
    grid = np.linspace(-12, 5, 4000)
    law = stats.norm(np.log(median).mean(), spread).logpdf(grid)
    sigma = np.exp(grid)[:, None] * np.ones(len(median))
    result = []
    for combination in product(range(len(library.names)), repeat=len(names)):
        owners = [owner for block in problem.layout.blocks for owner in block.owners]
        of = [combination[names.index(owner)] for owner in owners]
        phi = table[np.arange(len(owners)), of]
        residual = np.broadcast_to(problem.residual(phi), (1, *problem.observations.values.shape))
        data = np.concatenate([problem.log_density(residual, s[None]).sum(axis=-1) for s in sigma])
        p = np.log([library.prior(n)[m] for n, m in zip(names, combination, strict=True)]).sum()
        result.append(logsumexp(data + law) + p)
    return np.exp(np.array(result) - logsumexp(result))


@pytest.mark.parametrize("names", ["a", "ab"])
def test_ambiguous_sets_have_the_brute_force_probabilities(names) -> None:
    """Masses that little noise hides; with two bodies, in one part or in two.

    4 Monte Carlo standard errors at most a figure: false alarm 6e-5 each over seeds.
    """
    library = ParameterLibrary({"x": {"mass": 2.0}, "y": {"mass": 2.2}, "z": {"mass": 2.4}},
                  {"x": 1, "y": 2, "z": 1})  # fmt: skip
    scene = pucks(names)
    truth = {"mass": 2.2}
    history = simulated_history(
        scene, truth, seed=2, trajectories=3, intervals=1, wrench_sd=(1.0, 1.0, 0.002),
        noise=(0.01, 0.01, 0.01, 0.04, 0.04, 0.1), substeps=4,
    )  # fmt: skip
    model = physics_model(scene, history, library=library, sigma="scalar")
    assert len(problem_in(model).physics.simulator.parts) == len(names)
    idata = quick(model)
    expected = brute_force(problem_in(model), library)
    assert (expected > 0.005).sum() >= 2
    index = draws(idata)["library_index"]
    combination = index @ 3 ** np.arange(len(names))[::-1]
    found = np.bincount(combination, minlength=len(expected)) / len(index)
    ess = min(convergence(idata)[1].values())
    error = np.sqrt(expected * (1 - expected) / ess)
    assert (np.abs(found - expected) < 4 * error + 1e-3).all(), (found, expected)
    # one joined part gives the same answer as two
    joined = problem_in(model).with_physics(parts=(tuple(names),))
    again = draws(quick(build_model(joined)))["library_index"] @ 3 ** np.arange(len(names))[::-1]
    share = np.bincount(again, minlength=len(expected)) / len(again)
    assert (np.abs(share - expected) < 4 * error + 1e-3).all()


@pytest.fixture(scope="module")
def apartment():
    """Eleven bodies, each one of four kinds at random, pushed three times."""
    scene = pp.Scene.load(MODELS / "apartment" / "scene.toml")
    names = list(FURNITURE)
    true = np.random.default_rng(5).integers(len(names), size=len(scene.dynamic))
    library = ParameterLibrary(FURNITURE)
    layout = physics_layout(scene)
    table = library.table(layout, scene)
    bodies = [body.name for body in scene.dynamic]
    owners = [owner for block in layout.blocks for owner in block.owners]
    phi = table[np.arange(len(owners)), [true[bodies.index(owner)] for owner in owners]]
    history = simulated_history(
        scene, layout.to_dict(phi), seed=6, trajectories=4, intervals=2, noise=NOISE,
        poses=[body.pose for body in scene.dynamic], wrench_sd=(150.0, 150.0, 30.0),
    )  # fmt: skip
    return scene, history, library, true


def physics_layout(scene):
    from pbrl_ppl.physics import build_layout

    return build_layout(scene)


@pytest.fixture(scope="module")
def furnished(apartment):
    scene, history, library, _ = apartment
    return quick(physics_model(scene, history, library=library))


@pytest.mark.one_stack
def test_the_apartment_s_bodies_are_recognised(apartment, furnished) -> None:
    """Wheels turned are no matter to the three bodies that have none: there the prior decides."""
    scene, _, library, true = apartment
    table = library_probabilities(furnished)
    assert list(table.columns) == list(library.names)
    assert list(table.index) == [body.name for body in scene.dynamic]
    for body, which in zip(scene.dynamic, true, strict=True):
        same = {library.names[which]}
        if not body.wheel and library.names[which] in ("light", "turned"):
            same = {"light", "turned"}
        assert table.loc[body.name, sorted(same)].sum() > 0.99, (body.name, table.loc[body.name])
    # and the file has the parameters that a planner needs
    posterior = group(furnished, "posterior")
    assert posterior["mass"].dims == ("chain", "draw", "body")
    assert posterior["mass"].attrs["units"] == "kg"
    masses = np.array([dict(values)["mass"] for _, values in library.sets])
    np.testing.assert_array_equal(
        posterior["mass"].values, masses[posterior["library_index"].values]
    )
    assert furnished.attrs["max_rhat"] < 1.01
    assert furnished.attrs["min_ess"] > 400
    assert json.loads(furnished.attrs["warnings"]) == []


# ArviZ's own R-hat of a constant is 0 / 0
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_arviz_and_files_take_it(furnished, tmp_path) -> None:
    assert (
        "library_index[sofa]" in az.summary(furnished, var_names=["library_index", "sigma"]).index
    )
    r_hat, ess = convergence(furnished)
    assert np.isfinite(list(r_hat.values())).all()
    assert np.isfinite(list(ess.values())).all()
    save(furnished, tmp_path / "apartment.nc")
    loaded = load_posterior(tmp_path / "apartment.nc")
    pd.testing.assert_frame_equal(library_probabilities(loaded), library_probabilities(furnished))
    assert problem_of(loaded).library == problem_of(furnished).library


def test_same_seed_same_draws(apartment, furnished) -> None:
    scene, history, library, _ = apartment
    again = quick(physics_model(scene, history, library=library))
    for name, values in draws(furnished).items():
        np.testing.assert_array_equal(draws(again)[name], values)


@OBJECT_MODE
def test_an_ordinary_model() -> None:
    """The parameters are the library's in PyMC's own draws, and its density is the package's."""
    scene = pucks(known={})
    library = ParameterLibrary(
        {"x": KNOWN | {"mass": 2.0}, "y": KNOWN | {"mass": 3.0}}, {"b": {"y": 1.0}}
    )
    history = simulated_history(scene, KNOWN | {"mass": 3.0}, seed=1, trajectories=3, intervals=1)
    model = physics_model(scene, history, library=library)
    assert [v.name for v in model.free_RVs] == ["library_index", "sigma"]
    assert {v.name for v in model.deterministics} == {"mass", "r", "mu_c"}
    prior = group(
        pm.sample_prior_predictive(50, model, ["library_index", "mass"], random_seed=1), "prior"
    )
    assert dict(prior["mass"].sizes) == {"chain": 1, "draw": 50, "body": 2}
    np.testing.assert_array_equal(
        prior["mass"], np.array([2.0, 3.0])[prior["library_index"].values]
    )
    assert (prior["library_index"].sel(body="b") == 1).all()
    assert 0 < float(prior["library_index"].sel(body="a").mean()) < 1
    idata = quick(model, draws=400)
    theirs = pm.compute_log_likelihood(
        idata, model=model, extend_inferencedata=False, progressbar=False
    )["next_state"]
    np.testing.assert_allclose(group(idata, "log_likelihood")["next_state"], theirs.values)


@pytest.mark.one_stack
def test_updates(apartment, furnished) -> None:
    """Weights while they do; a new sum where they do not."""
    scene, _, library, _ = apartment
    light = dict(library.sets)["light"]
    more = simulated_history(
        scene, dict(light), seed=9, trajectories=1, intervals=1,
        poses=[body.pose for body in scene.dynamic],
    )  # fmt: skip
    with pytest.warns(RefitWarning):
        idata = update(furnished, more)
    assert idata.attrs["method"] == furnished.attrs["method"]
    assert group(idata, "log_likelihood").sizes["transition"] == 9


def test_library_from_posteriors() -> None:
    """Each learned on its own; known parameters and angles included."""
    scene = pucks("a")
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=8, intervals=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        idata = fit(physics_model(scene, history), seed=1, draws=60, tune=50, chains=2,
                    progress=False)  # fmt: skip
    library = learned_library({"puck": idata}, {"puck": 1.0})
    assert library.names == ("puck",)
    values = dict(dict(library.sets)["puck"])
    assert values == KNOWN | {"mass": pytest.approx(draws(idata)["mass"].mean())}
    two = group(idata, "posterior").assign_coords(body=["a"])
    turned = two.assign(w_theta=("body", [np.pi])).w_theta * xr_sign(two)
    held = {"posterior": two.assign(w_theta=turned)}
    angle = dict(dict(learned_library({"p": from_groups(held, idata.attrs)}).sets)["p"])["w_theta"]
    assert abs(angle) == pytest.approx(np.pi, abs=1e-6)


def xr_sign(posterior):
    """Half of the draws with the other sign: pi and -pi are one direction."""
    return 1.0 - 2.0 * (posterior["draw"] % 2) + 0.0 * posterior["mass"]


@pytest.mark.parametrize(
    ("sets", "probabilities", "message"),
    [
        ({}, None, "it is empty; name at least one"),
        ({"x": {"mass": np.nan}}, None, "set 'x': mass is nan"),
        ({"x": {"mass": 1.0}}, {"y": 1.0}, "probabilities of the library: there is no set 'y'"),
        ({"x": {"mass": 1.0}}, {"x": -1.0}, "expected none below 0"),
        ({"x": {"mass": 1.0}}, {"x": 1.0, "a": {"x": 1.0}}, "by set or by body, not both"),
    ],
)
def test_refused_libraries(sets, probabilities, message) -> None:
    with pytest.raises(ParameterError, match=message):
        ParameterLibrary(sets, probabilities)


@pytest.mark.parametrize(
    ("sets", "probabilities", "message"),
    [
        ({"x": {"r": 1.0}}, None, "set 'x': mass of body 'a' is missing; add it, or give"),
        ({"x": {"mass": 1.0, "mas": 1.0}}, None, "has 'mas', which is no parameter.*mass"),
        ({"x": {"mass": -1.0}}, None, "mass of body 'a' is -1 kg, expected 0 to inf; give"),
        ({"x": {"mass": 0.0}}, None, "mass of body 'a' is 0 kg"),
        (
            {"x": {"mass": 1.0}},
            {"c": {"x": 1.0}},
            "'c' is neither a parameter set nor",
        ),
    ],
)
def test_libraries_that_do_not_fit(sets, probabilities, message) -> None:
    scene = pucks()
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=2, intervals=1)
    with pytest.raises(ParameterError, match=message):
        physics_model(scene, history, library=ParameterLibrary(sets, probabilities))


def test_an_impossible_set_may_be_left_out_for_a_body() -> None:
    scene = pucks()
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=2, intervals=1)
    sets = {"x": {"mass": 2.0}, "y": {}}
    library = ParameterLibrary(sets, {"a": {"x": 1.0}, "b": {"x": 1.0}})
    idata = quick(physics_model(scene, history, library=library), draws=400)
    assert (library_probabilities(idata)["x"] == 1.0).all()
    assert hash(library) == hash(ParameterLibrary(sets, {"a": {"x": 1.0}, "b": {"x": 1.0}}))
    assert ParameterLibrary.from_json(library.to_json()) == library


def test_refused_fits(apartment, monkeypatch) -> None:
    scene = pucks()
    history = simulated_history(scene, {"mass": 2.0}, seed=1, trajectories=2, intervals=1)
    library = ParameterLibrary({"x": {"mass": 1.0}, "y": {"mass": 2.0}})
    model = physics_model(scene, history, library=library)
    for options in ({"method": "smc"}, {"resume": object()}):
        with pytest.raises(
            FitError, match="summed over exactly, or walked over by the method 'metropolis'; leave"
        ):
            quick(model, **options)
    monkeypatch.setattr("pbrl_ppl.modes.library_choice._Combinations.most", 10)
    with pytest.raises(FitError, match=r"2 combinations of parameter sets.*give some"):
        quick(model)
    with pytest.raises(ValueError, match="with horizon or library"):
        physics_model(scene, history, library=library, likelihood="trajectories")
    near = tuple(replace(body, pose=(0.5 * i, 0.0, 0.0)) for i, body in enumerate(scene.bodies))
    jointed = scene.replace(bodies=near, joints=(Joint("distance", ("a", "b"), known=False),))
    with pytest.raises(ParameterError, match="is to be inferred, and a library is of bodies"):
        physics_model(jointed, history, library=library)
    with pytest.raises(PosteriorError, match="has no library; pass its library"):
        library_probabilities(from_groups({}, {}))
