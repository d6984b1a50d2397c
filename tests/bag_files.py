"""Bags of a sequence, written by the ``rosbags`` library."""

from __future__ import annotations

import dataclasses
import io
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ms_slam_env.geometry import quaternion_from_pose

DEPTH, COLOR = "/camera/depth/image", "/camera/rgb/image_color"
INFO, TRUTH = "/camera/depth/camera_info", "/ground_truth/pose"


def png(pixels: np.ndarray) -> bytes:
    """An image file."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


class Messages:
    """Makes messages of one of the two versions of ROS."""

    def __init__(self, version: int) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST)

    def make(self, kind: str, **fields: Any) -> Any:
        """A message; what is left out is zero or empty."""
        package, name = kind.split("/")
        cls = self.store.types[f"{package}/msg/{name}"]
        return cls(**fields)

    def header(self, time: float, frame: str = "camera") -> Any:
        """Of a message."""
        nanoseconds = round(time * 1e9)
        stamp = self.make(
            "builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        number = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **number)

    def image(self, time: float, pixels: np.ndarray, encoding: str, **changes: Any) -> Any:
        """Raw."""
        fields = {
            "height": pixels.shape[0],
            "width": pixels.shape[1],
            "encoding": encoding,
            "is_bigendian": 0,
            "step": pixels.strides[0],
            "data": np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8),
        }
        return self.make("sensor_msgs/Image", header=self.header(time), **{**fields, **changes})

    def compressed(self, time: float, data: bytes, format: str) -> Any:
        """Compressed."""
        fields = {"format": format, "data": np.frombuffer(data, np.uint8)}
        return self.make("sensor_msgs/CompressedImage", header=self.header(time), **fields)

    def compressed_depth(self, time: float, depth: np.ndarray) -> Any:
        """Depth in metres as image_transport quantises it: 1 / depth, with two numbers."""
        a, b = 100.0 * (100.0 + 1.0), 1.0 - 100.0 * (100.0 + 1.0) / 10.0  # largest depth 10 m
        inverse = np.where(depth > 0, a / np.where(depth > 0, depth, 1) + b, 0)
        data = struct.pack("<iff", 0, a, b) + png(np.rint(inverse).astype(np.uint16))
        return self.compressed(time, data, "32FC1; compressedDepth png")

    def transforms(self, time: float, of: Mapping[tuple[str, str], np.ndarray]) -> Any:
        """What /tf_static says: T_parent_child (4, 4) by frames."""
        sent = []
        for (parent, child), T in of.items():
            moved = self.pose(time, T, "TransformStamped")
            header = self.header(time, parent)
            sent.append(dataclasses.replace(moved, header=header, child_frame_id=child))
        name = "tf2_msgs/msg/TFMessage"
        if name not in self.store.types:
            from rosbags.typesys import get_types_from_msg

            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, name))
        return self.store.types[name](transforms=sent)

    def info(self, time: float, K: Any) -> Any:
        """CameraInfo."""
        d = K.distortion
        numbers = {
            "D": np.array([d.k1, d.k2, d.p1, d.p2, d.k3]),
            "K": K.matrix.ravel(),
            "R": np.eye(3).ravel(),
            "P": np.hstack([K.matrix, np.zeros((3, 1))]).ravel(),
        }
        if self.version == 2:
            numbers = {name.lower(): value for name, value in numbers.items()}
        roi = self.make(
            "sensor_msgs/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        return self.make(
            "sensor_msgs/CameraInfo", header=self.header(time), height=K.height, width=K.width,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi, **numbers,
        )  # fmt: skip

    def pose(self, time: float, T: np.ndarray, kind: str = "PoseStamped") -> Any:
        """Of one of four types."""
        x, y, z, w = quaternion_from_pose(T)
        q = self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
        place = dict(zip("xyz", map(float, T[:3, 3]), strict=True))
        header = self.header(time)
        if kind == "TransformStamped":
            vector = self.make("geometry_msgs/Vector3", **place)
            moved = self.make("geometry_msgs/Transform", translation=vector, rotation=q)
            what = {"header": header, "child_frame_id": "camera", "transform": moved}
            return self.make("geometry_msgs/TransformStamped", **what)
        point = self.make("geometry_msgs/Point", **place)
        pose = self.make("geometry_msgs/Pose", position=point, orientation=q)
        if kind == "PoseStamped":
            return self.make("geometry_msgs/PoseStamped", header=header, pose=pose)
        zeros = np.zeros(36)
        sure = self.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=zeros)
        if kind == "PoseWithCovarianceStamped":
            return self.make(f"geometry_msgs/{kind}", header=header, pose=sure)
        still = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/Twist", linear=still, angular=still)
        moving = self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=zeros)
        return self.make(
            "nav_msgs/Odometry", header=header, child_frame_id="camera", pose=sure, twist=moving
        )


Topic = dict[str, list[tuple[float, Any]]]


def write_bag(path: Path, messages: Messages, topics: Topic, compressed: bool = False) -> Path:
    """Write messages by topic, each with the time of its recording; return the path to read.

    A ``.bag`` is of ROS 1; ``.mcap`` the file of a ROS 2 bag; any other a ROS 2 bag's folder.
    """
    from rosbags import rosbag1, rosbag2

    if messages.version == 1:
        writer: Any = rosbag1.Writer(path)
        if compressed:
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        encode: Callable[..., Any] = messages.store.serialize_ros1
    else:
        folder = path.with_suffix("")
        plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else None
        how = {} if plugin is None else {"storage_plugin": plugin}
        writer = rosbag2.Writer(folder, version=9, **how)
        encode = messages.store.serialize_cdr
    with writer:
        every = []
        for topic, sent in topics.items():
            kind = sent[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=messages.store)
            every += [(time, connection, kind, message) for time, message in sent]
        for time, connection, kind, message in sorted(every, key=lambda one: one[0]):
            writer.write(connection, round(time * 1e9), encode(message, kind))
    if messages.version == 2:
        return next(folder.glob("*.mcap")) if path.suffix == ".mcap" else folder
    return path


def topics_of(sequence: Any, messages: Messages) -> Topic:
    """A sequence as a depth camera's driver and a motion capture system send it."""
    frames = list(zip(sequence.timestamps, sequence.frames, sequence.poses, strict=True))

    def color(time: float, pixels: np.ndarray) -> Any:
        return messages.image(time + 0.004, np.ascontiguousarray(pixels[..., ::-1]), "bgr8")

    return {
        DEPTH: [(t, messages.image(t, f.depth, "32FC1")) for t, f, _ in frames],
        COLOR: [(t + 0.001, color(t, f.color)) for t, f, _ in frames],
        INFO: [(t, messages.info(t, sequence.intrinsics)) for t, _, _ in frames],
        TRUTH: [(t + 0.002, messages.pose(t, T)) for t, _, T in frames],
    }
