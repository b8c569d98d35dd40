"""Rollouts of MuJoCo as histories: its own arrays against its own positions."""

import numpy as np
import pytest
from mujoco_bridge import from_mujoco

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.scene import Body, Joint, Scene, Shape

pytestmark = pytest.mark.one_stack

mujoco = pytest.importorskip("mujoco")

SLED = """
<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody>
  <body name="sled" pos="1 2 0"><geom type="box" size=".2 .1 .1" mass="2"/>
    <joint name="sx" type="slide" axis="1 0 0"/><joint name="sy" type="slide" axis="0 1 0"/>
    <joint name="turn" type="hinge" axis="0 0 1"/></body>
  <body name="puck" pos="-1 0 0"><geom type="cylinder" size=".1 .1" mass="1"/><freejoint/></body>
</worldbody><actuator>
  <motor joint="sy" gear="3"/><motor joint="turn" ctrllimited="true" ctrlrange="-1 1"/>
  <motor joint="sx"/>
</actuator></mujoco>
"""
ARM = """
<mujoco><option timestep="0.01" gravity="0 0 -9.81"/><worldbody>
  <body name="arm" pos="0 0 1"><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5"/>
    <joint type="hinge" axis="0 1 0"/></body>
</worldbody></mujoco>
"""
BOTH = Scene(
    time_step=0.1,
    bodies=(Body("puck", Shape.circle(0.1)), Body("sled", Shape.box(0.4, 0.2))),
)


