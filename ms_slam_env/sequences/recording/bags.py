"""ROS 1 bags, ROS 2 bags and MCAP files, through the ``rosbags`` library; needs no ROS.

Messages are decoded with the library's definitions of the standard types, never with those in the
file.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import check_file, is_named
from ms_slam_env.camera import Distortion, Intrinsics
from ms_slam_env.camera.distortion import NO_DISTORTION
from ms_slam_env.errors import InputError, InputWarning, unknown
from ms_slam_env.geometry import check_pose, pose_from_quaternion
from ms_slam_env.sequences.recording.bag_frames import (
    Transforms,
    poses_of_camera,
    registration_of,
    transforms_of,
)
from ms_slam_env.sequences.recording.bag_images import read_color_message, read_depth_message
from ms_slam_env.sequences.recording.listings import Calibration
from ms_slam_env.sequences.recording.recording import Entry, Recording
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S, associate, say_few_pairs

SUFFIXES = (".bag", ".mcap", ".db3")
"""Suffixes of bag files; a ROS 2 bag may also be a folder with a ``metadata.yaml``."""

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = ("sensor_msgs/msg/CameraInfo",)
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_TF_STATIC = "/tf_static"
_MAX_BYTES = 1 << 40
_TRANSPORTS = ("compressed", "compressedDepth")
_NO_COLOR = r"depth|infra|(^|[/_])ir([/_\d]|$)|disparity|mask|normal"
_TRUTH = r"ground|truth|(^|[/_])gt([/_]|$)|vicon|mocap|optitrack"


@dataclass(frozen=True)
class Topics:
    """Topics of a bag to read; omitted ones are found by type and name."""

    depth: str | None = None
    """Depth images; by default the image topic named depth, or among several the one named
    registered or aligned."""
    color: str | None = None
    """Colour images; by default the image topic named so. If its frame or CameraInfo differs from
    that of depth, colour is registered to the depth camera by /tf_static."""
    info: str | None = None
    """CameraInfo of the depth images; by default camera_info beside them, or the only one."""
    pose: str | None = None
    """True poses of the camera (optical frame), PoseStamped, PoseWithCovarianceStamped,
    TransformStamped or Odometry; by default the topic named ground truth, vicon or mocap."""


def is_bag(path: str | Path) -> bool:
    """Whether a path is a bag: an existing file, or the folder of a ROS 2 bag."""
    given = Path(path)
    is_file = given.suffix in SUFFIXES and given.is_file()
    return is_file or is_named(given / "metadata.yaml")


@dataclass(frozen=True)
class Address:
    """Address of a message: its topic, recording time, and index among messages of that time."""

    topic: str
    recorded_ns: int
    number: int


class Bag:
    """The messages of a bag, which is opened on first use."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[type[Bag], tuple[Path]]:
        """Pickle only the path; the bag is opened again elsewhere."""
        return Bag, (self.path,)

    @cached_property
    def _opened(self) -> tuple[Any, Any]:
        """The library's reader, and its message decoder."""
        try:
            from rosbags import rosbag1, rosbag2
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise InputError(
                f"{self.path} needs rosbags (pip install 'ms-slam-env[ros]'): {error}"
            ) from None
        if self.path.suffix in SUFFIXES:
            check_file(self.path, "bag", _MAX_BYTES)
        if self.path.suffix == ".mcap":
            _check_profile(self.path)
        is_first = self.path.suffix == ".bag"
        with self.refusing():
            reader = (rosbag1 if is_first else rosbag2).Reader(self.path)
            reader.open()
        store = get_typestore(Stores.ROS1_NOETIC if is_first else Stores.LATEST)
        for name in TRANSFORMS if is_first else ():
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
        return reader, store.deserialize_ros1 if is_first else store.deserialize_cdr

    @contextmanager
    def refusing(self, what: str = "") -> Iterator[None]:
        """Turn any error of the library on a damaged file into one line."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            said = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"cannot read {self.path}{what}: {said}") from None

    @cached_property
    def types(self) -> dict[str, str]:
        """Message type by topic."""
        with self.refusing():
            return {str(c.topic): str(c.msgtype) for c in self._opened[0].connections}

    def of_types(self, types: Iterable[str]) -> list[str]:
        """Topics with messages of one of these types."""
        return sorted(topic for topic, kind in self.types.items() if kind in types)

    def _messages(self, topic: str, *span: int) -> Iterator[tuple[int, bytes]]:
        reader, _ = self._opened
        connections = [c for c in reader.connections if c.topic == topic]
        with self.refusing(f", topic {topic}"):
            for _, recorded, data in reader.messages(connections, *span):
                yield recorded, bytes(data)

    def index(self, topic: str) -> tuple[Float64, list[Address]]:
        """Times (N,) in seconds, increasing, and addresses of the messages of a topic.

        A time is that of the header, or of recording if all headers are 0. Of several messages with
        the same time the first is used.
        """
        is_first, is_stamped = self.path.suffix == ".bag", self._is_stamped(topic)
        found: dict[float, Address] = {}
        last, number = -1, 0
        for recorded, data in self._messages(topic):
            number = number + 1 if recorded == last else 0
            last = recorded
            time = _stamp(data, is_first) if is_stamped else 1e-9 * recorded
            found.setdefault(time, Address(topic, recorded, number))
        if not found:
            raise InputError(f"{self.path}: topic {topic} has no message")
        return np.array(sorted(found)), [found[time] for time in sorted(found)]

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Times in seconds and messages of a topic, decoded, in the order of recording."""
        is_first, is_stamped = self.path.suffix == ".bag", self._is_stamped(topic)
        for recorded, data in self._messages(topic):
            with self.refusing(f", topic {topic}"):
                message = self._opened[1](data, self.types[topic])
            yield _stamp(data, is_first) if is_stamped else 1e-9 * recorded, message

    def _is_stamped(self, topic: str) -> bool:
        """Whether headers contain the time; a simulated clock may start at 0."""
        is_first = self.path.suffix == ".bag"
        return any(_stamp(data, is_first) for _, data in self._messages(topic))

    @cached_property
    def transforms(self) -> Transforms:
        """Transforms from ``/tf_static``."""
        if _TF_STATIC not in self.of_types(TRANSFORMS):
            return {}
        with self.refusing(f", topic {_TF_STATIC}"):
            return transforms_of(self.messages(_TF_STATIC), _TF_STATIC)

    def read(self, address: Address) -> Any:
        """Decode the message at an address."""
        span = address.recorded_ns, address.recorded_ns + 1
        for number, (_, data) in enumerate(self._messages(address.topic, *span)):
            if number == address.number:
                with self.refusing(f", topic {address.topic}"):
                    return self._opened[1](data, self.types[address.topic])
        raise InputError(f"{self.path}: topic {address.topic} has lost a message")


