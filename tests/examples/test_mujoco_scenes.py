"""MuJoCo models as scenes and back: the same geometry, and the same motion without contacts."""

import json
import re
import sys
import warnings
from typing import Any

import arviz as az
import numpy as np
import pytest
from mujoco_bridge import ConversionWarning, from_mujoco, mjcf_ranges, scene_from_mjcf

import pbrl_ppl as pp
from pbrl_ppl.errors import PosteriorError, SceneError
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall

mujoco = pytest.importorskip("mujoco")

CHAIN = """
<mujoco><option timestep="0.001" gravity="0 0 -9.81" integrator="RK4"/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="shoulder" type="hinge" axis="0 -1 0" damping="0.02"/>
    <geom type="box" pos="0 0 -.2" size=".02 .03 .2" mass=".5"/>
    <body name="lower" pos="0 0 -.4"><joint name="elbow" type="hinge" axis="0 -1 0"/>
      <geom type="box" pos="0 0 -.15" size=".03 .02 .15" mass=".3"/></body></body>
</worldbody></mujoco>
"""
CRATE = """
<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody>
  <body name="crate" pos="1 0 2" euler="0 -30 0"><freejoint/>
    <geom type="box" size=".2 .1 .1" mass="2"/></body>
</worldbody></mujoco>
"""
TABLE = """
<mujoco><option timestep="0.02" gravity="0 0 -9.81"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1"/>
  <geom name="end" type="plane" size="2 1 1" pos="3 0 0" zaxis="-1 0 0"/>
  <geom name="edge" type="plane" size="0 0 1" pos="0 -3 0" zaxis="0 1 0"/>
  <geom name="post" type="cylinder" size=".1 1" pos="1 1 0"/>
  <geom name="step" type="box" size=".2 .1 .1" pos="0 2 0.1" euler="0 0 90"/>
  <geom name="lamp" type="sphere" size=".1" pos="0 0 2"/>
  <geom name="paint" type="sphere" size=".1" pos="0 0 .1" contype="0" conaffinity="0"/>
  <body name="sled" pos="0 0 .1"><geom type="box" size=".2 .1 .1" mass="2" euler="0 0 30"/>
    <joint name="x" type="slide" axis="1 0 0" damping="3"/>
    <joint name="y" type="slide" axis="0 1 0" damping="3"/>
    <joint name="turn" type="hinge" axis="0 0 1" damping=".5"/></body>
  <body name="ball" pos="-1 0 .1"><geom type="sphere" size=".1" mass="1"/><freejoint/></body>
</worldbody></mujoco>
"""
URDF = """
<robot name="pendulum"><link name="base"/>
  <link name="arm">
    <inertial><origin xyz="0 0 -.2"/><mass value="1.5"/>
      <inertia ixx=".03" iyy=".03" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -.2"/><geometry><box size=".05 .05 .4"/></geometry></collision>
  </link>
  <joint name="pivot" type="continuous"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 1"/><axis xyz="0 1 0"/></joint>
</robot>
"""


def quiet(*given: Any, **options: Any) -> Scene:
    """The scene of a model of which nothing is left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return scene_from_mjcf(*given, **options)


def motion(xml: str, qpos, qvel, seconds: float):
    """Places and orientations of every body each 0.02 s, from MuJoCo."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    every = round(0.02 / model.opt.timestep)
    places, turns = [], []
    for row in range(round(seconds / model.opt.timestep) + 1):
        mujoco.mj_forward(model, data)
        if row % every == 0:
            places.append(data.xipos[1:].copy())
            turns.append(data.xmat[1:].reshape(-1, 3, 3).copy())
        mujoco.mj_step(model, data)
    return np.array(places), np.array(turns)


def predicted(scene: Scene, start: np.ndarray, steps: int, **values: float) -> np.ndarray:
    """States (step, body, 6) from the scene's physics, without contacts or wrenches."""
    physics = pp.Physics.declare(scene, substeps=40)
    phi = [values.get(label.partition("[")[0], 0.1) for label in physics.layout.labels]
    actions = np.zeros((1, steps, len(scene.moving), 3))
    return physics.predict(np.array(phi), start[None], actions)[0]