def rollout(xml: str, rows: int, start=None, ctrl=None):
    """Model, qpos and qvel of every row, and positions as MuJoCo has them."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    if start is not None:
        data.qpos[:], data.qvel[:] = start
    qpos, qvel, poses = [], [], []
    for i in range(rows):
        if ctrl is not None:
            data.ctrl[:] = ctrl[i]
        mujoco.mj_forward(model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        poses.append((data.xpos[1:].copy(), data.xmat[1:].copy()))
        mujoco.mj_step(model, data)
    return model, np.array(qpos), np.array(qvel), poses


def test_slides_hinges_and_free_bodies() -> None:
    rng = np.random.default_rng(0)
    ctrl = rng.normal(size=(51, 3))
    start = [0, 0, 0.3, -1, 0, 0, np.cos(0.2), 0, 0, np.sin(0.2)], [0.5, 0, 1, 0.2, -1, 0, 0, 0, 2]
    model, qpos, qvel, poses = rollout(SLED, 51, start, ctrl)
    history = from_mujoco(model, BOTH, qpos, qvel, ctrl=ctrl)
    observed = history.dataset["observed"].to_numpy()[0]
    assert observed.shape == (11, 2, 6)
    for i, (xpos, xmat) in enumerate(poses[::5]):
        for body, place in (("sled", 0), ("puck", 1)):
            x, y, theta = observed[i, history.bodies.index(body), :3]
            np.testing.assert_allclose((x, y), xpos[place][:2], atol=1e-9)
            np.testing.assert_allclose(xmat[place].reshape(3, 3)[:2, 0],
                                       (np.cos(theta), np.sin(theta)), atol=1e-9)  # fmt: skip
    # velocities are rates of the positions
    rates = np.diff(observed[..., :3], axis=0) / 0.1
    mean = (observed[1:, :, 3:] + observed[:-1, :, 3:]) / 2
    np.testing.assert_allclose(rates[:, 0], mean[:, 0], atol=1e-6)
    # MuJoCo's own step is of first order, and the sled's pushes change with each
    assert np.abs(rates[:, 1, :2] - mean[:, 1, :2]).max() < 0.1
    # the impulse of each step: MuJoCo's sled has 2 kg
    action = history.dataset["action"].to_numpy()[0, :-1]
    np.testing.assert_allclose(action[:, 0], 0.0)
    gained = 2.0 * np.diff(observed[:, 1, 3:5], axis=0)
    np.testing.assert_allclose(0.1 * action[:, 1, :2], gained, atol=1e-9)
    clipped = np.clip(ctrl[:50, 1], -1, 1).reshape(10, 5).mean(axis=1)
    np.testing.assert_allclose(action[:, 1, 2], clipped)
    # wrenches in place of controls, of several trajectories
    wrench = np.zeros((2, 50, 2, 3))
    wrench[1, :, 1, 0] = 4.0
    two = from_mujoco(model, BOTH, np.stack([qpos] * 2), np.stack([qvel] * 2), wrench=wrench)
    assert (two.n_trajectories, two.n_transitions) == (2, 20)
    np.testing.assert_array_equal(two.dataset["action"][1, :-1, 1, 0], 4.0)


def test_a_pendulum_in_a_side_view() -> None:
    arm = Body("arm", Shape.box(0.04, 0.4))
    hinge = Joint("hinge", ("arm", "world"), anchor_a=(0.0, 0.2), anchor_b=(0.0, 1.0))
    scene = Scene(time_step=0.05, gravity=(0.0, -9.81), bodies=(arm,), joints=(hinge,))
    model, qpos, qvel, poses = rollout(ARM, 101, ([0.7], [1.0]))
    history = from_mujoco(model, scene, qpos, qvel, plane="xz")
    theta = history.dataset["observed"].to_numpy()[0, :, 0, 2]
    for angle, (_, xmat) in zip(theta, poses[::5], strict=True):
        # where the arm's upper end points, in x and z
        up = xmat[0].reshape(3, 3)[[0, 2], 2]
        np.testing.assert_allclose(up, (-np.sin(angle), np.cos(angle)), atol=1e-9)
    start = history.dataset["start"].to_numpy()[0, 0, 0]
    below = 0.2 * np.array([np.sin(theta[0]), -np.cos(theta[0])])
    np.testing.assert_allclose(start[:2], np.array([0.0, 1.0]) + below, atol=1e-9)


def test_a_chain_of_hinges_and_its_motors() -> None:
    """MuJoCo's angle of the lower link is relative to the upper one, a history's is not."""
    xml = ARM.replace("</body>", """
      <body name="tip" pos="0 0 -.4"><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/>
        <joint name="elbow" type="hinge" axis="0 -1 0"/></body></body>""").replace(
        "</mujoco>", '<actuator><motor joint="elbow" gear="2"/></actuator></mujoco>')  # fmt: skip
    bodies = Body("tip", Shape.box(0.04, 0.2)), Body("arm", Shape.box(0.04, 0.4))
    hinges = (
        Joint("hinge", ("arm", "world"), anchor_a=(0.0, 0.2), anchor_b=(0.0, 1.0)),
        Joint("hinge", ("arm", "tip"), anchor_a=(0.0, -0.2), anchor_b=(0.0, 0.1)),
    )
    scene = Scene(time_step=0.05, gravity=(0.0, -9.81), bodies=bodies, joints=hinges)
    ctrl = np.full((101, 1), 0.01)
    model, qpos, qvel, poses = rollout(xml, 101, ([0.7, 1.1], [1.0, 0.0]), ctrl)
    history = from_mujoco(model, scene, qpos, qvel, ctrl=ctrl, plane="xz")
    start = history.dataset["start"].to_numpy()[0]
    for row, (xpos, xmat) in zip(start, poses[::5], strict=True):
        for body, reach, place in zip(row, (0.1, 0.2), (1, 0), strict=True):
            up = xmat[place].reshape(3, 3)[[0, 2], 2]
            np.testing.assert_allclose(up, (-np.sin(body[2]), np.cos(body[2])), atol=1e-9)
            np.testing.assert_allclose(body[:2], xpos[place][[0, 2]] - reach * up, atol=1e-9)
    np.testing.assert_allclose(start[0, :, 5], -1.0)
    torque = history.dataset["action"].to_numpy()[0, :-1, :, 2]
    np.testing.assert_allclose(torque, np.tile((0.02, -0.02), (20, 1)))
    alone = Scene(time_step=0.05, bodies=bodies[:1])
    with pytest.raises(HistoryError, match=r'"tip" hangs on body "arm".*add that body'):
        from_mujoco(model, alone, qpos, qvel, plane="xz")


def test_what_is_no_plane_motion_is_refused() -> None:
    model, qpos, qvel, _ = rollout(SLED, 11)
    good = {"qpos": qpos, "qvel": qvel}
    tilted, shallow = qpos.copy(), qpos[:, :-1]
    tilted[:, 7] = 0.1
    servo = mujoco.MjModel.from_xml_string(
        SLED.replace('<motor joint="sx"/>', '<position joint="sx"/>')
    )
    other = mujoco.MjModel.from_xml_string(SLED.replace('axis="0 0 1"', 'axis="1 0 0"'))
    renamed = BOTH.replace(bodies=(Body("cart", Shape.circle(0.1)),))
    for message, scene, options in (
        ("leaves the plane", BOTH, {"qpos": tilted}),
        (r"qpos has shape \(11, 9\), expected \(trajectory, row, 10\)", BOTH, {"qpos": shallow}),
        ("qpos has .* qvel", BOTH, {"qvel": qvel[:-1]}),
        ("leads out of the plane", BOTH, {"model": other}),
        ("is no motor", BOTH, {"model": servo, "ctrl": np.zeros((11, 3))}),
        ("both given", BOTH, {"ctrl": np.zeros((11, 3)), "wrench": np.zeros((11, 2, 3))}),
        ("or one row less", BOTH, {"ctrl": np.zeros((9, 3))}),
        ('no body "cart"', renamed, {}),
        ("a whole number of rows", BOTH.replace(time_step=0.05), {}),
        ("plane is 'yz'", BOTH, {"plane": "yz"}),
    ):
        with pytest.raises(HistoryError, match=message):
            given = {"model": model} | good | options
            from_mujoco(given.pop("model"), scene, given.pop("qpos"), given.pop("qvel"), **given)