def _check_profile(path: Path) -> None:
    """Refuse an MCAP file with non-ROS messages, and say what to do."""
    with open(path, "rb") as file:
        start = file.read(64)
    profile = start[21 : 21 + int.from_bytes(start[17:21], "little")].decode(errors="replace")
    if start.startswith(b"\x89MCAP0\r\n\x01") and profile != "ros2":
        raise InputError(
            f"{path} is an MCAP file of profile {profile!r}; only ros2 is read. Of ROS 1 give the "
            ".bag that it was made from"
        )


def _stamp(data: bytes, is_first: bool) -> float:
    """Seconds in the header at the start of these messages; 0 if there is none."""
    if len(data) < 12:
        return 0.0
    if is_first:  # sequence number, seconds, nanoseconds
        seconds, nanoseconds = struct.unpack_from("<II", data, 4)
    else:  # preceded by four bytes about the encoding
        seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return float(seconds) + 1e-9 * nanoseconds


@dataclass(frozen=True)
class BagEntry(Entry):
    """A frame of two messages; its paths are only names.

    Attributes:
        bag: bag of the messages.
        depth_at: address of the depth image.
        color_at: address of the colour image; None without colour.
        depth_scale: depth image value per metre; None for that of its encoding.
    """

    bag: Bag
    depth_at: Address
    color_at: Address | None
    depth_scale: float | None

    def read(
        self, camera: Intrinsics, color_camera: Intrinsics | None = None
    ) -> tuple[NDArray[np.uint8] | None, NDArray[Any]]:
        """Colour, and depth in metres; see the base class."""
        message = self.bag.read(self.depth_at)
        with self.bag.refusing(f", topic {self.depth_at.topic}"):
            depth = read_depth_message(message, self.depth_at.topic, camera, self.depth_scale)
        if self.color_at is None:
            return None, depth
        message = self.bag.read(self.color_at)
        with self.bag.refusing(f", topic {self.color_at.topic}"):
            found = read_color_message(message, self.color_at.topic, color_camera or camera)
        return found, depth


