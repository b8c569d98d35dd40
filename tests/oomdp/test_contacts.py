"""Sector contact predicates: placed objects, invariances, and rays against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.errors import FitError, HistoryError
from pbrl_ppl.oomdp import SectorContacts
from pbrl_ppl.oomdp.relations import spans
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall

pytestmark = pytest.mark.one_stack

BOX = Shape.box(0.9, 0.5)
#: Concave: a corner sofa.
SOFA = Shape.polygon([(-1.0, -0.6), (1.4, -0.6), (1.4, 0.2), (-0.2, 0.2), (-0.2, 1.0), (-1.0, 1.0)])
CONTACTS = SectorContacts(radius=0.2, by_object=True)


def pair(shape: Shape = BOX, other: Shape | None = None) -> Scene:
    return Scene(
        time_step=0.1, bodies=(Body("body", shape), Body("disc", other or Shape.circle(0.2)))
    )


def poses(*rows) -> np.ndarray:
    return np.array([rows], dtype=float)


def sectors(scene: Scene, at: np.ndarray, body: int = 0, contacts=CONTACTS) -> list[int]:
    """Sectors of a body with which anything is in contact."""
    return np.flatnonzero(contacts.of(scene, at)[0, body].any(axis=0)).tolist()


@pytest.mark.parametrize("heading", [0.0, 0.7, np.pi / 2, -2.5])
@pytest.mark.parametrize("count", [1, 2, 4, 7, 12])
def test_each_sector_in_turn(count, heading) -> None:
    """A small disc at the middle of each sector, around a round body: that one and no other."""
    scene = pair(Shape.circle(0.5), Shape.circle(0.02))
    contacts = SectorContacts(sectors=count, rays=240 // count, radius=0.1)
    for sector in range(count):
        angle = heading + 2 * np.pi * sector / count
        at = poses((1, 2, heading), (1 + 0.55 * np.cos(angle), 2 + 0.55 * np.sin(angle), 0))
        assert sectors(scene, at, contacts=contacts) == [sector]


def test_at_the_edge_between_two_sectors_both() -> None:
    at = poses((0, 0, 0), (0.6 * np.sqrt(0.5), 0.6 * np.sqrt(0.5), 0))
    assert sectors(pair(Shape.circle(0.3)), at) == [0, 1]


@pytest.mark.parametrize(("gap", "touches"), [(0.0, True), (0.195, True), (0.205, False)])
@pytest.mark.parametrize("shape", ["circle", "box", "wall", "polygon"])
def test_collision_radius_is_a_gap_along_the_ray(shape, gap, touches) -> None:
    """The one ray goes along x: the gap is known in closed form for every kind of thing."""
    contacts = SectorContacts(sectors=4, rays=1, radius=0.2)
    if shape == "wall":
        wall = Wall((0.45 + gap, -0.3), (0.45 + gap, 0.4))
        scene = Scene(time_step=0.1, bodies=(Body("body", BOX),), walls=(wall,))
        at = poses((0, 0, 0))
    else:
        other, reach = {
            "circle": (Shape.circle(0.3), 0.3),
            "box": (Shape.box(0.4, 0.6), 0.3),
            # a corner points at the body
            "polygon": (Shape.polygon([(-0.6, 0.0), (0.3, -0.4), (0.3, 0.4)]), 0.6),
        }[shape]
        turn = np.pi / 2 if shape == "box" else 0.0
        scene, at = pair(other=other), poses((0, 0, 0), (0.45 + gap + reach, 0, turn))
        # the other one sees the body in its own frame
        own = {"circle": [2], "box": [1], "polygon": [2]}[shape]
        assert sectors(scene, at, body=1, contacts=contacts) == (own if touches else [])
    assert sectors(scene, at, contacts=contacts) == ([0] if touches else [])


def test_hollow_of_a_concave_body() -> None:
    """A table in the corner of the sofa is 0.1 m from it, one that stands farther out is not.

    A convex hull would have both inside.
    """
    scene = pair(SOFA)
    assert sectors(scene, poses((0, 0, 0), (0.1, 0.5, 0))) == [1]
    assert sectors(scene, poses((0, 0, 0), (0.35, 0.65, 0))) == []


def test_what_overlaps_is_in_contact() -> None:
    for at in [(0, 0, 0), (0.1, 0, 0), (0.3, 0.2, 1)]:
        assert sectors(pair(), poses((0, 0, 0), at))
    around = pair(Shape.box(0.2, 0.2), Shape.circle(2.0))  # the body lies wholly inside
    assert sectors(around, poses((0, 0, 0), (0.1, 0, 0))) == [0, 1, 2, 3]


def crowd(seed: int, mirrored: bool = False) -> tuple[Scene, np.ndarray]:
    """Boxes, circles and polygons near each other, walls and a static body; 200 states."""
    flip = np.array([1.0, -1.0 if mirrored else 1.0, -1.0 if mirrored else 1.0])

    def outline(corners) -> Shape:
        return Shape.polygon([tuple(np.array(c) * flip[:2]) for c in corners])

    bodies = (
        Body("box", BOX),
        Body("disc", Shape.circle(0.4)),
        Body("sofa", outline(SOFA.vertices)),
        Body("post", outline([(-0.6, 0.0), (0.3, -0.4), (0.3, 0.4)]), static=True,
             pose=tuple(np.array((1.0, -1.5, 0.4)) * flip)),
    )  # fmt: skip
    ends = [((-3, -2), (2, -2.4)), ((2, -2.4), (2.5, 2))]
    walls = tuple(
        Wall(tuple(np.array(a) * flip[:2]), tuple(np.array(b) * flip[:2])) for a, b in ends
    )
    at = np.random.default_rng(seed).uniform((-2, -2, -9), (2, 2, 9), (200, 3, 3))
    return Scene(time_step=0.1, bodies=bodies, walls=walls), at * flip


def moved(scene: Scene, at: np.ndarray, shift, turn: float) -> tuple[Scene, np.ndarray]:
    """The whole scene shifted and turned."""
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def point(p):
        return tuple(matrix @ p + shift)

    bodies = tuple(
        Body(b.name, b.shape, static=True, pose=(*point(b.pose[:2]), b.pose[2] + turn))
        if b.static else b for b in scene.bodies
    )  # fmt: skip
    walls = tuple(Wall(point(w.start), point(w.end)) for w in scene.walls)
    new = at.copy()
    new[..., :2] = at[..., :2] @ matrix.T + shift
    new[..., 2] += turn
    return scene.replace(bodies=bodies, walls=walls), new


def test_objects() -> None:
    scene, at = crowd(1)
    assert CONTACTS.objects(scene) == ("box", "disc", "sofa", "world", "post")
    flags = CONTACTS.of(scene, at)
    assert flags.shape == (200, 3, 5, 4)
    assert flags.any(axis=(0, 3)).sum() == 3 * 5 - 3  # a body never touches itself
    assert not flags[:, [0, 1, 2], [0, 1, 2]].any()
    merged = SectorContacts(radius=0.2)  # as the paper has it: which sectors, not with what
    np.testing.assert_array_equal(merged.of(scene, at)[:, :, 0], flags.any(axis=2))
    assert merged.objects(scene) == ("anything",)
    assert merged.labels(scene) == ("contact_0", "contact_1", "contact_2", "contact_3")
    assert CONTACTS.labels(scene)[3 * 4 + 1] == "contact_1(world)"


def test_walls_and_static_bodies_count() -> None:
    """Without telling them apart, too."""
    wall, post = Wall((0.5, -2.0), (0.5, 2.0)), Body("post", BOX, static=True, pose=(0.9, 0, 0))
    alone = Scene(time_step=0.1, bodies=(Body("body", BOX),))
    for scene in (alone.replace(walls=(wall,)), alone.replace(bodies=(*alone.bodies, post))):
        assert SectorContacts().conditions(scene, poses((0, 0, 0))) == [[{"contact_0"}]]


@pytest.mark.parametrize(("shift", "turn"), [((5.0, -3.0), 0.0), ((0, 0), 2.1), ((-40, 7), -0.6)])
def test_invariant_under_motion_of_the_whole_scene(shift, turn) -> None:
    scene, at = crowd(2)
    np.testing.assert_array_equal(
        CONTACTS.of(*moved(scene, at, np.array(shift), turn)), CONTACTS.of(scene, at)
    )


def test_mirror() -> None:
    """Left and right change places."""
    flags, other = CONTACTS.of(*crowd(3)), CONTACTS.of(*crowd(3, mirrored=True))
    assert flags.any(axis=(0, 1, 2)).all()
    np.testing.assert_array_equal(other, flags[..., [0, 3, 2, 1]])


def inside(body: Body, points: np.ndarray) -> np.ndarray:
    """Whether points of a body's frame are in its outline, by the even-odd rule."""
    x, y = points[..., 0], points[..., 1]
    corners = body.shape.outline
    if corners is None:
        return np.hypot(x, y) <= body.shape.radius
    odd = np.zeros(x.shape, dtype=bool)
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        if ay != by:
            odd ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return odd


