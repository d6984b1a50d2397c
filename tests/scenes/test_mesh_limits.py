"""What a mesh file refers to, and the sizes it states, are checked before anything is allocated."""

from __future__ import annotations

import base64
import io
import os
import resource
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mesh_writers import (
    ROOM,
    TRIANGLES,
    glb,
    gltf,
    ply,
    textured_gltf,
    write_gltf,
    write_obj,
    write_png,
)
from PIL import Image

from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_files import read_surface
from ms_slam_env.scenes.mesh_file import load_soup
from ms_slam_env.scenes.mesh_formats import gltf as gltf_reader
from ms_slam_env.scenes.mesh_formats import part

SPARE_BYTES = 1_500_000_000

Read = Callable[[Path], object]
READS = pytest.mark.parametrize("read", [load_soup, lambda path: read_surface(path, 10)])


@pytest.fixture(autouse=True)
def _little_memory() -> Iterator[None]:
    """What asks for gigabytes fails at once."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + SPARE_BYTES, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def refused(read: Read, path: Path, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        read(path)
    assert "\n" not in str(error.value)
    assert path.name in str(error.value)


SPECIALS = ("pipe", "device", "folder", "away")


def put(path: Path, kind: str) -> None:
    """Something that is no regular file of the folder."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if kind == "device" else "/etc/passwd")


SAID = {
    "pipe": "not a regular file",
    "device": "outside of its folder",
    "folder": "not a regular file",
    "away": "outside of its folder",
}


@READS
@pytest.mark.parametrize("kind", SPECIALS)
@pytest.mark.filterwarnings("error::ms_slam_env.errors.InputWarning")
@pytest.mark.parametrize("what", ["library", "texture", "buffer", "image", "ply"])
def test_what_a_mesh_names_is_a_regular_file_of_its_folder(
    tmp_path: Path, read: Read, kind: str, what: str
) -> None:
    """Refused, or warned of in the same words where a mesh may lack it."""
    tree, buffer = gltf()
    if what in ("library", "texture"):
        path = write_obj(tmp_path, "map_Kd wood.png")
        if what == "library":
            (tmp_path / "room.mtl").unlink()
        put(tmp_path / ("room.mtl" if what == "library" else "wood.png"), kind)
    elif what == "buffer":
        path = write_gltf(tmp_path, tree, None)
        put(tmp_path / "room.bin", kind)
    elif what == "image":
        tree, buffer = textured_gltf()
        path = write_gltf(tmp_path, tree, buffer)
        put(tmp_path / "wood.png", kind)
    else:
        data = ply([*map(tuple, TRIANGLES.tolist())], "ascii", ("float", "uchar", "int"))
        data = data.replace(b"red", b"u").replace(b"green", b"v")
        path = tmp_path / "room.ply"
        path.write_bytes(data.replace(b"made by hand", b"TextureFile wood.png"))
        put(tmp_path / "wood.png", kind)
    refused(read, path, SAID[kind])


def bomb(side: int) -> bytes:
    """A PNG of ``side`` x ``side`` grey pixels, of few bytes."""
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(side + 1)) for _ in range(side)) + packer.flush()
    header = side.to_bytes(4, "big") * 2 + bytes([8, 0, 0, 0, 0])
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b"")):
        sum_of = zlib.crc32(kind + content).to_bytes(4, "big")
        data += len(content).to_bytes(4, "big") + kind + content + sum_of
    return data


@READS
def test_a_texture_is_bounded_before_it_is_decoded(tmp_path: Path, read: Read) -> None:
    path = write_obj(tmp_path, "map_Kd wood.png")
    (tmp_path / "wood.png").write_bytes(bomb(13300))
    refused(read, path, "13300x13300 pixels: more than 8192x8192")
    tree, buffer = textured_gltf()
    uri = "data:image/png;base64," + base64.b64encode(bomb(13300)).decode()
    tree["images"] = [{"uri": uri}]
    refused(read, write_gltf(tmp_path, tree, buffer), "13300x13300 pixels")


