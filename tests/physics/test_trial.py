"""A user's own effect is tried before it runs inside a fit."""

import time
from dataclasses import replace

import numpy as np
import pytest

from pbrl_ppl.effects import (
    Command,
    Disc,
    Effect,
    EffectParameter,
    Force,
    Noise,
    Properties,
    Sensor,
    Structure,
    attach,
    catalogue,
)
from pbrl_ppl.errors import EffectError
from pbrl_ppl.parameters import Prior
from pbrl_ppl.physics import try_effect
from pbrl_ppl.scene import Body, Scene, Shape
from tests.helpers.histories import simulated_history

pytestmark = pytest.mark.one_stack

PUCK = Scene(
    time_step=0.1, bodies=(Body("puck", Shape.circle(0.2), known={"r": 0.2, "mu_c": 0.3}),)
)


@pytest.fixture(scope="module")
def history():
    return simulated_history(PUCK, {"mass": 2.0}, seed=1)


def own(stage, prior=None):
    prior = prior or Prior("half_normal", sigma=1.0)
    return Effect("own", (EffectParameter("size", "N", prior),), "made up", "a test", stage)


def raising(state, command, parameters, wrench):
    raise ZeroDivisionError("of course")


def endless(state, command, parameters, wrench):
    while parameters[0] >= 0.0:
        time.sleep(0.01)


def undefined(state, command, parameters, wrench):
    wrench[0] = np.inf - np.inf if parameters[0] > 0 else 0.0


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        (Force(raising), "raised ZeroDivisionError when it was tried: of course"),
        (Force(endless), "did not return within 0.3 s"),
        (Force(undefined), "not a finite number on puck at size ="),
        (Properties(lambda properties, parameters, clock: properties["nope"]), "raised KeyError"),
        (
            Sensor(lambda state, p: state, lambda state, p: state / (p["size"][..., None] * 0)),
            "not a finite number",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_broken_effect_is_refused(history, stage, said) -> None:
    with pytest.raises(EffectError, match=said):
        try_effect(own(stage), PUCK, history, patience=0.3)


def test_the_whole_catalogue_passes_and_with_wrong_null_values_does_not(history) -> None:
    """Without the second claim a trial that evaluates nothing would do."""
    acting, refused, rng = set(), set(), np.random.default_rng(1)
    for scene in (PUCK, PUCK.replace(gravity=(0.0, -9.81))):
        for effect in catalogue:
            try_effect(effect, scene, history)
            if effect.applies(scene, PUCK.bodies[0]):
                acting.add(effect.name)
            for _ in range(60):  # an obstacle may be far away, and a threshold below all pushes
                wrong = tuple(
                    replace(parameter, null=float(parameter.prior.sample(rng, 1)[0]))
                    for parameter in effect.parameters
                )
                try:
                    try_effect(replace(effect, parameters=wrong), scene, history)
                except EffectError as error:
                    assert "does not vanish on puck at its null value" in str(error)
                    refused.add(effect.name)
                    break
    assert acting - refused <= {"mass_change"}  # it may be after the recording
    assert refused <= acting


def push(state, command, parameters, wrench):
    wrench[0] += 1.0 + parameters[0]


def halve(state, command, parameters, wrench):
    for i in range(3):
        wrench[i] *= 0.5 + parameters[0]


def heavier(properties, parameters, clock):
    properties["mass"] = 1.5 * properties["mass"] + parameters["size"]


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        (Force(push), r"\(size = 0 N\): it changes vx of puck by 0\.\d+ m/s in one interval"),
        (Command(halve), "changes (v[xy]|omega) of puck by"),
        (Properties(heavier), "changes .* of puck by"),
        (Sensor(lambda s, p: s + 1.0, lambda s, p: s - 0.9), "of puck by"),
        (Structure(lambda p: (Disc(p["size"], 0.0 * p["size"], 9.0 + p["size"]),)), "of puck by"),
        (Noise(lambda p: 0.1 + p["size"]), r"its tail is 0\.1 there, expected 0"),
    ],
)
def test_an_effect_must_vanish_at_its_null_value(history, stage, said) -> None:
    with pytest.raises(EffectError, match=said) as caught:
        try_effect(own(stage), PUCK, history)
    assert "effect own does not vanish on puck at its null value" in str(caught.value)
    assert "change its law, or give EffectParameter the null=" in str(caught.value)


def test_a_null_value_that_is_not_zero_is_enough(history) -> None:
    size = EffectParameter("size", "1", Prior("normal"), null=0.5)
    effect = Effect("own", (size,), "made up", "a test", Command(halve))
    try_effect(effect, PUCK, history)
    for null, shown in ((0.0, "0"), (0.499, "0.499")):
        elsewhere = replace(effect, parameters=(replace(size, null=null),))
        with pytest.raises(EffectError, match=rf"at its null value \(size = {shown}\): it changes"):
            try_effect(elsewhere, PUCK, history)


def test_the_null_value_is_tried_without_measured_velocities() -> None:
    history = simulated_history(PUCK, {"mass": 2.0}, seed=1)
    history.dataset["start"].loc[{"state": ["vx", "vy", "omega"]}] = np.nan
    try_effect(own(Force(lambda state, command, parameters, wrench: None)), PUCK, history)
    with pytest.raises(EffectError, match="changes vx of puck"):
        try_effect(own(Force(push)), PUCK, history)


def test_the_name_of_a_catalogue_effect_is_refused() -> None:
    size = EffectParameter("coefficient", "kg/s", Prior("half_normal"))
    mine = Effect("linear_drag", (size,), "made up", "a test", Force(push))
    refused = "effect linear_drag: the catalogue has another effect of this name; choose another"
    for given in (((mine,), catalogue), ((), (*catalogue, mine))):
        with pytest.raises(EffectError, match=refused):
            attach(PUCK, *given)
    (drag,) = (effect for effect in catalogue if effect.name == "linear_drag")
    wide = Effect(drag.name, (size,), drag.sentence, drag.reference, drag.stage)
    assert attach(PUCK, (wide,))[0].effect.parameters == (size,)  # its law with another prior


def test_a_scan_of_another_shape_is_refused(history) -> None:
    def scan(scene, history, body):
        return np.zeros((3, 2))

    effect = Effect(
        "own",
        (EffectParameter("size", "N", Prior("half_normal", sigma=1.0)),),
        "made up",
        "a test",
        Force(lambda state, command, parameters, wrench: None),
        scan=scan,
    )
    with pytest.raises(EffectError, match=r"scan gave shape \(3, 2\), expected \(point, 1\)"):
        try_effect(effect, PUCK, history)
