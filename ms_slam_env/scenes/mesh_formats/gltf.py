"""Reads glTF 2.0, text or binary: geometry and appearance, without animations.

Sizes in the file are compared with the available bytes before anything is allocated.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import replace
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.lighting import linear_to_srgb
from ms_slam_env.scenes.mesh_formats.part import Image, MeshFolder, Part, check_size, text_of

_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_COPIES = 2_000_000  # most triangles placed by instancing beyond those stored
_TRIANGLES, _STRIP, _FAN, _POINTS = 4, 5, 6, 0

_PLAIN = ("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp")
_HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_node_visibility")
_COMPRESSED = {
    "KHR_draco_mesh_compression": "its meshes are compressed with Draco",
    "EXT_meshopt_compression": "its meshes are compressed with meshopt",
    "KHR_meshopt_compression": "its meshes are compressed with meshopt",
    "KHR_texture_basisu": "its textures are compressed (KTX2, Basis Universal)",
}
_GEOMETRY = ("EXT_mesh_gpu_instancing",)  # places meshes although a file need not require it


def read_gltf(data: bytes, folder: MeshFolder) -> list[Part]:
    """Read the parts of a file in metres, with y up as in glTF.

    Raises:
        InputError: the file needs unsupported features, or lacks data.
    """
    text, binary = _chunks(data) if data.startswith(_MAGIC) else (data, None)
    try:
        tree = json.loads(text_of(text))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {error}") from None
    if not isinstance(tree, dict) or "asset" not in tree:
        raise InputError("not a glTF")
    version = str(tree["asset"].get("version", "2.0"))
    if not version.startswith("2."):
        raise InputError(f"glTF {version}; version 2 is read")
    _check_extensions(tree)
    return _Reader(tree, binary, folder, len(data)).parts()


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Split a GLB into its JSON and binary chunk."""
    found: list[bytes] = []
    place = 12
    for kind in (_JSON, _BIN):
        size = int.from_bytes(data[place : place + 4], "little")
        if data[place + 4 : place + 8] != kind:
            break
        chunk = data[place + 8 : place + 8 + size]
        if len(chunk) < size:
            raise InputError(f"a chunk has {len(chunk)} bytes of {size}")
        found.append(chunk)
        place += 8 + size
    if not found:
        raise InputError("a GLB without JSON")
    return found[0], found[1] if len(found) > 1 else None


def _check_extensions(tree: dict[str, Any]) -> None:
    needed = [*tree.get("extensionsRequired", ())]
    needed += [name for name in tree.get("extensionsUsed", ()) if name in _GEOMETRY]
    for name in needed:
        if name in _PLAIN or str(name).startswith(_HARMLESS):
            continue
        what = _COMPRESSED.get(name, "it is not supported")
        raise InputError(f"it needs {name}: {what}; export the file without, as Blender does")


