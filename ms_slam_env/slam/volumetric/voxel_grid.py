"""A sparse grid of signed distances: fuse frames, cast rays, extract the surface, save, restore.

Curless and Levoy 1996, in hashed voxel blocks (Niessner et al. 2013), with Open3D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.state import Stateful
from ms_slam_env.slam.shared.state_check import ArrayOf
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M

STOCK: dict[str, Any] = {
    "voxel_m": 0.01,
    "block_voxels": 16,
    "blocks": 40_000,
    "truncation_voxels": 8.0,
    "aligner": "open3d-plane",
}
"""Parameters of Open3D's example. With noise, more iterations or a narrower truncation or
association do not lower the error."""


@dataclass(frozen=True)
class VolumetricConfig(Checked):
    """Parameters of tracking and of the voxel grid.

    Attributes:
        voxel_m: size of a voxel.
        block_voxels: voxels along an edge of a block; blocks are allocated near surfaces.
        blocks: blocks allocated at the start; the grid grows when they are used up.
        truncation_voxels: truncation of the signed distance, in voxels.
        depth_cutoff_m: readings beyond are ignored.
        aligner: how a frame is aligned with the model's view: ``opencv``, depth and intensity of
            all pixels; ``open3d-plane``, point-to-plane as in Open3D's dense SLAM; ``open3d``, that
            and intensity. On several cores the poses of both of Open3D's differ between runs, in
            the last digits at first and then by millimetres.
        least_weight: observations that a voxel needs to count as surface in predictions and surface
            points.
        stock: unmodified Open3D dense SLAM. Other parameters are ignored: it uses those of Open3D's
            example ``dense_slam.py``, with voxels of 1 cm. Kept are ``depth_cutoff_m`` and
            ``aligner="open3d"``, which aligns by intensity, too. Nothing is checked, no other pose
            is tried, and a frame that cannot be aligned is fused at the last pose.
    """

    voxel_m: float = bounded(0.015, 0.001, 0.2)
    block_voxels: int = bounded(8, 4, 32)
    blocks: int = bounded(4_000, 100, 10_000_000)
    truncation_voxels: float = bounded(4.0, 1.0, 50.0)
    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    aligner: str = chosen("opencv", "opencv", "open3d", "open3d-plane")
    least_weight: int = bounded(1, 1, 1000)
    stock: bool = False

    @property
    def in_force(self) -> VolumetricConfig:
        """The effective parameters."""
        if not self.stock:
            return self
        kept = {"aligner": self.aligner} if self.aligner == "open3d" else {}
        return replace(self, **STOCK | kept)


@dataclass(frozen=True)
class Open3DConfig(VolumetricConfig):
    """Parameters of the backend ``open3d``: Open3D's dense SLAM at its best, to compare with.

    What decides is the aligner: with intensity (``aligner="open3d"``), as the stock variant had it
    by mistake, the ATE of single runs at 160x120 is 6.4 mm in a room with Kinect noise and blur,
    7.1 mm in a corridor and 11.4 mm on lr_kt3. Point-to-plane alone has 1.3, 4.3 and 4.5 mm; with
    voxels of 1 cm, truncated at 8, instead of 1.5 cm, truncated at 4, 1.1, 1.3 and 1.2 mm, at twice
    the time. Depth cutoff and scale, blocks, iterations, the association distance and starting at
    the predicted pose hardly matter. Frames are not checked: where the camera moves fast, refusing
    them loses the rest of the sequence (46 of 60 frames of a HoloLens walk, otherwise 36).

    It reads the grid without Open3D's offset of half a voxel, as ``volumetric`` does. With
    ``stock=true`` it is the same as ``volumetric,stock=true``.
    """

    voxel_m: float = bounded(0.01, 0.001, 0.2)
    truncation_voxels: float = bounded(8.0, 1.0, 50.0)
    aligner: str = chosen("open3d-plane", "opencv", "open3d", "open3d-plane")


_NEAREST_M = 0.1
_FRAGMENT_PX = 16  # edge of the fragments in which Open3D draws its blocks
_SMOOTH_PX = 1.5  # width of the filter of cast depth


def load_open3d(what: str = "the volumetric backend") -> Any:
    """Import Open3D for ``what``, with messages below errors silenced.

    Raises:
        InputError: Open3D or a system library that it needs is not installed.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"{what} needs Open3D (pip install 'ms-slam-env[open3d]') and, on "
            f"Debian and Ubuntu, libgl1, libx11-6 and libgomp1 (apt-get install): {error}"
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