def test_textures_together_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part, "MAX_TEXELS", 3 * 64)
    lines = [*("v {:g} {:g} {:g}".format(*v) for v in ROOM), "vt 0 0", "mtllib room.mtl"]
    materials = []
    for k in range(4):
        write_png(tmp_path / f"{k}.png")
        materials += [f"newmtl m{k}", f"map_Kd {k}.png"]
        lines += [f"usemtl m{k}", "f 1/1 2/1 3/1"]
    (tmp_path / "room.obj").write_text("\n".join(lines))
    (tmp_path / "room.mtl").write_text("\n".join(materials[:6]))
    with pytest.warns(match="no material 'm3'"):
        load_soup(tmp_path / "room.obj")
    (tmp_path / "room.mtl").write_text("\n".join(materials))
    refused(load_soup, tmp_path / "room.obj", "textures have more than 192 pixels")


def test_an_image_of_many_parts_is_kept_once(tmp_path: Path) -> None:
    tree, buffer = textured_gltf()
    tree["nodes"] = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(1000)]
    tree["scenes"] = [{"nodes": list(range(1000))}]
    write_png(tmp_path / "wood.png", side=1024)
    soup = load_soup(write_gltf(tmp_path, tree, buffer))  # 3 GB if each had one
    assert len(soup.textures) == 1
    assert len(soup.corners) == 12_000


GLTF_CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "count": (lambda t: t["accessors"][1].update(count=2**29), "do not fit into the 96 bytes"),
    "count without data": (
        lambda t: (t["accessors"][1].update(count=2**29), t["accessors"][1].pop("bufferView")),
        "of 536870912 elements has no data",
    ),
    "sparse count": (
        lambda t: (
            t["accessors"][1].update(
                count=2**29,
                sparse={
                    "count": 1,
                    "indices": {"bufferView": 0, "componentType": 5123},
                    "values": {"bufferView": 1},
                },
            ),
            t["accessors"][1].pop("bufferView"),
        ),
        "of 536870912 elements has no data",
    ),
    "sparse indices": (
        lambda t: t["accessors"][1].update(
            sparse={
                "count": 2**30,
                "indices": {"bufferView": 0, "componentType": 5123},
                "values": {"bufferView": 1},
            }
        ),
        "1073741824 elements do not fit",
    ),
    "stride": (lambda t: t["bufferViews"][1].update(byteStride=1), "byteStride 1 is less"),
    "view": (lambda t: t["bufferViews"][1].update(byteLength=2**40), "beyond the 168 bytes"),
    "buffer": (lambda t: t["buffers"][0].update(byteLength=2**40), "168 bytes of 1099511627776"),
    "offset": (lambda t: t["accessors"][1].update(byteOffset=1), "do not fit"),
    "negative": (lambda t: t["accessors"][1].update(count=-8), "-8 is negative"),
    "fraction": (lambda t: t["accessors"][1].update(count=7.5), "7.5 is not a whole number"),
    "twice": (lambda t: t["scenes"][0].update(nodes=[0, 0]), "node 0 has two places"),
    "circle": (lambda t: t["nodes"][0].update(children=[0]), "node 0 has two places"),
    "places": (
        lambda t: t.update(nodes=[{"mesh": 0}] * 2000, scenes=[{"nodes": list(range(2000))}]),
        "it has [0-9]+ triangles, more than [0-9]{4,5}",
    ),
    "vertices": (lambda t: t["accessors"][1].update(count=7), "a vertex beyond the 7"),
}


@READS
@pytest.mark.parametrize("change", GLTF_CHANGES)
def test_sizes_that_a_gltf_states(
    tmp_path: Path, read: Read, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if change == "places":
        monkeypatch.setattr(gltf_reader, "_MOST_COPIES", 0)
    tree, buffer = gltf()
    alter, said = GLTF_CHANGES[change]
    alter(tree)
    refused(read, write_gltf(tmp_path, tree, buffer), said)
    if change not in ("buffer", "places"):
        (tmp_path / "room.glb").write_bytes(glb(tree, buffer))
        refused(read, tmp_path / "room.glb", said)


@READS
def test_a_gltf_names_one_file_many_times(tmp_path: Path, read: Read) -> None:
    """It is read once; many files are together as large as one may be."""
    tree, _ = gltf()
    size = 200_000_000
    with (tmp_path / "room.bin").open("wb") as file:
        file.truncate(size)
    tree["buffers"] = [{"byteLength": size, "uri": "room.bin"}] * 40
    tree["bufferViews"] = [{"buffer": k, "byteLength": 72} for k in range(40)]
    tree["accessors"] = [
        {"bufferView": k, "componentType": 5123, "count": 36, "type": "SCALAR"} for k in range(40)
    ]
    tree["accessors"].append({"bufferView": 0, "componentType": 5125, "count": 3, "type": "VEC3"})
    tree["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": 40}, "indices": k} for k in range(40)
    ]
    refused(read, write_gltf(tmp_path, tree, None), "has no triangles|without area")


