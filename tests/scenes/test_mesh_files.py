from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from ms_slam_env import scenes
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_files import read_surface
from ms_slam_env.scenes import mesh_scene
from ms_slam_env.scenes.free_space import FreeSpace, Holding
from ms_slam_env.scenes.mesh_file import load_soup, split_long_edges
from ms_slam_env.scenes.mesh_queries import sample_surface

_HOUSE = Path(__file__).parents[3] / "shared" / "data" / "small_house.glb"


def _room(size=(3.0, 2.4, 2.0)) -> trimesh.Trimesh:
    """A closed room seen from inside, with a block on the floor."""
    shell = trimesh.creation.box(extents=size)
    shell.apply_translation(np.array(size) / 2)
    shell.invert()
    block = trimesh.creation.box(extents=(0.6, 0.6, 0.6))
    block.apply_translation([1.5, 1.2, 0.31])
    return trimesh.util.concatenate([shell, block])


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_a_vertex_coloured_room_becomes_a_scene(tmp_path, suffix, monkeypatch):
    mesh = _room()
    colours = np.full((len(mesh.vertices), 4), 255, np.uint8)
    colours[:, :3] = np.random.default_rng(0).integers(40, 255, (len(mesh.vertices), 3))
    mesh.visual.vertex_colors = colours
    path = tmp_path / f"room{suffix}"
    mesh.export(path)
    scene = scenes.make(f"{path},up=z")
    with monkeypatch.context() as patch:
        patch.setattr(mesh_scene, "_MOST_OPEN_POINTS", 5000)
        assert 2000 < len(scene.surface_points(1e-6)[0]) <= 5000  # not 10^13
    clearance = scene.clearance(np.array([[0.6, 0.6, 1.2], [1.5, 1.2, 0.3], [4.0, 1, 1]]))
    assert clearance[0] == pytest.approx(0.6, abs=0.05)
    np.testing.assert_array_equal(clearance[1:], 0.0)
    points, labels = scene.surface_points(0.05)
    assert len(points) == len(labels)
    area = 2 * (3 * 2.4 + 3 * 2 + 2.4 * 2) + 5 * 0.36
    assert len(points) == pytest.approx(area / 0.05**2, rel=0.05)
    assert scene.clearance(scene.sample_start(np.random.default_rng(0))[None, :3, 3])[0] >= 0.25
    assert scene.mesh.irradiance.max() > 0.05


def test_corner_colours_survive_the_atlas(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    colours = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]], np.uint8)
    mesh.visual.vertex_colors = colours
    mesh.export(tmp_path / "triangle.ply")
    soup = load_soup(tmp_path / "triangle.ply")
    image = soup.textures[0]
    h, w = image.shape[:2]
    for corner in range(3):
        u, v = soup.uv[0, corner]
        texel = image[int(v * h), int(u * w)]
        where = np.argmin(np.linalg.norm(mesh.vertices - soup.corners[0, corner], axis=1))
        np.testing.assert_array_equal(texel, colours[where, :3])


def test_a_textured_material_keeps_image_and_orientation(tmp_path):
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:4] = (250, 10, 10)  # the image's upper half
    pixels[4:] = (10, 10, 250)
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels))
    visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / "quad.glb")
    soup = load_soup(f"{tmp_path}/quad.glb,up=z")
    # The writer's v = 1 is the image's top row; it lies at y = 1 of the quad.
    top = soup.corners[..., 1] > 0.5
    assert (soup.uv[top][:, 1] < 0.5).all()
    assert (soup.uv[~top][:, 1] > 0.5).all()
    np.testing.assert_array_equal(soup.textures[0], pixels)


def test_a_single_colour_material(tmp_path):
    mesh = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 100, 50, 255])
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    mesh.export(tmp_path / "box.glb")
    soup = load_soup(tmp_path / "box.glb")
    # The file's factor is linear light: 200 / 255 is 0.784 linear, 0.897 sRGB, and so on.
    linear = np.array([200, 100, 50]) / 255
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(soup.textures[0][0, 0], expected, atol=1)