def test_points_along_the_rays_agree() -> None:
    """Independently, for boxes, discs and concave outlines: points every 5 mm along each ray."""
    scene, at = crowd(6)
    flags = CONTACTS.of(scene, at)
    far, turns = np.arange(0.0, 4.0, 0.005), CONTACTS.directions
    seen = 0
    for state in range(40):
        for i, j in [(0, 1), (0, 2), (1, 2), (2, 0), (2, 1)]:
            own, other = scene.moving[i], scene.moving[j]
            points = turns[:, None] * far[:, None]
            c, s = np.cos(at[state, :, 2]), np.sin(at[state, :, 2])
            world = at[state, i, :2] + points @ np.array([[c[i], s[i]], [-s[i], c[i]]])
            there = (world - at[state, j, :2]) @ np.array([[c[j], -s[j]], [s[j], c[j]]])
            gaps = np.full(len(turns), np.inf)
            for ray, (mine, its) in enumerate(
                zip(inside(own, points), inside(other, there), strict=True)
            ):
                if mine.any() and its.any():
                    gaps[ray] = abs(far[mine][:, None] - far[its]).min()
            nearest = gaps.reshape(4, 10).min(axis=1)
            sure = abs(nearest - CONTACTS.radius) > 0.02
            np.testing.assert_array_equal(flags[state, i, j][sure], (nearest < 0.2)[sure])
            seen += int((nearest < 0.2).sum())
    assert seen > 100