def test_files_of_a_mesh_together_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(part, "MAX_MESH_BYTES", 150)
    folder = part.MeshFolder(tmp_path / "room.obj")
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(bytes(100))
    folder.read("a", "buffer", 1000)
    folder.read("A", "buffer", 1000)  # the same
    with pytest.raises(InputError, match="larger than"):
        folder.read("b", "buffer", 1000)


PLY_HEAD = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
PLY_HEAD += "property float z\nelement face {}\nproperty list {} int vertex_indices\nend_header\n"


@READS
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("vertices", "faces", "count", "said"),
    [
        (2**40, 1, "uchar", "element vertex ends beyond the file|within an element"),
        (3, 2**40, "uchar", "triangles, more than|ends beyond|within an element"),
        (3, 1, "uint", "within an element|more than"),
        (3, 1, "char", "within an element|a face refers to a vertex beyond|more than"),
    ],
)
def test_sizes_that_a_ply_states(
    tmp_path: Path, read: Read, form: str, vertices: int, faces: int, count: str, said: str
) -> None:
    path = tmp_path / "a.ply"
    data = b"0 0 0\n1 0 0\n0 1 0\n1e9 0 1 2\n" if form == "ascii" else bytes(36) + b"\xff" * 13
    path.write_bytes(PLY_HEAD.format(form, vertices, faces, count).encode() + data)
    refused(read, path, said)


@READS
def test_a_header_without_an_end(tmp_path: Path, read: Read) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply\n" + b"comment\n" * 1_000_000)
    refused(read, tmp_path / "a.ply", "no header of a PLY")


@READS
@pytest.mark.parametrize("suffix", [".zip", ".dae", ".3mf", ".3dxml", ".xaml", ".binvox", ".dict"])
def test_other_formats_are_not_opened(tmp_path: Path, read: Read, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.obj", b"v 0 0 0\n" * 1_000_000)
    refused(read, path, r"\.glb, \.gltf, \.obj, \.ply, \.stl, \.off")


@READS
@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_json_nested_too_deeply(tmp_path: Path, read: Read, suffix: str) -> None:
    text = b'{"asset": {}, "nodes": ' + b"[" * 200_000
    path = tmp_path / f"a.{suffix}"
    head = glb({}, b"")[:12] + len(text).to_bytes(4, "little") + b"JSON"
    path.write_bytes(text if suffix == "gltf" else head + text)
    refused(read, path, "not JSON")


@READS
def test_a_texture_that_is_no_image(tmp_path: Path, read: Read) -> None:
    """Nor is a program started, as Pillow does for PostScript."""
    path = write_obj(tmp_path, "map_Kd wood.png")
    for data in (b"", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", b"\x89PNG\r\n\x1a\n"):
        (tmp_path / "wood.png").write_bytes(data)
        refused(read, path, "texture .*wood.png: .*PNG, JPEG")


def test_a_grey_texture_of_16_bits(tmp_path: Path) -> None:
    path = write_obj(tmp_path, "map_Kd wood.png")
    Image.fromarray(np.full((4, 4), 0x8040, np.uint16)).save(tmp_path / "wood.png")
    np.testing.assert_array_equal(load_soup(path).textures[0], np.full((4, 4, 3), 0x80))


def test_the_tests_bomb_is_an_image() -> None:
    with Image.open(io.BytesIO(bomb(5)), formats=["PNG"]) as image:
        image.load()
        assert image.size == (5, 5)
