"""Attaching effects to bodies: by name, as values, and every way to get it wrong."""

import dataclasses

import pytest

from pbrl_ppl.effects import EffectParameter, attach, candidates
from pbrl_ppl.errors import EffectError
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Joint, Scene, Shape
from tests.helpers.worlds import BY_NAME, body

pytestmark = pytest.mark.one_stack

BOX = Shape.box(0.9, 0.55)


def test_attaches_declared_effects_then_extra_ones() -> None:
    bodies = (body("cart", BOX), body("arm", BOX))
    joint = Joint("hinge", ("cart", "arm"), (0.5, 0.0), (0.0, 0.2))
    scene = Scene(time_step=0.1, bodies=bodies, joints=(joint,)).with_effects(
        "arm", "angular_drag", "linear_drag"
    )
    got = attach(scene, [BY_NAME["pivot_damping"].on("arm"), BY_NAME["constant_torque"]])
    assert [(one.effect.name, one.body) for one in got] == [
        ("angular_drag", "arm"),
        ("linear_drag", "arm"),
        ("pivot_damping", "arm"),
        ("constant_torque", "cart"),
        ("constant_torque", "arm"),
    ]


def test_candidates_are_what_is_not_there_yet_and_applies() -> None:
    scene = Scene(time_step=0.1, bodies=(body("one", BOX), body("two", BOX)))
    declared = attach(scene.with_effects("two", "linear_drag"))
    pairs = {(one.effect.name, one.body) for one in candidates(scene, declared)}
    assert ("linear_drag", "one") in pairs
    assert ("linear_drag", "two") not in pairs
    assert not {name for name, _ in pairs if name.startswith("pivot")}


def test_a_candidate_in_a_hinge_can_do_something() -> None:
    """Friction in a hinge belongs to the body that hangs in it, so only that one is a candidate."""
    bodies = (body("base", BOX), body("arm", BOX))
    joint = Joint("hinge", ("base", "arm"), (0.5, 0.0), (0.0, 0.2))
    scene = Scene(time_step=0.1, bodies=bodies, joints=(joint,))
    on = [one.body for one in candidates(scene, ()) if one.effect.name == "pivot_friction"]
    assert on == ["arm"]


def test_attach_says_what_is_wrong() -> None:
    scene = Scene(time_step=0.1, bodies=(body("puck", BOX), body("two", BOX)))
    drag = BY_NAME["linear_drag"]
    with pytest.raises(EffectError, match=r"'puck' declares .*'linear_drga'.*mean \"linear_drag\""):
        attach(scene.with_effects("puck", "linear_drga"))
    with pytest.raises(EffectError, match=r"not in the catalogue.*; give an effect .* \(known: "):
        attach(scene.with_effects("puck", "zzz"))
    with pytest.raises(EffectError, match=r"linear_drag is put on 'cart'.*puck, two"):
        attach(scene, [drag.on("cart")])
    with pytest.raises(EffectError, match="linear_drag is put on body 'puck' twice"):
        attach(scene, [drag.on("puck"), drag.on("puck")])
    with pytest.raises(EffectError, match="linear_drag is put on body 'two' twice"):
        attach(scene.with_effects("two", "linear_drag"), [drag])
    with pytest.raises(EffectError, match="pivot_friction does not apply to body 'puck'"):
        attach(scene, [BY_NAME["pivot_friction"].on("puck")])
    with pytest.raises(EffectError, match="pivot_friction applies to no body"):
        attach(scene, [BY_NAME["pivot_friction"]])


def test_two_effects_of_one_name_on_a_body_are_refused() -> None:
    """Their parameters would have the same names."""
    scene = Scene(time_step=0.1, bodies=(body("puck", BOX),))
    drag = BY_NAME["linear_drag"]
    other = dataclasses.replace(drag, sentence="the user's own variant of the same name")
    with pytest.raises(EffectError, match="linear_drag"):
        attach(scene, [drag.on("puck"), other.on("puck")])


def test_an_effect_that_can_do_nothing_is_refused() -> None:
    drag = BY_NAME["linear_drag"]
    with pytest.raises(EffectError, match="not an identifier"):
        dataclasses.replace(drag, name="linear drag")
    with pytest.raises(EffectError, match="no parameters"):
        dataclasses.replace(drag, parameters=())
    with pytest.raises(EffectError, match="expected one of Structure"):
        dataclasses.replace(drag, stage=None)
    below = EffectParameter("coefficient", "kg/s", Prior("half_normal"), null=-1.0)
    with pytest.raises(EffectError, match=r"null value -1\.0 of coefficient"):
        dataclasses.replace(drag, parameters=(below,))
