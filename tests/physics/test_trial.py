"""A user's own effect is tried before it runs inside a fit."""

import time

import numpy as np
import pytest

from pbrl_ppl.effects import Effect, EffectParameter, Force, Properties, Sensor, catalogue
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


def test_the_whole_catalogue_passes(history) -> None:
    for scene in (PUCK, PUCK.replace(gravity=(0.0, -9.81))):
        for effect in catalogue:
            try_effect(effect, scene, history)


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
