"""Bags of ROS 1 and ROS 2 and MCAP files, written by rosbags."""

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

STORES = {
    "ros1": get_typestore(Stores.ROS1_NOETIC),
    "db3": get_typestore(Stores.ROS2_HUMBLE),
    "mcap": get_typestore(Stores.ROS2_HUMBLE),
}
KINDS = {name: f"{package}/msg/{name}" for package, name in (
    ("nav_msgs", "Odometry"), ("geometry_msgs", "WrenchStamped"), ("geometry_msgs", "Wrench"),
    ("geometry_msgs", "PoseStamped"), ("sensor_msgs", "JointState"), ("std_msgs", "String"),
    ("std_msgs", "Float64"), ("std_msgs", "Float64MultiArray"),
)}  # fmt: skip
#: Of the first stamp, as of a robot's clock.
EPOCH = 1_700_000_000.0


class Bag:
    """Messages of one format, to be written."""

    def __init__(self, form: str) -> None:
        self.form, self.store = form, STORES[form]
        self.messages: list[tuple[float, str, str, object]] = []

    def type(self, name: str, package: str = "geometry_msgs"):
        return self.store.types[f"{package}/msg/{name}"]

    def header(self, time: float | None):
        whole = 0.0 if time is None else EPOCH + time
        stamp = self.store.types["builtin_interfaces/msg/Time"](
            sec=int(whole), nanosec=round(1e9 * (whole % 1))
        )
        number = {"seq": 7} if self.form == "ros1" else {}
        return self.type("Header", "std_msgs")(stamp=stamp, frame_id="map", **number)

    def point(self, kind: str, *numbers: float):
        return self.type(kind)(**dict(zip("xyzw", map(float, numbers), strict=False)))

    def pose(self, x: float, y: float, theta: float):
        turn = self.point("Quaternion", 0, 0, np.sin(theta / 2), np.cos(theta / 2))
        return self.type("Pose")(position=self.point("Point", x, y, 0), orientation=turn)

    def odometry(self, stamp: float | None, x: float, y: float, theta: float, vx=0.0, omega=0.0):
        twist = self.type("Twist")(
            linear=self.point("Vector3", vx, 0, 0), angular=self.point("Vector3", 0, 0, omega)
        )
        return self.type("Odometry", "nav_msgs")(
            header=self.header(stamp),
            child_frame_id="base",
            pose=self.type("PoseWithCovariance")(
                pose=self.pose(x, y, theta), covariance=np.zeros(36)
            ),
            twist=self.type("TwistWithCovariance")(twist=twist, covariance=np.zeros(36)),
        )

    def wrench(self, x: float, y: float, torque: float):
        force, turn = self.point("Vector3", x, y, 0), self.point("Vector3", 0, 0, torque)
        return self.type("Wrench")(force=force, torque=turn)

    def wrench_stamped(self, stamp: float, *wrench: float):
        return self.type("WrenchStamped")(header=self.header(stamp), wrench=self.wrench(*wrench))

    def pose_stamped(self, stamp: float, *pose: float):
        return self.type("PoseStamped")(header=self.header(stamp), pose=self.pose(*pose))

    def add(self, time: float, topic: str, message) -> None:
        """Add a message that is received at this time."""
        self.messages.append((time, topic, type(message).__name__.rsplit("__", 1)[-1], message))

    def write(self, folder, name: str = "run"):
        if self.form == "ros1":
            path = folder / f"{name}.bag"
            writer, serialize = Writer1(path), self.store.serialize_ros1
        else:
            path = folder / name
            plugin = StoragePlugin.MCAP if self.form == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
            serialize = self.store.serialize_cdr
        with writer:
            connections = {}
            for time, topic, kind, message in self.messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, KINDS[kind], typestore=self.store
                    )
                stamp = round(1e9 * (EPOCH + time))
                writer.write(connections[topic], stamp, serialize(message, KINDS[kind]))
        return path