def open_bag(
    path: Path,
    intrinsics: Calibration | None,
    topics: Topics | None = None,
    is_registration_given: bool = False,
) -> Recording:
    """Open a bag: the frames of the depth topic, each with the colour image of the same time.

    If depth and colour images name different cameras, colour is registered to the depth camera,
    unless ``is_registration_given``.

    Raises:
        InputError: no such topic, no candidate or several, no calibration, or an unreadable file.
    """
    bag, given = Bag(path), topics or Topics()
    depth_topic = given.depth or _depth_topic(bag)
    color_topic = given.color or _color_topic(bag, depth_topic)
    for name, topic in (("depth", depth_topic), ("color", color_topic)):
        if topic is not None:
            _check_topic(bag, name, topic, IMAGES)
    scale = None
    if intrinsics is not None:
        camera, scale = intrinsics.intrinsics, intrinsics.depth_scale
    else:
        camera = _camera(bag, depth_topic, given.info)
    times, depths = bag.index(depth_topic)
    colors: list[Address | None] = [None] * len(times)
    if color_topic is not None:
        color_times, addresses = bag.index(color_topic)
        own, other = associate(times, color_times, MAX_DIFFERENCE_S)
        if len(own) == 0:
            raise InputError(f"{path}: no image of {color_topic} is as old as one of {depth_topic}")
        say_few_pairs(path, len(own), len(times))
        times, depths = times[own], [depths[k] for k in own]
        colors = [addresses[k] for k in other]
    entries = []
    for time, d, c in zip(times.tolist(), depths, colors, strict=True):
        names = path, None if c is None else path, f"{path}, time {time:.9f}"
        entries.append(BagEntry(time, *names, bag, d, c, scale))
    frame = _frame(bag, depths[0])
    registration = None
    if color_topic is not None and colors[0] is not None and not is_registration_given:
        beside = _info_beside(color_topic)
        is_there = beside in bag.of_types(INFO)
        cameras = camera, _read_camera(bag, beside, color_topic) if is_there else None
        frames = frame, _frame(bag, colors[0])
        registration = registration_of(path, frames, cameras, bag.transforms)
    truth_times, truth = _truth(bag, given.pose, frame)
    return Recording(
        name=path.stem,
        layout="bag",
        entries=tuple(entries),
        source=camera,
        intrinsics=camera.undistorted,
        depth_scale=1.0,
        truth_times=truth_times,
        truth=truth,
        registration=registration,
    )


def _frame(bag: Bag, address: Address) -> str:
    """The frame named in a message."""
    message = bag.read(address)
    return str(message.header.frame_id)


def _info_beside(topic: str) -> str:
    """The calibration topic that belongs to an image topic."""
    parts = [part for part in topic.split("/") if part not in _TRANSPORTS]
    return "/".join([*parts[:-1], "camera_info"])


def _check_topic(bag: Bag, name: str, topic: str, types: Iterable[str]) -> None:
    if topic not in bag.of_types(types):
        raise unknown(f"{name} topic of {bag.path}", topic, bag.of_types(types))


def _depth_topic(bag: Bag) -> str:
    named = [topic for topic in bag.of_types(IMAGES) if "depth" in topic.lower()]
    if not named:
        raise InputError(
            f"{bag.path} has no topic of depth images: none of its topics of images, "
            f"{bag.of_types(IMAGES)}, is named depth; say which with --topics depth=TOPIC"
        )
    return _best(bag, "depth", named, r"regist|aligned")


def _color_topic(bag: Bag, depth: str) -> str | None:
    others = [topic for topic in bag.of_types(IMAGES) if topic != depth]
    others = [topic for topic in others if not re.search(_NO_COLOR, topic.lower())]
    named = [topic for topic in others if re.search(r"rgb|colou?r", topic.lower())]
    return _best(bag, "color", named or others, r"rect") if others else None


