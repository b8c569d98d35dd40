"""Initial states that cannot be are refused, those that noise or contact explain are not."""

import re
import time

import numpy as np
import pymunk
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.physics import check_placement
from pbrl_ppl.physics.world import engine_shapes
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.places import ROOT
from tests.helpers.worlds import body, predict, state

pytestmark = pytest.mark.one_stack

CART, BOX = Shape.box(0.9, 0.55), Shape.box(0.4, 0.3)
# a channel 1.2 m wide and 1 m high about a mouth of 0.8 m by 0.8 m that is open at the top
CHANNEL = [(-0.6, 0.6), (-0.6, -0.4), (0.6, -0.4), (0.6, 0.6), (0.4, 0.6), (0.4, -0.2),
           (-0.4, -0.2), (-0.4, 0.6)]  # fmt: skip
CHANNEL_CENTROID = (2 * 0.2 * 0.8 * 0.2 + 1.2 * 0.2 * -0.3) / (2 * 0.2 * 0.8 + 1.2 * 0.2)
U = Shape.polygon([(x, y - CHANNEL_CENTROID) for x, y in CHANNEL])
LONG_WALL = Wall((-5.0, 0.0), (5.0, 0.0))


def scene_of(*shapes: Shape, **options) -> Scene:
    bodies = tuple(Body(name, shape) for name, shape in zip("abcdef", shapes, strict=False))
    static = options.pop("static", ())
    return Scene(time_step=0.1, bodies=(*bodies, *static), **options)


def message(scene: Scene, *states, **options) -> str | None:
    """What is said of one transition; None if it is fine."""
    try:
        check_placement(scene, np.array([states], dtype=float), **options)
    except SimulationError as error:
        return str(error)
    return None


def refused(scene: Scene, *states) -> bool:
    return message(scene, *states) is not None


def metres(text: str | None) -> list[float]:
    return [float(number) for number in re.findall(r"(-?[\d.]+(?:e-?\d+)?) m\b", text or "")]


# -- how deep is too deep --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shapes", "touch", "width"),  # two bodies on the x axis: where they touch, the smaller width
    [
        ((CART, CART), 0.9, 0.55),
        ((CART, BOX), 0.65, 0.3),
        ((BOX, CART), 0.65, 0.3),
        ((CART, Shape.circle(0.2)), 0.65, 0.4),
        ((Shape.circle(0.2), CART), 0.65, 0.4),
        ((Shape.circle(0.2), Shape.circle(0.5)), 0.7, 0.4),
        ((Shape.polygon([(-1, -1), (2, -1), (-1, 2)]), CART), 1.0 + 0.45, 0.55),
    ],
)
def test_bodies_up_to_a_quarter_of_the_smaller_one(shapes, touch, width) -> None:
    scene = scene_of(*shapes)
    if shapes[0].kind == "polygon":  # from the left, where the triangle has an upright side
        touch = -touch
    inward = -np.sign(touch)
    for depth, expected in [(-0.1, False), (0.0, False), (0.99 * width / 4, False),
                            (1.01 * width / 4, True)]:  # fmt: skip
        assert refused(scene, state(), state(x=touch + inward * depth)) is expected, depth


@pytest.mark.parametrize(
    ("shape", "half", "width"), [(CART, 0.275, 0.55), (Shape.circle(0.2), 0.2, 0.4)]
)
@pytest.mark.parametrize("side", [1, -1])
def test_body_and_wall_up_to_a_quarter_of_the_body(shape, half, width, side) -> None:
    scene = scene_of(shape, walls=(LONG_WALL,))
    for depth, expected in [(-0.1, False), (0.99 * width / 4, False), (1.01 * width / 4, True)]:
        assert refused(scene, state(x=3.0, y=side * (half - depth))) is expected, depth


def test_end_of_a_wall_pokes_into_a_body() -> None:
    scene = scene_of(CART, walls=(LONG_WALL,))
    assert not refused(scene, state(x=5.45 - 0.13))
    assert refused(scene, state(x=5.45 - 0.14))
    # beside the end, and beyond it
    assert not refused(scene, state(x=5.44, y=0.1))
    assert not refused(scene, state(x=6.0))


def test_a_body_that_is_wholly_beyond_a_wall_is_fine() -> None:
    assert not refused(scene_of(CART, walls=(LONG_WALL,)), state(y=-0.3))


