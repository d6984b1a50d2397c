"""Dwellings as scenes: mesh, light, free space, what can be seen, ways, the cache."""

import dataclasses
import pickle
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from homes import home_scene
from scipy import ndimage

from ms_slam_env import scenes
from ms_slam_env.geometry import check_pose
from ms_slam_env.scenes.free_space import FreeSpace
from ms_slam_env.scenes.homes import home as home_module
from ms_slam_env.scenes.homes.home import CAMERA_M, reachable_cells
from ms_slam_env.scenes.homes.ways import Ways
from ms_slam_env.scenes.lighting import Lamp, RoomLight, mean_albedo
from ms_slam_env.scenes.mesh_queries import RayCaster, face_cross
from ms_slam_env.scenes.mesh_scene import MIN_START_CLEARANCE_M
from ms_slam_env.scenes.scene import enclosed, floor_height, outside
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import RoutePath

FIELDS = ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance")
CAMERA_RADIUS_M = 0.1


@pytest.fixture(scope="module")
def scene():
    return home_scene()


def centres(scene):
    corners = scene.mesh.vertices[scene.mesh.faces].astype(np.float64)
    cross = face_cross(corners)
    return corners.mean(1), cross / np.linalg.norm(cross, axis=1, keepdims=True)


def test_the_mesh_is_sound_and_of_bearable_size(scene):
    mesh = scene.mesh
    assert 80_000 <= len(mesh.faces) <= 320_000
    for field in FIELDS:
        assert np.isfinite(getattr(mesh, field)).all()
    assert mesh.irradiance.min() >= 0.0
    assert (
        np.linalg.norm(face_cross(mesh.vertices[mesh.faces].astype(np.float64)), axis=1).min() > 0
    )
    assert mesh.face_texture.max() < len(mesh.textures)
    assert mesh.face_label.max() < len(mesh.labels)
    assert len(set(mesh.labels)) == len(mesh.labels)
    assert max(max(t.shape[:2]) for t in mesh.textures) <= 1024
    assert floor_height(scene) == 0.0


def test_it_is_closed_and_shows_its_fronts(scene):
    rng = np.random.default_rng(0)
    rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    normals = centres(scene)[1]
    for place in scene.places.values():
        directions = rng.standard_normal((2000, 3))
        eye = place + np.array([0.0, 0.0, 1.4])
        distance, face = rays.first_hit(np.broadcast_to(eye, directions.shape), directions)
        assert np.isfinite(distance).all()
        assert (np.einsum("ij,ij->i", directions, normals[face]) < 0).mean() > 0.995


def test_a_camera_gets_to_every_room(scene):
    """Flood fill over the grid of free space, with the size of a camera."""
    hall = scene.places["hall"] + np.array([0.0, 0.0, 1.4])
    cells = np.argwhere(reachable_cells(scene.free_space, hall, CAMERA_RADIUS_M))
    points = scene.free_space.origin + scene.free_space.voxel_m * cells
    free = (scene.free_space.distance > CAMERA_RADIUS_M).sum()
    assert len(points) > 0.97 * free, "nothing worth speaking of is shut off"
    for room in scene.plan.rooms:
        inside = ((points[:, :2] > room.low) & (points[:, :2] < room.high)).all(axis=1)
        share = inside.sum() * scene.free_space.voxel_m**3 / (room.area * scene.plan.height)
        assert share > 0.3, room.name


def test_no_room_is_dark_or_glaring(scene):
    mesh = scene.mesh
    middle, _ = centres(scene)
    radiance = (mean_albedo(mesh.textures)[mesh.face_texture] * mesh.irradiance.mean(1)).mean(1)
    seen = np.zeros(len(middle), bool)
    seen[scene._seen] = True
    for room in scene.plan.rooms:
        inside = seen & ((middle[:, :2] > room.low) & (middle[:, :2] < room.high)).all(axis=1)
        assert 0.06 < scene.exposure * np.median(radiance[inside]) < 0.5, room.name


