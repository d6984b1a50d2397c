"""What people's exporters write is read as they mean it, or named."""

from __future__ import annotations

import json
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_writers import (
    AREA,
    COLOURS,
    QUADS,
    ROOM,
    TRIANGLES,
    area_of,
    glb,
    gltf,
    ply,
    textured_gltf,
    write_gltf,
    write_obj,
    write_png,
)

from ms_slam_env import scenes
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.evaluation.map_files import read_surface
from ms_slam_env.scenes.mesh_file import Soup, load_soup

RED = (200, 10, 20)


def colour_at(soup: Soup, place: np.ndarray) -> np.ndarray:
    """Colour (3,) of the first corner at a place (3,)."""
    where = np.argwhere(np.linalg.norm(soup.corners - place, axis=2) < 1e-6)[0]
    image = soup.textures[soup.texture[where[0]]]
    u, v = soup.uv[tuple(where)] % 1.0
    return image[int(v * image.shape[0]), int(u * image.shape[1])]


def check_room(soup: Soup) -> None:
    points = soup.corners.reshape(-1, 3)
    np.testing.assert_allclose(points.min(0), [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(points.max(0), [6, 4, 2.5], atol=1e-6)
    assert area_of(soup.corners) == pytest.approx(AREA)


@pytest.mark.parametrize(
    ("line", "file"),
    [
        ("map_Kd wood.png", "wood.png"),
        ("map_Kd -s 2 2 1 -o 0 0 0 -clamp on wood.png", "wood.png"),
        ("map_Kd -s 2 -mm 0 1 my wood.png", "my wood.png"),
        ("map_Kd my wood.png", "my wood.png"),
        ("map_Kd textures\\wood.png", "textures/wood.png"),
        ("map_Kd C:\\Users\\me\\wood.png", "wood.png"),
        ("map_Kd /home/me/wood.png", "wood.png"),
        ("map_Kd Textures/Wood.PNG", "textures/wood.png"),
        ('map_Kd "wood.png"', "wood.png"),
        ("map_kd\twood.png  ", "wood.png"),
    ],
)
@pytest.mark.filterwarnings("error::ms_slam_env.errors.InputWarning")
def test_a_texture_is_found(tmp_path: Path, line: str, file: str) -> None:
    write_png(tmp_path / file, RED)
    soup = load_soup(write_obj(tmp_path, line))
    check_room(soup)
    np.testing.assert_array_equal(soup.textures[0], np.full((8, 8, 3), RED))


def test_a_texture_is_scaled_then_moved(tmp_path: Path) -> None:
    write_png(tmp_path / "wood.png")
    soup = load_soup(write_obj(tmp_path, "map_Kd -s 2 3 1 -o 0.25 wood.png", uv="0.1 0.2"))
    np.testing.assert_allclose(soup.uv, np.broadcast_to([0.45, 0.4], soup.uv.shape))  # v from top


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.warns(
        InputWarning, match=r"room\.obj names 'wood\.png', which is not in its folder"
    ):
        soup = load_soup(write_obj(tmp_path, "map_Kd wood.png"))
    np.testing.assert_array_equal(soup.textures[0][0, 0], [127, 127, 127])  # its Kd
    write_png(tmp_path / "wood.png")
    (tmp_path / "inner").mkdir()
    path = write_obj(tmp_path / "inner", "map_Kd ../wood.png")
    with pytest.warns(InputWarning, match=r"'\.\./wood\.png', which lies outside of its folder"):
        load_soup(path)
    (tmp_path / "inner" / "room.mtl").unlink()
    with pytest.warns(InputWarning, match=r"'room\.mtl', which is not in its folder"):
        load_soup(path)
    write_obj(tmp_path, "map_Kd wood.png")
    (tmp_path / "room.mtl").write_text("newmtl floor\nKd 1 0 0\n")
    with pytest.warns(InputWarning, match="no material 'wall' is found"):
        load_soup(tmp_path / "room.obj")


@pytest.mark.parametrize("library", ["room.mtl", "ROOM.MTL", "room.mtl other.mtl", "my room.mtl"])
def test_a_library_is_found(tmp_path: Path, library: str) -> None:
    write_png(tmp_path / "wood.png", RED)
    path = write_obj(tmp_path, "map_Kd wood.png", library)
    (tmp_path / "other.mtl").write_text("newmtl other\n")
    (tmp_path / "my room.mtl").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "room.mtl").read_bytes())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_soup(path).textures[0].shape == (8, 8, 3)


