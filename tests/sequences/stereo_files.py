"""Stereo recordings of a scene, written in the layouts of EuRoC and KITTI odometry."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from ms_slam_env.camera import Distortion, Intrinsics, intensity_image
from ms_slam_env.geometry import invert, make_pose, quaternion_from_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor

START_NS = 1_403_636_579_763_555_584
LENSES = (
    Distortion.of("radtan", [-0.28, 0.074, 0.0002, 1.8e-05]),
    Distortion.of("radtan", [-0.27, 0.07, -0.0001, -3.5e-05]),
)
T_BODY_LEFT = make_pose(so3_exp([0.1, -0.2, 1.5]), [-0.02, -0.06, 0.01])
T_LEFT_RIGHT = make_pose(so3_exp([0.01, -0.015, 0.008]), [0.11, 0.002, -0.001])


def save(path: Path, pixels: np.ndarray) -> None:
    """Write an image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write_euroc(folder: Path, scene: object, K: Intrinsics, poses: np.ndarray) -> Path:
    """Grey images of both cameras from poses (N, 4, 4) T_world_left at 20 Hz, and the body's."""
    inside = folder / "mav0"
    stamps = [START_NS + 50_000_000 * k for k in range(len(poses))]
    for k, (lens, T) in enumerate(zip(LENSES, (np.eye(4), T_LEFT_RIGHT), strict=True)):
        camera = dataclasses.replace(K, distortion=lens)
        sensor = RGBDSensor(scene, camera, noise="none")
        for stamp, pose in zip(stamps, poses, strict=True):
            color = sensor.ground_truth(pose @ T).color
            save(inside / f"cam{k}/data/{stamp}.png", intensity_image(color))
        rows = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        (inside / f"cam{k}/data.csv").write_text(f"#timestamp [ns],filename\n{rows}")
        about = {
            "sensor_type": "camera",
            "T_BS": {"rows": 4, "cols": 4, "data": (T_BODY_LEFT @ T).ravel().tolist()},
            "resolution": [K.width, K.height],
            "camera_model": "pinhole",
            "intrinsics": [K.fx, K.fy, K.cx, K.cy],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": [lens.k1, lens.k2, lens.p1, lens.p2],
        }
        (inside / f"cam{k}/sensor.yaml").write_text(yaml.safe_dump(about))
    rows = ["#timestamp, p_RS_R_x [m], y, z, q_RS_w [], x, y, z, v_RS_R_x [m s^-1]"]
    for stamp, pose in zip(stamps, poses @ invert(T_BODY_LEFT), strict=True):
        x, y, z, w = quaternion_from_pose(pose)
        numbers = [*pose[:3, 3], w, x, y, z, 0.0]
        rows.append(",".join([str(stamp + 1_000_000), *(f"{v:.9f}" for v in numbers)]))
    truth = inside / "state_groundtruth_estimate0/data.csv"
    truth.parent.mkdir()
    truth.write_text("\n".join(rows) + "\n")
    return folder


def write_kitti(
    folder: Path, scene: object, K: Intrinsics, poses: np.ndarray, baseline_m: float = 0.12
) -> Path:
    """Colour images of cameras 2 and 3 from poses (N, 4, 4) of camera 0, 6 cm left of camera 2."""
    places = {0: 0.0, 1: baseline_m, 2: 0.06, 3: 0.06 + baseline_m}
    sensor = RGBDSensor(scene, K, noise="none")
    for k in (2, 3):
        for index, pose in enumerate(poses):
            T = pose @ make_pose(np.eye(3), [places[k], 0, 0])
            save(folder / f"image_{k}/{index:06d}.png", sensor.ground_truth(T).color)
    lines = []
    for k, x in places.items():
        P = K.matrix @ np.hstack([np.eye(3), [[-x], [0], [0]]])
        lines.append(f"P{k}: " + " ".join(f"{v:.12e}" for v in P.ravel()))
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(len(poses))))
    np.savetxt(folder / "poses.txt", poses[:, :3].reshape(-1, 12), fmt="%.9e")
    return folder
