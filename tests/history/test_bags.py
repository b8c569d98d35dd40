"""Bags of ROS 1 and ROS 2 and MCAP files, as rosbags' own writers make them."""

import sqlite3
import sys

import numpy as np
import pytest

import pbrl_ppl as pp
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.bags import bag_topics, read_bag

pytestmark = pytest.mark.one_stack

pytest.importorskip("rosbags")

from rosbags.rosbag2 import Writer  # noqa: E402

from tests.helpers.bags import KINDS, STORES, Bag  # noqa: E402


def drive(form: str) -> Bag:
    """Odometry every 0.1 s through half turns, wrenches in between, each received 0.03 s later."""
    bag = Bag(form)
    for i in range(40):
        time = 0.1 * i
        bag.add(time + 0.03, "/odom", bag.odometry(time, 0.5 * i, -1.0, 0.4 * i, 5.0, 4.0))
        bag.add(time + 0.08, "/wrench", bag.wrench_stamped(time + 0.05, float(i), 2.0, -0.5 * i))
    bag.add(5.0, "/log", bag.type("String", "std_msgs")(data="end"))
    return bag


@pytest.mark.parametrize("form", ["ros1", "db3", "mcap"])
def test_odometry_and_wrench_in_every_format(form: str, tmp_path) -> None:
    path = drive(form).write(tmp_path)
    assert bag_topics(path) == {
        "/log": "std_msgs/msg/String",
        "/odom": "nav_msgs/msg/Odometry",
        "/wrench": "geometry_msgs/msg/WrenchStamped",
    }
    i = np.arange(40)
    for each in [path] if form == "ros1" else [path, next(path.glob(f"*.{form}"))]:
        odometry = read_bag(str(each), {"cart": "/odom"})
        assert list(odometry.columns) == [
            "time", "body",
            *(f"pose.pose.position.{axis}" for axis in "xyz"),
            *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
            *(f"twist.twist.linear.{axis}" for axis in "xyz"),
            *(f"twist.twist.angular.{axis}" for axis in "xyz"),
            "yaw",
        ]  # fmt: skip
        assert set(odometry.body) == {"cart"}
        np.testing.assert_allclose(odometry.time, 0.1 * i, atol=1e-6)
        np.testing.assert_allclose(odometry["pose.pose.position.x"], 0.5 * i)
        np.testing.assert_allclose(odometry["pose.pose.position.y"], -1.0)
        np.testing.assert_allclose(odometry.yaw, 0.4 * i, atol=1e-9)
        np.testing.assert_allclose(odometry["twist.twist.angular.z"], 4.0)
        wrench = read_bag(each, {"cart": "/wrench"})
        np.testing.assert_allclose(wrench["wrench.force.x"], i)
        np.testing.assert_allclose(wrench["wrench.torque.z"], -0.5 * i)
    # the wrench of a row is that of the last message before it, 0.05 s earlier
    both = read_bag(path, {"": ["/odom", "/wrench"]})
    assert "body" not in both
    np.testing.assert_allclose(both.time, 0.1 * i[:-1], atol=1e-6)
    np.testing.assert_allclose(both["pose.pose.position.x"], 0.5 * i[1:])
    np.testing.assert_allclose(both["wrench.force.x"], i[:-1])


def test_a_history_of_a_bag(tmp_path) -> None:
    scene = pp.Scene(time_step=0.1, bodies=(pp.Body("cart", pp.Shape.box(1.0, 0.6)),))
    columns = {"x": "pose.pose.position.x", "y": "pose.pose.position.y", "theta": "yaw",
               "omega": "twist.twist.angular.z", "force_x": "wrench.force.x",
               "force_y": "wrench.force.y", "torque": "wrench.torque.z"}  # fmt: skip
    path = drive("ros1").write(tmp_path)
    for body in ("", "cart"):
        log = read_bag(path, {body: ["/odom", "/wrench"]})
        if body:
            log = log.assign(trajectory=0)
        history = pp.History.from_dataframe(log, scene, columns=columns, resample=True)
        observed = history.dataset["observed"].to_numpy()[0, :, 0]
        np.testing.assert_allclose(observed[:, 0], 0.5 * np.arange(1, 40), atol=1e-5)
        action = history.dataset["action"].to_numpy()[0, :-1, 0]
        np.testing.assert_allclose(action[:, 0], np.arange(38), atol=1e-5)