def test_splitting_keeps_area_and_shortens_edges(tmp_path):
    mesh = _room()
    mesh.export(tmp_path / "room.ply")
    before = load_soup(tmp_path / "room.ply")
    after = split_long_edges(before, 0.4)
    edges = np.linalg.norm(after.corners[:, [1, 2, 0]] - after.corners, axis=2)
    assert edges.max() <= 0.4
    area = [
        np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1).sum() / 2
        for c in (before.corners, after.corners)
    ]
    assert area[1] == pytest.approx(area[0])


def test_flood_fill_stops_at_closed_doors():
    two_rooms = trimesh.util.concatenate(
        [_room((2.0, 2.4, 2.0)), _room((2.0, 2.4, 2.0)).apply_translation([2.2, 0, 0])]
    )
    points, _ = sample_surface(two_rooms.vertices, two_rooms.faces, 0.02)
    free = FreeSpace(points, Holding(np.array([[0.5, 0.5, 1.5]])))
    found = free.clearance(np.array([[0.5, 0.5, 1.5], [2.7, 0.5, 1.5], [0.5, 0.5, 3.0]]))
    assert found[0] > 0.4
    np.testing.assert_array_equal(found[1:], 0.0)


def test_samples_are_spread_by_area():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2.0], [3, 0, 2], [0, 1, 2]])
    points, face = sample_surface(vertices, np.array([[0, 1, 2], [3, 4, 5]]), 0.01)
    assert len(points) == 20000
    assert (face == 0).sum() == pytest.approx(5000, abs=1)
    first = points[face == 0]
    assert (first[:, 0] + first[:, 1] <= 1 + 1e-9).all()
    np.testing.assert_allclose(first.mean(0), [1 / 3, 1 / 3, 0], atol=0.01)


@pytest.mark.skipif(not _HOUSE.exists(), reason="../shared/data/small_house.glb is not there")
def test_small_house_is_read():
    soup = load_soup(f"{_HOUSE},up=z")
    assert len(soup.corners) > 140_000
    extent = np.ptp(soup.corners.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(extent[:2], [19, 11.4], atol=0.6)


def _single_line(error: pytest.ExceptionInfo) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


def test_an_unknown_name_lists_the_scenes_and_mentions_mesh_files():
    with pytest.raises(InputError) as error:
        scenes.make("no-such-scene")
    message = _single_line(error)
    assert all(name in message for name in scenes.SCENES)
    assert ".glb" in message


@pytest.mark.parametrize("seed", [-1, 1.5, "0", True])
def test_a_bad_seed_is_refused(seed):
    with pytest.raises(InputError, match="seed"):
        scenes.make("wall", seed)


def test_bad_mesh_files_are_refused_in_one_line(tmp_path):
    (tmp_path / "broken.glb").write_bytes(b"this is not a mesh")
    (tmp_path / "empty.obj").write_text("# nothing\n")
    trimesh.PointCloud(np.random.default_rng(0).random((10, 3))).export(tmp_path / "cloud.ply")
    for name, said in (
        ("missing.glb", "does not exist"),
        ("broken.glb", "cannot be read"),
        ("cloud.ply", "no triangles"),
        ("empty.obj", ""),
    ):
        with pytest.raises(InputError, match=said) as error:
            scenes.make(tmp_path / name)
        _single_line(error)


@pytest.mark.parametrize("read", [load_soup, lambda path: read_surface(path, 10)])
def test_what_is_no_mesh_inside_a_mesh_file_is_refused(tmp_path, read):
    """trimesh takes faces of vertices that are not there, and vertices of one number."""
    data = trimesh.creation.box().export(file_type="ply")
    first_face = data.index(b"end_header") + len(b"end_header\n") + 8 * 12 + 1
    for vertex in (2**30, 8, -1):
        there = vertex.to_bytes(4, "little", signed=True)
        (tmp_path / "a.ply").write_bytes(data[:first_face] + there + data[first_face + 4 :])
        said = r"a face refers to a vertex beyond the 8 of|is out of bounds"
        with pytest.raises(InputError, match=said):
            read(tmp_path / "a.ply")
    (tmp_path / "b.obj").write_text("v -1.0000")
    with pytest.raises(InputError, match=r"b\.obj"):
        read(tmp_path / "b.obj")