def test_two_links_and_their_swing(tmp_path) -> None:
    expected = Scene(
        time_step=0.02,
        gravity=(0.0, -9.81),
        bodies=(
            Body("upper", Shape.box(0.04, 0.4), known={"mass": 0.5}, pose=(0.0, 0.8, 0.0),
                 effects=("pivot_damping",),
                 prior={"pivot_damping_coefficient": {"mu": 0.02, "sigma": 0.01}}),
            Body("lower", Shape.box(0.06, 0.3), known={"mass": 0.3}, pose=(0.0, 0.45, 0.0)),
        ),
        joints=(
            Joint("hinge", ("world", "upper"), (0.0, 1.0), (0.0, 0.2)),
            Joint("hinge", ("upper", "lower"), (0.0, -0.2), (0.0, 0.15)),
        ),
    )  # fmt: skip
    options = {"plane": "xz", "known_mass": True, "time_step": 0.02}
    (tmp_path / "chain.xml").write_text(CHAIN)
    model = mujoco.MjModel.from_xml_string(CHAIN)
    for source in (CHAIN, tmp_path / "chain.xml", str(tmp_path / "chain.xml"), model):
        assert quiet(source, **options) == expected
    # masses that are not given have a prior about the model's
    inferred = quiet(CHAIN, plane="xz")
    assert inferred.time_step == 0.001 and not inferred.body("lower").known
    assert dict(inferred.body("lower").prior)["mass"][0][1] == pytest.approx(np.log(0.3))
    # a swing of half a second, released from rest: MuJoCo's angle of the lower is relative
    angles = np.array([0.7, 0.7 - 1.1])
    places, turns = motion(CHAIN, (0.7, -1.1), (0.0, 0.0), 0.5)
    start = np.zeros((2, 6))
    start[:, :2], start[:, 2] = places[0][:, [0, 2]], angles
    states = predicted(expected, start, 25, pivot_damping_coefficient=0.02)
    np.testing.assert_allclose(states[..., :2], places[1:, :, [0, 2]], atol=2e-4)
    theta = np.arctan2(turns[1:, :, 2, 0], turns[1:, :, 0, 0])
    np.testing.assert_allclose(states[..., 2], theta, atol=5e-4)
    assert np.ptp(theta, axis=0).min() > 0.5


def test_a_free_box_and_its_fall() -> None:
    scene = quiet(CRATE, plane="xz", known_mass=True, time_step=0.02)
    (crate,) = scene.bodies
    assert (crate.name, crate.shape, crate.known) == (
        "crate",
        Shape.box(0.4, 0.2),
        (("mass", 2.0),),
    )
    assert crate.effects == () and scene.joints == ()
    assert crate.pose == pytest.approx((1.0, 2.0, np.radians(30)))
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    places, turns = motion(CRATE, (1, 0, 2, c, 0, -s, 0), (0.5, 0, 1.0, 0, -3.0, 0), 0.4)
    start = np.array([[1.0, 2.0, crate.pose[2], 0.5, 1.0, 3.0]])
    states = predicted(scene, start, 20)
    # MuJoCo's Euler step is of first order: g dt/2 of the fall's time, 4 mm
    np.testing.assert_allclose(states[:, :, :2], places[1:, :, [0, 2]], atol=5e-3)
    theta = np.arctan2(turns[1:, :, 2, 0], turns[1:, :, 0, 0])
    np.testing.assert_allclose(states[..., 2], theta, atol=1e-6)


