import numpy as np
import pytest
from large_scenes import SEED, large_scene

from ms_slam_env import scenes
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import check_pose
from ms_slam_env.scenes.lighting import SkyLight
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.mesh_scene import MIN_START_CLEARANCE_M, SKY, LargeScene
from ms_slam_env.scenes.outdoors.plan import StreetPlan
from ms_slam_env.sensor import RGBDSensor

OUTDOORS = ("residential_street", "city_street")


@pytest.fixture(params=scenes.LARGE_SCENES)
def scene(request: pytest.FixtureRequest) -> LargeScene:
    return large_scene(request.param)


def test_names_are_split_into_rooms_and_large_scenes():
    assert set(scenes.SCENES) == set(scenes.ROOMS) | set(scenes.HOMES) | set(scenes.LARGE_SCENES)
    assert not set(scenes.ROOMS) & set(scenes.LARGE_SCENES)


def test_a_scene_is_of_bearable_size_and_its_arrays_fit(scene):
    mesh = scene.mesh
    assert 20_000 < len(mesh.faces) < 300_000
    assert mesh.faces.max() < len(mesh.vertices)
    assert set(np.unique(mesh.face_texture)) <= set(range(len(mesh.textures)))
    assert np.isfinite(mesh.uv).all()
    assert np.isfinite(mesh.irradiance).all()
    assert mesh.irradiance.min() >= 0.0
    assert len(set(mesh.labels)) == len(mesh.labels)


def test_every_ray_from_a_way_hits_the_front_of_something(scene):
    rng = np.random.default_rng(0)
    rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    corners = scene.mesh.vertices[scene.mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    directions = rng.standard_normal((6000, 3))
    eye = scene.sample_start(rng)[:3, 3]
    distance, face = rays.first_hit(np.broadcast_to(eye, directions.shape), directions)
    assert np.isfinite(distance).all(), "ground and sky, or the hall, are closed"
    assert (np.einsum("ij,ij->i", directions, normals[face]) < 0).mean() > 0.995


def test_start_poses_are_free_upright_and_see_things(scene):
    rng = np.random.default_rng(3)
    for _ in range(4):
        T = check_pose(scene.sample_start(rng))
        assert scene.clearance(T[None, :3, 3])[0] >= MIN_START_CLEARANCE_M
        assert 1.1 < T[2, 3] < 1.9
        assert T[2, 1] < -0.2
    again = [scene.sample_start(np.random.default_rng(5)) for _ in range(2)]
    np.testing.assert_array_equal(*again)


def test_places_and_lanes_lie_in_free_space(scene):
    points = np.array(list(scene.places.values()))
    assert scene.clearance(points + np.array([0.0, 0.0, 1.2])).min() > 0.4
    low, high = scene.bounds()
    for start, end in scene.lanes:
        along = np.linspace(0.0, 1.0, 30)[:, None]
        way = start + along * (end - start) + np.array([0.0, 0.0, 0.9])
        assert scene.clearance(way).min() > 0.6, "no parked car stands on a lane"
        assert ((way >= low) & (way <= high)).all()


def test_clearance_is_the_distance_to_the_nearest_surface(scene):
    points, _ = scene.surface_points(0.1)
    rng = np.random.default_rng(1)
    starts = [scene.sample_start(rng)[:3, 3] for _ in range(6)]
    for eye in np.array(starts) + rng.uniform(-0.3, 0.3, (6, 3)):
        brute = np.sqrt(((points - eye) ** 2).sum(1).min())
        assert abs(brute - scene.clearance(eye[None])[0]) < 0.15
    assert scene.clearance(np.array([[0.0, 0.0, 200.0]]))[0] == 0.0


@pytest.mark.parametrize("name", OUTDOORS)
def test_the_sky_is_no_surface_and_gives_no_reading(name):
    scene = large_scene(name)
    _, high = scene.bounds()
    assert high[2] < 40.0 < scene.mesh.vertices[:, 2].max()
    points, labels = scene.surface_points(0.3)
    assert points[:, 2].max() <= high[2] + 1e-3
    assert scene.mesh.labels.index(SKY) not in labels
    sensor = RGBDSensor(scene, xtion("80x60"), noise="range")
    up = np.eye(4)
    up[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ np.diag([1.0, -1.0, -1.0])  # looks along +z
    place = next(iter(scene.places.values()))
    up[:3, 3] = place + np.array([0.0, 0.0, 1.6])
    frame, truth = sensor.capture(up, 0), sensor.ground_truth(up)
    sky = truth.labels == scene.mesh.labels.index(SKY)
    assert sky.mean() > 0.3
    assert (frame.depth[sky] == 0).all()
    assert frame.color[sky].mean() > 100, "bright"
    blue, red = frame.color[sky][:, 2].mean(), frame.color[sky][:, 0].mean()
    assert blue > red


@pytest.mark.parametrize("name", OUTDOORS)
def test_the_sun_casts_shadows(name):
    mesh = large_scene(name).mesh
    road = mesh.irradiance[mesh.face_label == mesh.labels.index("road")].mean((1, 2))
    lit, shade = np.percentile(road, [98, 2])
    assert lit > 2.5 * shade > 0.0


def test_same_seed_same_hall_bit_for_bit():
    a, b = large_scene("factory_hall"), scenes.make("factory_hall", SEED)
    for field in ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance"):
        np.testing.assert_array_equal(getattr(a.mesh, field), getattr(b.mesh, field))
    np.testing.assert_array_equal(a.free_space.distance, b.free_space.distance)
    assert a.mesh.labels == b.mesh.labels
    assert a.exposure == b.exposure
    assert {k: v.tolist() for k, v in a.places.items()} == {
        k: v.tolist() for k, v in b.places.items()
    }


def test_open_ground_gets_the_light_of_the_whole_sky():
    """E / pi of a uniform sky of radiance L on open ground is L, on a wall half of it."""
    far = RayCaster(np.array([[0.0, 0, -5], [1, 0, -5], [0, 1, -5]]), np.array([[0, 1, 2]]))
    light = SkyLight((1.0, 0.5, 0.25), rays=4000)
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    got = light.irradiance(np.zeros((3, 3)), normals, far)
    np.testing.assert_allclose(got[0], [1.0, 0.5, 0.25], rtol=0.01)
    np.testing.assert_allclose(got[1], [0.5, 0.25, 0.125], rtol=0.02)
    np.testing.assert_array_equal(got[2], 0.0)


def test_streets_have_kerbs_and_lanes_keep_off_the_parked_side():
    plan = StreetPlan((0.0, 20.0), (0.0, 16.0), 5.0, 1.0, 8.0)
    assert plan.bounds == (-11.5, -11.5, 31.5, 27.5)
    np.testing.assert_array_equal(plan.crossing(1, 0), [20.0, 0.0, 0.0])
    (block,) = plan.blocks()
    assert (block.width_m, block.depth_m) == (13.0, 9.0)
    assert len(plan.lanes()) == 4
    for start, end in plan.lanes():
        assert abs(start - end).max() in (20.0, 16.0)