def test_far_rows_do_not_matter() -> None:
    scene, at = crowd(4)
    alone = np.concatenate([CONTACTS.of(scene, at[i : i + 1]) for i in range(len(at))])
    np.testing.assert_array_equal(CONTACTS.of(scene, at), alone)


def test_joined_bodies_do_not_touch() -> None:
    joint = Joint("hinge", ("body", "disc"), (0.5, 0.0), (-0.2, 0.0))
    scene = pair().replace(joints=(joint,))
    at = poses((0, 0, 0), (0.7, 0, 0))
    assert sectors(pair(), at) == [0]
    assert sectors(scene, at) == []


def test_conditions_are_values() -> None:
    scene, at = crowd(5)
    found = CONTACTS.conditions(scene, at)
    flags, names = CONTACTS.of(scene, at), CONTACTS.objects(scene)
    for state in range(len(at)):
        for body in range(3):
            expected = {
                f"contact_{sector}({name})"
                for i, name in enumerate(names)
                for sector in range(4)
                if flags[state, body, i, sector]
            }
            assert found[state][body] == expected
            assert hash(found[state][body]) == hash(frozenset(expected))


def test_empty() -> None:
    alone = Scene(time_step=0.1, bodies=(Body("body", BOX),))
    assert CONTACTS.of(alone, np.zeros((3, 1, 6))).shape == (3, 1, 1, 4)
    assert not CONTACTS.of(alone, np.zeros((3, 1, 6))).any()
    assert CONTACTS.of(pair(), np.zeros((0, 2, 6))).shape == (0, 2, 2, 4)