def test_a_log_of_a_chain_on_a_free_body() -> None:
    """The scene and the log of one model agree, with a parent that is turned in the model."""
    xml = CRATE.replace(
        'mass="2"/>',
        """mass="2"/>
      <body name="tail" pos="-.2 0 0"><joint type="hinge" axis="0 1 0"/>
        <geom type="box" pos="-.1 0 0" size=".1 .02 .02" mass=".2"/></body>""",
    )
    scene = quiet(xml, plane="xz", known_mass=True, time_step=0.02)
    assert [body.shape for body in scene.bodies] == [Shape.box(0.4, 0.2), Shape.box(0.2, 0.04)]
    assert scene.joints == (Joint("hinge", ("crate", "tail"), (-0.2, 0.0), (0.1, 0.0)),)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qvel[4], data.qvel[6] = 1.0, 4.0
    qpos, qvel, places = [], [], []
    for _ in range(21):
        mujoco.mj_forward(model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        places.append(data.xipos[2, [0, 2]].copy())
        mujoco.mj_step(model, data)
    history = from_mujoco(model, scene, qpos, qvel, plane="xz")
    start = history.dataset["start"].to_numpy()[0, :, 1]
    np.testing.assert_allclose(start[:, :2], places[::10], atol=1e-9)
    assert scene.body("tail").pose == pytest.approx(start[0, :3])


def test_a_table_seen_from_above() -> None:
    with pytest.warns(ConversionWarning) as said:
        scene = scene_from_mjcf(TABLE)
    (message,) = (str(each.message) for each in said)
    assert 'friction on the floor, geom "floor"' in message and "sliding_friction" in message
    assert 'geom "lamp" of the world, which is above or below all bodies' in message
    assert "post" not in message and "paint" not in message
    assert (scene.gravity, scene.normal_gravity) == ((0.0, 0.0), 9.81)
    sled, ball, post, step = scene.bodies
    corner = np.array([0.2 * np.cos(np.pi / 6) - 0.05, 0.1 + 0.1 * np.cos(np.pi / 6)])
    assert min(np.abs(np.subtract(v, corner)).max() for v in sled.shape.vertices) < 1e-6
    assert sled.effects == ("linear_drag", "angular_drag")
    assert dict(sled.prior)["linear_drag_coefficient"] == (("mu", 3.0), ("sigma", 1.5))
    # a sphere's moment is 2/5 m r^2, a disc's half
    assert (ball.shape, ball.pose) == (Shape.circle(0.1), (-1.0, 0.0, 0.0))
    assert dict(ball.prior)["inertia_scale_scale"][0][1] == pytest.approx(np.log(0.8))
    assert (post.shape, post.static, post.pose) == (Shape.circle(0.1), True, (1.0, 1.0, 0.0))
    assert (step.shape, step.pose) == (Shape.box(0.2, 0.4), (0.0, 2.0, 0.0))
    end, edge = scene.walls
    assert {end.start[0], end.end[0]} == {3.0} and edge.start[1] == edge.end[1] == -3.0
    assert abs(end.start[1] - end.end[1]) in (2.0, 4.0) and abs(edge.start[0] - edge.end[0]) > 20
    assert isinstance(end, Wall)


def test_urdf(tmp_path) -> None:
    (tmp_path / "pendulum.urdf").write_text(URDF)
    scene = quiet(tmp_path / "pendulum.urdf", plane="xz", known_mass=True)
    (arm,) = scene.bodies
    assert (arm.name, arm.shape) == ("arm", Shape.box(0.05, 0.4))
    (hinge,) = scene.joints
    assert hinge == Joint("hinge", ("world", "arm"), (0.0, 1.0), (0.0, 0.2))
    # its moment is stated: 0.03 kg m^2, of an even box it is 0.0203
    scale = 0.03 / (1.5 * (0.05**2 + 0.4**2) / 12)
    assert dict(arm.prior)["inertia_scale_scale"][0][1] == pytest.approx(np.log(scale))


def test_outlines_in_place_of_geoms() -> None:
    capsule = CHAIN.replace('type="box" pos="0 0 -.2" size=".02 .03 .2"',
                            'type="capsule" pos="0 0 -.2" size=".02 .18"')  # fmt: skip
    advice = r'"upper": its geom "geom0" is a capsule .*shapes=\{"upper": Shape.box\(0.04, 0.4\)\}'
    with pytest.raises(SceneError, match=advice):
        scene_from_mjcf(capsule, plane="xz")
    scene = quiet(capsule, plane="xz", shapes={"upper": Shape.box(0.04, 0.4)})
    assert scene.body("upper").shape == Shape.box(0.04, 0.4)
    assert scene.joints == quiet(CHAIN, plane="xz").joints
    with pytest.raises(SceneError, match=r"shapes names uper.*upper, lower"):
        scene_from_mjcf(CHAIN, plane="xz", shapes={"uper": Shape.circle(0.1)})


def test_masses_off_the_centre_and_welded_bodies() -> None:
    loaded = CHAIN.replace(
        "</body></body>",
        '<body name="load" pos="0.1 0 -.3"><inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4'
        ' 1e-4"/></body></body></body>',
    )
    scene = quiet(loaded, plane="xz", known_mass=True)
    lower = scene.body("lower")
    assert lower.known == (("mass", 0.4),) and lower.effects == ("inertia_scale", "com_offset")
    assert dict(lower.prior)["com_offset_x"][0][1] == pytest.approx(0.025)
    assert dict(lower.prior)["com_offset_y"][0][1] == pytest.approx(-0.15 / 4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('axis="0 -1 0"/>', 'axis="1 0 0"/>', '"lower": a joint of it leads out of the plane'),
        ('type="hinge" axis="0 -1 0"/>', 'type="ball"/>', '"lower": it has a ball joint on body'),
        ('type="hinge" axis="0 -1 0"/>', 'type="ball"/>', '"lower": .*a ball joint on body'),
        ('mass=".3"/>', 'mass=".3"/><geom name="tip" size=".1"/>', r'"lower" has 2 geoms .*tip'),
        ('<geom type="box" pos="0 0 -.15" size=".03 .02 .15" mass=".3"/>',
         '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>', '"lower" has no geom'),
        ("</mujoco>", "", "MuJoCo model: cannot be read"),
    ],
)  # fmt: skip
def test_what_is_no_planar_scene_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        scene_from_mjcf(CHAIN.replace(old, new), plane="xz")


