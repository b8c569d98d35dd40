"""Each effect is named from data of another engine; clean data yields no name."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from pbrl_ppl.criticism.score import Library, rank_candidates, same_physics
from pbrl_ppl.effects import attach, candidates, catalogue
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, single_transitions
from pbrl_ppl.modes import find_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE
from tests.helpers.free_puck import BOX, DISC, Disc, box2d, fitted
from tests.helpers.histories import NOISE
from tests.helpers.places import MODELS

pytestmark = [pytest.mark.one_stack, pytest.mark.first(2)]

EFFECTS = {effect.name: effect for effect in catalogue}

#: What the Box2D generator hides in a free puck's 120 transitions, and how the catalogue describes
#: it: some five to ten times the smallest that shows.
HIDDEN = {
    "linear_drag": (0.06, {"coefficient": 0.06}),
    "quadratic_drag": (0.03, {"coefficient": 0.03}),
    "angular_drag": (0.003, {"coefficient": 0.003}),
    "constant_force": ((0.1, -0.05), {"force_x": 0.1, "force_y": -0.05}),
    "body_force": ((0.1, 0.05), {"force_x": 0.1, "force_y": 0.05}),
    "constant_torque": (0.004, {"torque": 0.004}),
    "push_offset": ((-0.003, 0.002), {"offset_x": -0.003, "offset_y": 0.002}),
    "actuator_rotation": (0.03, {"angle": 0.03}),
    "inertia_scale": (1.08, {"scale": 1.08}),
    "sliding_friction": ((0.006, 0.1), {"mu": 0.006}),
    "actuator_delay": (0.12, {"share": 0.12}),
    "dead_zone": (0.3, {"threshold": 0.3}),
    "force_cutoff": (2.0, {"threshold": 2.0}),
    "mass_change": ((1.08, 4, 0.0), {"factor": 1.08, "trajectory": 3.5}),
    "hidden_obstacle": ((1.8, 0.0, 0.2), {}),
    "wheel": ((0.1, 0.0, 0.5, 0.002, 0.02), {"mu_x": 0.002, "mu_y": 0.02}),
    "distance_joint": ((0.1, 0.05, 1.0, -0.5, 1.5), {"a_x": 0.1, "a_y": 0.05, "length": 1.5}),
    "sensor_bias": ((0, 0, 0, 0.03, -0.015, 0.06), {"vx": 0.03, "vy": -0.015, "omega": 0.06}),
}
#: And in a cart's 360, whose wheel's friction bends what an effect does.
ON_A_CART = {
    "angular_drag": (0.8, {"coefficient": 0.8}),
    "constant_force": ((1.0, -1.5), {"force_x": 1.0, "force_y": -1.5}),
    "push_offset": ((0.05, -0.06), {"offset_x": 0.05, "offset_y": -0.06}),
}


def ranked(scene, history):
    mode = fitted(scene, history)
    return rank_candidates(mode, candidates(scene, mode.problem.physics.effects))


def off(candidate, truth):
    """Error of a first estimate, as a share of the size."""
    error = [candidate.estimate[name] - value for name, value in truth.items()]
    return np.linalg.norm(error) / np.linalg.norm(list(truth.values()))


@pytest.mark.parametrize("name", HIDDEN)
def test_the_hidden_effect_comes_first_with_its_size(name, make_history) -> None:
    hidden, truth = HIDDEN[name]
    train, _ = box2d(make_history, 21, near=name == "hidden_obstacle", **{name: hidden})
    best = ranked(BOX, train)[0].candidate
    assert best.effect == name
    assert best.p_value < 1e-5
    # Over seeds 21 to 25 the size was off by at most 12 %, a threshold, which is one of those that
    # were looked at, by 26 %: noise, for the statistics are 30 to 300. The wheel's direction
    # and place are looked at too: 18 %.
    if truth:
        assert off(best, truth) < (0.3 if name in ("dead_zone", "force_cutoff", "wheel") else 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_A_CART)
def test_it_does_on_a_cart_whose_wheel_rubs(name, make_history) -> None:
    hidden, truth = ON_A_CART[name]
    train, _ = make_history.simulate(seed=21, **{name: hidden})
    best = ranked(Scene.load(MODELS / "shopping_cart" / "scene.toml"), train)[0].candidate
    assert best.effect == name
    assert best.p_value < 1e-6
    # off by 0.1 to 7 %: the unexplained acceleration is no smaller than what is missing
    assert off(best, truth) < 0.15


def test_clean_data_of_another_engine_yields_no_name(make_history) -> None:
    train, _ = box2d(make_history, 22)
    # corrected p-values: a false alarm in one clean history of a hundred, at a fixed seed
    found = ranked(BOX, train)
    assert min(one.candidate.p_value for one in found) > 0.01
    # and what was not found would have been, were it there: a fifth of what is hidden above
    smallest = {one.candidate.effect: one.candidate.detectable for one in found}
    assert smallest["linear_drag"]["coefficient"] < 0.06
    assert smallest["constant_force"]["force_x"] < 0.1
    # of what is scanned too, where it shows best
    assert smallest["dead_zone"]["threshold"] < 0.3
    assert smallest["force_cutoff"]["threshold"] < 2.0
    assert smallest["mass_change"]["factor"] < 0.08
    assert smallest["wheel"]["mu_y"] < 0.02
    assert smallest["hidden_obstacle"] == smallest["distance_joint"] == {}


@pytest.mark.slow
def test_clean_data_of_a_cart_yields_no_name(make_history) -> None:
    train, _ = make_history.simulate(seed=22)
    found = ranked(Scene.load(MODELS / "shopping_cart" / "scene.toml"), train)
    assert min(one.candidate.p_value for one in found) > 0.01  # a false alarm in one of a hundred


def test_the_shape_of_the_noise_is_declared_and_no_candidate() -> None:
    assert not any(one.effect.name == "heavy_tails" for one in candidates(BOX, ()))


@pytest.mark.slow
def test_statistic_is_chi_squared_if_nothing_is_missing() -> None:
    """200 recordings of ten intervals with noise on every state, of a law in closed form."""
    degrees = {"constant_force": 2, "actuator_rotation": 1, "constant_torque": 1, "push_offset": 2}
    # the sensors' noise is stated, which saves half of the time; test_misfit infers it
    disc = Disc(scene=DISC.replace(substeps=40, noise=dict(zip(STATE, NOISE, strict=True))))
    rng = np.random.default_rng(5)
    tried = [EFFECTS[name].on("puck") for name in degrees]
    found = {name: [] for name in degrees}
    for _ in range(200):
        for one in rank_candidates(disc.mode(rng), tried):
            found[one.candidate.effect].append(one.candidate.statistic)
    for name, statistics in found.items():
        # a Kolmogorov-Smirnov test at 0.1 % of each of four, at a fixed seed
        assert kstest(statistics, chi2(degrees[name]).cdf).pvalue > 0.001, name


def test_one_sided_statistics_are_half_as_likely() -> None:
    """Drag is above zero or not there: under none, half of the statistics are zero."""
    disc = Disc(scene=DISC.replace(substeps=40, noise=dict(zip(STATE, NOISE, strict=True))))
    rng = np.random.default_rng(6)
    tried = [EFFECTS["linear_drag"].on("puck")]
    found = [rank_candidates(disc.mode(rng), tried)[0] for _ in range(60)]
    p = np.exp([one.log_p for one in found])
    assert 13 <= (p == 1).sum() <= 47  # binomial, a false alarm in 1e-5
    # those that are not are uniform below a half: Kolmogorov-Smirnov at 0.1 %
    assert kstest(2 * p[p < 1], "uniform").pvalue > 0.001


@pytest.mark.slow
def test_a_fifth_of_what_single_transitions_show_is_seen_along_trajectories() -> None:
    """At least half of twenty pucks' drags, each a fifth of the least that Eq. 11 shows."""
    scene = DISC.replace(substeps=40)
    smooth = [one for one in candidates(scene, ()) if one.effect.scan is None]
    rng = np.random.default_rng(15)

    def score(mode):
        found = {one.candidate.effect: one.candidate for one in rank_candidates(mode, smooth)}
        return found["linear_drag"]

    history = History.from_dataframe(Disc(8, 15, scene).frame(rng), scene)
    problem = single_transitions(Problem.of(Physics.declare(scene), history))
    limit = score(find_mode(problem, seed=1)).detectable["coefficient"]
    pucks = (Disc(8, 15, scene, drag=limit / 5, seed=seed) for seed in range(20))
    found = [score(puck.mode(rng)).p_value < 0.01 for puck in pucks]
    assert np.mean(found) >= 0.5


