"""Bodies of one class with equal attributes share Table 1's parameters."""

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem, along_trajectories, log_posterior, log_prior
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import PartedSimulator, Physics, build_layout, independent_parts
from pbrl_ppl.planning import ActionSet, Dynamics, Goal
from pbrl_ppl.posterior import learned_library, library_probabilities, updated_scene
from pbrl_ppl.posterior.store import scalars
from pbrl_ppl.sampling import fit
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

BOX, DISC = Shape.box(0.5, 0.3), Shape.circle(0.2)
KNOWN = {"r": 0.1, "mu_c": 0.3}
NOISE = (0.002, 0.002, 0.004, 0.02, 0.02, 0.04)
MASS = 6.0


def scene(shared: bool = True, shapes=(BOX, DISC), **options) -> Scene:
    """Two chairs, far from each other."""
    own = {"known": KNOWN, "object_class": "chair" if shared else None} | options
    bodies = tuple(Body(f"chair{i + 1}", shape, **own) for i, shape in enumerate(shapes))
    return Scene(time_step=0.1, normal_gravity=9.81, substeps=4, bodies=bodies)


def recorded(*, seed: int = 1, intervals: int = 6) -> History:
    """Both of them pushed, 3 m apart; classes do not matter to a history."""
    return simulated_history(
        scene(shared=False), {"mass": MASS}, seed=seed, trajectories=1, intervals=intervals,
        noise=NOISE, wrench_sd=(8.0, 8.0, 0.3), poses=[(0, 0, 0), (0, 3, 0)],
    )  # fmt: skip


def quick(model, **options):
    return fit(model, seed=1, progress=False, **options)


def test_layout_by_class() -> None:
    assert build_layout(scene()).labels == ("mass[chair]",)
    assert build_layout(scene(shared=False)).labels == ("mass[chair1]", "mass[chair2]")
    first, second = scene().bodies
    locked = Body("chair3", BOX, known=KNOWN, object_class="chair", attributes=["locked", "new"])
    table = Body("table", BOX, known=KNOWN)
    mixed = scene().replace(bodies=(table, first, locked, second))
    expected = ("mass[table]", "mass[chair]", "mass[chair (locked, new)]")
    assert build_layout(mixed).labels == expected
    drag = pp.physics_model(scene().with_effects("chair2", "linear_drag"), recorded())
    assert problem_in(drag).layout.labels == (
        "mass[chair]",
        "linear_drag_coefficient[chair2]",
    )


def test_inertia_is_each_bodys_own() -> None:
    """One torque turns a disc and a box of one mass by their own moments."""
    model = Dynamics.known(scene(), {"mass": MASS})
    states = np.zeros((1, 1, 2, 6))
    states[..., 1, 1] = 3.0
    turn = model.step(states, np.array([[[0.0, 0.0, 0.3]] * 2]))[0, 0, :, 5]
    moments = [MASS * shape.unit_moment for shape in (BOX, DISC)]
    np.testing.assert_allclose(turn, 0.1 * 0.3 / np.array(moments), rtol=1e-9)
    np.testing.assert_array_equal(model.mass("chair1"), model.mass("chair2"))


@pytest.mark.parametrize("trajectories", [False, True])
def test_likelihood_is_that_of_equal_masses(trajectories) -> None:
    """Shared at m as unshared at (m, m), to rounding, with its slope; the prior counts once."""
    problems = []
    for shared in (True, False):
        own = scene(shared)
        problem = Problem.of(Physics(own), recorded())
        if trajectories:
            problem = along_trajectories(problem, np.full(problem.layout.size, MASS))
        problems.append(problem)
    one, two = problems
    sigma = one.noise_prior[0]
    m = np.array([[3.0], [MASS], [11.0]])
    both = np.repeat(m, 2, axis=1)
    density = one.log_density(one.residual(m), sigma, m).sum(axis=-1)
    np.testing.assert_allclose(
        density, two.log_density(two.residual(both), sigma, both).sum(axis=-1), rtol=1e-9
    )
    slope = [p.physics.simulator.jacobian(x, p.segments.start, p.inputs)
             for p, x in ((one, m[1]), (two, both[1]))]  # fmt: skip
    np.testing.assert_allclose(slope[0][..., 0], slope[1].sum(axis=-1), atol=1e-7)
    # P(m), not P(m)^2
    prior = one.layout.priors[0].log_density(m[:, 0])
    noise = log_prior(one, m, sigma) - prior
    np.testing.assert_allclose(log_prior(two, both, sigma), noise + 2 * prior, rtol=1e-12)
    np.testing.assert_allclose(log_posterior(one, m, sigma), density + prior + noise, rtol=1e-12)
    if not trajectories:  # PyMC says the same, up to the transforms' Jacobians
        logp = [physics_model(s, recorded()).compile_logp(jacobian=False)
                for s in (scene(), scene(False))]  # fmt: skip
        points = [{"mass_log__": np.log(x), "sigma_log__": np.log(sigma)} for x in (m[0], both[0])]
        assert logp[1](points[1]) - logp[0](points[0]) == pytest.approx(prior[0], abs=1e-6)


