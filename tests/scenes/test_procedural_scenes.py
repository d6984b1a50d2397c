import pickle
from functools import cache

import numpy as np
import pytest

from ms_slam_env import scenes
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.mesh_scene import MIN_START_CLEARANCE_M, START_DEPTH_M
from ms_slam_env.scenes.scene import Scene, TexturedMesh


@pytest.fixture(scope="module", params=scenes.ROOMS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return _cached(request.param)


@cache
def _cached(name: str) -> Scene:
    return scenes.make(name, 2)


def _normals(mesh: TexturedMesh) -> np.ndarray:
    c = mesh.vertices[mesh.faces].astype(np.float64)
    n = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def test_arrays_have_the_promised_shapes_and_indices(scene):
    mesh = scene.mesh
    count = len(mesh.faces)
    assert mesh.vertices.dtype == np.float32
    assert mesh.faces.dtype == mesh.face_texture.dtype == mesh.face_label.dtype == np.int32
    assert mesh.uv.shape == (count, 3, 2)
    assert mesh.irradiance.shape == (count, 3, 3)
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)
    assert set(np.unique(mesh.face_texture)) <= set(range(len(mesh.textures)))
    assert set(np.unique(mesh.face_label)) <= set(range(len(mesh.labels)))
    assert len(set(mesh.labels)) == len(mesh.labels)
    assert np.isfinite(mesh.uv).all()
    assert np.isfinite(mesh.irradiance).all()
    assert mesh.irradiance.min() >= 0.0
    for texture in mesh.textures:
        assert texture.dtype == np.uint8
        assert texture.ndim == 3


def test_size_is_what_a_sensor_can_bear(scene):
    assert 20_000 <= len(scene.mesh.faces) <= 80_000
    assert max(max(t.shape[:2]) for t in scene.mesh.textures) <= 1024


def test_faces_seen_from_free_space_show_their_front(scene):
    rng = np.random.default_rng(0)
    rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    normals = _normals(scene.mesh)
    directions = rng.standard_normal((4000, 3))
    eye = scene.sample_start(rng)[:3, 3]
    distance, face = rays.first_hit(np.broadcast_to(eye, directions.shape), directions)
    assert np.isfinite(distance).all(), "the room is closed"
    facing = np.einsum("ij,ij->i", directions, normals[face]) < 0
    assert facing.mean() > 0.998


def test_clearance_is_the_distance_to_the_nearest_surface(scene):
    points, _ = scene.surface_points(0.02)
    rng = np.random.default_rng(1)
    low, high = points.min(0), points.max(0)
    queries = rng.uniform(low, high, (3000, 3))
    clearance = scene.clearance(queries)
    queries, clearance = queries[clearance > 0.12][:60], clearance[clearance > 0.12][:60]
    assert len(queries) > 20
    brute = np.array([np.sqrt(((points - q) ** 2).sum(1).min()) for q in queries])
    # The grid has cells of 5 cm and the samples are 2 cm apart.
    assert np.abs(brute - clearance).max() < 0.05
    assert np.abs(brute - clearance).mean() < 0.01


def test_clearance_is_zero_outside_and_behind_walls(scene):
    low, high = scene.mesh.vertices.min(0), scene.mesh.vertices.max(0)
    outside = np.stack([low - 0.3, high + 0.3, [low[0] - 5, 1.0, 1.0], [np.inf, 0, 0]])
    np.testing.assert_array_equal(scene.clearance(outside[:3].astype(np.float64)), 0.0)


def test_start_poses_are_valid(scene):
    rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.linspace(-0.55, 0.55, 20), np.linspace(-0.42, 0.42, 15))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], -1)
    for _ in range(8):
        T = check_pose(scene.sample_start(rng))
        assert scene.clearance(T[None, :3, 3])[0] >= MIN_START_CLEARANCE_M
        origins = np.broadcast_to(T[:3, 3], pixels.shape)
        depth, _ = rays.first_hit(origins, pixels @ T[:3, :3].T)
        good = (depth >= START_DEPTH_M[0]) & (depth <= START_DEPTH_M[1])
        assert good.mean() > 0.75
        assert T[2, 1] < -0.2, "the image's down is the world's down"