def test_static_body_counts_at_its_pose() -> None:
    pillar = Body("pillar", Shape.box(2.0, 0.2), static=True, pose=(1.0, 2.0, np.pi / 2))
    scene = scene_of(CART, static=(pillar,))
    assert not refused(scene, state())
    touch = 1.0 - 0.1 - 0.45
    assert not refused(scene, state(x=touch + 0.049, y=2.9))
    found = message(scene, state(x=touch + 0.051, y=2.9))
    assert 'bodies "a" and "pillar" overlap by 0.051 m, allowed is 0.05 m' in found


def test_static_bodies_and_walls_may_overlap_each_other() -> None:
    pillar = Body("pillar", Shape.box(2.0, 2.0), static=True, pose=(0, 0, 0))
    other = Body("other", Shape.box(2.0, 2.0), static=True, pose=(0, 0, 1))
    scene = scene_of(CART, static=(pillar, other), walls=(LONG_WALL,))
    assert not refused(scene, state(y=5.0))


@pytest.mark.parametrize("theta", [0.0, 0.4, np.pi / 2, 3.0])
@pytest.mark.parametrize("shape", [CART, U, Shape.circle(0.2), Shape.box(0.4, 0.4)])
def test_bodies_at_one_place_are_refused(shape, theta) -> None:
    """The engine finds no penetration of polygons whose centres coincide."""
    assert refused(scene_of(shape, shape), state(), state(theta=theta))
    assert refused(scene_of(shape, walls=(LONG_WALL,)), state(y=0.05 * (shape is U), theta=theta))


# -- concave polygons ------------------------------------------------------------------------------


def test_the_mouth_of_a_concave_polygon_is_free() -> None:
    scene = scene_of(U, Shape.box(0.7, 0.7))
    assert not refused(scene, state(), state(y=0.2 - CHANNEL_CENTROID))
    # turned and moved with it
    y, c, s = 0.2 - CHANNEL_CENTROID, np.cos(2.0), np.sin(2.0)
    assert not refused(scene, state(3, 4, 2.0), state(3 - s * y, 4 + c * y, 2.0))


def test_the_arms_of_a_concave_polygon_are_not() -> None:
    scene = scene_of(U, Shape.circle(0.2))
    assert refused(scene, state(), state(x=0.5))
    assert refused(scene, state(), state(x=-0.5))
    assert refused(scene, state(), state(y=-0.3 - CHANNEL_CENTROID))
    # at 0.2 it touches the arm's inner face; a quarter of the arm's 0.2 m is allowed
    assert not refused(scene, state(), state(x=0.2 + 0.049))
    assert refused(scene, state(), state(x=0.2 + 0.051))


def test_a_wall_into_the_mouth_is_fine() -> None:
    scene = scene_of(U, walls=(Wall((0.0, 0.0), (0.0, 5.0)),))
    assert not refused(scene, state())
    assert refused(scene, state(x=0.5))


# -- joints ----------------------------------------------------------------------------------------

UPPER, LOWER = Shape.box(0.05, 0.2), Shape.box(0.05, 0.3)


def chain(**options) -> Scene:
    """A double pendulum: 0.1 m and 0.15 m from hinge to centre."""
    joints = (
        Joint("hinge", ("a", "world"), (0.0, 0.1), (0.0, 0.0)),
        Joint("hinge", ("a", "b"), (0.0, -0.1), (0.0, 0.15)),
    )
    return scene_of(UPPER, LOWER, **({"joints": joints} | options))


def test_hinge_chain_up_to_a_quarter_of_the_smaller_body() -> None:
    scene, limit = chain(), np.hypot(0.025, 0.1) / 4
    assert not refused(scene, state(y=-0.1), state(y=-0.35))
    for off, expected in [(0.99, False), (1.01, True)]:
        # the world's hinge: only the moving body counts; then the one between the two
        assert refused(scene, state(off * limit, -0.1), state(off * limit, -0.35)) is expected
        assert refused(scene, state(0, -0.1), state(off * limit, -0.35)) is expected
    text = message(scene, state(0, -0.1), state(0.1, -0.35))
    assert text == (
        'transition 0: the anchors of the hinge joint of "a" and "b" are 0.1 m apart, expected 0 m'
        " to within 0.0258 m (a quarter of the smaller moving body's bounding radius); correct the"
        " poses or the anchors"
    )
    assert 'of "a" and world are 0.5 m' in message(scene, state(y=-0.6), state(y=-0.85))


