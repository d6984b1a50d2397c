# mypy: disable-error-code="empty-body"
"""One fused pass of joint geometric and photometric alignment: normal equations and statistics.

ElasticFusion section IV: E = E_icp + w_rgb E_rgb, linearised at the current estimate. The pass
runs over the points p of the *model* (denoised by fusion) and looks them up in the live frame:

    q     = T^-1 p                 in the live camera, T = T_model_live; n_q = R^T n
    r_icp = n_q . (v - q)          metres; v is the live vertex in the pixel that q falls into
    r_rgb = I_live(pi(q)) - (gain I_p + bias)    grey levels; I_live is interpolated bilinearly

With the right perturbation T <- T exp(xi), xi = (rho, phi):

    d r_icp / d xi = (n_q, v x n_q)
    d r_rgb / d xi = -(g, q x g)       g = grad I_live . d pi / d q

Residuals are divided by their standard deviations, so both terms are dimensionless:

    s_icp = depth_noise_m z^2                        axial noise of the sensor
    s_rgb^2 = intensity_noise^2 + (LATERAL_NOISE_PX |grad I|)^2

The second part of s_rgb is the position error of the sampled grey value in the image (aliasing,
depth, pose of the map). Without it strong edges, the best features, look like outliers. The cost,
with w = icp_rgb_weight, is

    E = (1 - w) / 50 sum rho(r_icp / s_icp) + w sum rho(r_rgb / s_rgb)

where rho(r) = c^2/2 log(1 + (r/c)^2) is Cauchy's loss: w = 0 is geometry alone, w = 1 photometry
alone. Errors of neighbouring depths are correlated (filter, quantisation, map), those of grey
values are not, so 50 depths count as one independent reading. The number was chosen so that the
default w = 0.1 is about the best on noisy sequences.

Gain and bias follow the camera's exposure. Each step also solves for them, from points weighted by
rho's weights over s_rgb^2, so that flat regions decide; misalignment hardly affects these. The gain
moves only as far as the data require: with noise or misalignment, regression of live values on the
model's gives too small a gain, and regression of the model's on live values too large a one. (A
gain that followed the first would shrink from frame to frame, because colours are divided by it
before they enter the map.) The photometric c is the maximum-likelihood scale of Cauchy's
distribution, where the mean weight is 1/2, but at least ``cauchy_rgb``. The term is divided by
(c / least c)^2, so blurred or badly registered images count less. ``Photometry.trust`` is one more
factor.

On the CPU, short loops over local arrays process many points at once; the compiler vectorizes them
over eight points. A GPU thread takes one point at a time.
"""

from __future__ import annotations

from enum import IntEnum

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source


class Sum(IntEnum):
    """Indices of a pass's sums; H takes 21 (upper triangle by rows), g = J^T W r takes six."""

    GEOMETRIC_HESSIAN = 0
    GEOMETRIC_GRADIENT = 21
    COST = 27  # truncated robust cost of the visible points, in [0, 3] each
    POINTS = 28  # model points sampled
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
    pixel_variance: float  # of the position in the image, pixels^2
    distance_m: float
    cos_angle: float
    inlier_sigmas: float  # these four as in ``AcceptanceConfig``
    conflict_sigmas: float
    texture: float
    photometric_inlier: float
    least_scale: float  # least c of photometric residuals, in sigmas


@wp.struct
class Photometry:
    """Relation of the live grey values to the model's: I_live ~ gain I_model + bias."""

    gain: float
    bias: float  # grey levels
    scale: float  # c of the photometric loss, in sigmas: half of all textured residuals exceed it
    reference: float  # usual scale over its least value; the unit of the acceptance thresholds
    trust: float  # weight of the photometric term, [0, 1]


@wp.struct
class Hypotheses:
    """K pose hypotheses of B envs."""

    pose: wp.array2d[wp.mat44d]  # (B, K) T_model_live
    photometry: wp.array2d[Photometry]  # (B, K)
    state: wp.array2d[wp.int32]  # (B, K) OFF, RUNNING or RESTING
    partial: wp.array4d[wp.float32]  # (B, K, rows * pieces, NUM_SUMS) of the parts of a pass
    sums: wp.array3d[wp.float64]  # (B, K, NUM_SUMS) of the last pass, see ``Sum``


@wp.struct
class AlignedImages:
    """Images of B envs at one pyramid level, flat, and the camera of the live ones."""

    model_vertices: wp.array[wp.vec3]
    model_normals: wp.array[wp.vec3]
    model_intensity: wp.array[wp.float32]
    live_vertices: wp.array[wp.vec3]
    live_normals: wp.array[wp.vec3]
    live_gradient: wp.array[wp.vec3]  # (I, dI/du, dI/dv)
    model_size: wp.vec2i  # (width, height); ``live_size`` likewise
    live_size: wp.vec2i
    focal: wp.vec2  # (fx, fy)
    centre: wp.vec2  # (cx, cy)


@wp.func_native(
    native_source(
        "normal_equations",
        "accumulate_points",
        **{f"SUM_{place.name}": place.value for place in Sum},
    )
)
def accumulate_points(
    images: AlignedImages,
    start: int,
    end: int,
    stride: int,
    live_image: int,
    R: wp.mat33,
    t: wp.vec3,
    weights: Weights,
    photometry: Photometry,
    partial: wp.array4d[wp.float32],
    row: int,
) -> None:
    """Sum the terms of the model points from ``start`` to ``end`` into a row of ``partial``.

    ``R`` and ``t`` are T_live_model.
    """


@wp.func
def accumulate_row(
    images: AlignedImages,
    weights: Weights,
    stride: int,
    columns: int,  # of the image, per piece
    hypotheses: Hypotheses,
    b: int,
    k: int,
    row_index: int,
    piece: int,
) -> None:
    """Sum the terms of one piece of a row of model points for hypothesis k of env b."""
    width = images.model_size[0]
    T = hypotheses.pose[b, k]
    R_inverse = wp.mat33(
        float(T[0, 0]), float(T[1, 0]), float(T[2, 0]),
        float(T[0, 1]), float(T[1, 1]), float(T[2, 1]),
        float(T[0, 2]), float(T[1, 2]), float(T[2, 2]),
    )  # fmt: skip
    t_inverse = -(R_inverse * wp.vec3(float(T[0, 3]), float(T[1, 3]), float(T[2, 3])))
    # Neighbouring rows sample different columns, like a chessboard.
    start = piece * columns + (row_index % 2) * (stride // 2)
    model_row = (b * images.model_size[1] + row_index * stride) * width
    pieces = (width + columns - 1) // columns
    slots = hypotheses.partial.shape[2]
    row = (b * hypotheses.partial.shape[1] + k) * slots + row_index * pieces + piece
    accumulate_points(
        images,
        model_row + start,
        model_row + wp.min((piece + 1) * columns, width),
        stride,
        b * images.live_size[0] * images.live_size[1],
        R_inverse,
        t_inverse,
        weights,
        hypotheses.photometry[b, k],
        hypotheses.partial,
        row,
    )


@wp.kernel
def accumulate_normal_equations(
    images: AlignedImages, weights: Weights, stride: int, columns: int, hypotheses: Hypotheses
) -> None:
    """Sum the terms of one piece of a row of model points, for every active hypothesis."""
    b, k, row_index, piece = wp.tid()
    if hypotheses.state[b, k] == RUNNING:
        accumulate_row(images, weights, stride, columns, hypotheses, b, k, row_index, piece)