def test_surface_points_lie_on_visible_surface(scene):
    points, labels = scene.surface_points(0.05)
    again, labels_again = scene.surface_points(0.05)
    np.testing.assert_array_equal(points, again)
    np.testing.assert_array_equal(labels, labels_again)
    assert labels.dtype == np.int32
    assert labels.max() < len(scene.mesh.labels)
    # On the surface, so in an occupied cell or right beside one.
    assert scene.clearance(points).max() < 0.06
    names = {scene.mesh.labels[k] for k in np.unique(labels)}
    assert "floor" in names
    assert "wall 0" in names


def test_segments_are_refused_at_walls_and_free_in_the_open(scene):
    eye = scene.sample_start(np.random.default_rng(5))[:3, 3]
    radius = 0.1
    assert scene.segment_is_free(eye, eye + 1e-3, radius)
    beyond = eye + np.array([0.0, 0.0, 10.0])
    assert not scene.segment_is_free(eye, beyond, radius)
    clear = float(scene.clearance(eye[None])[0])
    assert not scene.segment_is_free(eye, eye, clear + 0.01)


@pytest.mark.parametrize("name", ["wall", "window"])
def test_same_seed_same_scene_bit_for_bit(name):
    a, b = _cached(name), scenes.make(name, 2)
    for field in ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance"):
        np.testing.assert_array_equal(getattr(a.mesh, field), getattr(b.mesh, field))
    for x, y in zip(a.mesh.textures, b.mesh.textures, strict=True):
        np.testing.assert_array_equal(x, y)
    assert a.mesh.labels == b.mesh.labels
    assert a.exposure == b.exposure
    starts = [s.sample_start(np.random.default_rng(1)) for s in (a, b)]
    np.testing.assert_array_equal(*starts)
    other = scenes.make(name, 8)
    assert other.mesh.vertices.shape != a.mesh.vertices.shape or not np.array_equal(
        other.mesh.vertices, a.mesh.vertices
    )


def test_a_pickled_scene_is_the_same():
    scene = _cached("carpet")
    copy = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(copy.mesh.irradiance, scene.mesh.irradiance)
    np.testing.assert_array_equal(copy.free_space.distance, scene.free_space.distance)


def test_hard_scenes_are_hard():
    """The bare wall and the carpet lack what the table has: texture, and relief."""

    def contrast(name: str) -> float:
        mesh = _cached(name).mesh
        floor = mesh.labels.index("wall 0")
        texture = mesh.textures[mesh.face_texture[mesh.face_label == floor][0]]
        return float(texture.mean(2).std() / texture.mean())

    assert contrast("wall") < 0.5 * contrast("table")
    x = _cached("carpet")
    points, labels = x.surface_points(0.03)
    centre = x.mesh.vertices[:, :2].max(0) * [0.5, 0.42]
    middle = np.abs(points[:, :2] - centre).max(1) < 0.6
    middle &= points[:, 2] < 1.0
    assert np.percentile(points[middle, 2], 98) < 0.02
    assert x.mesh.labels[int(np.bincount(labels[middle]).argmax())] == "floor"


def test_splits_do_not_overlap():
    seen: set[int] = set()
    for name, seeds in scenes.SEED_SPLITS.items():
        assert not seen & set(seeds)
        seen |= set(seeds)
        assert scenes.split_of(seeds[0]) == name
    assert scenes.split_of(1500) is None


def test_seeds_may_be_ones_own():
    assert scenes.seeds_of("test") == range(2000, 2100)
    assert scenes.seeds_of("7000-7003") == [7000, 7001, 7002, 7003]
    assert scenes.seeds_of("7000,7005,7010-7011") == [7000, 7005, 7010, 7011]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tests", "split of seeds 'tests'; valid choices: train, validation, test, seeds of your"),
        ("", "split of seeds ''"),
        ("-3", "split of seeds '-3'"),
        ("7000-", "split of seeds '7000-'"),
        ("1 2", "split of seeds '1 2'"),
        ("7003-7000", "7003-7000 is not a range"),
        ("0-9999999999", "0-9999999999 is not a range of 1 to 100,000 seeds"),
        ("1,2,1", "names one twice"),
    ],
)
def test_what_are_no_seeds_is_refused(text, said):
    with pytest.raises(InputError, match=said):
        scenes.seeds_of(text)