def test_drag_cannot_have_the_wrong_sign() -> None:
    # a body that is pushed along by its own motion: no drag explains that
    disc = Disc(drag=-0.2)
    mode = fitted(DISC, disc.frame(np.random.default_rng(6)))
    (signature,) = rank_candidates(mode, [EFFECTS["linear_drag"].on("puck")])
    assert signature.candidate.statistic == 0.0
    assert signature.candidate.p_value == 1.0


def test_an_effect_without_a_trace_is_not_identifiable() -> None:
    frame = Disc().frame(np.random.default_rng(7)).assign(force_x=0.0, force_y=0.0)
    (signature,) = rank_candidates(fitted(DISC, frame), [EFFECTS["push_offset"].on("puck")])
    assert signature.candidate.identifiable == 0.0
    assert signature.candidate.statistic == 0.0
    assert signature.candidate.p_value == 1.0


def test_drags_of_a_single_pendulum_are_indistinguishable(make_history) -> None:
    scene = Scene.load(MODELS / "pendulum" / "scene.toml")
    setup = replace(make_history.PENDULUM, n_intervals=40)
    train, _ = make_history.simulate(seed=9, setup=setup, pivot_damping=0.02)
    found = ranked(scene, train)
    library = Library(fitted(scene, History.from_dataframe(train, scene)))
    names = ("pivot_damping", "angular_drag", "linear_drag", "constant_torque")
    tried = [one for one in candidates(scene, ()) if one.effect.name in names]
    by_name = {one.effect.name: library.scored(one, len(tried)) for one in tried}
    assert same_physics(by_name["pivot_damping"], by_name["angular_drag"])
    assert same_physics(by_name["pivot_damping"], by_name["linear_drag"])
    assert not same_physics(by_name["pivot_damping"], by_name["constant_torque"])
    assert found[0].attached.effect.name in ("pivot_damping", "angular_drag", "linear_drag")


def test_no_candidates_no_ranking() -> None:
    assert rank_candidates(Disc().mode(np.random.default_rng(8)), []) == []


def test_a_declared_effect_is_no_candidate() -> None:
    scene = BOX.with_effects("puck", "linear_drag")
    names = [one.effect.name for one in candidates(scene, attach(scene))]
    assert "linear_drag" not in names
    assert "quadratic_drag" in names


def test_a_declared_effect_leaves_nothing_to_find(make_history) -> None:
    scene = BOX.with_effects("puck", "linear_drag")
    train, _ = box2d(make_history, 21, linear_drag=0.06)
    history = History.from_dataframe(train, scene)
    assert ranked(scene, history)[0].candidate.p_value > 0.01  # 1 % false alarms