def test_hinge_on_a_static_body() -> None:
    post = Body("post", Shape.circle(0.1), static=True, pose=(1.0, 2.0, np.pi / 2))
    joint = Joint("hinge", ("a", "post"), (0.0, 0.1), (0.3, 0.0))  # at (1, 2.3) in the world
    scene = scene_of(UPPER, static=(post,), joints=(joint,))
    assert not refused(scene, state(1.0, 2.2))
    assert refused(scene, state(1.0, 1.9))


def test_bodies_folded_over_each_other_at_their_hinge_are_fine() -> None:
    """Joined pairs do not collide; that needs no joint that is known."""
    folded = state(y=-0.1), state(y=-0.05, theta=np.pi)
    assert not refused(chain(), *folded)
    assert refused(chain(joints=()), *folded)
    inferred = Joint("hinge", ("a", "b"), (0.0, -0.1), (0.0, 0.15), known=False)
    assert not refused(chain(joints=(inferred,)), *folded)


def test_a_body_on_a_hinge_of_the_world_swings_through_walls() -> None:
    """The walls belong to the world, so they are joined to it and do not collide with it."""
    wall = (Wall((-1.0, -0.1), (1.0, -0.1)),)
    assert refused(chain(joints=(), walls=wall), state(y=-0.1), state(y=-0.35))
    assert not refused(chain(walls=wall), state(y=-0.1), state(y=-0.35))
    arm = body("arm", Shape.box(1.0, 0.1))
    hinge = Joint("hinge", ("arm", "world"), (-0.5, 0.0), (0.0, 0.0))
    ahead = (Wall((-3.0, 0.3), (3.0, 0.3)),)
    scene = Scene(time_step=1.0, substeps=100, bodies=(arm,), walls=ahead, joints=(hinge,))
    # half a turn, through the wall in the engine as well
    after = predict(scene, state(x=0.5, vy=0.5 * np.pi, omega=np.pi))[0, 0]
    assert after[2] == pytest.approx(np.pi, abs=1e-2)


def test_rod_keeps_the_distance_of_the_reference_pose() -> None:
    rod = Joint("distance", ("a", "b"), (0.2, 0.0), (-0.2, 0.0))
    bodies = (Body("a", BOX), Body("b", BOX, pose=(1.4, 0.0, 0.0)))  # 1 m; a has no pose
    scene = Scene(time_step=0.1, bodies=bodies, joints=(rod,))
    limit = 0.25 / 4  # m, of a body with a bounding radius of 0.25 m
    for off, expected in [(0.0, False), (0.99, False), (1.01, True)]:
        for sign in (1, -1):
            apart = state(x=1.4 + sign * off * limit)
            assert refused(scene, state(), apart) is expected
    # a turned pair of another place
    assert not refused(scene, state(5, 6, np.pi / 2), state(5, 7.4, np.pi / 2))
    text = message(scene, state(), state(x=1.7))
    assert 'distance joint of "a" and "b" are 1.3 m apart, expected 1 m to within 0.0625 m' in text


def test_bodies_on_a_rod_do_not_collide() -> None:
    rod = Joint("distance", ("a", "b"), (-0.2, 0.0), (-0.2, 0.0))  # 0.3 m in the reference pose
    bodies = (Body("a", BOX, pose=(0.0, 0.0, 0.0)), Body("b", BOX, pose=(0.3, 0.0, 0.0)))
    scene = Scene(time_step=0.1, bodies=bodies, joints=(rod,))
    assert not refused(scene, state(), state(x=0.3))
    assert refused(scene.replace(joints=()), state(), state(x=0.3))


def test_joints_that_are_not_known_are_not_checked() -> None:
    loose = Joint("hinge", ("a", "world"), (0.0, 0.1), (0.0, 0.0), known=False)
    assert not refused(scene_of(UPPER, joints=(loose,)), state(5, 5))


def test_with_a_joint_of_unknown_bodies_any_two_may_be_joined() -> None:
    pillar = Body("pillar", Shape.circle(0.3), static=True, pose=(0, 5, 0))
    scene = scene_of(CART, BOX, static=(pillar,), joints=(Joint("hinge", known=False),))
    assert not refused(scene, state(), state(x=0.2))
    assert refused(scene, state(), state(y=5.0))  # a static body is not among the choices


# -- what is said ----------------------------------------------------------------------------------