def test_stamps_of_the_header_or_times_of_receipt(tmp_path) -> None:
    bag = Bag("db3")
    for i in range(5):
        bag.add(0.1 * i, "/cmd", bag.wrench(float(i), 0.0, 0.0))  # without a header
        bag.add(0.2 * i, "/unset", bag.odometry(None, float(i), 0.0, 0.0))
        bag.add(0.3 * i, "/late", bag.odometry(2.0 - 0.5 * i, float(i), 0.0, 0.0))
        bag.add(0.4 * i, "/twice", bag.odometry(1.0 * (i // 2), float(i), 0.0, 0.0))
    path = bag.write(tmp_path)
    for topic, times, column, values in (
        ("/cmd", [0, 0.1, 0.2, 0.3, 0.4], "force.x", [0, 1, 2, 3, 4]),
        ("/unset", [0, 0.2, 0.4, 0.6, 0.8], "pose.pose.position.x", [0, 1, 2, 3, 4]),
        ("/late", [0, 0.5, 1.0, 1.5, 2.0], "pose.pose.position.x", [4, 3, 2, 1, 0]),
        ("/twice", [0, 1.0, 2.0], "pose.pose.position.x", [1, 3, 4]),
    ):
        table = read_bag(path, {"a": topic})
        np.testing.assert_allclose(table.time, times, atol=1e-6)
        np.testing.assert_array_equal(table[column], values)


def test_arrays_by_the_names_of_their_elements(tmp_path) -> None:
    bag = Bag("mcap")
    joints, array = bag.type("JointState", "sensor_msgs"), bag.type("MultiArrayLayout", "std_msgs")
    for i in range(3):
        bag.add(0.1 * i, "/joint_states", joints(
            header=bag.header(0.1 * i + 0.01), name=["shoulder", "elbow"],
            position=np.array([0.1 * i, 1.0]), velocity=np.array([1.0, 0.0]), effort=np.array([]),
        ))  # fmt: skip
        for topic, size in (("/efforts", 2), ("/map", 50)):
            bag.add(0.1 * i, topic, bag.type("Float64MultiArray", "std_msgs")(
                layout=array(dim=[], data_offset=0), data=np.arange(float(size)) + i,
            ))  # fmt: skip
        for topic in ("/left", "/right"):
            number = bag.type("Float64", "std_msgs")(data=float(i if topic == "/left" else -i))
            bag.add(0.1 * i, topic, number)
    path = bag.write(tmp_path)
    table = read_bag(path, {"": "/joint_states"})
    assert list(table.columns) == ["time", "position[shoulder]", "position[elbow]",
                                   "velocity[shoulder]", "velocity[elbow]"]  # fmt: skip
    np.testing.assert_allclose(table["position[shoulder]"], [0, 0.1, 0.2])
    efforts = read_bag(path, {"": ["/joint_states", "/efforts"]})
    np.testing.assert_array_equal(efforts["data[1]"], [1, 2, 3])
    assert "data[0]" not in read_bag(path, {"": "/map"})
    sides = read_bag(path, {"": ["/left", "/right"]})
    np.testing.assert_array_equal(sides[["data", "data (/right)"]], [[0, 0], [1, -1], [2, -2]])


def test_bodies_with_other_stamps_are_interpolated(tmp_path) -> None:
    bag = Bag("mcap")
    for i in range(41):
        bag.add(0.1 * i, "/a", bag.pose_stamped(0.1 * i, float(i), 0.0, 0.0))
    for i in range(-1, 30):  # ends earlier, turns through pi, and lacks some messages
        if not 10 < i < 20:
            time = 0.1 * i + 0.04
            bag.add(time, "/b", bag.pose_stamped(time, 2.0 * i + 0.8, 3.0, 0.5 * i + 0.2))
    table = read_bag(bag.write(tmp_path), {"a": "/a", "b": "/b"})
    assert list(table.body[:4]) == ["a", "b", "a", "b"]
    a, b = (table[table.body == name].reset_index() for name in "ab")
    np.testing.assert_allclose(a.time, 0.1 * np.arange(30), atol=1e-6)
    np.testing.assert_allclose(a.time, b.time)
    # in the gap its cells are empty
    gap = (b.time > 1.04) & (b.time < 2.04)
    assert b["pose.position.x"].isna().tolist() == gap.tolist()
    np.testing.assert_allclose(b["pose.position.x"][~gap], 20 * b.time[~gap], atol=1e-5)
    np.testing.assert_allclose(np.diff(b.yaw[:10]), 0.5, atol=1e-5)


def test_a_bag_without_definitions_of_its_messages(tmp_path) -> None:
    """As ROS 2 wrote them before Iron."""
    path = drive("db3").write(tmp_path)
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    table = read_bag(path, {"cart": "/odom"})
    np.testing.assert_allclose(table["pose.pose.position.x"], 0.5 * np.arange(40))


def test_what_cannot_be_read_is_said(tmp_path, monkeypatch) -> None:
    bag = drive("ros1")
    bag.add(6.0, "/early", bag.pose_stamped(-50.0, 0.0, 0.0, 0.0))
    bag.add(7.0, "/far", bag.wrench_stamped(60.0, 0.0, 0.0, 0.0))
    path = bag.write(tmp_path)
    empty = tmp_path / "empty.mcap"
    with Writer(tmp_path / "empty", version=9) as writer:
        writer.add_connection("/odom", KINDS["Odometry"], typestore=STORES["db3"])
    empty.write_bytes(b"")
    damaged = tmp_path / "damaged.bag"
    damaged.write_bytes(path.read_bytes()[:5000])
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.txt").write_text("text")
    for file, topics, message in (
        (path, {"": "/odo"}, r'no topic "/odo"; did you mean "/odom"\? Its topics: /early \('
                             r"geometry_msgs/msg/PoseStamped\), .*/odom \(nav_msgs/msg/Odometry"),
        (path, {"": "/log"}, r"/log.*String.* have no numbers"),
        (path, {}, "expected a topic for each body"),
        (path, {"": []}, "expected a topic for each body"),
        (path, {"": 3}, "topics is {'': 3}, expected a topic for each body"),
        (path, {"": [3]}, "expected a topic for each body"),
        (path, "/odom", "topics is '/odom', expected a topic for each body"),
        (path, {"": "/odom", "b": "/odom"}, "name each body as the scene does"),
        (path, {"a": "/odom", "b": "/early"}, r"no time in common: .* \(a\), .* \(b\)"),
        (path, {"a": ["/odom", "/far"]}, '"/far" begins after the last message of "/odom"'),
        (tmp_path / "empty", {"": "/odom"}, '"/odom" .nav_msgs/msg/Odometry. has no messages'),
        (tmp_path / "none.bag", {"": "/odom"}, "there is no such file"),
        (tmp_path / "text.txt", {"": "/odom"}, "the suffix is '.txt', expected .bag"),
        (tmp_path / "folder", {"": "/odom"}, "metadata"),
        (empty, {"": "/odom"}, "cannot be read"),
        (damaged, {"": "/odom"}, "cannot be read .*reindex"),
    ):  # fmt: skip
        with pytest.raises(HistoryError, match=message):
            read_bag(file, topics)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(HistoryError, match=r"needs rosbags: pip install 'pbrl_ppl\[ros\]'"):
        bag_topics(path)
