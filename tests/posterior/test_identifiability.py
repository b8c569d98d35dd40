"""What the data say: uninformed and inseparable parameters by name, nothing where all is well."""

import json
import warnings

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.effects import Effect, EffectParameter
from pbrl_ppl.errors import ConvergenceWarning
from pbrl_ppl.model import physics_model, problem_in
from pbrl_ppl.modes import find_mode
from pbrl_ppl.parameters import Prior
from pbrl_ppl.posterior import draws, identify, uninformed
from pbrl_ppl.posterior.identifiability import _spread
from pbrl_ppl.sampling import fit
from tests.helpers.carts import CART, cart_scene
from tests.helpers.histories import simulated_history

CONTACT = {"r": 0.2, "mu_c": 0.3}
QUICK = {"draws": 300, "tune": 200, "chains": 2, "cores": 1, "progress": False}


def _gain(state, command, parameters, wrench):
    for i in range(3):
        wrench[i] += (parameters[0] - 1.0) * command[i]


def _swirl(state, command, parameters, wrench):
    wrench[2] -= (parameters[0] + parameters[1]) * state[5]


def effect(name, force, *parameters) -> Effect:
    return Effect(name, parameters, "a sentence", "a test", force=force)


#: What every push and torque is multiplied by: nothing but the ratio to the mass shows.
GAIN = effect(
    "push_gain",
    _gain,
    EffectParameter("gain", "1", Prior("log_normal", mu=0.0, sigma=0.5), null=1.0),
)
#: Two numbers of which only the sum acts.
SWIRL = effect(
    "swirl",
    _swirl,
    EffectParameter("one", "N m s", Prior("normal", sigma=0.5)),
    EffectParameter("two", "N m s", Prior("normal", sigma=0.5)),
)


@pytest.fixture(scope="module")
def history():
    return simulated_history(cart_scene(), CART, seed=5, trajectories=8, intervals=12)


def mode_of(history, effects=(), **known):
    return find_mode(problem_in(physics_model(cart_scene(known=known), history, effects)), seed=1)


def quick_fit(model, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # few draws, on purpose
        return fit(model, seed=1, **(QUICK | options))


@pytest.fixture(scope="module")
def no_contact(history):
    """A whole fit where nothing touches anything."""
    model = physics_model(cart_scene(), history)
    return quick_fit(model)


@pytest.mark.one_stack
def test_without_contacts_the_contact_parameters_are_the_prior_s(no_contact) -> None:
    said = pp.identify(no_contact)
    table = said.table()
    assert set(table.index[table["verdict"] == "prior only"]) == {"r[cart]", "mu_c[cart]"}
    assert set(table.index[table["verdict"] == "informed"]) == {
        f"{name}[cart]" for name in ("mass", "w_x", "w_y", "w_theta", "mu_x", "mu_y")
    }
    # about 150 effective draws: the sd of a prior's own width is 6 % off
    assert table.loc[["r[cart]", "mu_c[cart]"], "ratio"].between(0.8, 1.2).all()
    assert table.loc["mass[cart]", "prior_sd"] == pytest.approx(1.5, rel=0.03)
    assert table.loc["mass[cart]", "posterior_sd"] == pytest.approx(
        np.log(draws(no_contact)["mass"]).std()
    )
    (sentence,) = said.sentences
    assert sentence.startswith("The data say nothing about r[cart] and mu_c[cart]: record contacts")
    assert said.uninformed == uninformed(no_contact) == ("r[cart]", "mu_c[cart]")


def test_a_mode_says_the_same_as_the_posterior_there(history, no_contact) -> None:
    mode = mode_of(history)
    alone, both = identify(mode), identify(no_contact, mode=mode)
    assert alone.sentences == both.sentences == identify(no_contact).sentences
    assert list(alone.table()["verdict"]) == list(both.table()["verdict"])
    # linearised against sampled, of what has a smooth posterior; 150 draws give 6 %
    for name in ("mass[cart]", "mu_x[cart]"):
        ratio = alone.table()["ratio"][name] / both.table()["ratio"][name]
        assert 0.7 < ratio < 1.4, name


def test_an_informed_problem_has_no_sentences(history) -> None:
    said = identify(mode_of(history, **CONTACT))
    assert said.sentences == ()
    assert (said.table()["verdict"] == "informed").all()


def test_mass_and_gain_move_together(history) -> None:
    """Only their ratio acts: a factor on one is a factor on the other."""
    said = identify(mode_of(history, (GAIN,), **CONTACT))
    (direction,) = said.directions
    weights = dict(direction.weights)
    assert set(weights) == {"mass[cart]", "push_gain_gain[cart]"}
    # equal logarithms: in prior sds as 1 / 1.5 to 1 / 0.5
    assert weights["push_gain_gain[cart]"] / weights["mass[cart]"] == pytest.approx(3.0, rel=0.05)
    assert direction.effect < 0.1
    (sentence,) = said.sentences
    assert "mass[cart] and push_gain_gain[cart] apart" in sentence
    assert "mass[cart] up with push_gain_gain[cart] up" in sentence
    assert said.uninformed == ()


def test_with_the_mass_known_the_gain_is_informed(history) -> None:
    said = identify(mode_of(history, (GAIN,), mass=CART["mass"], **CONTACT))
    assert said.sentences == ()
    assert said.table().loc["push_gain_gain[cart]", "verdict"] == "informed"


def test_opposite_signs_and_two_ambiguities_at_once(history) -> None:
    """They come out as two pairs, not as mixtures of both."""
    said = identify(mode_of(history, (GAIN, SWIRL), **CONTACT))
    assert {frozenset(dict(each.weights)) for each in said.directions} == {
        frozenset({"mass[cart]", "push_gain_gain[cart]"}),
        frozenset({"swirl_one[cart]", "swirl_two[cart]"}),
    }
    assert any("swirl_one[cart] up with swirl_two[cart] down" in each for each in said.sentences)


def test_everything_known(history) -> None:
    said = identify(mode_of(history, **CART))
    assert said.sentences == ()
    assert said.table().empty
    posterior = quick_fit(physics_model(cart_scene(known=CART), history))
    assert identify(posterior).table().empty


def test_report_values_are_json(history) -> None:
    values = identify(mode_of(history, (GAIN,))).to_dict()
    assert json.loads(json.dumps(values)) == values
    rows = {row["parameter"]: row for row in values["parameters"]}
    assert set(rows["r[cart]"]) == {"parameter", "prior_sd", "posterior_sd", "ratio", "verdict"}
    assert [set(each["weights"]) for each in values["directions"]] == [
        {"mass[cart]", "push_gain_gain[cart]"}
    ]
    assert len(values["sentences"]) == 2


def test_a_user_s_effect_has_to_be_passed_in(history) -> None:
    model = physics_model(cart_scene(known=CART), history, (GAIN,))
    idata = quick_fit(model, draws=100, tune=100)
    with pytest.raises(pp.PbrlError, match="push_gain"):
        identify(idata)
    said = identify(idata, effects=(*pp.catalogue, GAIN))
    assert said.table().loc["push_gain_gain[cart]", "verdict"] == "informed"
    assert uninformed(idata, effects=(*pp.catalogue, GAIN)) == ()


def test_equal_angles_have_no_spread() -> None:
    """The length of the mean of equal unit vectors may be just over 1."""
    with np.errstate(all="raise"):
        for angle in np.linspace(-3.0, 3.0, 50):
            spread = _spread(Prior("von_mises"), np.full(250, angle))
            assert spread == pytest.approx(0.0, abs=1e-7)