def test_message_of_two_bodies() -> None:
    scene = Scene(time_step=0.1, bodies=(Body("cart", CART), Body("box", Shape.box(0.7, 0.56))))
    text = message(scene, state(), state(x=0.49), where=lambda i: f"history trajectory 3, step {i}")
    assert text == (
        'history trajectory 3, step 0: bodies "cart" and "box" overlap by 0.31 m, allowed is'
        " 0.138 m (a quarter of the smaller one's width); correct the poses, the shapes or the"
        " walls"
    )


def test_message_of_a_wall() -> None:
    text = message(scene_of(CART, walls=(LONG_WALL,)), state(y=0.075))
    assert text == (
        'transition 0: body "a" and the wall from (-5, 0) to (5, 0) overlap by 0.2 m, allowed is'
        " 0.138 m (a quarter of the body's width); correct the poses, the shapes or the walls"
    )


def test_the_first_transition_is_named_whatever_is_wrong_in_it() -> None:
    scene = scene_of(CART, CART, CART, walls=(LONG_WALL,))
    fine = np.array([state(y=3), state(y=6), state(y=9)])
    start = np.repeat(fine[None], 30, axis=0)
    start[20:, 0, 1] = 6.1  # a on b
    start[12, 2, 1] = 0.1  # c in the wall
    with pytest.raises(SimulationError, match=r'^transition 12: body "c" and the wall from'):
        check_placement(scene, start)
    start[12] = fine
    with pytest.raises(SimulationError, match=r'^transition 20: bodies "a" and "b"'):
        check_placement(scene, start)
    check_placement(scene, start[:20])
    check_placement(scene, start[:0])
    late = np.repeat(fine[None], 5000, axis=0)
    late[4321:, 1] = late[4321:, 0]
    with pytest.raises(SimulationError, match=r"^transition 4321: "):
        check_placement(scene, late)


def test_states_that_are_not_finite_are_left_to_others() -> None:
    scene = chain(walls=(LONG_WALL,))
    for bad in (np.nan, np.inf, -np.inf):
        for column in range(6):
            broken = state(5, 5)
            broken[column] = bad
            assert not refused(scene, broken, state(y=-0.35))
    # the others still count
    scene = scene_of(CART, CART, CART)
    assert refused(scene, state(x=np.nan), state(), state(x=0.1))


@pytest.mark.parametrize("shape", [(1, 6), (2, 3, 6), (2, 1, 5)])
def test_start_of_another_shape(shape) -> None:
    with pytest.raises(SimulationError, match=r"start has shape .* expected \(transition, 1, 6\)"):
        check_placement(scene_of(CART), np.zeros(shape))


# -- depth by another way, and symmetry ------------------------------------------------------------

OVAL = Shape.polygon([(np.cos(t), 0.5 * np.sin(t)) for t in np.arange(8) * np.pi / 4])
SHAPES = [CART, BOX, U, Shape.circle(0.3), Shape.polygon([(-1, -1), (2, -1), (-1, 2)]), OVAL]
coordinate = st.floats(-0.8, 0.8)
angle = st.floats(-4.0, 4.0)


def outlines(body: Body, pose) -> list[np.ndarray]:
    """Corners of a body's convex parts in the world; a circle has so many that it is round."""
    x, y, theta = pose
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    if body.shape.radius is not None:
        way = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        parts = [body.shape.radius * np.column_stack([np.cos(way), np.sin(way)])]
    else:
        parts = [np.array(part.get_vertices()) for part in engine_shapes(body, pymunk.Body())]
    return [part @ turn.T + (x, y) for part in parts]


def minkowski_depth(one: Body, other: Body, at_one, at_other) -> float:
    """How far the origin is inside the deepest Minkowski difference of convex parts."""
    deepest = 0.0
    for a in outlines(one, at_one):
        for b in outlines(other, at_other):
            difference = (a[:, None] - b).reshape(-1, 2)
            deepest = max(deepest, -ConvexHull(difference).equations[:, -1].max())
    return deepest


@given(st.sampled_from(SHAPES), st.sampled_from(SHAPES), coordinate, coordinate, angle)
def test_depth_is_that_of_minkowski_differences(one, other, x, y, theta) -> None:
    scene = scene_of(one, other)
    at = state(x, y, theta)
    text = message(scene, state(), at)
    if text is not None:
        depth = minkowski_depth(*scene.bodies, (0.0, 0.0, 0.0), at[:3])
        assert metres(text)[0] == pytest.approx(depth, rel=6e-3)