def test_starts_are_free_upright_and_look_at_things_in_many_rooms(scene):
    rng = np.random.default_rng(3)
    rooms = set()
    for _ in range(12):
        T = check_pose(scene.sample_start(rng))
        assert scene.clearance(T[None, :3, 3])[0] >= MIN_START_CLEARANCE_M
        assert T[2, 1] < -0.2
        assert scene._view_quality(T)[1] >= 5
        rooms |= {
            room.name
            for room in scene.plan.rooms
            if (T[:2, 3] > room.low).all() and (T[:2, 3] < room.high).all()
        }
    assert len(rooms) >= 3
    again = [scene.sample_start(np.random.default_rng(5)) for _ in range(2)]
    np.testing.assert_array_equal(*again)


def test_the_surface_is_what_can_be_seen_from_where_a_camera_gets_to(scene):
    """By brute force: some place of a finer grid sees a point of it, none sees a hidden face."""
    rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    hall = scene.places["hall"] + np.array([0.0, 0.0, 1.4])
    cells = np.argwhere(reachable_cells(scene.free_space, hall, CAMERA_M))[::37]
    eyes = scene.free_space.origin + scene.free_space.voxel_m * cells
    eyes = eyes[(eyes[:, 2] > 0.35) & (eyes[:, 2] < 1.85)]
    middle, normal = centres(scene)
    corners = scene.mesh.vertices[scene.mesh.faces].astype(np.float64)
    area = np.linalg.norm(face_cross(corners), axis=1)
    is_seen = np.zeros(len(middle), bool)
    is_seen[scene._seen] = True
    before = middle + 1.2 * scene.free_space.voxel_m * normal
    hidden = np.flatnonzero(~is_seen & (scene.clearance(before) > 0))

    def seen_by_any(faces):
        found = np.zeros(len(faces), bool)
        for k, face in enumerate(faces):
            towards = middle[face] - eyes
            length = np.linalg.norm(towards, axis=1)
            near = np.flatnonzero((-(towards @ normal[face]) > 0.15 * length) & (length < 5))
            distance, _ = rays.first_hit(eyes[near], towards[near])
            found[k] = (distance > 0.99).any()
        return found

    rng = np.random.default_rng(0)
    picked = rng.choice(scene._seen, 150, replace=False)
    assert seen_by_any(picked).mean() > 0.97
    picked = rng.choice(hidden, 150, replace=False)
    missed = seen_by_any(picked) @ area[picked] / area[picked].sum() * area[hidden].sum()
    assert missed < 0.08 * area[is_seen].sum()
    points, labels = scene.surface_points(0.05)
    assert scene.clearance(points).max() < 0.06
    names = {scene.mesh.labels[k] for k in np.unique(labels)}
    for room in scene.plan.rooms:
        assert {f"{room.name} floor", f"{room.name} ceiling"} <= names


def test_ways_lead_through_doors_and_keep_clear(scene):
    names = [room.name for room in scene.plan.rooms]
    for a, b in pairwise(names):
        way = scene.way(scene.places[a], scene.places[b])
        np.testing.assert_array_equal(way[[0, -1]], [scene.places[a], scene.places[b]])
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.3
        assert scene.clearance(way + np.array([0.0, 0.0, 1.4])).min() > 0.25


def test_no_way_into_a_room_that_is_shut(scene):
    bathroom = next(room for room in scene.plan.rooms if room.kind == "bathroom")
    points = scene.free_space.origin[:2, None] + scene.free_space.voxel_m * np.indices(
        scene.free_space.distance.shape[:2]
    ).reshape(2, -1)
    inside = ((bathroom.low < points.T) & (bathroom.high > points.T)).all(axis=1)
    shut = (
        scene.free_space.distance * ~inside.reshape(scene.free_space.distance.shape[:2])[..., None]
    )
    free = FreeSpace.of_grid(shut, scene.free_space.origin, scene.free_space.voxel_m)
    ways = Ways(free, np.zeros(2), np.max([room.high for room in scene.plan.rooms], axis=0))
    assert ways.between(scene.places["living"], scene.places["hall"]) is not None
    assert ways.between(scene.places["bathroom"], scene.places["hall"]) is None


def test_a_route_through_rooms(scene):
    names = ("hall", "living", "bathroom")
    path = RoutePath(names, speed_m_s=0.5, rate_hz=10.0)
    _, poses = path.motion(scene, 0)
    assert scene.clearance(poses[:, :3, 3]).min() > 0.25
    for name in names:
        place = scene.places[name] + np.array([0.0, 0.0, path.height_m])
        assert np.linalg.norm(poses[:, :3, 3] - place, axis=1).min() < 0.5