def test_sharing_bodies_are_one_part() -> None:
    """Given the noise their likelihoods are not independent; parts given otherwise agree too."""
    own = scene()
    history = recorded()
    assert independent_parts(own, history) == (("chair1", "chair2"),)
    assert len(independent_parts(scene(False), recorded())) == 2
    split = PartedSimulator(Physics(own, parts=(("chair1",), ("chair2",))))
    whole = PartedSimulator(Physics(own))
    start = history.transitions(history.dataset["start"].to_numpy())
    given = np.array([5.0]), start.start, start.actions
    np.testing.assert_allclose(split(*given), whole(*given), rtol=1e-12)
    np.testing.assert_allclose(split.jacobian(*given), whole.jacobian(*given), atol=1e-9)


def test_both_chairs_speak_of_one_mass() -> None:
    """Recovery from six transitions each: narrower than either alone, the truth inside.

    The 94 % interval misses by chance in 6 of 100 seeds; this one is fixed.
    """
    widths = {}
    for shared in (True, False):
        own = scene(shared)
        model = physics_model(own, recorded(seed=3))
        idata = quick(model, method="laplace")
        for label, values in scalars(idata).data_vars.items():
            if str(label).startswith("mass"):
                low, high = np.quantile(values, [0.03, 0.97])
                widths[label] = high - low
                assert low < MASS < high
        if shared:
            assert idata.posterior["mass"].dims == ("chain", "draw", "owner")
            assert idata.posterior["owner"].to_numpy().tolist() == ["chair"]
    alone = min(widths["mass[chair1]"], widths["mass[chair2]"])
    assert 0.4 * alone < widths["mass[chair]"] < 0.95 * alone


def test_file_prior_and_plan(tmp_path) -> None:
    """The file keeps the classes; the next prior is each chair's; a plan moves both alike."""
    own = scene().with_effects("chair2", "linear_drag")
    own = own.replace(bodies=tuple(
        Body(**(vars(b) | {"pose": (0.0, 3.0 * i, 0.0)})) for i, b in enumerate(own.bodies)
    ))  # fmt: skip
    idata = quick(physics_model(own, recorded()), method="laplace")
    pp.save_posterior(idata, tmp_path / "chairs.nc")
    loaded = pp.load_posterior(tmp_path / "chairs.nc")
    assert pp.Scene.from_toml(loaded.attrs["scene"]) == with_units(own, recorded())
    new = updated_scene(loaded)
    first, second = (dict(body.prior) for body in new.bodies)
    assert first["mass"] == second["mass"] and dict(first["mass"])["sigma"] < 0.1
    assert "linear_drag_coefficient" in second and "linear_drag_coefficient" not in first
    dynamics = Dynamics.of(loaded, 5)
    np.testing.assert_array_equal(dynamics.mass("chair1"), dynamics.mass("chair2"))
    goal = Goal.of({"chair1": (0.6, 0.0, None)}, tolerance=0.1)
    pushes = ActionSet.box("chair1", forces=(-20.0, 0.0, 20.0))
    plan = pp.plan(loaded, {"chair1": (0, 0, 0), "chair2": (0, 3, 0)}, goal, pushes)
    assert plan.reached
    library = learned_library({"room": idata})
    assert library.names == ("room",)


def test_one_choice_a_class() -> None:
    """A library's set is chosen for the class: what both chairs' data say together."""
    own = scene()
    library = ParameterLibrary({"light": {"mass": 3.0}, "heavy": {"mass": MASS}}, {"chair": {
        "light": 0.7, "heavy": 0.3}})  # fmt: skip
    np.testing.assert_allclose(library.prior("chair"), [0.7, 0.3])
    model = physics_model(own, recorded(), library=library)
    idata = quick(model)
    assert idata.posterior["library_index"].shape[2:] == (1,)
    table = library_probabilities(idata)
    assert table.index.tolist() == ["chair"] and table.loc["chair", "heavy"] == 1.0
    assert Dynamics.of(idata).mass("chair2") == MASS
