"""The whole loop: verdicts on data of another engine, on nonsense, on effects of the user's own.

Most are of a free puck, for a loop on it takes seconds; each loop is run once.
"""

import json
import warnings
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import pbrl_ppl as pp
from pbrl_ppl.criticism import close_loop
from pbrl_ppl.criticism import closing as loop_module
from pbrl_ppl.criticism.criteria import DEFAULT
from pbrl_ppl.criticism.refinement import checked_histories
from pbrl_ppl.errors import (
    ConvergenceWarning,
    EffectError,
    HistoryError,
    PosteriorError,
    PriorWarning,
    RefitWarning,
)
from pbrl_ppl.modes import filtered_mode
from pbrl_ppl.sampling import WeightsError
from pbrl_ppl.state import STATE, WRENCH
from tests.helpers.free_puck import BOX, DISC, MASS, Disc, box2d, fitted, searched
from tests.helpers.places import load

pytestmark = [
    pytest.mark.first(1),
    # a posterior of few draws is enough to test a verdict, and says that it is one
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.ConvergenceWarning"),
    # of a missing effect too, where it is large
    pytest.mark.filterwarnings("ignore::pbrl_ppl.errors.PriorWarning"),
]
#: Of each of four chains: about 250 effective ones, where a verdict needs 100.
DRAWS = 300
#: The Gaussian at the mode will do where the claim is a verdict's, not that of the chains.
GAUSSIAN = "laplace"
#: Enough to search where the claim is of the draws.
DRAGS = tuple(effect for effect in pp.catalogue if effect.name.endswith("drag"))


def without(*names: str) -> tuple[pp.Effect, ...]:
    return tuple(effect for effect in pp.catalogue if effect.name not in names)


def histories(frames, scene=BOX):
    return tuple(pp.History.from_dataframe(frame, scene) for frame in frames)


def loop(frames, scene=BOX, method=GAUSSIAN, **options):
    return close_loop(scene, *histories(frames, scene), seed=1, method=method, **options)


@pytest.fixture(scope="module")
def clean(make_history):
    return box2d(make_history, 4)


@pytest.fixture(scope="module")
def adequate(clean):
    return loop(clean, method="importance", draws=DRAWS)


@pytest.mark.slow
def test_clean_data_are_adequate(adequate) -> None:
    assert adequate.verdict == "adequate"
    assert adequate.added == ()
    assert adequate.unexplained is None
    assert all(test.passed for test in adequate.tests)
    assert adequate.posterior_after is adequate.posterior_before
    mass = adequate.posterior_after["posterior"]["mass"].values
    low, high = np.quantile(mass, [0.0005, 0.9995])  # a false alarm in a thousand
    assert low <= MASS <= high


@pytest.mark.slow
def test_adequate_says_what_would_have_been_seen(adequate) -> None:
    """Sizes that are found in test_criticism are above those."""
    sizes = {one.effect: one.detectable for one in adequate.candidates}
    for effect, parameter, hidden in (
        ("linear_drag", "coefficient", 0.06),
        ("constant_force", "force_x", 0.1),
        ("actuator_delay", "share", 0.12),
        ("constant_torque", "torque", 0.004),
    ):
        assert 0 < sizes[effect][parameter] < hidden
    assert "hidden_obstacle" not in sizes  # unusual laws were not tried


@pytest.mark.slow
def test_its_posterior_goes_on_with_what_is_recorded_after(adequate, clean) -> None:
    """What a loop gives is what an update takes: whole trajectories, both noises."""
    more = histories(clean)[1].select([0])
    with warnings.catch_warnings():
        for kind in (ConvergenceWarning, RefitWarning):  # of so few draws
            warnings.simplefilter("ignore", kind)
        updated = pp.update(adequate.posterior_after, more, seed=1)
    (entry,) = json.loads(updated.attrs["updates"])
    assert entry["did"] in ("reweighted", "refitted")
    assert entry["transitions"] == 15
    before, after = (
        each["posterior"]["mass"].values for each in (adequate.posterior_after, updated)
    )
    assert np.unique(after).size > 50
    # a thousandth of false alarms for the truth, and no wider than Monte Carlo makes it
    low, high = np.quantile(after, [0.0005, 0.9995])
    assert low <= MASS <= high
    assert after.std() < 1.2 * before.std()
    with pytest.raises(PosteriorError, match="already"):
        pp.update(updated, more, seed=1)