_FARTHEST_M = 1e4  # limit for blocks in a state; rays are cast from beyond all blocks
DEPTH_SCALE = 5000.0  # 16-bit depth of 0.2 mm, well below the sensor's noise
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


@dataclass(frozen=True)
class CastView:
    """An image ray-cast from the grid."""

    depth: Float32  # (H, W) float32 metres; 0 where the grid is empty
    color: Float32  # (H, W, 3) float32 RGB in [0, 1]
    # (H, W, 3) float32 unit vectors in the camera frame, facing the camera; 0 where empty.
    normals: Float32

    @property
    def intensity(self) -> Float32:
        """Grey values (H, W) float32 in [0, 255]."""
        return np.asarray(self.color @ _LUMA * np.float32(255.0), dtype=np.float32)


class VoxelGrid(Stateful):
    """The map of one camera."""

    # Open3D truncates a voxel's pixel coordinates to integers. With pixel centres at integers that
    # is half a pixel too low.
    _reading_shift_px = 0.5

    def __init__(self, intrinsics: Intrinsics, config: VolumetricConfig) -> None:
        self.open3d = load_open3d()
        self.intrinsics = intrinsics
        self.config = config
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        core = self.open3d.core
        self._grid = self.open3d.t.geometry.VoxelBlockGrid(
            ["tsdf", "weight", "color"],
            [core.float32, core.uint16, core.uint16],
            [core.SizeVector([1]), core.SizeVector([1]), core.SizeVector([3])],
            self.config.voxel_m,
            self.config.block_voxels,
            self.config.blocks,
            core.Device("CPU:0"),
        )
        self._reserved = 0
        self._forget_derived()

    def _forget_derived(self) -> None:
        self._keys: Any = None
        self._surface: tuple[Float64, NDArray[np.uint8], Float32] | None = None

    def tensor(self, array: NDArray[Any]) -> Any:
        """Wrap an array as an Open3D tensor."""
        return self.open3d.core.Tensor.from_numpy(np.ascontiguousarray(array))

    def image(self, array: NDArray[Any]) -> Any:
        """Wrap an array (H, W) or (H, W, C) as an Open3D image."""
        full = array if array.ndim == 3 else array[..., None]
        return self.open3d.t.geometry.Image(self.tensor(full))

    def fuse(self, depth: NDArray[np.uint16], color: NDArray[np.uint8], pose: Float64) -> None:
        """Fuse depth (H, W) in units of 1 / DEPTH_SCALE m and colour (H, W, 3) at a pose (4, 4)."""
        depth_image, color_image = self.image(depth), self.image(color)
        extrinsic = self.tensor(invert(pose))
        limits = DEPTH_SCALE, self.config.depth_cutoff_m, float(self.config.truncation_voxels)
        camera = camera_matrix(self, self.intrinsics)
        try:
            blocks = self._grid.compute_unique_block_coordinates(
                depth_image, camera, extrinsic, *limits
            )
        except RuntimeError as error:  # none of the few pixels that it samples is in range
            if "No block is touched" not in str(error):
                raise
            return
        matrix = camera_matrix(self, self.intrinsics, self._reading_shift_px)
        self._grid.integrate(blocks, depth_image, color_image, matrix, matrix, extrinsic, *limits)
        self._forget_derived()

    def cast(self, pose: Float64, least_weight: float, intrinsics: Intrinsics) -> CastView:
        """Cast the image seen from ``pose`` (4, 4), of voxels observed ``least_weight`` times."""
        if self._block_keys() is None:
            return _nothing(intrinsics)
        self._reserve_fragments(intrinsics)
        # Open3D looks up distances at the voxel below a point, on average half a voxel off along
        # each axis, but interpolates colours and normals at the right position.
        moved = pose.copy()
        moved[:3, 3] += self.config.voxel_m / 2
        distance = self._ray_cast(moved, least_weight, intrinsics, ["depth"])["depth"]
        found = self._ray_cast(pose, least_weight, intrinsics, ["color", "normal"])
        depth = distance.numpy()[..., 0] / np.float32(DEPTH_SCALE)
        normals = -found["normal"].numpy()  # Open3D's normals point away from the camera
        hit = (depth > 0) & (np.linalg.norm(normals, axis=-1) > 0.5)
        return CastView(
            depth=np.where(hit, smooth_depth(depth, hit, self.config.voxel_m), np.float32(0)),
            color=np.where(hit[..., None], found["color"].numpy(), np.float32(0)),
            normals=np.where(hit[..., None], normals, np.float32(0)),
        )

    def _ray_cast(
        self, pose: Float64, least_weight: float, intrinsics: Intrinsics, names: list[str]
    ) -> Any:
        """Ray-cast the images ``names`` with Open3D, as tensors (H, W, channels)."""
        limits = self.config.depth_cutoff_m, least_weight, range_factor(intrinsics)
        return self._ray_cast_blocks(self._keys, pose, intrinsics, names, *limits)

    def _ray_cast_blocks(
        self,
        keys: Any,
        pose: Float64,
        intrinsics: Intrinsics,
        names: list[str],
        farthest_m: float,
        least_weight: float,
        factor: int,
    ) -> Any:
        extrinsic, size = self.tensor(invert(pose)), (intrinsics.width, intrinsics.height)
        range_m = DEPTH_SCALE, _NEAREST_M, farthest_m
        truncation = float(self.config.truncation_voxels)  # Open3D refuses an integer
        rule = least_weight - 0.5, truncation, factor  # Open3D compares strictly
        camera = camera_matrix(self, intrinsics)
        return self._grid.ray_cast(keys, camera, extrinsic, *size, names, *range_m, *rule)

    def _block_keys(self) -> Any:
        """Tensor (M, 3) of all block coordinates; None if there are none."""
        hashmap = self._grid.hashmap()
        if self._keys is None and hashmap.size() > 0:
            used = hashmap.active_buf_indices().to(self.open3d.core.int64)
            self._keys = hashmap.key_tensor()[used]
        return self._keys

    def _reserve_fragments(self, intrinsics: Intrinsics) -> None:
        """Reserve room for all block fragments that a ray cast draws to bound its rays.

        Open3D starts with room for about a hundred. A cast that needs more omits the rest, and
        makes room only for the next cast. A dummy cast from far away, with every block in view
        several times, avoids that.
        """
        factor = range_factor(intrinsics)
        pieces = math.ceil(intrinsics.width / factor / _FRAGMENT_PX) * math.ceil(
            intrinsics.height / factor / _FRAGMENT_PX
        )
        keys = self._keys.numpy()
        if pieces * len(keys) < self._reserved:
            return
        repeats = 2 * pieces
        edge_m = self.config.voxel_m * self.config.block_voxels
        low, high = keys.min(axis=0) * edge_m, (keys.max(axis=0) + 1) * edge_m
        radius = float(np.linalg.norm(high - low)) / 2
        pose = np.eye(4)
        pose[:3, 3] = (low + high) / 2 - [0.0, 0.0, 4 * radius]
        size = 8
        camera = Intrinsics(float(size), float(size), (size - 1) / 2, (size - 1) / 2, size, size)
        everything = self.tensor(np.repeat(keys, repeats, axis=0))
        self._ray_cast_blocks(everything, pose, camera, ["depth"], 8 * radius, 1.0, 1)
        self._reserved = repeats * len(keys) - 1

    def surface(self) -> tuple[Float64, NDArray[np.uint8], Float32]:
        """Points (M, 3) metres, colours (M, 3) RGB and normals (M, 3) of the zero crossings.

        Sorted by position, because Open3D's order changes from run to run.
        """
        if self._surface is None:
            self._surface = self._extract_surface()
        return self._surface

    def _extract_surface(self) -> tuple[Float64, NDArray[np.uint8], Float32]:
        nothing = np.zeros((0, 3))
        if self._block_keys() is not None:
            cloud = self._grid.extract_point_cloud(self.config.least_weight - 0.5).point
            points = cloud.positions.numpy()
            if len(points):
                order = np.lexsort(points.T)
                colors = np.clip(np.rint(cloud.colors.numpy()[order] * 255), 0, 255)
                normals = cloud.normals.numpy()[order]
                return points[order].astype(np.float64), colors.astype(np.uint8), normals
        return nothing, nothing.astype(np.uint8), nothing.astype(np.float32)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Block coordinates and voxel contents."""
        hashmap = self._grid.hashmap()
        used = hashmap.active_buf_indices().numpy().astype(np.int64)
        keys = hashmap.key_tensor().numpy()[used]
        order = np.lexsort(keys.T)
        state = {"keys": keys[order]}
        for name in ("tsdf", "weight", "color"):
            state[name] = self._blocks(name)[used[order]]
        return state

    def state_like(self) -> Any:
        """See ``Stateful``."""
        own = self.get_state().items()
        like = {name: ArrayOf(one.dtype, ("blocks", *one.shape[1:])) for name, one in own}
        most = round(_FARTHEST_M / (self.config.voxel_m * self.config.block_voxels))
        return like | {"keys": replace(like["keys"], least=-most, most=most)}

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Restore the state of a grid with the same configuration."""
        self.clear()
        if len(state["keys"]) == 0:
            return
        indices, _ = self._grid.hashmap().activate(self.tensor(state["keys"]))
        places = indices.numpy().astype(np.int64)
        for name in ("tsdf", "weight", "color"):
            self._blocks(name)[places] = state[name]

    def _blocks(self, name: str) -> NDArray[Any]:
        """Writable array (capacity, n, n, n, channels) of the voxels of all blocks."""
        index = ("tsdf", "weight", "color").index(name)
        array: NDArray[Any] = self._grid.hashmap().value_tensor(index).numpy()
        return array


