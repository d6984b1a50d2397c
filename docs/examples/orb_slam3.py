"""Run ORB-SLAM3 over a folder that ``ms-slam compare`` writes, and write its trajectory.

A program of its own, in a process of its own: ORB-SLAM3 and its binding ``pyorbslam3`` are GPL, so
nothing of the package imports them or this file. Install them in an environment of their own::

    python -m venv orb && orb/bin/pip install pyorbslam3 pillow

and give the interpreter, this file and the vocabulary (``ORBvoc.txt`` of ORB-SLAM3) as absolute
paths::

    ms-slam compare --backends surfel "orb_slam3=command:/path/to/orb/bin/python
        /path/to/orb_slam3.py --vocabulary /path/to/ORBvoc.txt --in {sequence} --out {trajectory}"

The poses are those returned with each frame, as for the package's own backends. A frame that
ORB-SLAM3 does not track has no pose. It runs several threads, and its results vary between runs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

SETTINGS = """%YAML:1.0
---
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx:.6f}
Camera1.fy: {fy:.6f}
Camera1.cx: {cx:.6f}
Camera1.cy: {cy:.6f}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: {fps}
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.0745
RGBD.DepthMapFactor: {scale:.6f}
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: {levels}
ORBextractor.iniThFAST: {corner}
ORBextractor.minThFAST: {least_corner}
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""
"""Settings of its RGB-D mode; ``Stereo.ThDepth`` times ``Stereo.b`` is about 3 m."""


def listed(folder: Path, name: str) -> list[tuple[str, Path]]:
    """Times, as written, and files of ``rgb.txt`` or ``depth.txt``."""
    lines = (folder / name).read_text().splitlines()
    words = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    return [(time, folder / file) for time, file in words]


def settings_of(folder: Path, args: argparse.Namespace) -> str:
    """Settings of ORB-SLAM3 for the folder's camera."""
    text = (folder / "intrinsics.txt").read_text()
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    fx, fy, cx, cy, width, height, scale = map(float, " ".join(rows).split())
    camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": int(width), "height": int(height)}
    options = {name: getattr(args, name) for name in ("fps", "features", "levels")}
    corners = {"corner": args.corner, "least_corner": args.least_corner}
    return SETTINGS.format(**camera, scale=scale, **options, **corners)


def quaternion(R: np.ndarray) -> np.ndarray:
    """Quaternion (x, y, z, w) of a rotation (3, 3).

    It is the eigenvector of the largest eigenvalue of Davenport's matrix, which has no special
    cases (Bar-Itzhack, JGCD 2000).
    """
    z = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    K = np.block([[R + R.T - np.trace(R) * np.eye(3), z[:, None]], [z[None], np.trace(R)]])
    return np.linalg.eigh(K)[1][:, -1]


def main() -> None:
    """Track every frame and write the poses of those that were tracked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vocabulary", type=Path, required=True, help="ORBvoc.txt of ORB-SLAM3")
    parser.add_argument("--in", dest="folder", type=Path, required=True, help="folder of frames")
    parser.add_argument("--out", type=Path, required=True, help="TUM trajectory to write")
    parser.add_argument("--fps", type=int, default=30, help="frames per second")
    parser.add_argument("--features", type=int, default=1000, help="features of an image")
    parser.add_argument("--levels", type=int, default=8, help="levels of the image pyramid")
    parser.add_argument("--corner", type=int, default=20, help="threshold of FAST corners")
    parser.add_argument("--least-corner", type=int, default=7, help="the same where there are few")
    args = parser.parse_args()
    if not args.vocabulary.is_file():
        sys.exit(f"there is no vocabulary {args.vocabulary}: give the path of ORBvoc.txt")
    import pyorbslam3

    colors, depths = listed(args.folder, "rgb.txt"), listed(args.folder, "depth.txt")
    lines = []
    with tempfile.TemporaryDirectory() as scratch:
        settings = Path(scratch) / "settings.yaml"
        settings.write_text(settings_of(args.folder, args))
        sensor = pyorbslam3.Sensor.RGBD
        with pyorbslam3.Slam(str(args.vocabulary), str(settings), sensor) as system:
            for (time, color_file), (_, depth_file) in zip(colors, depths, strict=True):
                color = np.ascontiguousarray(Image.open(color_file).convert("RGB"))
                depth = np.asarray(Image.open(depth_file), dtype=np.float32)
                result = system.track_rgbd(color, depth, float(time))
                if result.ok:
                    T = np.asarray(result.pose_wc)  # T_world_camera
                    values = (*T[:3, 3], *quaternion(T[:3, :3]))
                    lines.append(" ".join([time, *(f"{value:.9f}" for value in values)]))
    args.out.write_text("".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    main()