@pytest.mark.slow
def test_a_catalogued_effect_is_named_with_its_size(make_history) -> None:
    found = loop(box2d(make_history, 4, actuator_delay=0.3))
    assert found.verdict == "effects-added"
    (added,) = found.added
    assert added.effect == "actuator_delay"
    low, high = added.parameters["share"].hdi
    assert low <= 0.3 <= high  # of one seed: it does in 94 % of all
    assert high - low < 0.02
    assert added.elpd_difference > 2 * added.elpd_difference_se
    (named,) = [one for one in found.candidates if one.effect == added.effect]
    assert named.why == "added"
    assert all(one.why for one in found.candidates)
    assert all(test.passed for test in found.tests)
    before, after = found.acceleration.before, found.acceleration.after
    assert after["vx"] < 0.1 * before["vx"]
    json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_an_effect_outside_the_catalogue_gets_no_wrong_name(make_history) -> None:
    """Quadratic drag takes most of a linear one, 83 % of its square: the verdict stays open."""
    frames = box2d(make_history, 4, linear_drag=0.6)
    found = loop(frames, catalogue=without("linear_drag", "drag_by_axis"))
    assert found.candidates[0].effect == "quadratic_drag"
    assert found.verdict == "unexplained"
    assert found.unexplained.body == "puck"


@pytest.mark.slow
def test_what_comes_by_chance_takes_no_name_away() -> None:
    """Two fifths of what was missing remain, and nothing predicts them: the rest is the drag's."""
    disc = Disc(8, 20, drag=1.2)
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, (0.45, 0.45, 0.0), disc.pushes.shape)
    train, test = disc.frame(rng, pushed=noise), disc.frame(rng, pushed=noise[::-1])
    found = loop((train, test), DISC, catalogue=DRAGS)
    assert found.verdict == "unexplained"  # and that something remains is said
    assert [one.effect for one in found.added] == ["linear_drag"]
    estimate = found.added[0].parameters["coefficient"]
    assert abs(estimate.mean - 1.2) < 3 * estimate.sd
    before, after = found.acceleration.before, found.acceleration.after
    assert after["vx"] ** 2 > 0.2 * before["vx"] ** 2
    assert after["vx"] == pytest.approx(0.45, rel=0.2)


@pytest.mark.one_stack
@pytest.mark.parametrize(
    ("name", "size", "richer"),
    [
        ("saturation", 2.7, ()),
        ("spring", (0.5, 1.0, -0.5), ()),
        ("actuator_delay", 0.4, ("first_order_lag", "rate_limit", "actuator_backlash")),
        ("corrugation", (0.3, 0.3), ()),
    ],
)
def test_the_search_has_no_name_for_what_is_outside(name, size, richer, make_history) -> None:
    mode = fitted(BOX, box2d(make_history, 4, **{name: size})[0])
    found = searched(mode, without(name, *richer))
    if found.laws:  # then much of what was missing remains
        before, after = mode.sigma[6:], filtered_mode(mode, found.after).sigma[6:]
        assert (after[:2] > 0.4 * before[:2]).all()


def degrees(frame):
    return frame.assign(theta=np.degrees(frame["theta"]), omega=np.degrees(frame["omega"]))


def unpushed(frame):
    return frame.assign(
        force_x=0 * frame["force_x"], force_y=0 * frame["force_y"], torque=0 * frame["torque"]
    )


def millinewtons(frame):
    return frame.assign(force_x=1000 * frame["force_x"], force_y=1000 * frame["force_y"])


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [degrees, unpushed, millinewtons])
def test_nonsense_is_never_adequate(wrong, clean) -> None:
    """Of half of the trajectories: the loop fits laws to nonsense for long."""
    found = loop([wrong(frame[frame["trajectory"] < 4]) for frame in clean])
    assert found.verdict != "adequate"
    assert found.unexplained is not None
    assert not all(test.passed for test in found.tests)


class Fitting(Exception):
    """The loop began to fit."""


def until_it_fits(stage: str) -> None:
    if stage.startswith("fitting"):
        raise Fitting


@pytest.mark.one_stack
def test_wrong_units_are_told_before_the_fit(clean) -> None:
    told = pytest.warns(PriorWarning, match="of puck changes .* check units.*; [0-9]+ more")
    with told, pytest.raises(Fitting):
        loop([millinewtons(frame) for frame in clean], progress=until_it_fits)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(Fitting):
            loop(clean, progress=until_it_fits)


@pytest.mark.slow
def test_too_few_draws_give_no_verdict(clean) -> None:
    found = loop(clean, method="importance", draws=5, catalogue=DRAGS)
    assert found.verdict == "not-converged"
    assert found.unexplained is None  # the tests are of the mode, and passed


