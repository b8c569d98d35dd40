"""Natural units of a body."""

import math

import pytest

from pbrl_ppl.effects import EffectParameter
from pbrl_ppl.errors import EffectError, SceneError
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Joint, Scene, Shape, motion_time, state_sizes, units_of
from pbrl_ppl.scene.units import check_product

pytestmark = pytest.mark.one_stack

ARM = Body("arm", Shape.box(0.1, 0.4), known={"mass": 2.0})
HINGE = Joint("hinge", ("arm", "world"), (0.0, 0.5), (0.0, 0.0))


def pendulum(**options) -> Scene:
    arm = Body(**(vars(ARM) | options))
    return Scene(time_step=0.02, gravity=(0.0, -10.0), bodies=(arm,), joints=(HINGE,))


def test_a_scene_alone_has_units() -> None:
    """A pendulum's length is its lever, its force its weight."""
    units = units_of(pendulum(), "arm")
    assert (units.mass, units.length, units.force, units.torque) == (2.0, 0.5, 20.0, 10.0)
    assert units.speed == pytest.approx(math.sqrt(10 * 0.5))
    assert motion_time(pendulum()) == pytest.approx(math.sqrt(0.5 / 10))
    assert state_sizes(pendulum())[2] == 1.0


def test_the_mass_is_its_prior_s_median() -> None:
    free = pendulum(known=(), prior={"mass": {"mu": 3.0}})
    assert units_of(free, "arm").mass == pytest.approx(math.exp(3.0))


def test_stated_units_replace_the_scene_s() -> None:
    scene = pendulum(typical={"force": 3.0, "x": -1.0})
    units = units_of(scene, "arm")
    assert (units.force, units.x, units.length) == (3.0, -1.0, 0.5)
    assert Scene.from_toml(scene.to_toml()) == scene


def test_products_of_units() -> None:
    units = units_of(pendulum(typical={"force": 6.0, "speed": 2.0, "length": 3.0}), "arm")
    assert units.of("force/speed^2") == 1.5
    assert units.of("force length^2") == 54.0
    assert units.of("") == 1.0


@pytest.mark.parametrize("product", ["speeed", "force/x", "force*length", "N"])
def test_unknown_units_are_refused(product) -> None:
    with pytest.raises(SceneError, match="natural unit"):
        check_product(product)


@pytest.mark.parametrize("typical", [{"force": 0.0}, {"weight": 1.0}, {"speed": -2.0}])
def test_impossible_sizes_are_refused(typical) -> None:
    with pytest.raises(SceneError, match="typical"):
        pendulum(typical=typical)


def test_a_place_is_counted_from_the_mean() -> None:
    units = units_of(pendulum(typical={"range": 4.0, "x": 100.0}), "arm")
    place = EffectParameter("x", "m", Prior("normal", sigma=0.5), scale="range", origin="x")
    sized = place.in_si(units)
    assert (sized.prior.mu, sized.prior.sigma, sized.null) == (100.0, 2.0, 100.0)
    assert sized.in_si(units) == sized
    with pytest.raises(EffectError, match="origin"):
        EffectParameter("x", "m", Prior("normal"), scale="range", origin="z")