def test_other_bad_input(monkeypatch, tmp_path) -> None:
    for source, plane, message in (
        (CHAIN, "yz", "plane is 'yz', expected xy"),
        (CHAIN, "xy", "leads out of the plane.*Choose the other plane"),
        (CRATE, "xy", '"crate" is tilted out of the plane'),
        (tmp_path / "none.xml", "xy", "there is no such file"),
        (3, "xy", "3 is no MuJoCo model"),
    ):
        with pytest.raises(SceneError, match=message):
            scene_from_mjcf(source, plane=plane)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SceneError, match=r"needs MuJoCo: pip install mujoco"):
        scene_from_mjcf(CHAIN)


def test_what_a_scene_leaves_out_is_named() -> None:
    more = CHAIN.replace(
        'type="hinge" axis="0 -1 0"/>',
        'type="hinge" axis="0 -1 0" range="-90 90" stiffness="1" armature=".01"/>',
    ).replace("</worldbody>", '</worldbody><equality><joint joint1="elbow"/></equality>')
    with pytest.warns(ConversionWarning) as said:
        scene_from_mjcf(more, plane="xz")
    message = str(said[0].message)
    for part in ('limits of joint "elbow"', 'spring .*"elbow"', "armature", "equality constraint"):
        assert re.search(part, message), part
    off = CRATE.replace('size=".2 .1 .1"', 'size=".2 .1 .1" pos=".1 0 0"')
    with pytest.warns(ConversionWarning, match='the frame of body "crate"'):
        scene_from_mjcf(off, plane="xz")


def posterior(scene: Scene, **draws: Any) -> Any:
    """A posterior of a scene with these draws, (draw, body) each, by parameter and bodies."""
    arrays = {name: np.asarray(values)[None] for name, (values, _) in draws.items()}
    dims = {name: [f"{name}_of"] for name in draws}
    coords = {f"{name}_of": bodies for name, (_, bodies) in draws.items()}
    if az.__version__.startswith("0."):
        idata = az.from_dict(arrays, coords=coords, dims=dims)
    else:
        idata = az.from_dict({"posterior": arrays}, coords=coords, dims=dims)
    idata.attrs["scene"] = scene.to_toml()
    return idata


