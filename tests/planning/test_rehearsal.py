"""Rehearsals of recordings, against recordings with the law that are searched in earnest."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pbrl_ppl.criticism import DEFAULT, attribute
from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.errors import HistoryError, ParameterError
from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics, simulated_recording
from pbrl_ppl.planning.rehearsal import Rehearsal, RehearsedLaw, rehearse
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, Shape
from pbrl_ppl.state import STATE
from tests.helpers.counted import of_work
from tests.helpers.examples import EXAMPLES

pytestmark = [pytest.mark.one_stack, pytest.mark.first(2)]
ARM = Body("arm", Shape.box(0.03, 0.4), known={"mass": 0.5, "r": 0.2, "mu_c": 0.2})
PENDULUM = Scene(
    time_step=0.02, gravity=(0.0, -9.81), bodies=(ARM,), noise={"theta": 1e-3},
    joints=(Joint("hinge", ("arm", WORLD), (0.0, 0.18), (0.0, 0.0)),),
)  # fmt: skip
PUCK = Scene(
    time_step=0.1, normal_gravity=9.81, noise={"x": 2e-3, "y": 2e-3, "theta": 2e-3},
    bodies=(Body("puck", Shape.box(0.5, 0.3), known={"mass": 4.0, "r": 0.2, "mu_c": 0.2}),),
)  # fmt: skip
OFFERED = {
    PENDULUM: (
        "pivot_damping", "pivot_friction", "quadratic_drag", "angular_drag", "torque_gain",
        "constant_torque",
    ),
    PUCK: ("linear_drag", "sliding_friction", "force_gain", "constant_force", "push_offset"),
}  # fmt: skip


def named(*names: str) -> list:
    return [effect for effect in catalogue if effect.name in names]


def offered(scene: Scene) -> list:
    return named(*OFFERED[scene])


@cache
def rehearsal_of(scene: Scene) -> Rehearsal:
    return rehearse(scene, catalogue=offered(scene), seed=1)


@pytest.fixture(scope="module", params=[PENDULUM, PUCK], ids=["pendulum", "puck"])
def rehearsed(request) -> tuple[Scene, Rehearsal]:
    return request.param, rehearsal_of(request.param)


def law_of(rehearsal: Rehearsal, effect: str) -> RehearsedLaw:
    return next(law for law in rehearsal.laws if law.effect == effect)


def recorded(scene: Scene, rehearsal: Rehearsal, law: RehearsedLaw, times: float) -> History:
    """A recording of the rehearsed commands with a law of some times the stated size."""
    (name, size), *_ = law.sizes.items()
    values = law.null | {name: law.null[name] + times * size}
    if law.effect == "sliding_friction":
        values["radius"] = 0.2
    effects = attach(
        scene, [effect.on(law.body) for effect in catalogue if effect.name == law.effect]
    )
    physics = Physics(scene, effects)
    known = rehearsal.parameters | {f"{law.effect}_{k}[{law.body}]": v for k, v in values.items()}
    phi = np.array([[known[label] for label in physics.layout.labels]])
    (states,) = simulated_recording(physics, phi, rehearsal.history)
    sd = [rehearsal.noise.get(name, np.nan) for name in STATE]  # NaN: not measured
    states += sd * np.random.default_rng(7).standard_normal(states.shape)
    return History.of_arrays(states, scene, rehearsal.history.dataset["action"].to_numpy())


def found(scene: Scene, history: History) -> dict:
    return {law.effect: law for law in attribute(scene, history, catalogue=offered(scene)).laws}


@pytest.mark.slow
@pytest.mark.parametrize("place", range(4))
def test_a_law_is_named_from_the_stated_size_on(rehearsed, place) -> None:
    """Alone above that size, under the stated name; nothing below it."""
    scene, rehearsal = rehearsed
    law = law_of(rehearsal, OFFERED[scene][place])
    for times in (1.5, 3.0):
        assert set(found(scene, recorded(scene, rehearsal, law, times))) == {law.named}
    for times in (0.1, 0.6):
        assert not found(scene, recorded(scene, rehearsal, law, times))


@pytest.mark.slow
def test_confounded_laws_are_worth_as_much() -> None:
    """Two dampings of one pendulum: each explains the recording, alone in the catalogue."""
    rehearsal = rehearsal_of(PENDULUM)
    law = law_of(rehearsal, "angular_drag")
    assert law.named == "pivot_damping" and "pivot_damping" in law.confounded
    assert "angular_drag" in law_of(rehearsal, "pivot_damping").confounded
    history = recorded(PENDULUM, rehearsal, law, 3.0)
    assert "angular_drag" in found(PENDULUM, history)["pivot_damping"].not_separable_from
    worth = [
        attribute(PENDULUM, history, catalogue=[effect]).laws[0].simulated_nats
        for effect in named("pivot_damping", "angular_drag")
    ]
    assert abs(worth[0] - worth[1]) < 3.0


def test_what_is_seen_best_comes_first(rehearsed) -> None:
    scene, rehearsal = rehearsed
    shares = [law.share for law in rehearsal.laws]
    assert shares == sorted(shares)
    assert rehearsal.noise == dict(scene.noise)
    measured = np.isfinite(rehearsal.history.dataset["observed"]).any(
        ("trajectory", "time", "body")
    )
    seen = [name for name, there in zip(STATE, measured, strict=True) if there]
    assert seen == list(dict(scene.noise))


def test_a_law_that_changes_nothing_is_unseen() -> None:
    """A pendulum that torques turn shows no gain of forces."""
    seen, unseen = rehearse(PENDULUM, catalogue=named("force_gain", "torque_gain")).laws
    assert (seen.effect, unseen.effect) == ("torque_gain", "force_gain")
    assert unseen.named == "" and not unseen.sizes and not np.isfinite(unseen.share)


def test_a_law_that_needs_what_is_not_measured_is_unseen() -> None:
    """Drag along a puck's axes needs its angle; the same drag in any direction does not."""
    places = PUCK.replace(noise={"x": 2e-3, "y": 2e-3})
    seen, unseen = rehearse(places, catalogue=named("linear_drag", "drag_by_axis")).laws
    assert (seen.effect, unseen.effect) == ("linear_drag", "drag_by_axis")
    assert unseen.named == "" and "nothing here shows it" in unseen.note
    both = rehearse(PUCK, catalogue=named("linear_drag", "drag_by_axis")).laws
    assert {law.named for law in both} == {"linear_drag", "drag_by_axis"}


