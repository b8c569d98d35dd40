"""Whole scenes: invariances of many bodies at once, impacts between them, order of convergence."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.worlds import BY_NAME, G, body, phi_of, predict, simulator

pytestmark = pytest.mark.one_stack

number = st.floats(-2.0, 2.0)

# -- a crowd, moved, turned and mirrored -----------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Move:
    """Mirror in the x axis, then turn about the origin, then shift."""

    mirror: bool = False
    angle: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)

    @property
    def hand(self) -> float:
        """What angles about the normal are multiplied by."""
        return -1.0 if self.mirror else 1.0

    def vector(self, v) -> np.ndarray:
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, -s], [s, c]]) @ [v[0], self.hand * v[1]]

    def point(self, p) -> tuple[float, float]:
        return tuple(self.vector(p) + self.shift)

    def pose(self, pose) -> tuple[float, float, float]:
        return (*self.point(pose[:2]), self.hand * pose[2] + self.angle)

    def states(self, states) -> np.ndarray:
        moved = [(*self.pose(s[:3]), *self.vector(s[3:5]), self.hand * s[5]) for s in states]
        return np.array(moved)

    def wrenches(self, wrenches) -> np.ndarray:
        return np.array([(*self.vector(w[:2]), self.hand * w[2]) for w in wrenches])


HOME = Move()
CART = (-0.45, 0.1, 0.5)  # pose
TAIL = 0.4  # rad, of the disc behind it
DOOR_ANGLE = 0.1
CART_ANCHOR, TAIL_ANCHOR = (-0.3, 0.05), (0.1, 0.0)
DOOR_PLACE, DOOR_ANCHOR = (0.9, -0.4), (-0.2, 0.0)
EFFECTS = ("pivot_damping", "pivot_friction", "linear_drag")
VALUES = {"pivot_damping": 0.01, "pivot_friction": 0.05, "linear_drag": 0.3}


def crowd(move: Move = HOME, order=range(5), substeps: int = 50) -> Scene:
    """A wheeled cart with a disc hinged behind it, two pucks, a hinged door and a post in a room.

    The cart does not reach door and post: two boxes often touch at two points at once, and then the
    solver's order matters (see `difference`).
    """
    h = move.hand
    cart_wheel = {"w_x": 0.1, "w_y": -0.05 * h, "w_theta": 0.3 * h, "mu_x": 0.1, "mu_y": 0.5}
    ball_wheel = {"w_y": 0.05 * h, "mu_x": 0.2, "mu_y": 0.2}
    moving = [
        body("cart", Shape.box(0.5, 0.3), wheel=True, mass=2.0, r=0.6, mu_c=0.3, **cart_wheel),
        body("tail", Shape.circle(0.08), mass=0.3, r=0.5, mu_c=0.2),
        body("puck", Shape.circle(0.1), mass=0.5, r=0.7, mu_c=0.4),
        body("ball", Shape.circle(0.15), wheel=True, r=0.8, mu_c=0.5, **ball_wheel),
        body("door", Shape.box(0.5, 0.06), mass=1.5, r=0.5, mu_c=0.2),
    ]
    post = Body("post", Shape.box(0.2, 0.1), static=True, pose=move.pose((0.6, 0.5, 0.4)))
    corners = [(-1.1, -0.7), (1.5, -0.7), (1.5, 0.8), (-1.1, 0.8)]

    def mirrored(anchor) -> tuple[float, float]:
        return anchor[0], h * anchor[1]

    return Scene(
        time_step=0.4,
        substeps=substeps,
        gravity=tuple(move.vector((0.3, -0.5))),
        normal_gravity=G,
        bodies=(*(moving[i] for i in order), post),
        walls=tuple(
            Wall(move.point(corners[i - 1]), move.point(corners[i])) for i in range(len(corners))
        ),
        joints=(
            Joint("hinge", ("world", "door"), move.point(DOOR_PLACE), mirrored(DOOR_ANCHOR)),
            Joint("hinge", ("cart", "tail"), mirrored(CART_ANCHOR), mirrored(TAIL_ANCHOR)),
        ),
    )


def crowd_states(velocities) -> np.ndarray:
    """States (5, 6) of the crowd from 11 numbers: what the hinges leave free."""
    v = np.asarray(velocities)
    cart = np.array([*CART, *v[:3]])
    tail = hung(TAIL, v[3], TAIL_ANCHOR, cart, CART_ANCHOR)
    puck = np.array([0.05, 0.25, 0.0, *v[4:7]])
    ball = np.array([0.75, -0.1, 1.0, *v[7:10]])
    ground = np.array([*DOOR_PLACE, 0.0, 0.0, 0.0, 0.0])
    return np.array([cart, tail, puck, ball, hung(DOOR_ANGLE, v[10], DOOR_ANCHOR, ground, (0, 0))])


def hung(theta, omega, anchor, upper, upper_anchor) -> np.ndarray:
    """State of a body that hangs in a hinge of another."""
    place, velocity = complex(*upper[:2]), complex(*upper[3:5])
    lever = complex(*upper_anchor) * np.exp(1j * upper[2])
    arm = -complex(*anchor) * np.exp(1j * theta)
    place, velocity = place + lever + arm, velocity + 1j * (upper[5] * lever + omega * arm)
    return np.array([place.real, place.imag, theta, velocity.real, velocity.imag, omega])


def run(scene: Scene, start, wrench) -> np.ndarray:
    """States (body, 6) after the interval, with friction in the hinges and drag on the puck."""
    effects = tuple(
        BY_NAME[name].on("puck") if name == "linear_drag" else BY_NAME[name] for name in EFFECTS
    )
    sim = simulator(scene, effects)
    return sim(phi_of(sim.physics.layout, VALUES), start[None], wrench[None, None])[0, 0]


# 1e-12 as a rule, and every impact magnifies it; 6e-5 at most in 300 random crowds, where a box
# stays pressed on a wall in two points, which the solver takes in either order
TOLERANCE = 1e-4
motions = st.tuples(*[number] * 11)
pushes = st.tuples(*[number] * 15).map(lambda w: np.reshape(w, (5, 3)) * [2.0, 2.0, 0.1])


def difference(motion, push, move: Move = HOME, order=range(5)) -> float:
    """Largest difference between the crowd and the same crowd moved, its bodies in another order.

    The solver takes contacts one after the other and stops short of convergence, so where a body
    touches two others within one substep their order matters, and that depends on the axes and on
    the numbering. With another substep the two do not fall together: the smaller difference counts.
    """
    order = list(order)
    start = crowd_states(motion)
    found = []
    for substeps in (50, 170):
        here = run(crowd(substeps=substeps), start, push)[order]
        scene = crowd(move, order, substeps)
        there = run(scene, move.states(start)[order], move.wrenches(push)[order])
        found.append(float(np.abs(there - move.states(here)).max()))
        if found[-1] < TOLERANCE:
            break
    return min(found)


@given(motions, pushes, st.tuples(number, number))
def test_crowd_is_the_same_elsewhere(motion, push, shift) -> None:
    assert difference(motion, push, Move(shift=shift)) < TOLERANCE


@given(motions, pushes, st.floats(-np.pi, np.pi))
def test_crowd_is_the_same_in_every_direction(motion, push, angle) -> None:
    assert difference(motion, push, Move(angle=angle)) < TOLERANCE


@given(motions, pushes)
def test_crowd_is_the_same_in_a_mirror(motion, push) -> None:
    assert difference(motion, push, Move(mirror=True)) < TOLERANCE


@given(motions, pushes, st.permutations(range(5)))
def test_order_of_the_bodies_does_not_matter(motion, push, order) -> None:
    assert difference(motion, push, order=order) < TOLERANCE


def test_crowd_collides() -> None:
    """What the tests above are worth: in most runs bodies meet, often several."""
    scene = crowd()
    soft = [dataclasses.replace(b, known=dict(b.known) | {"r": 0.0}) for b in scene.dynamic]
    without_bounce = scene.replace(bodies=(*soft, scene.body("post")))
    rng = np.random.default_rng(0)
    met = np.zeros(5)
    for motion in rng.uniform(-2, 2, (40, 11)):
        start, push = crowd_states(motion), rng.normal(0, 1, (5, 3))
        difference = run(scene, start, push) - run(without_bounce, start, push)
        met += np.abs(difference).max(axis=1) > 0.1
    assert (met >= 5).all()
    assert met.sum() > 60


# -- impacts ---------------------------------------------------------------------------------------


@given(
    st.tuples(*[st.floats(0.1, 10.0)] * 2),
    st.tuples(*[st.floats(0.0, 1.0)] * 2),
    st.floats(0.0, 1.0),
    st.floats(-1.0, 1.0),
    st.floats(1.0, 3.0),
    st.floats(-np.pi, np.pi),
)
def test_head_on_impact_of_unequal_discs(masses, bounces, friction, speed, closing, angle) -> None:
    """Closed form, with the product of the two bodies' values as the restitution."""
    discs = tuple(
        body(name, Shape.circle(0.1), mass=m, r=r, mu_c=friction)
        for name, m, r in zip("ab", masses, bounces, strict=True)
    )
    scene = Scene(time_step=0.5, substeps=100, bodies=discs)
    start = np.zeros((2, 6))
    start[1, 0], start[:, 3] = 0.5, (speed + closing, speed)
    move = Move(angle=angle)
    after = predict(scene, move.states(start))[0]
    e = bounces[0] * bounces[1]
    middle = speed + closing * masses[0] / sum(masses)  # of the centre of mass
    share = np.array([-masses[1], masses[0]]) / sum(masses)
    expected = np.outer(middle + e * closing * share, move.vector((1, 0)))
    # the impulse is solved to rounding: one contact, and friction has nothing to resist; without
    # bounce the discs go on touching, and an overlap is pushed out
    np.testing.assert_allclose(after[:, 3:5], expected, atol=1e-9)
    np.testing.assert_allclose(after[:, 5], 0.0, atol=1e-9)


