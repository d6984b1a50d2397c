"""Paths of changing pace: uneven ones, and quiet ones with violent segments."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env.geometry import relative_angle
from ms_slam_env.sequences import MotionSegments, open_sequence
from ms_slam_env.sequences.paths.paced import PACES, UnevenPath

SHORT = MotionSegments(frames=24, quiet=12, violent=10, factor=8.0, rate_hz=30.0)


def test_the_same_path_is_travelled_faster_in_haste():
    pace = SHORT.pace()
    violent = SHORT.is_violent()
    assert pace[0] == pace[11] == 1.0
    assert pace.max() == pytest.approx(8.0, rel=0.2)
    assert not violent[:12].any()
    assert violent[15:19].all()
    assert (MotionSegments(frames=50, violent=0).pace() == 1.0).all()


def test_a_sequence_moves_at_its_pace_and_is_the_same_twice():
    sequence = open_sequence("table:1000", "80x60", path=SHORT)
    again = open_sequence("table:1000", "80x60", path=SHORT)
    np.testing.assert_array_equal(sequence.poses, again.poses)
    np.testing.assert_array_equal(sequence.frames[5].depth, again.frames[5].depth)
    np.testing.assert_allclose(np.diff(sequence.frames.timestamps), 1 / 30)
    P = sequence.poses
    steps = np.linalg.norm(np.diff(P[:, :3, 3], axis=0), axis=1)
    turns = np.array([relative_angle(a[:3, :3], b[:3, :3]) for a, b in itertools.pairwise(P)])
    motion = steps + turns  # it moves where it does not turn
    violent = SHORT.is_violent()[1:]
    assert motion[violent].mean() > 4 * motion[:11].mean()


def test_an_uneven_path_stands_walks_and_hurries(box_scene: BoxScene):
    path = UnevenPath(frames=240)
    paces = path.paces(seed=1)
    for pace in PACES:
        assert np.mean(np.abs(paces - pace) < 1e-9) > 0.1
    assert paces.min() >= PACES[0] - 1e-9
    assert paces.max() <= PACES[-1] + 1e-9
    poses = path.poses(box_scene, 1)
    np.testing.assert_array_equal(poses, path.poses(box_scene, 1))
    assert not np.array_equal(poses, path.poses(box_scene, 2))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [relative_angle(a[:3, :3], b[:3, :3]) for a, b in itertools.pairwise(poses)]
    tremor_m, tremor_rad = 0.004, 0.006
    assert np.all(steps <= paces[1:] * 0.5 / 30 + tremor_m)
    assert np.all(turns <= paces[1:] * np.radians(1.0) + tremor_rad)
    fast = paces[1:] > 3.9
    effort = np.maximum(steps / (0.5 / 30), np.array(turns) / np.radians(1.0))
    assert np.median(effort[fast]) > 3  # whichever limit is reached first
    assert box_scene.clearance(poses[:, :3, 3]).min() > 0.05