def test_bad_input() -> None:
    with pytest.raises(HistoryError, match=r"shape \(2, 6\), expected \(n, 2, 6\)"):
        CONTACTS.of(pair(), np.zeros((2, 6)))
    with pytest.raises(HistoryError, match="not finite"):
        CONTACTS.of(pair(), np.full((1, 2, 6), np.nan))
    for wrong in ({"sectors": 0}, {"rays": 1.5}, {"radius": -0.1}, {"radius": np.nan}):
        with pytest.raises(FitError, match=next(iter(wrong))):
            SectorContacts(**wrong)


# -- rays ------------------------------------------------------------------------------------------

RECTANGLE = (np.array([[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]]), 0.0)
CIRCLE = (np.zeros((1, 2)), 0.7)
WALL = (np.array([[2.0, -1.0], [2.0, 1.0]]), 0.0)
MISS = [np.inf, -np.inf]


def one(part, origin, direction) -> np.ndarray:
    direction = np.array(direction, dtype=float) / np.hypot(*direction)
    return spans(part, np.array([origin], dtype=float), direction[None, None])[0, 0]


@pytest.mark.parametrize(
    ("part", "origin", "direction", "expected"),
    [
        (CIRCLE, (-3, 0), (1, 0), [2.3, 3.7]),
        (CIRCLE, (0, 0), (3, 4), [0.0, 0.7]),
        (CIRCLE, (-3, 0), (-1, 0), MISS),
        (CIRCLE, (-3, 0.8), (1, 0), MISS),
        # a chord at half the radius
        (CIRCLE, (-3, 0.35), (1, 0), [3 - 0.7 * np.sqrt(0.75), 3 + 0.7 * np.sqrt(0.75)]),
        (RECTANGLE, (-3, 0.4), (1, 0), [2.0, 4.0]),
        (RECTANGLE, (0, 0), (0, -1), [0.0, 0.5]),
        (RECTANGLE, (0, 0), (1, 1), [0.0, 0.5 * np.sqrt(2)]),
        (RECTANGLE, (-2, -1.5), (1, 1), [np.sqrt(2), 2 * np.sqrt(2)]),
        (RECTANGLE, (-3, 0.6), (1, 0), MISS),
        (RECTANGLE, (3, 0), (1, 0), MISS),
        (WALL, (0, 0.9), (1, 0), [2.0, 2.0]),
        (WALL, (1, 0), (1, 1), [np.sqrt(2)] * 2),
        (WALL, (0, 1.1), (1, 0), MISS),
        (WALL, (3, 0), (1, 0), MISS),
        (WALL, (2, -3), (0, 1), MISS),  # along it: it has no width
    ],
)
def test_closed_forms(part, origin, direction, expected) -> None:
    np.testing.assert_allclose(one(part, origin, direction), expected, atol=1e-14)


@given(
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.floats(-np.pi, np.pi),
    st.sampled_from([RECTANGLE, CIRCLE]),
)
def test_span_is_where_the_ray_is_inside(x, y, angle, part) -> None:
    """Points of a fine grid along the ray, by the shape's own inequality."""
    ray = np.array([np.cos(angle), np.sin(angle)])
    enter, leave = one(part, (x, y), ray)
    at = np.linspace(0.0, 8.0, 400)
    px, py = np.array([[x], [y]]) + ray[:, None] * at
    depth = 0.7 - np.hypot(px, py) if part is CIRCLE else np.minimum(1 - abs(px), 0.5 - abs(py))
    sure = abs(depth) > 1e-9
    inside = (enter <= at) & (at <= leave)
    assert (inside == (depth > 0))[sure].all()


def test_rows_are_independent() -> None:
    rng = np.random.default_rng(3)
    origins, angles = rng.normal(0, 2, (50, 2)), rng.uniform(-np.pi, np.pi, (50, 7))
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for part in (RECTANGLE, CIRCLE, WALL):
        together = spans(part, origins, directions)
        alone = [spans(part, origins[i : i + 1], directions[i : i + 1])[0] for i in range(50)]
        np.testing.assert_array_equal(together, alone)