def test_a_posterior_as_mjcf_and_ranges() -> None:
    scene = quiet(CHAIN, plane="xz", time_step=0.02).with_effects("lower", "inertia_scale")
    rng = np.random.default_rng(1)
    mass = np.exp(np.log([0.6, 0.2]) + 0.05 * rng.normal(size=(2000, 2)))
    damping, scale = 0.03 + 0.001 * rng.normal(size=(2, 2000, 1))
    scale += 1.5 - 0.03
    idata = posterior(
        scene,
        mass=(mass, ["upper", "lower"]),
        mu_c=(rng.uniform(0.2, 0.4, size=(2000, 2)), ["upper", "lower"]),
        pivot_damping_coefficient=(damping, ["upper"]),
        inertia_scale_scale=(scale, ["lower"]),
    )
    text, ranges = mjcf_ranges(idata, plane="xz")
    assert json.loads(json.dumps(ranges)) == ranges
    assert set(ranges["upper"]) == {"mass", "mu_c", "pivot_damping_coefficient", "inertia"}
    np.testing.assert_allclose(ranges["lower"]["mass"], np.quantile(mass[:, 1], (0.05, 0.95)))
    moment = mass[:, 1] * scale[:, 0] * Shape.box(0.06, 0.3).unit_moment
    np.testing.assert_allclose(ranges["lower"]["inertia"], np.quantile(moment, (0.05, 0.95)))
    model = mujoco.MjModel.from_xml_string(text)
    np.testing.assert_allclose(model.body("upper").mass, mass[:, 0].mean(), rtol=1e-6)
    np.testing.assert_allclose(model.body("lower").inertia, moment.mean(), rtol=1e-6)
    np.testing.assert_allclose(model.geom("lower").friction[0], 0.3, atol=0.01)
    np.testing.assert_allclose(np.ravel(model.joint("upper_theta").damping)[0], 0.03, rtol=0.01)
    # the same scene again, and the same motion as of the scene with the means
    again = quiet(text, plane="xz", time_step=0.02)
    assert again.joints == scene.joints and again.gravity == scene.gravity
    assert [(b.name, b.shape, b.pose) for b in again.bodies] == [
        (b.name, b.shape, b.pose) for b in scene.bodies
    ]
    places, _ = motion(text, (0.7, -1.1), (0.0, 0.0), 0.3)
    start = np.zeros((2, 6))
    start[:, :2], start[:, 2] = places[0][:, [0, 2]], (0.7, -0.4)
    heavy = scene.replace(bodies=tuple(
        Body(b.name, b.shape, known={"mass": m}, effects=b.effects, pose=b.pose)
        for b, m in zip(scene.bodies, mass.mean(axis=0).tolist(), strict=True)
    ))  # fmt: skip
    states = predicted(heavy, start, 15, pivot_damping_coefficient=0.03, inertia_scale_scale=1.5)
    np.testing.assert_allclose(states[..., :2], places[1:, :, [0, 2]], atol=3e-3)


def test_every_part_of_a_scene_as_mjcf() -> None:
    corners = [(-0.2, -0.1), (0.2, -0.1), (0.2, 0.1), (-0.2, 0.1)]
    scene = Scene(
        time_step=0.1,
        normal_gravity=9.81,
        walls=(Wall((-2.0, -1.0), (-2.0, 3.0)),),
        bodies=(
            Body("puck", Shape.circle(0.1), wheel=True, pose=(1.0, 2.0, 0.0),
                 effects=("linear_drag", "quadratic_drag")),
            Body("plate", Shape.polygon(corners), known={"mass": 3.0}, pose=(0.0, 1.0, 0.0)),
            Body("post", Shape.box(0.2, 0.1), static=True, pose=(3.0, 0.0, np.pi / 2)),
            Body("door", Shape.box(0.8, 0.1), known={"mass": 1.0}),
            Body("finger", Shape.circle(0.02), kinematic=True),
            Body("bar", Shape.box(0.8, 0.1), known={"mass": 1.0}),
        ),
        joints=(
            Joint("hinge", ("door", "post"), (-0.4, 0.0), (0.1, 0.0)),
            Joint("hinge", ("door", "bar"), (0.4, 0.0), (-0.4, 0.0)),
            Joint("hinge", ("bar", "world"), (0.4, 0.0), (4.6, 0.1)),
            Joint("hinge", known=False, bodies=("puck", "plate")),
        ),
    )  # fmt: skip
    ones = np.full((10, 1), 0.5) + 0.01 * np.arange(10)[:, None]
    names = ("mass", "w_x", "linear_drag_coefficient", "quadratic_drag_coefficient")
    idata = posterior(scene, **{name: (ones, ["puck"]) for name in names})
    with pytest.warns(ConversionWarning) as said:
        text, ranges = mjcf_ranges(idata)
    message = str(said[0].message)
    for part in ('wheel of body "puck"', 'effect quadratic_drag of body "puck"', '"joint4"'):
        assert part in message
    assert set(ranges["puck"]) == {*names, "inertia"}
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name, place in {
        "puck": (1, 2),
        "plate": (0, 1),
        "door": (3.4, 0.1),
        "bar": (4.2, 0.1),
    }.items():
        np.testing.assert_allclose(data.body(name).xpos[:2], place, atol=1e-6)
        np.testing.assert_allclose(data.body(name).xmat.reshape(3, 3), np.eye(3), atol=1e-6)
    np.testing.assert_allclose(model.body("plate").mass, 3.0)
    assert model.neq == 1 and model.body("finger").mocapid[0] == 0
    np.testing.assert_allclose(model.opt.gravity, (0, 0, -9.81))
    np.testing.assert_allclose(np.ravel(model.joint("puck_x").damping)[0], 0.545)
    np.testing.assert_allclose(model.geom("wall1").size, (2.0, 0.002, 0.05))


