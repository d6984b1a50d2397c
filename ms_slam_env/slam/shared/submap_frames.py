"""Tracks which frames belong to which submap, where submaps lie, and how certain that is.

A SLAM that has lost its map starts a new one (the Atlas of Elvira, Tardós and Montiel, IROS 2019).
Submap 0 starts with the run and defines the world. A later one is placed at the best guess of the
camera's pose when it started: a link to the submap before it, with a covariance. When the camera
sees an older submap again, the newer of the two is moved onto it, and both continue as one under
the older's number.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env.geometry import adjoint, invert, se3_exp, se3_log
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ListOf, WholeNumber


@dataclass(frozen=True)
class Submaps:
    """The K submaps of a run and how they are joined now."""

    first_frames: Int32  # (K,) frame, counted since ``reset``, that started each
    # (K,) the oldest submap that each is joined to; itself if it is not joined.
    joined_to: Int32
    joined_at: Int32  # (K,) frame at which it was joined to an older one; -1 if it was not
    # (K, 6, 6) of the twist (rho, phi) in metres and radians, with the true pose of the first
    # camera T exp(twist), relative to the submap before; 0 for the first.
    links: Float64

    def __len__(self) -> int:
        return len(self.first_frames)


def one_submap() -> Submaps:
    """The submaps of a run that never lost tracking for long: only the first."""
    one = np.zeros(1, dtype=np.int32)
    return Submaps(one, one.copy(), np.full(1, -1, dtype=np.int32), np.zeros((1, 6, 6)))


_OF_SUBMAPS = ("first_frames", "joined_to", "joined_at", "links", "starts")


@dataclass
class SubmapLedger(Saved):
    """Submaps of one camera, and the trajectory since the second started."""

    first_frames: list[int] = field(default_factory=lambda: [0])
    joined_to: list[int] = field(default_factory=lambda: [0])
    joined_at: list[int] = field(default_factory=lambda: [-1])
    links: list[Float64] = field(default_factory=lambda: [np.zeros((6, 6))])
    starts: list[Float64] = field(default_factory=lambda: [np.eye(4)])  # (4, 4) of the first camera
    # frames tracked since the second submap started, the submap and the pose (4, 4) of each.
    frames: list[int] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    poses: list[Float64] = field(default_factory=list)

    saved: ClassVar[tuple[str, ...]] = (*_OF_SUBMAPS, "frames", "labels", "poses")

    @property
    def has_several(self) -> bool:
        """Whether a second submap was started."""
        return len(self.first_frames) > 1

    def start(self, frame: int, pose: Float64, link: Float64) -> int:
        """Start a submap at a frame with ``pose`` (4, 4); return its number."""
        number = len(self.first_frames)
        self.first_frames.append(frame)
        self.joined_to.append(number)
        self.joined_at.append(-1)
        self.links.append(link.copy())
        self.starts.append(pose.copy())
        return number

    def record(self, frame: int, label: int, pose: Float64) -> None:
        """Record a frame tracked in submap ``label``."""
        self.frames.append(frame)
        self.labels.append(label)
        self.poses.append(pose.copy())

    def correct(self, frames: Int32, poses: Float64) -> None:
        """Move frames (N,) to new poses (N, 4, 4); frames not recorded are ignored."""
        known = {frame: place for place, frame in enumerate(self.frames)}
        for frame, pose in zip(frames.tolist(), poses, strict=True):
            if frame in known:
                self.poses[known[frame]] = pose.copy()

    def covariance(self, number: int, pose: Float64) -> Float64:
        """Covariance (6, 6) of a submap's placement, as the twist of a camera at ``pose`` in it.

        The sum over the links back to the last submap joined to the first.
        """
        total = np.zeros((6, 6))
        for k in range(number, 0, -1):
            if self.joined_to[k] == 0:
                break
            if self.joined_to[k] == k:
                carry = adjoint(invert(pose) @ self.starts[k])
                total += carry @ self.links[k] @ carry.T
        return total

    def join(self, older: int, newer: int, correction: Float64, frame: int) -> None:
        """Move submap ``newer`` onto ``older`` by the world-frame ``correction`` (4, 4)."""
        self.move(newer, correction)
        self.joined_at[newer] = frame
        for k, root in enumerate(self.joined_to):
            if root == newer:
                self.joined_to[k] = older

    def move(self, root: int, correction: Float64) -> None:
        """Move everything joined to a submap by the world-frame ``correction`` (4, 4)."""
        self.starts = [
            correction @ pose if self.joined_to[k] == root else pose
            for k, pose in enumerate(self.starts)
        ]
        self.poses = [
            correction @ pose if self.joined_to[label] == root else pose
            for label, pose in zip(self.labels, self.poses, strict=True)
        ]

    def between(self, older: int, newer: int, correction: Float64) -> dict[int, Float64]:
        """Motions of the unjoined submaps between two that are about to be joined.

        Each moves by a share of the correction: the uncertainty of the links up to it over that of
        all links. A certain link hardly changes.
        """
        inner = [k for k in range(older + 1, newer + 1) if self.joined_to[k] in (k, newer)]
        sizes = np.cumsum([np.trace(self.links[k]) for k in inner])
        twist = se3_log(correction)
        return {
            k: se3_exp(twist * (size / sizes[-1] if sizes[-1] > 0 else 0.0))
            for k, size in zip(inner, sizes, strict=True)
            if self.joined_to[k] == k and k != newer
        }

    def get_state(self) -> dict[str, Any]:
        """Everything but the first submap, which is always the same."""
        state = super().get_state()
        return state | {name: state[name][1:] for name in _OF_SUBMAPS}

    def state_like(self) -> Any:
        """See ``Stateful``; "submaps" are those after the first."""
        frame, submap = WholeNumber(index_of="frames"), WholeNumber(most="submaps")
        return {
            "first_frames": ListOf(frame, "submaps"),
            "joined_to": ListOf(submap, "submaps"),
            "joined_at": ListOf(replace(frame, least=-1), "submaps"),
            "links": ListOf(np.zeros((6, 6)), "submaps"),
            "starts": ListOf(np.eye(4), "submaps"),
            "frames": ListOf(frame, "followed"),
            "labels": ListOf(submap, "followed"),
            "poses": ListOf(np.eye(4), "followed"),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        first = SubmapLedger()
        super().set_state(
            state | {name: getattr(first, name) + state[name] for name in _OF_SUBMAPS}
        )

    def summary(self) -> Submaps:
        """The submaps as arrays."""
        return Submaps(
            np.array(self.first_frames, dtype=np.int32),
            np.array(self.joined_to, dtype=np.int32),
            np.array(self.joined_at, dtype=np.int32),
            np.stack(self.links),
        )

    def trajectory(self) -> tuple[Int32, Float64]:
        """Frames (N,) since the second submap started, and their poses (N, 4, 4) now."""
        return np.array(self.frames, dtype=np.int32), np.array(self.poses).reshape(-1, 4, 4)