def _best(bag: Bag, name: str, topics: list[str], preferred: str) -> str:
    """The only topic, or the only one with the best name; raw is preferred to compressed."""

    def rank(topic: str) -> tuple[bool, bool]:
        is_raw = bag.types[topic] == IMAGES[0]
        return re.search(preferred, topic.lower()) is not None, is_raw

    best = [topic for topic in topics if rank(topic) == max(map(rank, topics))]
    if len(best) > 1:
        raise InputError(
            f"{bag.path}: which topic is {name}? Say --topics {name}=TOPIC, one of {best}"
        )
    return best[0]


def _camera(bag: Bag, depth: str, given: str | None) -> Intrinsics:
    """Intrinsics from the CameraInfo of the depth images."""
    beside, all_of_them = _info_beside(depth), bag.of_types(INFO)
    if given is not None:
        _check_topic(bag, "info", given, INFO)
    elif beside in all_of_them:
        given = beside
    elif len(all_of_them) == 1:
        given = all_of_them[0]
    else:
        raise InputError(
            f"{bag.path}: the calibration of {depth} is missing: there is no {beside}; say "
            f"--topics info=TOPIC, one of {all_of_them}, or --intrinsics"
        )
    return _read_camera(bag, given, depth)


def _read_camera(bag: Bag, given: str, images: str) -> Intrinsics:
    """Intrinsics for an image topic from the first message of a CameraInfo topic."""
    parts = [part for part in images.split("/") if part not in _TRANSPORTS]
    message = next((message for _, message in bag.messages(given)), None)
    if message is None:
        raise InputError(f"{bag.path}: topic {given} has no message")
    with bag.refusing(f", topic {given}"):
        return _intrinsics(message, "rect" in parts[-1])


def _intrinsics(message: Any, is_rectified: bool) -> Intrinsics:
    """Intrinsics of a CameraInfo: K and D, or P without distortion if images are rectified."""
    names = ("K", "D", "P") if hasattr(message, "K") else ("k", "d", "p")  # ROS 1, ROS 2
    K, D, P = ([float(v) for v in getattr(message, name)] for name in names)
    size = int(message.width), int(message.height)
    if is_rectified and P[0] > 0:
        return Intrinsics(P[0], P[5], P[2], P[6], *size)
    name = message.distortion_model
    distortion = Distortion.of(name, D) if any(D) or name == "equidistant" else NO_DISTORTION
    return Intrinsics(K[0], K[4], K[2], K[5], *size, distortion)


def _truth(bag: Bag, given: str | None, camera: str) -> tuple[Float64, Float64] | tuple[None, None]:
    """Times (M,) and true T_world_camera (M, 4, 4) of the frame ``camera``."""
    if given is None:
        every = bag.of_types(POSES)
        named = [t for t in every if re.search(_TRUTH, t.lower())]
        if len(named) != 1 and every:
            text = (
                f"{bag.path}: no poses are taken as true; say --topics pose=TOPIC, one of {every}"
            )
            warnings.warn(text, InputWarning, stacklevel=2)
        if len(named) != 1:
            return None, None
        given = named[0]
    _check_topic(bag, "pose", given, POSES)
    poses: dict[float, Float64] = {}
    body = ""
    for time, message in bag.messages(given):
        body = body or str(getattr(message, "child_frame_id", ""))
        with bag.refusing(f", topic {given}, time {time:.9f}"):
            poses.setdefault(time, _pose(message, given))
    times = np.array(sorted(poses))
    if len(times) == 0:
        raise InputError(f"{bag.path}: topic {given} has no message")
    found = np.stack([poses[time] for time in times.tolist()])
    return times, poses_of_camera(bag.path, given, found, body, camera, bag.transforms)


def _pose(message: Any, topic: str) -> Float64:
    """Pose (4, 4) of a message with a type in `POSES`."""
    found = message.transform if hasattr(message, "transform") else message.pose
    found = getattr(found, "pose", found)
    t = getattr(found, "translation", None) or found.position
    q = getattr(found, "rotation", None) or found.orientation
    if not abs(np.linalg.norm([q.x, q.y, q.z, q.w]) - 1) < 0.1:
        raise InputError(f"a pose of {topic} has no unit quaternion")
    return check_pose(pose_from_quaternion([t.x, t.y, t.z], [q.x, q.y, q.z, q.w]), topic)