@pytest.mark.slow
def test_weights_that_miss_a_part_give_no_verdict(clean, monkeypatch) -> None:
    """Whatever the other diagnostics say."""

    def weighted(*arguments, **options):
        fitted = sample(*arguments, **options)
        fitted.posterior.attrs["pareto_k"] = 0.8
        return fitted

    sample = loop_module.sample
    monkeypatch.setattr(loop_module, "sample", weighted)
    assert loop(clean, catalogue=DRAGS).verdict == "not-converged"


def test_a_users_effect_that_fails_says_so_at_once(clean) -> None:
    def law(state, command, parameters, wrench):
        wrench[0] -= parameters[1] * state[3]  # there is one parameter

    size = pp.EffectParameter("size", "kg/s", pp.Prior("half_normal", sigma=1.0))
    broken = pp.Effect("broken", (size,), "a mistake", "none", force=law)
    stages = []
    with pytest.raises(EffectError, match="broken"):
        loop(clean, catalogue=(*pp.catalogue, broken), progress=stages.append)
    assert stages == []


def _tether(state, command, parameters, wrench):
    wrench[0] -= parameters[0] * (state[0] - 1.0)
    wrench[1] -= parameters[0] * (state[1] + 0.5)


TETHER = pp.Effect(
    "tether",
    (pp.EffectParameter("stiffness", "N/m", pp.Prior("half_normal", sigma=20.0)),),
    "a pull towards a place in the room that grows with the distance",
    "Hooke's law, F = -k x",
    force=_tether,
)


@pytest.mark.slow
def test_a_users_own_effect_is_found_in_a_model_without_unknowns(make_history) -> None:
    known = {"mass": MASS, "r": 0.1, "mu_c": 0.3}
    scene = BOX.replace(bodies=(pp.Body("puck", pp.Shape.box(0.4, 0.3), known=known),))
    frames = box2d(make_history, 4, spring=(0.5, 1.0, -0.5))
    found = loop(frames, scene, catalogue=(*without("hidden_obstacle"), TETHER))
    assert found.verdict == "effects-added"
    assert [one.effect for one in found.added] == ["tether"]
    estimate = found.added[0].parameters["stiffness"]
    assert estimate.mean == pytest.approx(0.5, rel=0.02)
    assert found.candidates[0].effect == "tether"


@pytest.mark.one_stack
def test_computed_velocities_are_recognised_and_the_effect_is_found(make_history) -> None:
    frames = box2d(make_history, 4, trajectories=12, intervals=30, linear_drag=0.3)
    computed = []
    for frame in frames:
        for rate, place in (("vx", "x"), ("vy", "y"), ("omega", "theta")):
            frame[rate] = frame.groupby("trajectory")[place].transform(
                lambda values: np.gradient(values, 0.1)
            )
        computed.append(frame)
    train, test, unused, _ = checked_histories(BOX, *histories(computed))
    assert [each.state for each in unused] == ["vx", "vy", "omega"]
    for history in (train, test):
        observed = history.dataset["observed"].to_numpy()[..., 3:]
        assert np.isnan(observed).all()
    (law,) = searched(fitted(BOX, train), pp.catalogue).laws.values()
    assert law.effect == "linear_drag"
    size, spread = law.estimate["coefficient"], law.sd["coefficient"]
    assert abs(size - 0.3) < 4 * spread  # a false alarm in 1e-4
    assert spread < 0.02


@pytest.mark.one_stack
def test_a_recording_in_which_nothing_moves_is_refused_at_once(clean) -> None:
    still = clean[0].assign(**dict.fromkeys((*STATE, *WRENCH), 0.0))
    stages = []
    with pytest.raises(HistoryError, match="nothing moves: every number"):
        loop([still, clean[1]], progress=stages.append)
    assert stages == []
    (history,) = histories([still])
    with pytest.raises(HistoryError, match="nothing moves"):
        pp.physics_model(BOX, history, likelihood="trajectories")
    pp.physics_model(BOX, history)  # Eq. 11 has a noise of its own


@pytest.mark.slow
def test_a_carts_drag_is_chosen_and_known_to_a_hundredth(shared_data) -> None:
    """Without draws: the mode and its covariance say what the posterior will."""
    scene, train, _ = load(shared_data / "cart-linear-drag")
    (law,) = searched(fitted(scene, train), pp.catalogue).laws.values()
    assert law.effect == "linear_drag"
    size, spread = law.estimate["coefficient"], law.sd["coefficient"]
    assert abs(size - 3.0) < 4 * spread  # a false alarm in 1e-4
    assert 2 * norm.isf(0.03) * spread < 0.05  # the width of 94 %


