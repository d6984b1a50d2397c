"""What the kernels that align frames with maps share: sums of a pass, weights, poses, images."""

from __future__ import annotations

from enum import IntEnum

from ms_slam_env._runtime.warp import wp


class Sum(IntEnum):
    """Places of a pass's sums; H takes 21 (upper triangle by rows), g = J^T W r six."""

    GEOMETRIC_HESSIAN = 0
    GEOMETRIC_GRADIENT = 21
    COST = 27  # truncated robust cost of the visible points, in [0, 3] each
    POINTS = 28  # model points looked at
    VISIBLE = 29  # of those, inside the live image
    MATCHED = 30  # of those, with a live vertex
    INLIERS = 31  # of those, within the gates and a few sigmas of the model's plane
    SQUARED_M2 = 32  # squared point-to-plane residuals of the inliers, m^2
    TEXTURED = 33  # visible, with a marked intensity gradient
    PHOTOMETRIC_INLIERS = 34  # of those, with a small photometric residual
    DEPTH_CONFLICTS = 35  # matched, but the live surface is clearly nearer or farther
    EXPOSURE_W = 36  # exposed points: robust weight w
    EXPOSURE_WM = 37  # w m, with m = I_p - 128
    EXPOSURE_WMM = 38
    EXPOSURE_WR = 39  # w r, with r the photometric residual
    EXPOSURE_WMR = 40
    ROUGH = 41  # of the textured: 1 - robust weight; half their number at the right scale
    PHOTOMETRIC_HESSIAN = 42
    PHOTOMETRIC_GRADIENT = 63
    TILTED = 69  # geometric weights times 1 - cosine of the angle between the normals
    EXPOSURE_WRR = 70


NUM_SUMS = 71

OFF = wp.constant(0)  # states of a hypothesis, in ``active``: takes no part
RUNNING = wp.constant(1)
RESTING = wp.constant(2)  # converged at its level, wakes at the next


@wp.struct
class Weights:
    """Scales of the residuals; see ``normal_equations``. Reciprocals save divisions per pixel."""

    icp: float
    rgb: float
    per_depth_noise: float  # 1 / depth_noise_m
    per_cauchy_icp: float  # 1 / sigmas
    per_cauchy_rgb: float  # 1 / sigmas
    grey_variance: float  # of the intensity, grey levels^2
    pixel_variance: float  # of the place in the image, pixels^2
    distance_m: float
    cos_angle: float
    inlier_sigmas: float  # these four as in ``AcceptanceConfig``
    conflict_sigmas: float
    texture: float
    photometric_inlier: float
    least_scale: float  # least c of photometric residuals, in sigmas


@wp.struct
class Photometry:
    """How the live grey values relate to the model's: I_live ~ gain I_model + bias."""

    gain: float
    bias: float  # grey levels
    scale: float  # c of the photometric loss, in sigmas: half of all textured residuals exceed it
    reference: float  # the same as it usually is, over its least value; the unit of the acceptance
    trust: float  # weight of the photometric term, [0, 1]


@wp.struct
class Hypotheses:
    """K pose hypotheses of B envs."""

    pose: wp.array2d(dtype=wp.mat44d)  # (B, K) T_model_live
    photometry: wp.array2d(dtype=Photometry)  # (B, K)
    state: wp.array2d(dtype=wp.int32)  # (B, K) OFF, RUNNING or RESTING
    partial: wp.array4d(dtype=wp.float32)  # (B, K, rows * pieces, NUM_SUMS) of the parts of a pass
    sums: wp.array3d(dtype=wp.float64)  # (B, K, NUM_SUMS) of the last pass, see ``Sum``


@wp.struct
class AlignedImages:
    """Images of B envs at one pyramid level, flat, and the camera of the live ones."""

    model_vertices: wp.array(dtype=wp.vec3)
    model_normals: wp.array(dtype=wp.vec3)
    model_intensity: wp.array(dtype=wp.float32)
    live_vertices: wp.array(dtype=wp.vec3)
    live_normals: wp.array(dtype=wp.vec3)
    live_gradient: wp.array(dtype=wp.vec3)  # (I, dI/du, dI/dv)
    model_size: wp.vec2i  # (width, height); ``live_size`` likewise
    live_size: wp.vec2i
    focal: wp.vec2  # (fx, fy)
    centre: wp.vec2  # (cx, cy)
