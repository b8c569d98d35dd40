"""Laws that a recording cannot show are no candidates."""

import numpy as np
import pytest

from pbrl_ppl.effects import candidates, catalogue
from pbrl_ppl.effects.effect import Command
from pbrl_ppl.history import History
from pbrl_ppl.scene import Body, Joint, Recording, Scene, Shape
from tests.helpers.examples import EXAMPLES

ARM = Scene(
    time_step=0.02,
    gravity=(0.0, -9.81),
    bodies=(Body("arm", Shape.box(0.04, 0.3), known={"mass": 0.5}),),
    joints=(Joint("hinge", ("arm", "world"), (0.0, 0.15), (0.0, 0.0)),),
)
PUCK = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1), known={"mass": 1.0}),))
#: The catalogue, and a law of a hinge that needs a camera.
LAWS = (*catalogue, EXAMPLES["askew_angle"])
CAMERA = {"askew_camera", "askew_angle"}
PLACES = {effect.name for effect in LAWS if "places" in effect.needs} - CAMERA


def names(scene: Scene, history: History) -> set[str]:
    return {one.effect.name for one in candidates(scene, (), LAWS, history)}


def swinging(push: float = 0.0) -> History:
    """An arm's angle alone, two swings."""
    states = np.full((2, 101, 1, 6), np.nan)
    time = 0.02 * np.arange(101)
    states[:, :, 0, 2] = 0.5 * np.cos(np.multiply.outer((5.0, 5.1), time))
    wrenches = np.zeros((2, 100, 1, 3))
    wrenches[..., 2] = push
    return History.of_arrays(states, ARM, wrenches)


def sliding(*speeds: float, dimensions: int = 2) -> History:
    """A puck on a line, one trajectory a speed, in x alone or in x and y, turned by nothing."""
    states = np.zeros((len(speeds), 40, 1, 6))
    for i, speed in enumerate(speeds):
        states[i, :, 0, 0] = speed * 0.1 * np.arange(40)
        states[i, :, 0, 1] = 0.5 * states[i, :, 0, 0] * (dimensions == 2)
    return History.of_arrays(states, PUCK, np.zeros((len(speeds), 39, 1, 3)))


def test_laws_of_commands_need_commands() -> None:
    commands = {effect.name for effect in catalogue if isinstance(effect.stage, Command)}
    assert not names(ARM, swinging()) & (commands | {"push_offset"})
    assert {"torque_gain", "actuator_delay", "push_offset"} <= names(ARM, swinging(push=0.1))


def test_a_steady_force_in_a_hinge_is_a_tilt_of_gravity() -> None:
    under_gravity = names(ARM, swinging())
    assert "gravity_tilt" in under_gravity and "constant_force" not in under_gravity
    assert "constant_force" in names(ARM.replace(gravity=(0.0, 0.0)), swinging())
    assert "constant_force" in names(PUCK, sliding(1.0, 1.1))


def test_an_encoder_is_no_camera_unless_the_scene_says_so() -> None:
    assert not names(ARM, swinging()) & CAMERA
    seen = ARM.replace(recording=Recording(camera=True))
    assert "askew_angle" in names(seen, swinging())
    assert "askew_camera" in names(PUCK, sliding(1.0, 1.1))
    assert not names(PUCK, sliding(1.0, 1.1, dimensions=1)) & CAMERA
    mocap = PUCK.replace(recording=Recording(camera=False))
    assert not names(mocap, sliding(1.0, 1.1)) & CAMERA


def test_laws_of_places_need_places_that_repeat() -> None:
    """In two trajectories, or twice in one; a single pass shows a place once."""
    assert not names(PUCK, sliding(1.0)) & PLACES
    assert "spring" in names(PUCK, sliding(1.0, 1.1))
    assert "torsion_spring" in names(ARM, swinging())


@pytest.mark.parametrize("law", ["drag_by_axis", "body_force", "magnus_force"])
def test_laws_of_the_body_s_own_axes_need_its_angle(law) -> None:
    history = sliding(1.0, 1.1)
    assert law not in names(PUCK, history)  # its angle never changes
    states = history.dataset["observed"].to_numpy().copy()
    states[..., 2] = 0.1 * np.arange(states.shape[1])[None, :, None]
    turned = History.of_arrays(states, PUCK, np.zeros((2, 39, 1, 3)))
    assert law in names(PUCK, turned)


def test_the_shape_of_the_noise_is_no_candidate() -> None:
    assert "heavy_tails" not in names(PUCK, sliding(1.0, 1.1))