@pytest.mark.long
def test_the_loop_finds_a_carts_drag(shared_data) -> None:
    found = close_loop(*load(shared_data / "cart-linear-drag"), seed=1)
    assert found.verdict == "effects-added"
    assert [one.effect for one in found.added] == ["linear_drag"]
    low, high = found.added[0].parameters["coefficient"].hdi
    assert low <= 3.0 <= high
    assert high - low <= 0.05
    for dimension, error in found.after.rollout_rmse.items():
        assert error < found.before.rollout_rmse[dimension]


#: Effect in the truth file -> name in the catalogue, and its parameters' names.
NAMES = {
    "cart-slope": ("constant_force", ("force_x", "force_y")),
    "cart-thrust-bias": ("body_force", ("force_x", "force_y")),
    "cart-offset-push": ("push_offset", ("offset_x", "offset_y")),
}


@pytest.mark.long
@pytest.mark.parametrize("case", NAMES)
def test_other_effects_on_carts_are_found(case, shared_data) -> None:
    found = close_loop(*load(shared_data / case), seed=1)
    ((_, value),) = json.loads((shared_data / case / "truth.json").read_text())[
        "undeclared"
    ].items()
    name, parameters = NAMES[case]
    assert found.verdict == "effects-added"
    assert [one.effect for one in found.added] == [name]
    for parameter, true in zip(parameters, np.atleast_1d(value), strict=True):
        estimate = found.added[0].parameters[parameter]
        assert abs(estimate.mean - true) < 4 * estimate.sd  # a false alarm in 1e-4


@pytest.mark.long
def test_a_clean_cart_is_adequate(shared_data) -> None:
    found = close_loop(*load(shared_data / "cart-null"), seed=1)
    assert found.verdict == "adequate"
    truth = json.loads((shared_data / "cart-null" / "truth.json").read_text())["truth"]
    body = truth["bodies"][0]
    expected = {"mass": body["mass"]} | {
        name: body["wheel"][key]
        for name, key in (
            ("w_x", "x"), ("w_y", "y"), ("w_theta", "theta"), ("mu_x", "mu_x"), ("mu_y", "mu_y")
        )
    }  # fmt: skip
    draws = found.posterior_after["posterior"]
    for name, value in expected.items():
        low, high = np.quantile(draws[name].values, [0.0005, 0.9995])
        assert low <= value <= high, (name, low, value, high)


@dataclass(frozen=True)
class _Mode:
    """What the loop asks of a mode before it draws."""

    problem: Any


def test_weights_that_do_not_suffice_leave_gaussians(monkeypatch) -> None:
    """The verdict then relies on the mode, which is said: particles could take minutes."""

    def weighted(problem: Any, *, method: str, **options: Any) -> Any:
        if method == "importance":
            raise WeightsError("fit: importance weights do not suffice")
        held = {"method": method, "interrupted": None, "pareto_k": None}
        return SimpleNamespace(record=SimpleNamespace(**held, max_rhat=1.02, min_ess=350.0))

    monkeypatch.setattr("pbrl_ppl.criticism.closing.sample", weighted)
    mode = _Mode(SimpleNamespace(likelihood=SimpleNamespace(name="transitions")))
    task = SimpleNamespace(method="importance", seed=1, draws=None, criteria=DEFAULT, say=print)
    with pytest.warns(ConvergenceWarning, match="do not suffice; the draws are from the Gaussian"):
        (fitted,) = loop_module._fits(task, [mode])
    assert fitted.record.method == "laplace"


@pytest.mark.parametrize(("method", "said"), [("laplace", 0), ("smc", 1)])
def test_only_chains_are_said_not_to_converge(method, said, monkeypatch) -> None:
    """Independent draws have an R-hat too, and nothing to converge."""

    def unconverged(*args: Any, **options: Any) -> Any:
        warnings.warn("the chains have not converged", ConvergenceWarning, stacklevel=1)
        held = {"method": method, "interrupted": None, "pareto_k": None}
        held |= {"max_rhat": 1.02, "min_ess": 350.0}
        return SimpleNamespace(record=SimpleNamespace(**held))

    monkeypatch.setattr("pbrl_ppl.criticism.closing.sample", unconverged)
    mode = _Mode(SimpleNamespace(likelihood=SimpleNamespace(name="transitions")))
    task = SimpleNamespace(method=method, seed=1, draws=None, criteria=DEFAULT, say=print)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loop_module._fits(task, [mode])
    assert len(caught) == said
