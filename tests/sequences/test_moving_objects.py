"""Moving objects, hurried paths and changing light in rendered sequences."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BOXES, ROOM_HIGH, ROOM_LOW, BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion

from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at
from ms_slam_env.sequences import (
    FastMotion,
    Illumination,
    MotionBlur,
    MovingObjects,
    PoseInterpolation,
    RollingShutter,
    handheld_trajectory,
    read_trajectory,
    render_sequence,
)
from ms_slam_env.sequences.perturbations.illumination import WanderingLamp
from ms_slam_env.sequences.perturbations.movers import bodies_of, round_track, straight_track
from ms_slam_env.sequences.perturbed_camera import Imperfections
from ms_slam_env.sequences.writing import write_sequence

K = xtion("80x60")
FRAMES = 12


@pytest.fixture(scope="module")
def path(box_scene: BoxScene) -> np.ndarray:
    return handheld_trajectory(box_scene, FRAMES, 1, speed_m=0.04, rot_deg=2.0)


@pytest.fixture(scope="module")
def with_boxes(box_scene, path):
    return render_sequence(box_scene, path, K, seed=2, perturbations=[MovingObjects("box", 2)])


def test_objects_are_in_the_labels_and_the_same_every_time(box_scene, path, with_boxes) -> None:
    frames = with_boxes.frames
    assert frames.labels[-2:] == ("box 0", "box 1")
    seen = {label for k in range(FRAMES) for label in np.unique(frames.truth(k).labels)}
    assert seen & {len(frames.labels) - 2, len(frames.labels) - 1}
    again = render_sequence(box_scene, path, K, seed=2, perturbations=[MovingObjects("box", 2)])
    for k in (7, 0):
        np.testing.assert_array_equal(frames[k].color, again.frames[k].color)
        np.testing.assert_array_equal(frames[k].depth, again.frames[k].depth)
    for name, poses in frames.object_trajectories.items():
        np.testing.assert_array_equal(poses, again.frames.object_trajectories[name])
    other = render_sequence(box_scene, path, K, seed=3, perturbations=[MovingObjects("box", 2)])
    assert not np.array_equal(
        frames.object_trajectories["box 0"], other.frames.object_trajectories["box 0"]
    )


def test_what_is_seen_of_an_object_lies_where_its_trajectory_says(with_boxes) -> None:
    frames = with_boxes.frames
    count = 0
    for k in range(0, FRAMES, 3):
        truth = frames.truth(k)
        for name, poses in frames.object_trajectories.items():
            points = truth.points[truth.labels == frames.labels.index(name)]
            local = (points - poses[k, :3, 3]) @ poses[k, :3, :3]
            count += len(points)
            assert (np.abs(local) < 0.19).all()  # half of the largest side of a parcel
            assert np.abs(local).max(initial=0.1) > 0.08
    assert count > 100


def test_trajectories_on_disk_are_those_used(with_boxes, tmp_path) -> None:
    write_sequence(with_boxes, tmp_path / "seq", {"a": 1}, with_truth=True)
    for name, poses in with_boxes.frames.object_trajectories.items():
        file = tmp_path / "seq" / "objects" / f"{name.replace(' ', '_')}.txt"
        times, written = read_trajectory(file)
        np.testing.assert_allclose(times, with_boxes.frames.timestamps, atol=1e-6)
        np.testing.assert_allclose(written, poses, atol=1e-6)


def test_no_objects_is_no_change(box_scene, path) -> None:
    plain = render_sequence(box_scene, path, K, seed=2)
    off = [MovingObjects(count=0), FastMotion(factor=1.0), Illumination(dim=0.0, lamp=0.0)]
    same = render_sequence(box_scene, path, K, seed=2, perturbations=off)
    assert len(plain) == len(same)
    assert same.frames.object_trajectories == {}
    np.testing.assert_array_equal(plain.frames[3].color, same.frames[3].color)
    np.testing.assert_array_equal(plain.frames[3].depth, same.frames[3].depth)


@pytest.mark.parametrize(("kind", "count"), [("box", 2), ("person", 1)])
def test_ways_keep_clear(box_scene: BoxScene, path, kind, count) -> None:
    moving = MovingObjects(kind, count, speed_m_s=1.0)
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)
    movers = moving.populate(box_scene, camera, K, seed=4)
    times = np.arange(0.0, 20.0, 0.05)
    for mover in movers:
        for body in bodies_of([mover], box_scene):
            T = body.pose(times[::8])
            points = body.mesh.vertices[::9] @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
            points = points.reshape(-1, 3)
            assert (points > ROOM_LOW - 0.02).all()  # soles, which swing
            assert (points < ROOM_HIGH).all()
            for low, high in BOXES:
                assert not ((points > low) & (points < high)).all(axis=1).any()
        steps = np.linalg.norm(np.diff(mover.middle(times), axis=0), axis=1)
        assert 0.5 * 0.05 < steps.max() < 1.02 * 0.05
        assert mover.distance(path[:, :3, 3], camera.times_s).min() > 0.3
    for a in movers:
        for b in movers:
            if a is not b:
                assert all((a.distance(p, times) > 0.1).all() for p in b.outline(times))


def test_kinds_keep_clear_of_each_other(box_scene, path) -> None:
    both = Imperfections.of([MovingObjects("person", 1), MovingObjects("box", 1)])
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)
    movers = both.movers(box_scene, camera, K, seed=4)
    assert [mover.name for mover in movers] == ["person 0", "box 0"]
    times = np.arange(0.0, 20.0, 0.05)
    for mover in movers[1:]:
        assert (movers[0].distance(mover.middle(times), times) > 0.1).all()


def test_a_person_walks_on_the_ground_and_looks_ahead(box_scene, path) -> None:
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)
    (mover,) = MovingObjects("person", 1, 0.8).populate(box_scene, camera, K, seed=4)
    times = np.arange(0.0, 10.0, 0.05)
    poses = mover.pose(times)
    np.testing.assert_allclose(poses[:, 2, 3], 0.0, atol=1e-5)
    steps = np.diff(poses[:, :3, 3], axis=0)
    is_going = np.linalg.norm(steps, axis=1) > 0.01
    ahead = steps[is_going] / np.linalg.norm(steps[is_going], axis=1, keepdims=True)
    assert np.median(np.einsum("ni,ni->n", ahead, poses[:-1][is_going, :3, 0])) > 0.98
    legs = [body.pose(times) for body in bodies_of([mover], box_scene)[1:3]]
    assert not np.allclose(legs[0], legs[1])


def test_a_mover_can_wait(box_scene, path) -> None:
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)
    (mover,) = MovingObjects("box", 1).populate(box_scene, camera, K, seed=4)
    before = mover.pose([0.5, 1.0, 2.0])
    mover.wait(1.0, 0.5)
    np.testing.assert_array_equal(mover.pose([0.5, 1.0]), before[:2])
    np.testing.assert_array_equal(mover.pose([1.3]), before[1:2])
    np.testing.assert_allclose(mover.pose([2.5]), before[2:], atol=1e-12)


@pytest.mark.parametrize("kind", ["box", "person"])
def test_an_object_takes_the_same_route_at_every_size(box_scene, path, kind) -> None:
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)
    times = np.linspace(0.0, 2.0, 9)

    def route(size: str) -> np.ndarray:
        (mover,) = MovingObjects(kind, 1).populate(box_scene, camera, xtion(size), seed=1)
        return mover.middle(times)

    expected = route("40x30")
    for size in ("64x48", "100x75", "160x120", "640x480"):
        np.testing.assert_array_equal(route(size), expected)


def test_a_lamp_takes_the_same_route_at_every_size(box_scene, path) -> None:
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)

    def route(size: str) -> np.ndarray:
        light = Illumination(lamp=1.0).light(box_scene, camera, xtion(size), 1)
        return np.array([light._lamp.position(t) for t in np.linspace(0.0, 2.0, 9)])

    for size in ("64x48", "100x75", "640x480"):
        np.testing.assert_array_equal(route(size), route("40x30"))


@given(st.floats(0.3, 3.0), st.floats(0.05, 0.4), st.floats(0.1, 3.0), st.floats(0.5, 4.0))
@settings(max_examples=25)
def test_tracks_keep_their_pace(length, half_width, speed, turning) -> None:
    end = np.array([length, 0.2 * length, 0.1])
    track = round_track(np.zeros(3), end, half_width, speed, turning)
    np.testing.assert_allclose(track.points[0], track.points[-1], atol=1e-9)
    assert np.isclose(abs(track.yaws[-1] - track.yaws[0]), 2 * np.pi, atol=1e-6)
    seconds = np.diff(track.times_s)
    assert (np.diff(track.way_m) <= speed * seconds * (1 + 1e-9)).all()
    assert (np.abs(np.diff(track.yaws)) <= turning * seconds * (1 + 1e-9)).all()
    a, b = track.at(0.3), track.at(0.3 + track.period_s)
    np.testing.assert_allclose(a[0], b[0], atol=1e-9)
    assert b[2] - a[2] == pytest.approx(track.way_m[-1])


def test_a_lane_begins_again() -> None:
    track = straight_track(np.zeros(3), np.array([10.0, 0.0, 0.0]), 5.0)
    points, yaws, ways = track.at([0.0, 1.0, 1.9, 2.1])
    np.testing.assert_allclose(points[:, 0], [0.0, 5.0, 9.5, 0.5])
    np.testing.assert_allclose(ways, [0.0, 5.0, 9.5, 10.5])
    np.testing.assert_array_equal(yaws, 0.0)


def test_cars_take_the_lanes_of_the_scene(path) -> None:
    scene = BoxScene(seed=0)
    scene.lanes = ((np.array([-1.0, -30.0, 0.0]), np.array([-1.0, -10.0, 0.0])),)
    camera = PoseInterpolation(np.arange(FRAMES) / 30, path)
    (car,) = MovingObjects("car", 1, 8.0).populate(scene, camera, K, seed=0)
    x, y, z = car.pose([0.0, 0.3])[:, :3, 3].T
    np.testing.assert_allclose([x, z], [[-1.0] * 2, [0.0] * 2])
    assert (y >= -30).all()
    assert (y <= -10).all()
    assert car.pose(0.0)[1, 0] == pytest.approx(1.0)  # heads along +y


def test_blur_and_rolling_rows_go_with_the_objects(box_scene) -> None:
    """A camera at rest sees a moving object blurred and sheared, and the room as it is."""
    still = np.repeat(
        look_at(np.array([-1.2, -1.2, 1.4]), np.array([0.2, 0.0, 0.6]))[None], FRAMES, 0
    )
    fast = MovingObjects("box", 1, speed_m_s=2.0)
    plain = render_sequence(box_scene, still, K, "none", 3, perturbations=[fast])
    shaken = render_sequence(
        box_scene, still, K, "none", 3, perturbations=[fast, MotionBlur(0.03, 4)]
    )
    rolling = render_sequence(
        box_scene, still, K, "none", 3, perturbations=[fast, RollingShutter(0.03)]
    )
    k = 5
    far = plain.frames.truth(k).labels != len(plain.frames.labels) - 1
    for other in (4, 6):
        far &= plain.frames.truth(other).labels != len(plain.frames.labels) - 1
    far = binary_erosion(far, iterations=2, border_value=1)  # it is in between, too
    assert 0 < (~far).sum() < 0.6 * far.size
    blur = np.abs(shaken.frames[k].color.astype(int) - plain.frames[k].color)
    assert blur[far].max() <= 2 < blur[~far].max()
    shear = rolling.frames[k].depth != plain.frames[k].depth
    assert shear.any()
    assert not shear[far].any()


def test_no_room_for_a_car_is_one_clear_line(box_scene, path) -> None:
    with pytest.raises(InputError, match="no free way for car 0 in scene 'box'"):
        render_sequence(box_scene, path, K, perturbations=[MovingObjects("car", 1)])


def test_two_of_a_name_are_refused(box_scene, path) -> None:
    two = [MovingObjects("box", 1), MovingObjects("box", 1, seed=1)]
    with pytest.raises(InputError, match="give it once"):
        render_sequence(box_scene, path, K, perturbations=two)
    with pytest.raises(InputError, match="illumination once"):
        render_sequence(box_scene, path, K, perturbations=[Illumination(), Illumination()])


# ---------------------------------------------------------------- fast motion


@given(st.floats(1.1, 6.0), st.floats(0.1, 0.9), st.integers(0, 50))
@settings(max_examples=20)
def test_a_hurried_path_is_the_same_path(factor, share, seed) -> None:
    t = np.arange(120) / 30
    poses = np.repeat(np.eye(4)[None], 120, 0)
    poses[:, 0, 3] = 0.3 * t
    path = PoseInterpolation(t, poses)
    fast = FastMotion(factor, share, length_s=0.8).retime(path, seed)
    assert len(fast.times_s) < len(t)
    np.testing.assert_array_equal(fast.times_s, t[: len(fast.times_s)])
    x = fast.poses[:, 0, 3]
    np.testing.assert_allclose(fast.poses, path(x / 0.3), atol=1e-6)
    speed = np.diff(x) * 30 / 0.3
    assert speed.min() > 1 - 1e-6
    assert speed.max() < factor * (1 + 1e-3)
    assert x[-1] <= poses[-1, 0, 3] + 1e-9


def test_a_hurry_reaches_its_factor(box_scene, path) -> None:
    t = np.arange(300) / 30
    poses = np.repeat(np.eye(4)[None], 300, 0)
    poses[:, 0, 3] = t
    fast = FastMotion(4.0, 0.5, 1.0).retime(PoseInterpolation(t, poses), 0)
    speed = np.diff(fast.poses[:, 0, 3]) * 30
    assert speed.max() == pytest.approx(4.0, abs=0.05)
    assert 0.35 < (speed > 1.01).mean() < 0.6
    rendered = render_sequence(box_scene, path, K, perturbations=[FastMotion(3.0, 0.9, 0.2)])
    assert len(rendered) == len(rendered.poses) < FRAMES
    np.testing.assert_array_equal(rendered.frames.poses, rendered.poses)


# ---------------------------------------------------------------- illumination


def test_light_changes_and_depth_does_not(box_scene, path) -> None:
    plain = render_sequence(box_scene, path, K, seed=2)
    light = Illumination(dim=0.6, period_s=0.4, lamp=0.0)
    dim = render_sequence(box_scene, path, K, seed=2, perturbations=[light])
    np.testing.assert_array_equal(dim.frames[0].color, plain.frames[0].color)
    for k in (3, 6):
        np.testing.assert_array_equal(dim.frames[k].depth, plain.frames[k].depth)
    assert dim.frames[6].color.mean() < 0.75 * plain.frames[6].color.mean()  # after half a period
    lamp = Illumination(dim=0.0, lamp=2.0)
    lit = render_sequence(box_scene, path, K, seed=2, perturbations=[lamp])
    a, b = lit.frames[6], plain.frames[6]
    np.testing.assert_array_equal(a.depth, b.depth)
    assert a.color.mean() > b.color.mean() + 1
    again = render_sequence(box_scene, path, K, seed=2, perturbations=[lamp])
    np.testing.assert_array_equal(again.frames[6].color, a.color)


def test_a_lamp_obeys_the_inverse_square_and_casts_shadows(box_scene) -> None:
    up = np.array([[0.0, 0.0, 1.0]])
    track = straight_track(np.array([1.25, 0.0, 1.8]), np.array([1.25, 0.2, 1.8]), 1e-3)
    lamp = WanderingLamp(box_scene, track, 1.0)
    top = lamp.light(np.array([[1.25, 0.0, 0.8 + 1e-4]]), up, 0.0)  # of a box, 1 m below
    median = np.median(box_scene.mesh.irradiance.mean(axis=(1, 2)))
    np.testing.assert_allclose(top, median, rtol=1e-3)
    beside, below = lamp.light(
        np.array([[0.0, 0.0, 1e-3], [0.95, 0.2, -1e-3]]), np.repeat(up, 2, 0), 0.0
    )
    r2 = 1.25**2 + 1.8**2
    assert beside == pytest.approx(median * 1.8 / r2**1.5, rel=1e-2)
    assert below == 0.0


def test_a_lamp_finds_a_way_beside_a_camera_that_looks_at_a_wall(box_scene: BoxScene) -> None:
    """Nothing in view has room for it, as before an arm at a wall."""
    eye = np.array([ROOM_HIGH[0] - 0.55, 1.0, 1.5])
    poses = np.stack([look_at(eye, eye + np.array([1.0, 0.0, 0.0]))] * 2)
    camera = PoseInterpolation([0.0, 1.0], poses)
    light = Illumination(dim=0.0, lamp=0.3, speed_m_s=0.001).light(box_scene, camera, K, 0)
    assert light is not None
