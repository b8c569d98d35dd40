"""Scenes: TOML there and back, shapes against numeric integration, and every rule."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbrl_ppl.errors import SceneError
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from pbrl_ppl.scene.joints import JOINT_KINDS
from tests.helpers.places import RECORDED

pytestmark = pytest.mark.one_stack

CART = """
[world]
normal_gravity = 9.81
time_step = 0.1

[[body]]
name = "cart"
shape = { kind = "box", size = [1, 0.6] }
wheel = true
known = { mu_c = 0.2, mass = 2 }
prior = { r = { sigma = 0.5, mu = 2.0 } }
effects = ["linear_drag"]

[[wall]]
from = [-1, 0]
to = [1, 0]

[[joint]]
kind = "hinge"
bodies = ["cart", "world"]
anchor_a = [0.5, 0]
anchor_b = [0, 0]
"""
TRIANGLE = ((-1.0, -1.0), (1.0, -1.0), (0.0, 2.0))
PUCK = Body("puck", Shape.circle(0.1))


def test_reads_toml() -> None:
    scene = Scene.from_toml(CART)
    assert (scene.gravity, scene.normal_gravity, scene.time_step) == ((0.0, 0.0), 9.81, 0.1)
    assert scene.substeps == 10
    cart = scene.body("cart")
    assert cart.shape.size == (1.0, 0.6)
    assert cart.known == (("mass", 2.0), ("mu_c", 0.2))
    assert cart.prior == (("r", (("mu", 2.0), ("sigma", 0.5))),)
    assert scene.walls == (Wall((-1, 0), (1, 0)),)
    assert scene.joints == (Joint("hinge", ("cart", "world"), (0.5, 0), (0, 0)),)
    assert hash(scene) == hash(Scene.from_toml(CART))


def test_python_mappings_equal_toml() -> None:
    body = Body(
        "cart",
        Shape.box(1, 0.6),
        wheel=True,
        known={"mass": np.float64(2), "mu_c": 0.2},
        prior={"r": {"mu": 2, "sigma": 0.5}},
        effects=["linear_drag"],
    )
    assert body == Scene.from_toml(CART).body("cart")


def chairs(first: dict, second: dict) -> Scene:
    """A scene of two boxes."""
    bodies = tuple(
        Body(f"chair{i}", **({"shape": Shape.box(1.0, 0.6)} | own))
        for i, own in enumerate((first, second))
    )
    return Scene(time_step=0.1, normal_gravity=9.81, bodies=bodies)


def test_class_and_attributes() -> None:
    text = CART.replace("[[body]]", '[[body]]\nclass = "trolley"\nattributes = ["b", "a"]', 1)
    scene = Scene.from_toml(text)
    body = scene.body("cart")
    assert (body.object_class, body.attributes) == ("trolley", ("b", "a"))
    assert body.owner == "trolley (a, b)" and Scene.from_toml(CART).body("cart").owner == "cart"
    assert Scene.from_toml(scene.to_toml()) == scene
    assert "class" not in Scene.from_toml(CART).to_toml()
    kind = {"object_class": "chair"}
    shared = chairs(kind, kind)
    assert shared.owners == {"chair": ("chair0", "chair1")}
    assert shared.subset(["chair1"]).owners == {"chair": ("chair1",)}
    apart = chairs(kind, kind | {"attributes": ["locked"], "known": {"mass": 3.0}})
    assert apart.owners == {"chair": ("chair0",), "chair (locked)": ("chair1",)}
    chairs(kind | {"effects": ["linear_drag"]}, kind)  # effects are each body's own
    chairs(kind | {"shape": Shape.circle(0.3)}, kind)  # without a wheel outlines may differ


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"known": {"mass": 2.0}}, r"differ in known: \{'mass': 2.0\} and \{\}; make them equal"),
        ({"wheel": True}, 'shares the parameters of class "chair" with body "chair0".* wheel'),
        ({"kinematic": True}, "differ in kinematic"),
        ({"prior": {"mass": {"mu": 2.0}}}, "differ in prior"),
        ({"object_class": "chair0"}, 'makes "chair0" the owner .* another body'),
        ({"object_class": "world"}, "give the class another name"),
        ({"object_class": ""}, "class is '', expected a name"),
        ({"object_class": 3}, "class is 3, expected text"),
        ({"attributes": "locked"}, "attributes is 'locked', expected a list"),
        ({"attributes": ["a", "a"]}, "names one twice"),
        ({"object_class": "chair (b)", "attributes": ["a"], "known": {}}, None),
    ],
)
def test_bodies_of_a_class_must_agree(own: dict, message: str | None) -> None:
    kind = {"object_class": "chair"}
    if message is None:
        chairs(kind, kind | own)
        return
    with pytest.raises(SceneError, match=message):
        chairs(kind, kind | own)


def test_wheels_of_a_class_need_one_outline() -> None:
    wheeled = {"object_class": "chair", "wheel": True}
    with pytest.raises(SceneError, match="differ in shape"):
        chairs(wheeled, wheeled | {"shape": Shape.circle(0.3)})
    odd = {"object_class": "chair (a)"}, {"object_class": "chair", "attributes": ["a"]}
    with pytest.raises(SceneError, match="differ in object_class"):
        chairs(*odd)


@pytest.mark.skipif(not RECORDED.is_dir(), reason="../shared/data is not beside the repository")
def test_reads_every_scene_of_the_data() -> None:
    paths = sorted(RECORDED.rglob("scene.toml"))
    assert paths
    for path in paths:
        scene = Scene.load(path)
        assert Scene.from_toml(scene.to_toml()) == scene


def test_changes_are_new_scenes() -> None:
    scene = Scene.from_toml(CART)
    more = scene.with_effects("cart", "linear_drag", "angular_drag")
    assert more.body("cart").effects == ("linear_drag", "angular_drag")
    assert scene.body("cart").effects == ("linear_drag",)
    assert scene.replace(substeps=40).substeps == 40
    table = Body("table", Shape.box(1, 1), static=True, pose=(3, 0, 0))
    assert [b.name for b in scene.replace(bodies=(table, *scene.bodies)).dynamic] == ["cart"]
    with pytest.raises(SceneError, match='no body "crat"; did you mean "cart"'):
        scene.with_effects("crat", "linear_drag")
    with pytest.raises(SceneError, match="substeps is 0"):
        scene.replace(substeps=0)


@pytest.mark.parametrize(
    "shape",
    [
        Shape.box(1.0, 0.6),
        Shape.circle(0.7),
        Shape.polygon(TRIANGLE),
        Shape.polygon(TRIANGLE[::-1]),
    ],
)
def test_moments_agree_with_numeric_integration(shape: Shape) -> None:
    x_min, x_max, y_min, y_max = shape.bounds
    n = 1500
    x = x_min + (x_max - x_min) * (np.arange(n) + 0.5) / n
    y = (y_min + (y_max - y_min) * (np.arange(n) + 0.5) / n)[:, None]
    if shape.outline is None:
        inside = x**2 + y**2 < x_max**2
    else:
        corners = np.array(shape.outline)
        edges = np.roll(corners, -1, axis=0) - corners
        # The shapes here are convex and counter-clockwise: inside is left of every edge.
        inside = np.ones((n, n), dtype=bool)
        for (cx, cy), (ex, ey) in zip(corners, edges, strict=True):
            inside &= ex * (y - cy) - ey * (x - cx) > 0
    assert shape.unit_moment == pytest.approx((x**2 + y**2)[inside].mean(), rel=2e-3)


def test_concave_polygon_moment_is_the_sum_of_its_boxes() -> None:
    # An L of two 1 x 1 boxes and a 2 x 1 box below; the centroid is at (5/6, 5/6).
    corner = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    shape = Shape.polygon([tuple(p) for p in corner - 5 / 6])
    parts = [((1.0, 0.5), (2, 1)), ((0.5, 1.5), (1, 1))]
    moment = sum(
        w * h * ((w**2 + h**2) / 12 + (cx - 5 / 6) ** 2 + (cy - 5 / 6) ** 2)
        for (cx, cy), (w, h) in parts
    )
    assert shape.unit_moment == pytest.approx(moment / 3)


def test_outline_is_counter_clockwise() -> None:
    assert Shape.polygon(TRIANGLE).outline == TRIANGLE
    assert Shape.polygon(TRIANGLE[::-1]).outline == TRIANGLE
    assert Shape.polygon(TRIANGLE[::-1]).vertices == TRIANGLE[::-1]
    assert Shape.circle(1).outline is None
    assert Shape.box(2, 4).bounds == (-1, 1, -2, 2)


number = st.floats(-1e6, 1e6)
size = st.floats(1e-6, 1e6)
name = st.text(st.characters(codec="utf-8"), min_size=1).filter(
    lambda s: s != "world" and s == s.strip() and s.isprintable()
)


@st.composite
def polygons(draw: st.DrawFn) -> Shape:
    # Corners on a circle in order of angle never cross.
    steps = draw(st.lists(st.floats(0.2, 1.0), min_size=3, max_size=8))
    angles = np.cumsum(steps) / sum(steps) * 2 * math.pi
    corners = draw(size) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    following = np.roll(corners, -1, axis=0)
    cross = corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]
    centroid = ((corners + following) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    return Shape.polygon([(float(x), float(y)) for x, y in corners - centroid])


shapes = st.one_of(st.builds(Shape.box, size, size), st.builds(Shape.circle, size), polygons())
pairs = st.tuples(number, number)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    share = st.floats(0, 1)
    known = st.fixed_dictionaries({}, optional={"mass": size, "mu_c": share, "w_theta": number})
    hyper = st.fixed_dictionaries({}, optional={"mu": number, "sigma": size, "kappa": size})
    prior = st.fixed_dictionaries({}, optional={"r": hyper, "mu_x": hyper})
    effects = st.lists(name, unique=True, max_size=2)
    movers = draw(st.lists(name, min_size=1, max_size=3, unique=True))
    bodies = [
        Body(
            n,
            draw(shapes),
            draw(st.booleans()),
            known=draw(known),
            prior=draw(prior),
            effects=draw(effects),
            pose=(*draw(pairs), draw(number)),
        )
        for n in movers
    ]
    bodies.append(Body("w" + max(movers), draw(shapes), static=True, pose=(*draw(pairs), 1)))
    walls = [Wall(a, b) for a, b in draw(st.lists(st.tuples(pairs, pairs))) if a != b]
    kinds = st.sampled_from(sorted({*JOINT_KINDS} - {"slider"}))
    slider, ways = st.just("slider"), pairs.filter(any)
    weights = st.dictionaries(st.sampled_from(["world", *movers]), size, min_size=1)
    indices = st.fixed_dictionaries({}, optional={"i_a": weights, "i_b": weights})
    two, maybe = st.just(("world", movers[0])), st.none() | pairs
    joint = st.one_of(
        st.builds(Joint, kinds, two, pairs, pairs),
        st.builds(Joint, kinds, two, maybe, maybe, st.just(False)),
        st.builds(Joint, kinds, known=st.just(False), prior=indices),
        st.builds(Joint, slider, two, maybe, maybe, axis=ways, known=st.just(False)),
    )
    return Scene(
        gravity=draw(pairs),
        normal_gravity=draw(size),
        time_step=draw(size),
        substeps=draw(st.integers(1, 1000)),
        bodies=(*(b for b in bodies[:-1] if b.name != bodies[-1].name), bodies[-1]),
        walls=tuple(walls),
        joints=tuple(draw(st.lists(joint, max_size=2))),
    )


@given(scenes())
def test_toml_round_trip(scene: Scene) -> None:
    again = Scene.from_toml(scene.to_toml())
    assert again == scene
    assert hash(again) == hash(scene)


@given(shapes)
def test_moment_is_within_the_bounds(shape: Shape) -> None:
    x_min, x_max, y_min, y_max = shape.bounds
    farthest = max(-x_min, x_max) ** 2 + max(-y_min, y_max) ** 2
    assert 0 < shape.unit_moment < farthest


def edited(old: str, new: str) -> str:
    assert CART.count(old) == 1
    return CART.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (edited("time_step", "timestep"), r'key "timestep" in \[world\]; did you mean "time_step"'),
        (edited("[[body]]", "[[bodies]]"), 'key "bodies" in the file; did you mean "body"'),
        (edited("[[body]]", "[body]"), r"write \[\[body\]\]"),
        (edited("wheel", "wheels"), r'"wheels" in \[\[body\]\] number 1 \("cart"\).*"wheel"'),
        (edited("size", "sizes"), r'"sizes" in shape of \[\[body\]\] number 1.*"size"'),
        (edited("from", "form"), r'"form" in \[\[wall\]\] number 1.*"from"'),
        (edited("anchor_a", "anchor_A"), r'"anchor_A" in \[\[joint\]\] number 1.*"anchor_a"'),
        (edited("mass", "mas"), 'parameter "mas" in known of body "cart"; did you mean "mass"'),
        (edited("{ r = {", "{ rr = {"), 'parameter "rr" in prior of body "cart"; did you mean "r"'),
        (edited("mu = 2.0", "mean = 2.0"), 'key "mean" in prior of body "cart": r; did you mean'),
        (edited("sigma = 0.5", "sigma = 0"), "prior of .*r: sigma is 0.0, expected more than 0"),
        (edited("time_step = 0.1", ""), r'\[world\] has no "time_step"'),
        (edited("time_step = 0.1", "time_step = 0"), "time_step is 0.0, expected more than 0"),
        (edited("time_step = 0.1", "time_step = true"), "time_step is True, expected a number"),
        (edited("time_step = 0.1", "time_step = inf"), "time_step is inf, expected a finite"),
        (edited("time_step = 0.1", "time_step = '0.1'"), "time_step is '0.1', expected a number"),
        (edited("time_step = 0.1", "time_step = 0.1\nsubsteps = 2.5"), "substeps is 2.5"),
        (edited("time_step = 0.1", "time_step = 0.1\nsubsteps = true"), "substeps is True"),
        (edited("time_step = 0.1", "time_step = 0.1\ngravity = 9.81"), "expected 2 numbers"),
        (edited("normal_gravity = 9.81", ""), "wheel = true but nothing presses"),
        (edited("9.81", "-9.81"), "normal_gravity is -9.81"),
        (edited('"box"', '"boxx"'), "kind is 'boxx'.*did you mean \"box\""),
        (edited('"box"', '"circle"'), 'a circle has no "size"|a circle needs "radius"'),
        (edited("size = [1, 0.6]", "size = [1, -0.6]"), "size is -0.6, expected more than 0"),
        (edited("size = [1, 0.6]", "size = [1]"), "size has 1 numbers, expected 2"),
        (edited(", size = [1, 0.6]", ""), 'a box needs "size"'),
        (edited("mass = 2", "mass = 0"), "known of .*: mass is 0.0"),
        (edited("mass = 2", "mass = false"), "known of .*: mass is False, expected a number"),
        (edited("mass = 2", "mass = nan"), "known of .*: mass is nan, expected a finite"),
        (edited("mu_c = 0.2", "mu_c = 1.2"), "known of .*: mu_c is 1.2, expected between 0 and 1"),
        (edited("mu_c = 0.2", "r = 0.2"), "r is in both known and prior"),
        (edited("wheel = true", "wheel = 1"), "wheel is 1, expected true or false"),
        (edited("wheel = true", "wheel = true\nstatic = true\npose = [0, 0, 0]"), "static body"),
        (edited("wheel = true", "static = true"), "it is static and has no pose"),
        (edited("wheel = true", "static = true\npose = [0, 0, 0]"), "no body that moves"),
        (edited('["linear_drag"]', '"linear_drag"'), "effects is 'linear_drag', expected a list"),
        (edited('["linear_drag"]', '["a", "a"]'), "names one twice"),
        (edited('name = "cart"', 'name = "world"'), "name of the ground"),
        (edited('name = "cart"', 'name = ""'), "name is ''"),
        (edited('name = "cart"', "name = 3"), "name is 3, expected text"),
        (edited("to = [1, 0]", "to = [-1, 0]"), "length is zero"),
        (edited('"hinge"', '"hingee"'), "kind is 'hingee'.*\"hinge\""),
        (edited('"cart", "world"', '"crat", "world"'), 'no body "crat"; did you mean "cart"'),
        (edited('"cart", "world"', '"cart", "cart"'), "with itself"),
        (edited('"cart", "world"', '"cart"'), "expected two names"),
        ("[world]\ntime_step = 0.1\n", "no body that moves"),
        ("time_step = 0.1", 'key "time_step" in the file'),
        ("", 'has no "world"'),
        ("[world]\ntime_step == 0.1\n", "not TOML.*line 2"),
        ("world = 3", r"\[world\] is 3, expected a table"),
        (CART + CART[CART.index("[[body]]") : CART.index("[[wall]]")], 'called "cart"; rename'),
    ],
)
def test_bad_scenes_say_what_and_where(text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        Scene.from_toml(text)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (((0, 0), (1, 0)), "has 2 points, expected at least 3"),
        (((-1, -1), (1, 1), (1, -1), (-1, 1)), "edges 1 and 3 meet"),
        (((-1, 0), (0, 0), (1, 0)), "meet|no area"),
        (((-1, -1), (1, -1), (0, 2), (-1, -1)), "point 4 is point 1 again"),
        (((0, 0), (3, 0), (0, 3)), r"centroid is at \(1, 1\).*subtract \(1, 1\)"),
        (((0, 0), (1, 0), "ab"), "expected 2 numbers"),
        (((0, 0), (1, 0), (0, math.nan)), "expected a finite number"),
        ("abc", "expected a list of points"),
    ],
)
def test_bad_polygons(vertices: tuple[tuple[float, float], ...], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        Shape("polygon", vertices=vertices)


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (-7.25, 0.3)])
def test_cure_for_a_polygon_off_its_centroid_works(dx: float, dy: float) -> None:
    """A right triangle with legs a has the unit moment a^2 / 9 about its centroid."""
    corners = [(x + dx, y + dy) for x, y in ((0, 0), (3, 0), (0, 3))]
    with pytest.raises(SceneError) as caught:
        Shape.polygon(corners)
    said = re.search(r"subtract \((.+), (.+)\) from every vertex", str(caught.value))
    x_said, y_said = map(float, said.groups())
    cured = Shape.polygon([(x - x_said, y - y_said) for x, y in corners])
    np.testing.assert_allclose(cured.vertices, [(-1, -1), (2, -1), (-1, 2)], atol=1e-9)
    assert cured.unit_moment == pytest.approx(1.0, rel=1e-9)


def test_python_scenes_are_checked() -> None:
    with pytest.raises(SceneError, match="expected a Body"):
        Scene(time_step=0.1, bodies=("puck",))
    with pytest.raises(SceneError, match="expected a Shape"):
        Body("puck", "circle")
    with pytest.raises(SceneError, match="gives one name twice"):
        Body("puck", Shape.circle(1), known=(("mass", 1.0), ("mass", 2.0)))
    with pytest.raises(SceneError, match="expected a finite number"):
        Scene(time_step=10**400, bodies=(PUCK,))
    assert Scene(time_step=1, bodies=[PUCK]).bodies == (PUCK,)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no such file"):
        Scene.load(tmp_path / "none.toml")
    with pytest.raises(SceneError, match="cannot be read"):
        Scene.load(tmp_path)
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(SceneError, match="UTF-8"):
        Scene.load(tmp_path / "bytes.toml")
    (tmp_path / "bad.toml").write_text("[world]\ntime_step = \n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"bad.toml: not TOML: .*line 2"):
        Scene.load(tmp_path / "bad.toml")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"bodies": ("puck", "world")}, "lacks bodies, anchor_a or anchor_b.*known = false"),
        ({"anchor_a": (0, 0), "anchor_b": (0, 0)}, "lacks bodies"),
        ({"anchor_a": (0, 0), "known": False}, "has anchor_a and no bodies.*in which body's frame"),
        ({"bodies": ("puck", "puck"), "known": False}, 'joins "puck" with itself'),
        ({"bodies": ("puck",), "known": False}, "expected two names"),
        ({"known": 0}, "known is 0"),
    ],
)
def test_impossible_joint(kwargs, message) -> None:
    with pytest.raises(SceneError, match=message):
        Joint("hinge", **kwargs)


def test_rod_to_be_inferred_needs_reference_poses() -> None:
    placed = Body("placed", Shape.circle(0.1), pose=(1.0, 0.0, 0.0))
    Scene(time_step=0.1, bodies=(placed,), joints=(Joint("distance", known=False),))
    Scene(time_step=0.1, bodies=(PUCK,), joints=(Joint("hinge", known=False),))
    with pytest.raises(SceneError, match=r'number 1: .*body "puck" has no pose.*add pose'):
        Scene(time_step=0.1, bodies=(placed, PUCK), joints=(Joint("distance", known=False),))


def test_extent_holds_walls_and_poses() -> None:
    assert Scene(time_step=0.1, bodies=(PUCK,)).extent is None
    placed = Body("placed", Shape.circle(0.1), pose=(1.0, 0.0, 0.0))
    scene = Scene(time_step=0.1, bodies=(PUCK, placed), walls=(Wall((-2, 0), (0, 3)),))
    assert scene.extent == (-2.0, 1.1, -0.1, 3.0)


def test_joint_of_two_things_that_cannot_move():
    table = Body("table", Shape.circle(0.5), static=True, pose=(0, 0, 0))
    puck = Body("puck", Shape.circle(0.1))
    joint = Joint("hinge", ("table", "world"), (0, 0), (0, 0))
    with pytest.raises(SceneError, match="neither table nor world can move"):
        Scene(time_step=0.1, bodies=(table, puck), joints=(joint,))


def test_kinematic_bodies_are_moving_and_not_dynamic() -> None:
    finger = Body("finger", Shape.circle(0.01), kinematic=True, known={"mu_c": 0.5})
    scene = Scene(time_step=0.1, bodies=(finger, Body("puck", Shape.circle(0.1))))
    assert [body.name for body in scene.moving] == ["finger", "puck"]
    assert [body.name for body in scene.dynamic] == ["puck"]
    assert scene.joinable == ("puck", "world")
    assert Scene.from_toml(scene.to_toml()) == scene
    with pytest.raises(SceneError, match="no body that moves freely"):
        Scene(time_step=0.1, bodies=(finger,))
    joint = Joint("hinge", ("finger", "world"), (0, 0), (0, 0))
    with pytest.raises(SceneError, match="neither finger nor world can move freely"):
        scene.replace(joints=(joint,))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wheel": True}, "it is kinematic.* has wheel = True; drop one"),
        ({"static": True, "pose": (0, 0, 0)}, "it is kinematic.* has static = True"),
        ({"effects": ("linear_drag",)}, "it is kinematic.* has effects"),
        (
            {"known": {"mass": 1.0}},
            "known has mass, which does not matter then; expected r or mu_c",
        ),
        ({"prior": {"mass": {"mu": 1.0}}}, "prior has mass"),
        ({"kinematic": 1}, "kinematic is 1, expected true or false"),
    ],
)
def test_kinematic_bodies_have_nothing_that_forces_act_on(options, message) -> None:
    with pytest.raises(SceneError, match=message):
        Body("finger", Shape.circle(0.01), **{"kinematic": True} | options)


@pytest.mark.parametrize("value", ["1e308", "-1e308", "1e19", "1e-300", "-1.0", "nan", "true"])
@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("[1, 0.6]", "[{0}, {0}]", "size"),
        ("time_step = 0.1", "time_step = {0}", "time_step"),
        ("normal_gravity = 9.81", "normal_gravity = 9.81\nsubsteps = {0}", "substeps"),
        ("mass = 2", "mass = {0}", "mass"),
        ("sigma = 0.5", "sigma = {0}", "r: sigma"),
        ("[[wall]]", "[noise]\nx = {0}\n[[wall]]", r"\[noise\]: x"),
    ],
)
def test_absurd_numbers_are_refused(old: str, new: str, where: str, value: str) -> None:
    text = CART.replace(old, new.format(value))
    assert text != CART
    with pytest.raises(SceneError, match=f"{where} is .*, expected"):
        Scene.from_toml(text)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[1, 0.6]", "[{0}, {0}]"),
        ("normal_gravity = 9.81", "normal_gravity = 9.81\ngravity = [{0}, 0]"),
        ("anchor_b = [0, 0]", "anchor_b = [{0}, 0]"),
        ("from = [-1, 0]", "from = [{0}, 0]"),
        ("mu = 2.0", "mu = {0}"),
    ],
)
def test_numbers_have_a_largest(old: str, new: str) -> None:
    Scene.from_toml(CART.replace(old, new.format("1e18")))
    with pytest.raises(SceneError, match=r"expected at most 1e\+18 in SI units"):
        Scene.from_toml(CART.replace(old, new.format("1.1e18")))


@given(st.floats(1e-18, 1e18), st.floats(1e-18, 1e18))
def test_the_moments_of_any_box_are_numbers(width: float, height: float) -> None:
    shape = Shape.box(width, height)
    assert 0 < shape.unit_moment < math.inf