@given(
    st.lists(st.tuples(coordinate, coordinate, angle), min_size=3, max_size=3),
    st.tuples(st.floats(-30, 30), st.floats(-30, 30), angle),
)
def test_the_verdict_does_not_depend_on_where_the_world_is(poses, motion) -> None:
    poses = np.array(poses) * (3, 3, 1)
    pillar, ends = (0.5, -1.0, 0.7), [(-3.0, 1.5), (2.0, 1.0)]
    anchor = (0.1, 0.2)

    def built(moved_pillar, moved_ends, moved_anchor) -> Scene:
        static = Body("pillar", U, static=True, pose=moved_pillar)
        wall = Wall(*moved_ends)
        joint = Joint("hinge", ("c", "world"), (0.1, 0.0), moved_anchor)
        return scene_of(U, Shape.circle(0.3), BOX, static=(static,), walls=(wall,), joints=(joint,))

    dx, dy, turn = motion
    c, s = np.cos(turn), np.sin(turn)

    def moved(x, y, *theta):
        return (c * x - s * y + dx, s * x + c * y + dy, *(each + turn for each in theta))

    # c hangs in its hinge to within the noise, so that overlaps come to be seen
    x, y, theta = poses[2]
    poses[2, 0] = anchor[0] - 0.1 * np.cos(theta) + 0.03 * x
    poses[2, 1] = anchor[1] - 0.1 * np.sin(theta) + 0.03 * y
    before = message(built(pillar, ends, anchor), *([*p, 0, 0, 0] for p in poses))
    after = message(
        built(moved(*pillar), [moved(*end) for end in ends], moved(*anchor)),
        *([*moved(*p), 0, 0, 0] for p in poses),
    )
    assert (before is None) == (after is None)
    np.testing.assert_allclose(metres(after), metres(before), rtol=6e-3)


def test_order_of_the_bodies_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        shapes = [SHAPES[i] for i in rng.integers(len(SHAPES), size=2)]
        there = state(*rng.uniform(-1, 1, 2), rng.uniform(-3, 3))
        forth = metres(message(scene_of(*shapes), state(), there))
        back = metres(message(scene_of(*shapes[::-1]), there, state()))
        np.testing.assert_allclose(forth, back)


# -- measured data, and time -----------------------------------------------------------------------


def check_recorded(folder) -> None:
    scene = Scene.load(folder / "scene.toml")
    recorded = folder / "recorded" if (folder / "recorded").is_dir() else folder
    for path in sorted(recorded.glob("*.csv")):
        history = History.load(path, scene, estimate_velocities=True)
        check_placement(scene, history.segments(1).start)


@pytest.mark.parametrize(
    "name", sorted(path.parent.name for path in (ROOT / "models").glob("*/recorded"))
)
def test_recorded_models_pass(name) -> None:
    check_recorded(ROOT / "models" / name)


@pytest.mark.parametrize(
    "name",
    ["cart-linear-drag", "cart-null", "cart-offset-push", "cart-slope", "cart-thrust-bias",
     "pair-linear-drag", "pair-null", "real/double-pendulum-driven", "real/pendulum-swing"],
)  # fmt: skip
def test_shared_data_pass(name, shared_data) -> None:
    check_recorded(shared_data / name)


def test_the_apartment_starts_in_free_space() -> None:
    scene = Scene.load(ROOT / "models" / "apartment" / "scene.toml")
    assert len(scene.dynamic) == 11
    start = np.array([[*(body.pose or ()), 0, 0, 0] for body in scene.dynamic])
    check_placement(scene, start[None])
    noise = np.random.default_rng(1).normal(0.0, 0.02, (200, 11, 6))
    check_placement(scene, start + noise)
    start[3, :2] = start[7, :2]
    assert refused(scene, *start)


def test_ten_thousand_states_of_eleven_bodies_take_about_a_second() -> None:
    scene = Scene.load(ROOT / "models" / "apartment" / "scene.toml")
    start = np.array([[*(body.pose or ()), 0, 0, 0] for body in scene.dynamic])
    start = start + np.random.default_rng(1).normal(0.0, 0.02, (10_000, 11, 6))
    begin = time.perf_counter()
    check_placement(scene, start)
    assert time.perf_counter() - begin < 10.0  # about 1 s on an idle core