def test_unusual_laws_are_named_where_common_ones_leave_much_more_than_noise() -> None:
    """A power of the command looks like a gain; a wrong inertia looks like no common law."""
    laws = (*named("torque_gain", "inertia_scale"), EXAMPLES["command_power"])
    rehearsal = rehearse(PENDULUM, catalogue=laws, seed=1)
    assert law_of(rehearsal, "command_power").named == "torque_gain"
    assert law_of(rehearsal, "inertia_scale").named == "inertia_scale"


def test_twice_the_noise_hides_twice_as_much() -> None:
    drag = named("pivot_damping")
    (law,), (noisy,) = (
        rehearse(PENDULUM.replace(noise={"theta": sd}), catalogue=drag).laws for sd in (1e-3, 2e-3)
    )
    assert noisy.sizes["coefficient"] == pytest.approx(2 * law.sizes["coefficient"], rel=0.35)


@pytest.mark.slow
def test_a_single_trajectory_shows_what_takes_half_of_its_error() -> None:
    """A main law of several takes a fifth."""
    single = History(rehearsal_of(PENDULUM).history.dataset.isel(trajectory=[0]))
    limits = replace(DEFAULT.search, alone=DEFAULT.search.main_share)
    rehearsal, lax = (
        rehearse(PENDULUM, single, catalogue=offered(PENDULUM), criteria=criteria)
        for criteria in (DEFAULT, replace(DEFAULT, search=limits))
    )
    law, fifth = (law_of(one, "pivot_damping") for one in (rehearsal, lax))
    # the law's square over the noise's: 1 / 0.5^2 - 1 and 1 / 0.8^2 - 1
    assert law.share / fifth.share == pytest.approx(np.sqrt(3.0 / 0.5625), rel=0.01)
    assert set(found(PENDULUM, recorded(PENDULUM, rehearsal, law, 3.0))) == {"pivot_damping"}
    assert not found(PENDULUM, recorded(PENDULUM, rehearsal, law, 0.2))


def test_the_laws_that_are_linearised_are_counted() -> None:
    said: list[str] = []
    rehearse(PENDULUM, catalogue=named("pivot_damping", "torque_gain"), progress=said.append)
    assert of_work(said) == {"linearising 2 laws": 2}
    assert any(one.startswith("linearising 2 laws on pieces of") for one in said)


def test_parameters_are_by_label_or_name() -> None:
    scene = PUCK.replace(bodies=(replace(PUCK.bodies[0], known=()),))
    drag = named("linear_drag")
    for name in ("mass", "mass[puck]"):
        assert (
            rehearse(scene, parameters={name: 3.0}, catalogue=drag).parameters["mass[puck]"] == 3.0
        )
    with pytest.raises(ParameterError, match='no parameter "mas"'):
        rehearse(scene, parameters={"mas": 3.0})


def test_a_body_on_a_path_needs_commands() -> None:
    finger = Body("finger", Shape.circle(0.05), kinematic=True)
    with pytest.raises(HistoryError, match="give a file of commands"):
        rehearse(PUCK.replace(bodies=(*PUCK.bodies, finger)))