def _whole(value: Any, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != int(value):
        raise InputError(f"{what} {value!r} is not a whole number")
    if value < 0:
        raise InputError(f"{what} {value!r} is negative")
    return int(value)


class _Reader:
    """Reads one file."""

    def __init__(
        self, tree: dict[str, Any], binary: bytes | None, folder: MeshFolder, size: int
    ) -> None:
        self._tree = tree
        self._binary = binary
        self._folder = folder
        self._size = size
        self._buffers: dict[int, bytes] = {}
        self._positions: dict[int, Float64] = {}

    def parts(self) -> list[Part]:
        """All meshes of the scene, placed by its nodes."""
        nodes = self._tree.get("nodes", [])
        scenes = self._tree.get("scenes")
        if scenes is None:
            children = {child for node in nodes for child in node.get("children", ())}
            roots = [index for index in range(len(nodes)) if index not in children]
        else:
            roots = scenes[_whole(self._tree.get("scene", 0), "scene")].get("nodes", [])
        found: list[Part] = []
        seen: set[int] = set()
        meshes: dict[int, list[Part]] = {}
        triangles = vertices = 0
        waiting = [(root, np.eye(4)) for root in roots]
        while waiting:
            index, T_scene_parent = waiting.pop()
            if index in seen:
                raise InputError(f"node {index} has two places")
            seen.add(index)
            node = self._get("nodes", index)
            T_scene_node = T_scene_parent @ _transform(node)
            waiting += [(child, T_scene_node) for child in node.get("children", ())]
            if "mesh" not in node:
                continue
            mesh = _whole(node["mesh"], "mesh")
            if mesh not in meshes:
                meshes[mesh] = self._mesh(mesh)
            moved: dict[int, Float64] = {}  # primitives of a mesh share vertices
            for part in meshes[mesh]:
                if id(part.vertices) not in moved:
                    vertices += len(part.vertices)
                    check_size(vertices // 3)
                    moved[id(part.vertices)] = _moved(part.vertices, T_scene_node)
                triangles += len(part.faces)
                check_size(triangles, _MOST_COPIES + self._stored() // 3)
                found.append(_placed(part, moved[id(part.vertices)], T_scene_node))
        return found

    def _stored(self) -> int:
        """Number of bytes read; a triangle has at least three."""
        return self._size + sum(map(len, self._buffers.values()))

    def _get(self, kind: str, index: Any) -> dict[str, Any]:
        items = self._tree.get(kind, [])
        if _whole(index, kind) >= len(items):
            raise InputError(f"{kind}: there is no {index}, only {len(items)}")
        item: dict[str, Any] = items[index]
        return item

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            entry = self._get("buffers", index)
            data = self._bytes(entry["uri"]) if "uri" in entry else self._binary
            size = _whole(entry["byteLength"], "byteLength")
            if data is None or len(data) < size:
                held = 0 if data is None else len(data)
                raise InputError(f"buffer {index} has {held} bytes of {size}")
            self._buffers[index] = data[:size]
        return self._buffers[index]

    def _bytes(self, uri: str) -> bytes:
        if not uri.startswith("data:"):
            return self._folder.read(unquote(uri), "buffer")
        head, _, body = uri.partition(",")
        try:
            is_base64 = head.endswith(";base64")
            return base64.b64decode(body) if is_base64 else unquote_to_bytes(body)
        except binascii.Error as error:
            raise InputError(f"data URI: {error}") from None

    def _view(self, index: Any) -> tuple[memoryview, int]:
        """Bytes of a buffer view, and its stride; 0 if it has none."""
        entry = self._get("bufferViews", index)
        if "EXT_meshopt_compression" in entry.get("extensions", {}):
            raise InputError(f"{_COMPRESSED['EXT_meshopt_compression']}; export the file without")
        data = memoryview(self._buffer(_whole(entry["buffer"], "buffer")))
        start = _whole(entry.get("byteOffset", 0), "byteOffset")
        size = _whole(entry["byteLength"], "byteLength")
        if start + size > len(data):
            raise InputError(f"buffer view {index} ends beyond the {len(data)} bytes of its buffer")
        return data[start : start + size], _whole(entry.get("byteStride", 0), "byteStride")

    def _rows(self, entry: dict[str, Any], count: int, dtype: str, columns: int) -> NDArray[Any]:
        """Rows (count, columns) of a buffer view, without copying."""
        data, stride = self._view(entry["bufferView"])
        start = _whole(entry.get("byteOffset", 0), "byteOffset")
        item = np.dtype(dtype).itemsize
        stride = stride or item * columns
        if stride < item * columns:
            raise InputError(f"byteStride {stride} is less than an element")
        if count and start + (count - 1) * stride + item * columns > len(data):
            raise InputError(
                f"{count} elements do not fit into the {len(data)} bytes of their view"
            )
        return np.ndarray((count, columns), dtype, data, start, (stride, item))

    def _array(self, index: Any, columns: tuple[int, ...]) -> NDArray[Any]:
        """Values (N, columns) of an accessor; normalised integers become fractions."""
        entry = self._get("accessors", index)
        count, width = _whole(entry["count"], "count"), _COLUMNS[entry["type"]]
        dtype = _TYPES[entry["componentType"]]
        if width not in columns:
            raise InputError(f"accessor {index} has {width} columns")
        if "bufferView" in entry:
            values = self._rows(entry, count, dtype, width)
        elif "sparse" in entry and count <= self._size:
            values = np.zeros((count, width), dtype)
        else:
            used = self._tree.get("extensionsUsed", ())
            why = "".join(f": {what}" for name, what in _COMPRESSED.items() if name in used)
            raise InputError(f"accessor {index} of {count} elements has no data{why}")
        if "sparse" in entry:
            values = self._with_sparse(values, entry["sparse"], dtype)
        if entry.get("normalized") and values.dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values

    def _with_sparse(
        self, values: NDArray[Any], sparse: dict[str, Any], dtype: str
    ) -> NDArray[Any]:
        count = _whole(sparse["count"], "count")
        kind = _TYPES[sparse["indices"]["componentType"]]
        where = self._rows(sparse["indices"], count, kind, 1)[:, 0]
        if count and not 0 <= where.min() <= where.max() < len(values):
            raise InputError(f"a sparse accessor replaces more than its {len(values)} elements")
        values = values.copy()
        values[where] = self._rows(sparse["values"], count, dtype, values.shape[1])
        return values

    def _mesh(self, index: int) -> list[Part]:
        entry = self._get("meshes", index)
        name = str(entry.get("name") or f"mesh {index}")
        return [part for one in entry["primitives"] if (part := self._primitive(one, name))]

    def _primitive(self, entry: dict[str, Any], name: str) -> Part | None:
        """One surface in its node's axes; None if it is neither surface nor points."""
        mode, attributes = entry.get("mode", _TRIANGLES), entry["attributes"]
        if mode not in (_TRIANGLES, _STRIP, _FAN, _POINTS) or "POSITION" not in attributes:
            return None
        where = _whole(attributes["POSITION"], "accessor")
        if where not in self._positions:
            values = self._array(where, (3,))
            check_size((len(values) + sum(map(len, self._positions.values()))) // 3)
            self._positions[where] = values.astype(np.float64)
        vertices = self._positions[where]
        if mode == _POINTS:
            return Part(name, vertices, np.zeros((0, 3), np.int64))
        if "indices" in entry:
            order = self._array(entry["indices"], (1,))[:, 0]
            check_size(len(order) // 3)
        else:
            order = np.arange(len(vertices))
        faces = _faces(order.astype(np.int64), mode)
        part = Part(name, vertices, faces)
        image, tint, choice, place = self._material(entry.get("material"))
        if image is not None and (uv := attributes.get(f"TEXCOORD_{choice}")) is not None:
            corners = place(self._array(uv, (2,)).astype(np.float64))
            if "COLOR_0" in attributes:
                self._folder.warn(f"{name} has a texture: its colours of corners are not read")
            return Part(name, vertices, faces, self._of(corners, part), image, tint)
        if "COLOR_0" not in attributes:
            return Part(name, vertices, faces, tint=tint)
        linear = self._array(attributes["COLOR_0"], (3, 4))[:, :3]
        if linear.dtype.kind in "iu":
            linear = linear / np.iinfo(linear.dtype).max
        colours = 255.0 * linear_to_srgb(np.clip(linear.astype(np.float64), 0.0, 1.0))
        factor = 1.0 if tint is None else tint / 255.0
        return Part(name, vertices, faces, colours=self._of(colours, part) * factor)

    def _of(self, values: Float64, part: Part) -> Float64:
        """Vertex values at the face corners."""
        if len(values) != len(part.vertices):
            raise InputError(f"{len(values)} values for {len(part.vertices)} vertices")
        return values[part.faces]

    def _material(self, index: Any) -> tuple[Image | None, Float64 | None, int, Any]:
        """Image, colour, index of the texture coordinates, and their transform."""
        entry = {} if index is None else self._get("materials", index)
        glossy = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        metallic = entry.get("pbrMetallicRoughness", {})
        factor = metallic.get("baseColorFactor", glossy.get("diffuseFactor"))
        texture = metallic.get("baseColorTexture", glossy.get("diffuseTexture"))
        tint = None
        if factor is not None:
            linear = np.clip(np.asarray(factor, dtype=np.float64)[:3], 0.0, 1.0)
            tint = 255.0 * linear_to_srgb(np.rint(255.0 * linear) / 255.0)
        if texture is None:
            return None, tint, 0, None
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        choice = transform.get("texCoord", texture.get("texCoord", 0))
        return self._texture(texture["index"]), tint, choice, _TextureTransform(transform)

    def _texture(self, index: Any) -> Image | None:
        entry = self._get("textures", index)
        webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", entry.get("source"))
        if source is None:
            self._folder.warn(f"texture {index} has no PNG, JPEG or WebP: the surface stays plain")
            return None
        image = self._get("images", source)
        if "bufferView" in image:
            data = bytes(self._view(image["bufferView"])[0])
        elif image["uri"].startswith("data:"):
            data = self._bytes(image["uri"])
        else:
            return self._folder.texture(unquote(image["uri"]))
        return self._folder.image(source, data, str(image.get("name") or source))


class _TextureTransform:
    """KHR_texture_transform: scale, rotate, then translate."""

    def __init__(self, entry: dict[str, Any]) -> None:
        self._scale = np.asarray(entry.get("scale", (1.0, 1.0)), dtype=np.float64).reshape(2)
        self._offset = np.asarray(entry.get("offset", (0.0, 0.0)), dtype=np.float64).reshape(2)
        angle = float(entry.get("rotation", 0.0))
        c, s = np.cos(angle), np.sin(angle)
        self._turn = np.array([[c, -s], [s, c]])  # multiplied from the right: u' = c u + s v

    def __call__(self, uv: Float64) -> Float64:
        """Transform coordinates (N, 2) to those of the image."""
        return uv * self._scale @ self._turn + self._offset


def _faces(order: Int64, mode: int) -> Int64:
    """Triangles (F, 3) from the indices of a list, a strip or a fan."""
    if mode == _TRIANGLES:
        return order.reshape(-1, 3)
    if mode == _FAN:
        first = np.broadcast_to(order[:1], max(len(order) - 2, 0))
        return np.stack([first, order[1:-1], order[2:]], -1)
    faces = np.stack([order[:-2], order[1:-1], order[2:]], -1)
    faces[1::2] = faces[1::2, ::-1]
    return faces


def _transform(node: dict[str, Any]) -> Float64:
    """T_parent_node (4, 4): a matrix, or translation times rotation times scale."""
    if "matrix" in node:
        return np.asarray(node["matrix"], dtype=np.float64).reshape(4, 4).T
    T = np.eye(4)
    x, y, z, w = np.asarray(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=np.float64)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, :3] *= np.asarray(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64).reshape(3)
    T[:3, 3] = np.asarray(node.get("translation", (0.0, 0.0, 0.0)), dtype=np.float64)
    return T


def _moved(vertices: Float64, T_scene_node: Float64) -> Float64:
    if (T_scene_node == np.eye(4)).all():
        return vertices
    return vertices @ T_scene_node[:3, :3].T + T_scene_node[:3, 3]


def _placed(part: Part, vertices: Float64, T_scene_node: Float64) -> Part:
    """Place a part by its node; flip the faces if the node mirrors."""
    if np.linalg.det(T_scene_node[:3, :3]) > 0:
        return replace(part, vertices=vertices)
    uv, colours = (None if one is None else one[:, ::-1] for one in (part.uv, part.colours))
    return replace(part, vertices=vertices, faces=part.faces[:, ::-1], uv=uv, colours=colours)
