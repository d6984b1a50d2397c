from itertools import pairwise

import numpy as np
import pytest
from large_scenes import large_scene

from ms_slam_env import scenes
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, relative_angle
from ms_slam_env.sequences import HandheldPath, RoutePath, read_trajectory


@pytest.fixture(scope="module")
def hall():
    return large_scene("factory_hall")


def test_a_route_passes_its_places_freely_at_its_pace(hall):
    path = RoutePath(("A", "B", "F"), rate_hz=10.0, speed_m_s=1.2, turn_deg_s=30.0)
    times, poses = path.motion(hall, 4)
    assert len(times) == len(poses)
    np.testing.assert_allclose(np.diff(times), 0.1)
    for T in poses[::20]:
        check_pose(T)
    assert hall.clearance(poses[:, :3, 3]).min() > 0.25
    for name, near in (("A", 0.8), ("B", 1.6), ("F", 1.0)):
        place = hall.places[name] + np.array([0.0, 0.0, path.height_m])
        assert np.linalg.norm(poses[:, :3, 3] - place, axis=1).min() < near
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0.08 < np.median(steps) < 0.14
    assert steps.max() < 0.12 * (1 + path.variation) + 0.01
    turns = np.degrees([relative_angle(a[:3, :3], b[:3, :3]) for a, b in pairwise(poses)])
    assert turns.max() < 3.0 * (1 + path.variation) + 0.5


def test_same_seed_same_route_and_another_seed_another(hall):
    path = RoutePath(("A", "B"))
    first, again, other = (path.motion(hall, seed)[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert len(first) != len(other) or not np.array_equal(first, other)


def test_fewer_frames_for_the_same_way(hall):
    path = RoutePath(("A", "B"))
    long, short = path.motion(hall, 1)[1], path.with_frames_scaled(0.5).motion(hall, 1)[1]
    assert len(short) == pytest.approx(0.5 * len(long), rel=0.02)
    length = [np.linalg.norm(np.diff(p[:, :3, 3], axis=0), axis=1).sum() for p in (long, short)]
    assert length[0] == pytest.approx(length[1], rel=0.05)


@pytest.mark.parametrize("name", ["factory_hall", "residential_street"])
def test_a_hand_held_camera_finds_its_way_too(name):
    scene = large_scene(name)
    poses = HandheldPath(frames=12).poses(scene, 3)
    assert scene.clearance(poses[:, :3, 3]).min() > 0.1


def test_generate_takes_a_route(hall, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scenes, "make", lambda name, seed: hall)
    few = ["--image-size", "80x60", "--noise", "range", "--out", str(tmp_path / "out")]
    assert main(["generate", "--scene", "factory_hall", "--route", "A", "A-E", *few]) == 0
    times, poses = read_trajectory(tmp_path / "out/groundtruth.txt")
    assert len(times) > 10
    assert np.linalg.norm(poses[-1, :2, 3] - poses[0, :2, 3]) > 1.0
    assert main(["generate", "--scene", "factory_hall", "--route", "A", *few]) == 2
    assert "two places" in capsys.readouterr().err


def test_bad_routes_are_refused(hall):
    with pytest.raises(InputError, match=r"place of a route.*'Z'.*A, B"):
        RoutePath(("A", "Z")).motion(hall, 0)
    with pytest.raises(InputError, match="two places"):
        RoutePath(("A",))
    with pytest.raises(InputError, match="speed_m_s"):
        RoutePath(("A", "B"), speed_m_s=0.0)
    with pytest.raises(InputError, match="no free way via A, D, F, C"):
        RoutePath(("A", "D", "F", "C")).motion(hall, 0)  # straight through the racks


def test_a_room_has_no_places():
    class Room:
        name, seed = "room", 0

    with pytest.raises(InputError, match="no named places"):
        RoutePath(("A", "B")).motion(Room(), 0)