def test_an_obj_as_long_as_its_format(tmp_path: Path) -> None:
    """A byte order mark, faces counted back in the midst, mixed corners, lines that go on."""
    lines = [
        "o near",
        *("v {} {} {}".format(*v) for v in ROOM[:4]),
        "vt 0 0",
        "f -4 -3 \\",
        "-1 -2",
    ]
    lines += ["o far", *("v\t{} {} {} 1.0".format(*v) for v in ROOM[4:]), "f -4//1 -2//1 -1 6/1 "]
    lines += ["f -4/1 -2 8//"]
    (tmp_path / "a.obj").write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    corners = load_soup(tmp_path / "a.obj").corners
    assert area_of(corners[:2]) == pytest.approx(24)
    np.testing.assert_allclose(corners[0], ROOM[[0, 1, 3]])
    np.testing.assert_allclose(corners[2], ROOM[[4, 6, 7]])
    np.testing.assert_allclose(corners[4], ROOM[[4, 6, 7]])


def test_an_obj_with_colours_of_corners_beside_a_plain_material(tmp_path: Path) -> None:
    lines = ["mtllib room.mtl", "usemtl wall"]
    lines += [f"v {x} {y} {z} {r / 255} {g / 255} {b / 255}"
              for (x, y, z), (r, g, b) in zip(ROOM, COLOURS, strict=True)]  # fmt: skip
    lines += ["f " + " ".join(str(i + 1) for i in quad) for quad in QUADS]
    (tmp_path / "room.obj").write_text("\n".join(lines))
    (tmp_path / "room.mtl").write_text("newmtl wall\nKd 1 1 1\n")
    soup = load_soup(tmp_path / "room.obj")
    check_room(soup)
    for place, colour in zip(ROOM, COLOURS, strict=True):
        np.testing.assert_array_equal(colour_at(soup, place), colour)


