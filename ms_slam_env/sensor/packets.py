"""Kernel that casts packets of eight rays with Embree; for the CPU only.

A packet is a tile of 4 x 2 pixels of one image, so what a ray meets depends on its image alone,
not on the batch.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.sensor.rays import Pinhole, pose_of_row
from ms_slam_env.sensor.spans import VECTOR_FLAGS

wp.set_module_options(VECTOR_FLAGS)

TILE_WIDTH = 4
TILE_HEIGHT = 2

# Layouts: RTCRayHit8 and RTCIntersectArguments of embree4/rtcore_ray.h and rtcore_common.h.
_CAST_TILE = """
struct alignas(32) RayHit8 {
    float org_x[8], org_y[8], org_z[8], tnear[8];
    float dir_x[8], dir_y[8], dir_z[8], time[8], tfar[8];
    unsigned mask[8], id[8], flags[8];
    float normal_x[8], normal_y[8], normal_z[8], u[8], v[8];
    unsigned primitive[8], geometry[8], instance[8], instance_primitive[8];
};
struct Arguments {
    int flags;
    unsigned feature_mask;
    void *context, *filter, *intersect;
};
const int coherent = 1 << 16;
const unsigned none = 0xffffffffu;
const int width = camera.width;
const int first = image * camera.height * width;

RayHit8 r = {};
alignas(32) int valid[8];
int pixel[8];
for (int k = 0; k < 8; ++k) {
    const int x = 4 * tile_x + k % 4;
    const int y = 2 * tile_y + k / 4;
    valid[k] = x < width && y < camera.height ? -1 : 0;
    pixel[k] = first + y * width + x;
    const float a = ((float)x - camera.cx) / camera.fx;
    const float b = ((float)y - camera.cy) / camera.fy;
    r.org_x[k] = T.data[0][3];
    r.org_y[k] = T.data[1][3];
    r.org_z[k] = T.data[2][3];
    r.dir_x[k] = T.data[0][0] * a + T.data[0][1] * b + T.data[0][2];
    r.dir_y[k] = T.data[1][0] * a + T.data[1][1] * b + T.data[1][2];
    r.dir_z[k] = T.data[2][0] * a + T.data[2][1] * b + T.data[2][2];
    r.tfar[k] = 1.0e37f;
    r.mask[k] = none;
    r.primitive[k] = r.geometry[k] = r.instance[k] = r.instance_primitive[k] = none;
}
Arguments arguments = {coherent, none, nullptr, nullptr, nullptr};
reinterpret_cast<void (*)(const int*, void*, RayHit8*, Arguments*)>(intersect)(
    valid, reinterpret_cast<void*>(scene), &r, &arguments);
for (int k = 0; k < 8; ++k) {
    if (valid[k]) {
        t.data[pixel[k]] = r.tfar[k];
        u.data[pixel[k]] = r.u[k];
        v.data[pixel[k]] = r.v[k];
        face.data[pixel[k]] = (int)r.primitive[k];
    }
}
"""


@wp.func_native(_CAST_TILE)
def _cast_tile(
    intersect: wp.uint64,
    scene: wp.uint64,
    T: wp.mat44,
    camera: Pinhole,
    image: int,
    tile_y: int,
    tile_x: int,
    t: wp.array(dtype=wp.float32),
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
): ...


@wp.kernel
def cast_tiles(
    intersect: wp.uint64,  # address of rtcIntersect8
    scene: wp.uint64,  # address of the RTCScene
    T_world_camera: wp.array(dtype=wp.mat44),  # (B * poses an image,)
    camera: Pinhole,
    t: wp.array(dtype=wp.float32),  # (B * H * W,)
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
):
    """First hit of the ray of each pixel; face -1 where there is none; one thread a tile."""
    b, y, x = wp.tid()
    T = T_world_camera[pose_of_row(camera, b, 2 * y)]  # the rows of a tile share their pose
    _cast_tile(intersect, scene, T, camera, b, y, x, t, u, v, face)