def row(masses, bounces, speed: float) -> tuple[Scene, np.ndarray]:
    """Discs in a row, 1 cm apart, the first of which comes from the left at a speed (m/s)."""
    n, radius = len(masses), 0.05
    discs = tuple(
        body(f"disc{i}", Shape.circle(radius), mass=masses[i], r=bounces[i], mu_c=0.3)
        for i in range(n)
    )
    start = np.zeros((n, 6))
    start[:, 0] = np.arange(n) * (2 * radius + 0.01)
    start[0, 0], start[0, 3] = -0.05, speed
    return Scene(time_step=0.5, substeps=400, bodies=discs), start


def test_row_of_equal_discs_hands_the_speed_on() -> None:
    """Newton's cradle: the last leaves as the first came, and the others rest."""
    scene, start = row([0.7] * 5, [1.0] * 5, 1.0)
    after = predict(scene, start)[0]
    np.testing.assert_allclose(after[:, 3], [0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-9)
    # each but the last came to the next one's place less a diameter: to a substep of 1 / 800 s
    np.testing.assert_allclose(after[:4, 0], start[1:, 0] - 0.1, atol=2 / 800)


@given(
    st.lists(st.tuples(st.floats(0.2, 5.0), st.floats(0.0, 1.0)), min_size=5, max_size=5),
    st.floats(0.5, 2.0),
)
def test_row_of_any_discs_keeps_momentum(discs, speed) -> None:
    masses, bounces = np.array(discs).T
    scene, start = row(masses, bounces, speed)
    after = predict(scene, start, horizon=3)
    # impulses are equal and opposite: exact
    np.testing.assert_allclose(after[..., 3] @ masses, masses[0] * speed, rtol=1e-9)
    np.testing.assert_allclose(after[..., 4:], 0.0, atol=1e-9)
    energies = np.array([masses @ s[:, 3] ** 2 / 2 for s in (start, *after)])
    # several contacts at once are solved short of exactness, by a thousandth
    assert (np.diff(energies) <= 1e-3 * energies[0]).all()
    # nobody passes through another; discs at rest on each other overlap by 0.1 mm, or in a hard
    # impact by what they move in a substep
    assert (np.diff(after[..., 0], axis=1) > 0.1 - 1e-4 - 2 * speed / 800).all()


@given(
    st.tuples(st.floats(0.2, 5.0), st.floats(0.2, 5.0)),
    st.tuples(*[st.floats(0.0, 1.0)] * 2),
    st.tuples(*[st.floats(0.0, 1.0)] * 2),
    st.floats(-0.8, 0.8),
    st.tuples(*[st.floats(-20.0, 20.0)] * 2),
)
def test_oblique_impact_of_two_discs(masses, bounces, frictions, offset, spins) -> None:
    """The tangential impulse is at most the product of the frictions times the normal one."""
    radii = np.array([0.1, 0.15])
    discs = tuple(
        body(f"disc{i}", Shape.circle(radii[i]), mass=masses[i], r=bounces[i], mu_c=frictions[i])
        for i in range(2)
    )
    scene = Scene(time_step=0.3, substeps=1000, bodies=discs)
    start = np.zeros((2, 6))
    start[1, :2], start[0, 3], start[:, 5] = (0.5, offset * radii.sum()), 2.0, spins
    after = predict(scene, start)[0]
    change = after - start
    impulse = masses[0] * complex(*change[0, 3:5])
    # the turning of either disc gives the tangential impulse on its rim, the same for both; the
    # rims overlap by up to a substep's way, 0.6 mm, which both levers lose
    moments = np.array(masses) * radii**2 / 2
    tangential = moments * change[:, 5] / radii
    slack = 0.01 * abs(impulse) + 1e-9
    assert tangential[0] == pytest.approx(tangential[1], abs=slack)
    normal = np.sqrt(max(0.0, abs(impulse) ** 2 - tangential[0] ** 2))
    mu = frictions[0] * frictions[1]
    assert abs(tangential[0]) <= mu * normal + slack
    # it works against the slip of the rims; where they slip on, it is all that friction can do
    line = complex(*(start[1, :2])) - complex(2.0 * meeting_time(start, radii), 0.0)
    line /= abs(line)

    def slip(states: np.ndarray) -> float:
        relative = complex(*(states[0, 3:5] - states[1, 3:5]))
        return (relative * (1j * line).conjugate()).real + radii @ states[:, 5]

    assert slip(start) * tangential[0] <= slack
    assert abs(impulse) > 0.1 * min(masses)  # they met
    if slip(after) * slip(start) > 0.05 * abs(slip(start)):
        assert abs(tangential[0]) == pytest.approx(mu * normal, abs=slack)


def meeting_time(start: np.ndarray, radii: np.ndarray) -> float:
    """When the first disc, moving along x, touches the second, which rests (s)."""
    (x, y), speed = start[1, :2] - start[0, :2], start[0, 3]
    return float((x - np.sqrt(radii.sum() ** 2 - y**2)) / speed)


# -- a wheel anywhere on the body ------------------------------------------------------------------

BOX = Shape.box(0.9, 0.55)
wheels = st.fixed_dictionaries(
    {"w_x": st.floats(-0.4, 0.4), "w_y": st.floats(-0.25, 0.25), "w_theta": st.floats(-3.0, 3.0)}
)
frictions = st.floats(0.0, 1.0)


def wheeled(wheel, mu_x: float, mu_y: float) -> Scene:
    cart = body("cart", BOX, wheel=True, mass=2.0, mu_x=mu_x, mu_y=mu_y, **wheel)
    return Scene(time_step=0.1, substeps=40, normal_gravity=G, bodies=(cart,))


@given(wheels, frictions, st.floats(-2.0, 2.0))
def test_wheel_does_not_hinder_a_body_that_moves_along_it(wheel, mu_y, speed) -> None:
    velocity = speed * np.exp(1j * wheel["w_theta"])
    start = np.array([0.0, 0.0, 0.0, velocity.real, velocity.imag, 0.0])
    after = predict(wheeled(wheel, 0.0, mu_y), start, horizon=3)[-1, 0]
    straight = [0.3 * velocity.real, 0.3 * velocity.imag, 0.0, velocity.real, velocity.imag, 0.0]
    np.testing.assert_allclose(after, straight, atol=1e-9)  # rounding


@given(wheels, frictions, frictions, st.tuples(number, number, number))
def test_wheel_only_takes_energy(wheel, mu_x, mu_y, velocity) -> None:
    start = np.array([0.0, 0.0, 0.0, *velocity])
    states = predict(wheeled(wheel, mu_x, mu_y), start, horizon=10, extrapolate=False)[:, 0]
    speeds = np.vstack([start, states])[:, 3:]
    energy = (speeds**2 @ [1.0, 1.0, BOX.unit_moment]) / 2 * 2.0
    assert (np.diff(energy) <= 1e-9 * energy[0] + 1e-15).all()  # rounding: an impulse can only stop


# -- order of convergence --------------------------------------------------------------------------

DRAG = {"quadratic_drag": 0.7, "angular_drag": 0.3, "body_force": (1.0, 2.0)}
RUDDER = {"w_x": -0.25, "w_y": 0.05, "w_theta": 0.3, "mu_x": 0.05, "mu_y": 0.45}


def two_boxes(wheel: bool) -> Scene:
    """Two boxes that never meet, both with wheels or both without."""
    wheels = RUDDER if wheel else {}
    boxes = (
        body("heavy", BOX, wheel=wheel, mass=6.5, **wheels),
        body("light", BOX, wheel=wheel, mass=3.0, **wheels),
    )
    return Scene(time_step=0.1, normal_gravity=G, bodies=boxes)


def slope(scene: Scene, extrapolate: bool) -> float:
    """How fast the median error of 100 random transitions falls with the substep, as a power."""
    rng = np.random.default_rng(1)
    starts = rng.uniform(-1, 1, (100, 2, 6)) * [3, 3, np.pi, 2, 2, 1.5] + [[0] * 6, [10] + [0] * 5]
    wrenches = rng.normal(0, [12.0, 12.0, 2.0], (100, 1, 2, 3))

    def predictions(substeps: int, extrapolate: bool) -> np.ndarray:
        effects = tuple(BY_NAME[name] for name in DRAG)
        sim = simulator(scene, effects, substeps=substeps, extrapolate=extrapolate)
        return sim(phi_of(sim.physics.layout, DRAG), starts, wrenches)

    exact = predictions(2048, True)
    counts = np.array([8, 16, 32, 64, 128])
    # the median: where a wheel's friction turns round within the interval, in a tenth or so of the
    # transitions, its kink leaves an error of the first order whatever is done
    errors = [
        np.median(np.abs(predictions(n, extrapolate) - exact).max(axis=(1, 2, 3))) for n in counts
    ]
    return -float(np.polyfit(np.log(counts), np.log(errors), 1)[0])


# a fit over a factor of 16 in the substep; a tenth is what 100 transitions leave uncertain
@pytest.mark.parametrize("wheel", [True, False])
def test_plain_prediction_is_of_the_first_order(wheel) -> None:
    assert slope(two_boxes(wheel), extrapolate=False) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("wheel", "order"), [(True, 2.0), (False, 3.0)])
def test_extrapolated_prediction_is_of_a_higher_order(wheel, order) -> None:
    assert slope(two_boxes(wheel), extrapolate=True) == pytest.approx(order, abs=0.1)