_MIXED = [*QUADS[:4], (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
_BINARY, _BIG = "binary_little_endian", "binary_big_endian"


@pytest.mark.parametrize("faces", [QUADS, _MIXED, [tuple(t) for t in TRIANGLES.tolist()]])
@pytest.mark.parametrize("form", ["ascii", _BINARY, _BIG])
@pytest.mark.parametrize("kinds", [("float", "uchar", "int"), ("double", "uint8", "uint")])
def test_a_ply(tmp_path: Path, faces: list, form: str, kinds: tuple[str, str, str]) -> None:
    for head in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "room.ply").write_bytes(head + ply(faces, form, kinds))
        soup = load_soup(tmp_path / "room.ply")
        check_room(soup)
        for place, colour in zip(ROOM, COLOURS, strict=True):
            np.testing.assert_array_equal(colour_at(soup, place), colour)
        assert read_surface(tmp_path / "room.ply", 10).kind == "mesh"


def test_a_ply_with_a_colour_a_face_and_polygons(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 2\nproperty list uchar int vertex_index\n"
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    rows = "0 0 0\n2 0 0\n2 2 0\n1 3 0\n0 2 0\n5 0 1 2 3 4 1 0 0\n3 0 1 2 0 9 250\n"
    (tmp_path / "a.ply").write_text(header + rows)
    soup = load_soup(tmp_path / "a.ply")
    assert area_of(soup.corners) == pytest.approx(5 + 2)
    colours = [soup.textures[0][tuple((c[0] * soup.textures[0].shape[0]).astype(int))[::-1]]
               for c in soup.uv]  # fmt: skip
    np.testing.assert_array_equal(
        colours, [[1, 0, 0]] * 3 + [[0, 9, 250]]
    )  # bytes, though all <= 1


def test_a_ply_with_textures_of_faces(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\ncomment TextureFile a b.png\ncomment TextureFile c.png\n"
    header += "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 2\nproperty list uchar int vertex_indices\n"
    header += "property list uchar float texcoord\nproperty int texnumber\nend_header\n"
    rows = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 0.5 0 0 0.25 1\n3 2 1 0 6 0 0 0 0 0 0 0\n"
    (tmp_path / "a.ply").write_text(header + rows)
    write_png(tmp_path / "c.png", RED)
    with pytest.warns(InputWarning, match=r"names 'a b\.png', which is not in its folder"):
        soup = load_soup(tmp_path / "a.ply")
    np.testing.assert_allclose(soup.corners[1], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(soup.uv[1], [[0, 1], [0.5, 1], [0, 0.75]])  # v from the top
    np.testing.assert_array_equal(soup.textures[soup.texture[1]][0, 0], RED)


def test_triangle_strips_of_a_ply_are_named(tmp_path: Path) -> None:
    text = ply(QUADS, "ascii", ("float", "uchar", "int")).replace(
        b"element face", b"element tristrips"
    )
    (tmp_path / "a.ply").write_bytes(text)
    for read in (load_soup, lambda path: read_surface(path, 10)):
        with pytest.raises(InputError, match="element tristrips is not read"):
            read(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "off"])
def test_other_formats(tmp_path: Path, kind: str) -> None:
    mesh = trimesh.Trimesh(ROOM, TRIANGLES, process=False)
    path = tmp_path / f"room.{kind[:3]}"
    mesh.export(path, file_type=kind)
    check_room(load_soup(path))


def test_what_is_not_read_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(
        "COFF\n3 1 0\n0 0 0 9 9 9 255\n1 0 0 0 0 0 0\n0 1 0 0 0 0 0\n3 0 1 2\n"
    )
    with pytest.warns(InputWarning, match=r"a\.off': its colours are not read"):
        load_soup(tmp_path / "a.off")
    data = ply(QUADS, "ascii", ("float", "uchar", "int"))
    (tmp_path / "a.ply").write_bytes(data.replace(b"made by hand", b"TextureFile wood.png"))
    with pytest.warns(InputWarning, match=r"'wood\.png' is not read, for there are no texture coo"):
        load_soup(tmp_path / "a.ply")
    tree, buffer = textured_gltf()
    tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 1
    write_png(tmp_path / "wood.png")
    with pytest.warns(InputWarning, match="room has a texture: its colours of corners are not"):
        load_soup(write_gltf(tmp_path, tree, buffer))


def test_colours_of_16_bits_of_a_ply(tmp_path: Path) -> None:
    data = ply(QUADS, "ascii", ("float", "uchar", "int")).replace(
        b"property uchar", b"property ushort"
    )
    (tmp_path / "a.ply").write_bytes(data.replace(b"255", b"65535").replace(b"250", b"64250"))
    soup = load_soup(tmp_path / "a.ply")
    np.testing.assert_array_equal(colour_at(soup, ROOM[0]), [255, 0, 0])
    np.testing.assert_array_equal(colour_at(soup, ROOM[7]), [250, 250, 250])


def test_gltf_is_y_up_unless_said_otherwise(tmp_path: Path) -> None:
    path = write_gltf(tmp_path, *gltf())
    check_room(load_soup(path))
    (tmp_path / "room.glb").write_bytes(glb(*gltf()))
    check_room(load_soup(tmp_path / "room.glb"))
    turned = load_soup(f"{path},up=z").corners
    np.testing.assert_allclose(np.ptp(turned.reshape(-1, 3), axis=0), [6, 2.5, 4])
    with pytest.raises(InputError, match=r"MeshOptions\.up 'x'; valid choices: format, y, z"):
        load_soup(f"{path},up=x")
    with pytest.raises(InputError, match="unknown"):
        scenes.make(f"{path},upp=y")
    points = read_surface(Path(f"{path},scale=0.1"), 1000).points
    np.testing.assert_allclose(points.max(0), [0.6, 0.4, 0.25], atol=0.01)


def test_other_formats_are_z_up_unless_said_otherwise(tmp_path: Path) -> None:
    trimesh.Trimesh(ROOM[:, [0, 2, 1]] * (1, 1, -1), TRIANGLES).export(tmp_path / "room.ply")
    check_room(load_soup(f"{tmp_path}/room.ply,up=y"))


def test_a_name_may_have_commas(tmp_path: Path) -> None:
    trimesh.Trimesh(ROOM, TRIANGLES).export(tmp_path / "a,up=y.ply")
    check_room(load_soup(tmp_path / "a,up=y.ply"))
    scenes.registry.check_name(str(tmp_path / "a,up=y.ply"))


@pytest.mark.parametrize("scale", [40, 100, 1000, 1e5])
def test_a_mesh_in_another_unit_is_refused_with_its_extent(tmp_path: Path, scale: float) -> None:
    trimesh.Trimesh(ROOM * scale, TRIANGLES).export(tmp_path / "room.ply")
    extent = "{:.4g} x {:.4g} x {:.4g} m".format(*(scale * np.array([6, 4, 2.5])))
    said = r"reaches farther than 10000 m" if scale > 1e4 else extent
    with pytest.raises(InputError, match=said + ".*scale=0.01' for centimetres"):
        scenes.make(tmp_path / "room.ply")
    check_room(load_soup(f"{tmp_path}/room.ply,scale={1 / scale!r}"))


@pytest.mark.parametrize(
    ("extension", "said"),
    [
        ("KHR_draco_mesh_compression", "meshes are compressed with Draco; export the file without"),
        ("EXT_meshopt_compression", "meshes are compressed with meshopt"),
        ("KHR_texture_basisu", r"textures are compressed \(KTX2"),
        ("EXT_unheard_of", "EXT_unheard_of: it is not supported; export"),
    ],
)
def test_a_gltf_that_needs_more_says_so(tmp_path: Path, extension: str, said: str) -> None:
    path = write_gltf(tmp_path, *gltf(extensionsRequired=[extension], extensionsUsed=[extension]))
    for read in (load_soup, lambda name: read_surface(name, 10)):
        with pytest.raises(InputError, match=said):
            read(path)


def test_a_gltf_whose_data_is_only_compressed(tmp_path: Path) -> None:
    tree, buffer = gltf()
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    with pytest.raises(InputError, match=r"has no data$"):
        load_soup(write_gltf(tmp_path, tree, buffer))
    tree["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    with pytest.raises(InputError, match=r"has no data: its meshes are compressed with Draco$"):
        load_soup(write_gltf(tmp_path, tree, buffer))


def test_whole_numbers_of_a_gltf_that_stand_for_fractions(tmp_path: Path) -> None:
    tree, buffer = gltf(extensionsRequired=["KHR_mesh_quantization"])
    places = np.rint(ROOM[:, [0, 2, 1]] / 6 * (1, 1, -1) * 32767).astype("<i2")
    padded = np.concatenate([places, np.zeros((8, 1), "<i2")], 1)  # rows of 8 bytes
    uv = np.array([[0, 65535]] * 8, "<u2")
    tree["bufferViews"] = [
        {"buffer": 0, "byteLength": 72},
        {"buffer": 0, "byteOffset": 72, "byteLength": 64, "byteStride": 8},
        {"buffer": 0, "byteOffset": 136, "byteLength": 32},
    ]
    tree["accessors"][1] |= {"componentType": 5122, "normalized": True}
    tree["accessors"] += [
        {"bufferView": 2, "componentType": 5123, "count": 8, "type": "VEC2", "normalized": True}
    ]
    tree["nodes"] = [{"mesh": 0, "scale": [6, 6, 6]}]
    tree["meshes"][0]["primitives"][0] |= {"material": 0}
    tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["textures"], tree["images"] = [{"source": 0}], [{"uri": "my%20wood.png"}]
    tree["buffers"][0]["byteLength"] = 168
    write_png(tmp_path / "my wood.png", RED)
    data = buffer[:72] + padded.tobytes() + uv.tobytes()
    soup = load_soup(write_gltf(tmp_path, tree, data))
    np.testing.assert_allclose(soup.corners.reshape(-1, 3).max(0), [6, 4, 2.5], atol=1e-3)
    np.testing.assert_allclose(soup.uv, np.broadcast_to([0.0, 1.0], soup.uv.shape))
    np.testing.assert_array_equal(soup.textures[0], np.full((8, 8, 3), RED))


def test_a_gltf_with_colours_of_corners_beside_a_material(tmp_path: Path) -> None:
    """COLOR_0 is linear light, and multiplied by the material's colour."""
    tree, buffer = gltf()
    linear = np.linspace(0, 1, 24).reshape(8, 3).astype("<f4")
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": 96})
    tree["accessors"].append({"bufferView": 2, "componentType": 5126, "count": 8, "type": "VEC3"})
    tree["buffers"][0]["byteLength"] = len(buffer) + 96
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["attributes"]["COLOR_0"], primitive["material"] = 2, 0
    tree["materials"] = [{"name": "as exporters give it", "pbrMetallicRoughness": {}}]
    soup = load_soup(write_gltf(tmp_path, tree, buffer + linear.tobytes()))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    for place, colour in zip(ROOM, 255 * srgb, strict=True):
        np.testing.assert_allclose(colour_at(soup, place), colour, atol=0.51)


def test_texture_coordinates_of_a_gltf_are_scaled_turned_and_moved(tmp_path: Path) -> None:
    tree, buffer = textured_gltf()
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": 64})
    tree["accessors"].append({"bufferView": 2, "componentType": 5126, "count": 8, "type": "VEC2"})
    tree["buffers"][0]["byteLength"] = len(buffer) + 64
    tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = 3
    texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    change = {"scale": [2, 1], "rotation": np.pi / 2, "offset": [0.1, 0.2], "texCoord": 1}
    texture["extensions"] = {"KHR_texture_transform": change}
    write_png(tmp_path / "wood.png")
    uv = np.tile([0.25, 0.5], (8, 1)).astype("<f4").tobytes()
    soup = load_soup(write_gltf(tmp_path, tree, buffer + uv))
    # As the Khronos viewer has it: u' = cos 2u + sin v, v' = -sin 2u + cos v, then the offset.
    np.testing.assert_allclose(soup.uv, np.broadcast_to([0.6, -0.3], soup.uv.shape), atol=1e-6)


def test_a_sparse_accessor_of_a_gltf(tmp_path: Path) -> None:
    tree, buffer = gltf()
    buffer += struct.pack("<2H", 0, 1) + np.array([[1, 0, 0], [5, 0, 0]], "<f4").tobytes()
    tree["bufferViews"] += [
        {"buffer": 0, "byteOffset": len(buffer) - 28, "byteLength": 4},
        {"buffer": 0, "byteOffset": len(buffer) - 24, "byteLength": 24},
    ]
    tree["buffers"][0]["byteLength"] = len(buffer)
    tree["accessors"][1]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": 2, "componentType": 5123},
        "values": {"bufferView": 3},
    }
    corners = load_soup(write_gltf(tmp_path, tree, buffer)).corners
    np.testing.assert_allclose(corners[0], [[1, 0, 0], [5, 0, 0], [6, 4, 0]], atol=1e-6)


def test_placed_mirrored_and_in_strips(tmp_path: Path) -> None:
    tree, buffer = gltf()
    tree["nodes"] = [
        {"children": [1, 2], "translation": [0, 0, -10]},
        {"mesh": 0, "rotation": [0, 0.5**0.5, 0, 0.5**0.5]},
        {"mesh": 0, "scale": [-1, 1, 1]},
    ]
    corners = load_soup(write_gltf(tmp_path, tree, buffer)).corners
    assert area_of(corners) == pytest.approx(2 * AREA)
    mirrored, turned = corners[:12], corners[12:]  # the last child first
    np.testing.assert_allclose(mirrored.min((0, 1)), [-6, 10, 0], atol=1e-5)
    np.testing.assert_allclose(turned.min((0, 1)), [-4, 10, 0], atol=1e-5)  # y up: turned about it
    for part in (mirrored, turned):  # all still look outwards
        outwards = part.mean(1) - part.mean((0, 1))
        normal = np.cross(part[:, 1] - part[:, 0], part[:, 2] - part[:, 0])
        signs = np.sign((outwards * normal).sum(1))
        assert (signs == signs[0]).all()
    tree["meshes"][0]["primitives"][0]["mode"] = 5
    tree["accessors"][0]["count"] = 4
    tree["nodes"] = [{"mesh": 0}]
    strip = np.array([0, 1, 2, 3], "<u2").tobytes()
    corners = load_soup(write_gltf(tmp_path, tree, strip + buffer[8:])).corners
    np.testing.assert_allclose(corners, [ROOM[[0, 1, 2]], ROOM[[3, 2, 1]]], atol=1e-6)


def test_a_missing_texture_of_a_gltf_is_named(tmp_path: Path) -> None:
    tree, buffer = textured_gltf()
    with pytest.warns(InputWarning, match=r"names 'wood\.png', which is not in its folder"):
        load_soup(write_gltf(tmp_path, tree, buffer))
    tree["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    with pytest.warns(InputWarning, match="texture 0 has no PNG, JPEG or WebP"):
        load_soup(write_gltf(tmp_path, tree, buffer))


def test_a_gltf_of_another_version(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "1.0"}, "meshes": {}}))
    with pytest.raises(InputError, match=r"glTF 1\.0; version 2 is read"):
        load_soup(tmp_path / "a.gltf")


def test_a_scene_of_a_mesh_with_options_is_picklable_and_named(tmp_path: Path) -> None:
    import pickle

    (tmp_path / "room.glb").write_bytes(glb(*gltf()))
    scene = scenes.make(f"{tmp_path}/room.glb,scale=0.5")
    again = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(scene.bounds(), again.bounds())
    np.testing.assert_allclose(scene.bounds()[1], [3, 2, 1.25], atol=1e-6)
    assert scene.name.endswith("room.glb,scale=0.5")
