// Casts eight rays at a time with Embree. Layouts: RTCRayHit8 and RTCIntersectArguments of
// embree4/rtcore_ray.h and rtcore_common.h.
#pragma once

#include "checked.h"

void cast_tile(
    unsigned long long intersect, unsigned long long scene, const auto& vertices, const auto& faces,
    const auto& T, const auto& camera, int image, int tile_y, int tile_x, const auto& hits) {
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
    const auto bent = VIEW(const float, camera.bent, 0, 2 * camera.bent.shape[0]);
    const int first = image * camera.height * width;

    RayHit8 r = {};
    alignas(32) int valid[8];
    int pixel[8];
    for (int k = 0; k < 8; ++k) {
        const int x = 4 * tile_x + k % 4;
        const int y = 2 * tile_y + k / 4;
        valid[k] = x < width && y < camera.height ? -1 : 0;
        pixel[k] = first + y * width + x;
        const bool is_bent = camera.bent.shape[0] > 0 && valid[k];
        const int ray = is_bent ? y * width + x : 0;
        const float a = is_bent ? bent[2 * ray] : ((float)x - camera.cx) / camera.fx;
        const float b = is_bent ? bent[2 * ray + 1] : ((float)y - camera.cy) / camera.fy;
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
    double p[3][8] = {}, a[3][8] = {}, b[3][8] = {};  // a corner and the edges from it
    for (int k = 0; k < 8; ++k) {
        if (r.primitive[k] == none) continue;
        const wp::vec3i corners = ELEMENT(faces, r.primitive[k]);
        for (int i = 0; i < 3; ++i) {
            p[i][k] = ELEMENT(vertices, corners[0])[i];
            a[i][k] = ELEMENT(vertices, corners[1])[i] - p[i][k];
            b[i][k] = ELEMENT(vertices, corners[2])[i] - p[i][k];
        }
    }
    float t[8], u[8], v[8];
    VECTORISE
    for (int k = 0; k < 8; ++k) {
        const double ox = r.org_x[k] - p[0][k], oy = r.org_y[k] - p[1][k],
                     oz = r.org_z[k] - p[2][k];
        const double dx = r.dir_x[k], dy = r.dir_y[k], dz = r.dir_z[k];
        const double hx = dy * b[2][k] - dz * b[1][k];
        const double hy = dz * b[0][k] - dx * b[2][k];
        const double hz = dx * b[1][k] - dy * b[0][k];
        const double qx = oy * a[2][k] - oz * a[1][k];
        const double qy = oz * a[0][k] - ox * a[2][k];
        const double qz = ox * a[1][k] - oy * a[0][k];
        const double scale = 1.0 / (a[0][k] * hx + a[1][k] * hy + a[2][k] * hz);
        t[k] = (float)(scale * (b[0][k] * qx + b[1][k] * qy + b[2][k] * qz));
        u[k] = (float)(scale * (ox * hx + oy * hy + oz * hz));
        v[k] = (float)(scale * (dx * qx + dy * qy + dz * qz));
    }
    for (int k = 0; k < 8; ++k) {
        if (valid[k]) {
            const bool is_met = r.primitive[k] != none;
            ELEMENT(hits.t, pixel[k]) = is_met ? t[k] : r.tfar[k];
            ELEMENT(hits.u, pixel[k]) = is_met ? u[k] : 0.0f;
            ELEMENT(hits.v, pixel[k]) = is_met ? v[k] : 0.0f;
            ELEMENT(hits.face, pixel[k]) = (int)r.primitive[k];
        }
    }
}
