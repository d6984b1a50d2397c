"""The USME suite: its sequences are what the paper says in words."""

from functools import cache

import numpy as np
import pytest
from large_scenes import SEED, large_scene
from scipy.spatial import cKDTree

from ms_slam_env import scenes
from ms_slam_env.camera import xtion
from ms_slam_env.evaluation.loop_closures import find_revisits
from ms_slam_env.geometry import look_at
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import MotionBlur, MovingObjects
from ms_slam_env.sequences.usme_suite import NAMES, SUITE, describe, find, render

WITHOUT_BLUR = "residential-three-loops-blur"  # has the path of another
LARGE = [e for e in SUITE if e.scene in scenes.LARGE_SCENES and e.name != WITHOUT_BLUR]
make_scene = cache(scenes.make)


def revisits(
    poses: np.ndarray, near_m: float = 1.5, apart_m: float = 20.0, angle_deg: float = 40.0
) -> np.ndarray:
    """Frames (N,) at places that were left and are seen again from about the same side.

    Args:
        poses: T_world_camera (N, 4, 4).
        near_m: an earlier position within this distance,
        apart_m: from which the way has been at least this long,
        angle_deg: with a viewing direction within this angle.
    """
    positions, views = poses[:, :3, 3], poses[:, :3, 2]
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    neighbours = cKDTree(positions).query_ball_point(positions, near_m)
    least = np.cos(np.radians(angle_deg))
    found = np.zeros(len(poses), bool)
    for k, near in enumerate(neighbours):
        earlier = np.array([j for j in near if walked[k] - walked[j] > apart_m], int)
        found[k] = bool(len(earlier)) and bool((views[earlier] @ views[k] > least).any())
    return found


def count_loops(
    poses: np.ndarray, near_m: float = 1.5, apart_m: float = 20.0, angle_deg: float = 40.0
) -> int:
    """Runs of frames that revisit places; runs less than half of ``apart_m`` apart are one."""
    again = revisits(poses, near_m, apart_m, angle_deg)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    where = walked[again]
    return int(len(where) > 0) + int((np.diff(where) > 0.5 * apart_m).sum())


def circle(rounds: float, radius_m: float = 10.0, frames: int = 300) -> np.ndarray:
    angles = np.linspace(0.0, 2 * np.pi * rounds, frames)
    eyes = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(frames)], -1)
    ahead = np.stack([-np.sin(angles), np.cos(angles), np.zeros(frames)], -1)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, ahead, strict=True)])


def test_loops_of_a_circle():
    assert count_loops(circle(0.9)) == 0
    assert count_loops(circle(1.1)) == 1
    assert count_loops(circle(2.5)) == 1, "the second round revisits without a break"
    again = revisits(circle(1.5))
    np.testing.assert_array_equal(again[:190], False)
    assert again[205:].all()


def test_the_suite_is_what_the_paper_says_in_words():
    names = [entry.name for entry in SUITE]
    assert len(names) == len(set(names)) == 8
    assert {entry.scene for entry in SUITE} == {
        "residential_street",
        "city_street",
        "factory_hall",
        "living_room",
    }
    no, one, three, blurred = SUITE[:4]
    assert no.path.via[:8] == one.path.via[:8], "two like sequences"
    assert (no.loops, one.loops, three.loops) == (0, 1, 3)
    assert blurred.path == three.path
    assert [type(p) for p in blurred.made_perturbations()] == [MotionBlur]
    for entry in SUITE[4:6]:
        kinds = {p.kind for p in entry.made_perturbations() if isinstance(p, MovingObjects)}
        assert kinds
    fast, black = SUITE[6:]
    assert black.perturbations[:-1] == fast.perturbations
    assert black.path == fast.path


@pytest.mark.parametrize("entry", LARGE, ids=lambda entry: entry.name)
def test_a_way_has_the_loops_it_claims_and_is_free(entry):
    scene = large_scene(entry.scene)
    times, poses = entry.motion(scene, SEED)
    assert count_loops(poses) == (entry.loops or 0)
    assert scene.clearance(poses[:, :3, 3]).min() > 0.25
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() > 70.0
    assert (np.diff(times) > 0).all()


@pytest.mark.parametrize("entry", LARGE, ids=lambda entry: entry.name)
def test_a_way_without_loops_shows_nothing_twice(entry):
    scene = large_scene(entry.scene)
    times, poses = entry.motion(scene, SEED, 0.5)
    sensor = RGBDSensor(scene, xtion("80x60"), noise="none")
    depths = np.stack([sensor.ground_truth(pose).depth for pose in poses])
    again = find_revisits(depths, sensor.intrinsics, poses, times, 10.0)
    if entry.loops is not None:
        assert (again >= 0).any() == (entry.loops > 0), np.flatnonzero(again >= 0)


def test_the_fast_sequence_is_fast_and_the_black_frames_are_there():
    scene = make_scene("living_room", SEED)
    fast, black = (
        render(find(name), scene, "80x60", 0.5) for name in ("room-fast", "room-fast-black")
    )
    np.testing.assert_array_equal(fast.poses, black.poses)
    _, calm = find("room-fast").motion(scene, SEED, 0.5)
    pace = [
        np.percentile(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), 95)
        for poses in (fast.poses, calm)
    ]
    assert pace[0] > 2.0 * pace[1]
    dark = [not black.frames[k].color.any() for k in (124, 125, 134, 135)]
    assert dark == [False, True, True, False]
    assert fast.frames[130].color.any()


def test_what_was_made_without_its_truth_is_not_taken_for_it():
    plain, true = (describe(NAMES[0], with_truth=given) for given in (False, True))
    assert plain != true
    assert {**plain, "truth": True} == true


def test_moving_objects_are_in_the_hall():
    entry = find("factory-moving")
    sequence = render(entry, large_scene("factory_hall"), "80x60", 0.2)
    extra = set(sequence.frames.labels) - set(large_scene("factory_hall").mesh.labels)
    assert len(extra) == 8