def test_same_seed_same_home_from_the_cache_or_not(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("MS_SLAM_ENV_CACHE", str(tmp_path))
    calls = []
    kept = {field: getattr(scene.mesh, field) for field in FIELDS}
    original = home_module.worked_out
    monkeypatch.setattr(home_module, "worked_out", lambda s: calls.append(s) or original(s))
    fresh, stored = scenes.make("home", scene.seed), scenes.make("home", scene.seed)
    assert calls == [scene.seed]
    for other in (fresh, stored):
        for field, array in kept.items():
            np.testing.assert_array_equal(getattr(other.mesh, field), array)
        for a, b in zip(other.mesh.textures, scene.mesh.textures, strict=True):
            np.testing.assert_array_equal(a, b)
        assert other.mesh.labels == scene.mesh.labels
        assert other.exposure == scene.exposure
        assert other.plan == scene.plan
        np.testing.assert_array_equal(other.free_space.distance, scene.free_space.distance)
        np.testing.assert_array_equal(other.surface_points(0.1)[0], scene.surface_points(0.1)[0])
    copy = pickle.loads(pickle.dumps(stored))
    np.testing.assert_array_equal(copy.mesh.irradiance, scene.mesh.irradiance)
    assert calls == [scene.seed]
    monkeypatch.setattr(home_module, "version", lambda: "another")
    monkeypatch.setattr(home_module, "worked_out", lambda _: pytest.fail("asked anew"))
    with pytest.raises(pytest.fail.Exception, match="asked anew"):
        scenes.make("home", scene.seed)


def test_an_episode_in_a_home(scene):
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="home", scene_seed=scene.seed)
    _, info = env.reset(seed=1)
    for _ in range(3):
        *_, info = env.step(env.action_space.sample(mask=info["action_mask"].astype(np.int8)))
    assert info["scene"] == "home"
    assert 0.0 < info["mapped_share"] < 0.5


def test_light_of_a_room_fades_behind_its_doors():
    lamp = Lamp((1.0, 1.0, 2.0), (1.0, 1.0, 1.0))
    far = RayCaster(np.array([[0.0, 0, -5], [1, 0, -5], [0, 1, -5]]), np.array([[0, 1, 2]]))
    points = np.array([[1.0, 1.0, 0.0], [3.0, 1.0, 0.0], [4.5, 1.0, 0.0]])
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    alone = lamp.irradiance(points, up, far)
    of_room = RoomLight(lamp, (0.0, 0.0, 0.0), (2.0, 2.0, 2.5), reach_m=2.0)
    np.testing.assert_allclose(of_room.irradiance(points, up, far), alone * [[1.0], [0.5], [0.0]])
    assert dataclasses.replace(of_room, reach_m=1e9).irradiance(points, up, far) == pytest.approx(
        alone
    )


def test_free_space_is_one_piece_for_a_walker(scene):
    level = round((1.4 - scene.free_space.origin[2]) / scene.free_space.voxel_m)
    _, count = ndimage.label(scene.free_space.distance[:, :, level] > 0.28)
    sizes = np.bincount(ndimage.label(scene.free_space.distance[:, :, level] > 0.28)[0].ravel())[1:]
    assert count >= 1
    assert sizes.max() > 0.9 * sizes.sum()


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ((0.0, -1.0, 1.0), ""),
        ((1.25, 0.05, 0.4), "inside something in scene box"),
        ((0.0, 0.0, -0.5), "below the floor of scene box, which is at z = 0.00 m"),
        ((0.0, 0.0, 3.0), "outside scene box, which spans -2.00 to 2.00 x -2.00 to 2.00 x 0.00 to"),
        ((9.0, 0.0, -3.0), "outside scene box, which spans"),
    ],
)
def test_where_a_place_lies(box_scene, position, words):
    found = enclosed(box_scene, np.array(position))
    assert found.startswith(words)
    assert bool(found) == bool(words)


def test_on_the_floor_is_not_outside(box_scene):
    assert outside(box_scene, np.zeros(3)) == ""


def test_leaves_below_the_floor_do_not_lower_it():
    scene = get_scene("table", 2000)
    assert scene.mesh.vertices[:, 2].min() < -0.1
    assert floor_height(scene) == 0.0