class StockVoxelGrid(VoxelGrid):
    """The grid of Open3D's ``t.pipelines.slam.Model``, without corrections."""

    _reading_shift_px = 0.0

    def cast(self, pose: Float64, least_weight: float, intrinsics: Intrinsics) -> CastView:
        """Cast the image seen from ``pose`` (4, 4), of voxels observed ``least_weight`` times."""
        if self._block_keys() is None:
            return _nothing(intrinsics)
        names = ["depth", "color", "normal"]
        found = self._ray_cast(pose, least_weight, intrinsics, names)
        return CastView(
            depth=found["depth"].numpy()[..., 0] / np.float32(DEPTH_SCALE),
            color=found["color"].numpy(),
            normals=-found["normal"].numpy(),
        )


def _nothing(intrinsics: Intrinsics) -> CastView:
    image = np.zeros((*intrinsics.shape, 3), dtype=np.float32)
    return CastView(image[..., 0].copy(), image, image.copy())


def smooth_depth(depth: Float32, hit: NDArray[np.bool_], voxel_m: float) -> Float32:
    """Smooth subvoxel steps in a depth image (H, W); edges stay."""
    filled = np.where(hit, depth, np.float32(-100.0))  # far from every surface, so without weight
    return np.asarray(cv2.bilateralFilter(filled, 5, voxel_m, _SMOOTH_PX), dtype=np.float32)


def camera_matrix(grid: VoxelGrid, intrinsics: Intrinsics, shift_px: float = 0.0) -> Any:
    """Camera matrix (3, 3) as a tensor, with its centre shifted by ``shift_px``."""
    matrix = intrinsics.matrix
    matrix[:2, 2] += shift_px
    return grid.tensor(matrix)


def range_factor(intrinsics: Intrinsics) -> int:
    """Downsampling factor of Open3D's ray range map.

    It must divide the image size; otherwise Open3D reads beyond that map, and a cast may never end.
    """
    return math.gcd(8, intrinsics.width, intrinsics.height)