def test_mjcf_ranges_refuses_bad_input() -> None:
    scene = quiet(CRATE, plane="xz")
    idata = posterior(scene, mass=(np.ones((5, 1)), ["crate"]))
    with pytest.raises(SceneError, match="plane is 'up'"):
        mjcf_ranges(idata, plane="up")
    with pytest.raises(SceneError, match="probability is 90"):
        mjcf_ranges(idata, probability=90)
    del idata.attrs["scene"]
    with pytest.raises(PosteriorError, match="holds no scene"):
        mjcf_ranges(idata)


def test_a_pendulum_on_a_cart_there_and_back() -> None:
    """A slide on an inclined rail, read again from what was written, and its rollout."""
    along = (0.8, 0.6)
    bodies = (
        Body("cart", Shape.box(0.2, 0.1), known={"mass": 1.5}, pose=(0.1, 0.2, 0.0),
             effects=("slider_damping", "slider_friction")),
        Body("pole", Shape.box(0.04, 0.6), known={"mass": 0.7}, pose=(0.1, -0.1, 0.0)),
    )  # fmt: skip
    joints = (
        Joint("slider", ("cart", "world"), (0.0, 0.0), (0.1, 0.2), axis=along),
        Joint("hinge", ("cart", "pole"), (0.0, 0.0), (0.0, 0.3)),
    )
    scene = Scene(time_step=0.02, gravity=(0.0, -9.81), bodies=bodies, joints=joints, substeps=40)
    draws = {"slider_damping_coefficient": 0.4, "slider_friction_force": 0.0}
    idata = posterior(scene, **{n: (np.full((5, 1), v), ["cart"]) for n, v in draws.items()})
    text, _ = mjcf_ranges(idata, plane="xz")
    places, _ = motion(text, (0.3, 0.7), (0.5, 0.0), 0.3)
    start = np.zeros((2, 6))
    start[:, :2], start[1, 2] = places[0][:, [0, 2]], 0.7
    start[:, 3:5] = 0.5 * np.array(along)
    states = predicted(scene, start, 15, **draws)
    np.testing.assert_allclose(states[..., :2], places[1:, :, [0, 2]], atol=2e-3)
    again = quiet(text, plane="xz", time_step=0.02, known_mass=True)
    assert [joint.kind for joint in again.joints] == ["slider", "hinge"]
    np.testing.assert_allclose(again.joints[0].axis, along)
    assert again.body("cart").effects == ("slider_damping",)
    model = mujoco.MjModel.from_xml_string(text)
    history = from_mujoco(
        model, again, [[0.3, 0.7]] * 2, [[0.5, 0.0]] * 2, plane="xz", time_step=0.02
    )
    np.testing.assert_allclose(history.dataset["start"].to_numpy()[0, 0], start, atol=1e-9)
