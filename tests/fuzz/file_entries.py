"""Entry points that read files: recordings, images, trajectories, meshes, calibrations."""

from __future__ import annotations

import io
import json
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from bag_files import Messages, write_bag
from fuzzing import Entry
from mesh_writers import (
    QUADS,
    embedded,
    glb,
    ply,
    textured_gltf,
    write_gltf,
    write_obj,
    write_png,
)
from mutations import Files, mutated_bytes, mutated_folder, mutated_text, write_files
from PIL import Image

from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.image_files import read_color, read_depth
from ms_slam_env.evaluation.map_files import read_surface
from ms_slam_env.evaluation.trajectory_files import TrajectoryOptions
from ms_slam_env.evaluation.trajectory_measures import evaluate_files
from ms_slam_env.scenes.mesh_file import load_soup
from ms_slam_env.sequences import open_sequence, read_trajectory
from ms_slam_env.sequences.recording import parse_calibration

WIDTH, HEIGHT, FRAMES = 16, 12, 4
K = Intrinsics(15.0, 15.0, 7.5, 5.5, WIDTH, HEIGHT)
CALIBRATION = "15 15 7.5 5.5 16 12 5000\n"
MATRIX = b"15 0 7.5 0\n0 15 5.5 0\n0 0 1 0\n0 0 0 1\n"
LENS = "15 15 7.5 5.5 16 12 5000 radial-tangential -0.2 0.05 0.001 0.002 0\n"
RATIONAL = "15 15 7.5 5.5 16 12 5000 rational 0.52 -2.63 0.0005 -0.0002 1.52 0.39 -2.45 1.45\n"


def image(kind: str, number: int, suffix: str = "PNG", times: int = 1) -> bytes:
    """A small image of colour or depth as a file."""
    rng, shape = np.random.default_rng(number), (times * HEIGHT, times * WIDTH)
    if kind == "depth":
        pixels = rng.integers(4000, 9000, shape).astype(np.uint16)
    else:
        pixels = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, suffix)
    return stream.getvalue()


def trajectory(seed: int = 0) -> bytes:
    """A trajectory of twelve poses in the TUM format."""
    rng = np.random.default_rng(seed)
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for k in range(12):
        q = np.array([0.01 * k, 0.02 * k, 0.0, 1.0])
        numbers = [k / 30, *(0.1 * k * np.arange(1, 4) + rng.normal(0, 1e-3, 3)), *q]
        numbers[4:] = list(q / np.linalg.norm(q))
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    return ("\n".join(lines) + "\n").encode()


@cache
def tum() -> Files:
    """A recording in the TUM layout."""
    files = {"intrinsics.txt": CALIBRATION.encode(), "groundtruth.txt": trajectory()}
    for kind, name in (("color", "rgb"), ("depth", "depth")):
        files |= {f"{name}/{k}.png": image(kind, k) for k in range(FRAMES)}
        lines = [f"{k / 30:.6f} {name}/{k}.png" for k in range(FRAMES)]
        files[f"{name}.txt"] = ("\n".join(lines) + "\n").encode()
    return files


@cache
def icl_nuim() -> Files:
    """A recording in the layout of ICL-NUIM."""
    lines = [f"{k} depth/{k}.png {k} rgb/{k}.png" for k in range(FRAMES)]
    images = {name: data for name, data in tum().items() if name.endswith(".png")}
    poses = b"\n".join(
        b"%d %s" % (k, line.split(b" ", 1)[1])
        for k, line in enumerate(trajectory().splitlines()[1:])
    )
    return {
        **images,
        "associations.txt": "\n".join(lines).encode(),
        "livingRoom.gt.freiburg.txt": poses,
        "intrinsics.txt": b"15 -15 7.5 5.5 16 12 5000\n",
    }


@cache
def seven_scenes() -> Files:
    """A recording in the layout of 7-Scenes."""
    files = {"intrinsics.txt": b"15 15 7.5 5.5 16 12 1000\n"}
    for k in range(FRAMES):
        pose = np.eye(4)
        pose[:3, 3] = 0.01 * k
        rows = "\n".join(" ".join(f"{v:.7e}" for v in row) for row in pose)
        files |= {
            f"frame-{k:06d}.color.jpg": image("color", k, "JPEG"),
            f"frame-{k:06d}.depth.png": image("depth", k),
            f"frame-{k:06d}.pose.txt": rows.encode(),
        }
    return files


@cache
def plain() -> Files:
    """A recording as folders of images."""
    images = {name: data for name, data in tum().items() if name.endswith(".png")}
    times = "\n".join(f"{k / 30}" for k in range(FRAMES)).encode()
    return {**images, "intrinsics.txt": CALIBRATION.encode(), "times.txt": times}


@cache
def match3d() -> Files:
    """A recording in the layout of 3DMatch: that of 7-Scenes with its camera's matrix."""
    files = {name: data for name, data in seven_scenes().items() if name != "intrinsics.txt"}
    lost = b"-inf -inf -inf -inf\n" * 4
    return {**files, "camera-intrinsics.txt": MATRIX, "frame-000001.pose.txt": lost}


@cache
def scannet() -> Files:
    """A recording in the layout of ScanNet, with colour twice as large as depth."""
    files: Files = {
        "intrinsic/intrinsic_depth.txt": MATRIX,
        "intrinsic/intrinsic_color.txt": MATRIX,
    }
    for k in range(FRAMES):
        files |= {
            f"depth/{k}.png": image("depth", k),
            f"color/{k}.jpg": image("color", k, "JPEG", times=2),
            f"pose/{k}.txt": match3d()[f"frame-{k:06d}.pose.txt"],
        }
    return files


@cache
def replica() -> Files:
    """A recording in the layout of Replica."""
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 15, "fy": 15, "cx": 7.5, "cy": 5.5, "scale": 6553.5}
    files: Files = {"cam_params.json": json.dumps({"camera": camera}).encode()}
    for k in range(FRAMES):
        files |= {
            f"results/depth{k:06d}.png": image("depth", k),
            f"results/frame{k:06d}.jpg": image("color", k, "JPEG"),
        }
    poses = [f"1 0 0 {0.1 * k} 0 1 0 0 0 0 1 0 0 0 0 1" for k in range(FRAMES)]
    return {**files, "traj.txt": "\n".join(poses).encode()}


@cache
def vary_times() -> Files:
    """Folders of images with ids in their times and nanoseconds since boot in the truth's."""
    times = "\n".join(f"{k} {512 * 10**9 + k * 33_333_333} 12.5" for k in range(FRAMES))
    truth = "\n".join(f"{512 * 10**9 + k * 16_666_667} 0 0 0 0 0 0 1" for k in range(2 * FRAMES))
    return {**plain(), "times.txt": times.encode(), "groundtruth.txt": truth.encode()}


FORMS: tuple[Callable[[bytes], bytes], ...] = (
    lambda data: b"\xef\xbb\xbf" + data,
    lambda data: data.replace(b"\n", b"\r\n"),
    lambda data: re.sub(rb"(?<=\d)\.(?=\d)", b",", data),
    lambda data: data.replace(b" ", b";"),
    lambda data: b"# [ns]\n" + data,
    lambda data: b"%YAML:1.0\n---\n" + data,
    lambda data: b"-inf -inf -inf -inf\n" * 4,
)
"""Other forms of the same text, as others' tools write it."""


def varied_folder(files: Files, rng: np.random.Generator) -> Files:
    """Some texts in another form, and then, mostly, a mutation of the folder."""
    made = dict(files)
    texts = [name for name in sorted(made) if name.endswith((".txt", ".csv", ".yaml", ".json"))]
    form = FORMS[rng.integers(len(FORMS))]
    for name in texts:
        content = made[name]
        if rng.random() < 0.3 and isinstance(content, bytes):
            made[name] = form(content)
    return made if rng.random() < 0.2 else mutated_folder(made, rng)


@cache
def euroc() -> Files:
    """A stereo recording in the layout of EuRoC."""
    files: Files = {}
    stamps = [1_400_000_000_000_000_000 + 50_000_000 * k for k in range(FRAMES)]
    for k in (0, 1):
        pose = [1, 0, 0, 0.1 * k, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        about = {
            "camera_model": "pinhole",
            "intrinsics": [60, 60, 31.5, 23.5],
            "resolution": [4 * WIDTH, 4 * HEIGHT],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": [-0.2, 0.05, 0.001, 0.001],
            "T_BS": {"rows": 4, "cols": 4, "data": pose},
        }
        lines = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        files |= {
            f"mav0/cam{k}/sensor.yaml": yaml.safe_dump(about).encode(),
            f"mav0/cam{k}/data.csv": f"#timestamp [ns],filename\n{lines}".encode(),
        }
        for index, stamp in enumerate(stamps):
            files[f"mav0/cam{k}/data/{stamp}.png"] = image("color", index, times=4)
    rows = "".join(f"{stamp},{0.01 * i},0,0,1,0,0,0\n" for i, stamp in enumerate(stamps))
    return {**files, "mav0/state_groundtruth_estimate0/data.csv": rows.encode()}


@cache
def kitti() -> Files:
    """A stereo recording in the layout of KITTI odometry."""
    pictures = {f"{i:06d}.png": image("color", i, times=4) for i in range(FRAMES)}
    right = "60 0 31.5 -6 0 60 23.5 0 0 0 1 0"
    return {
        **{f"image_{k}/{name}": data for k in (0, 1) for name, data in pictures.items()},
        "calib.txt": f"P0: {right.replace('-6', '0')}\nP1: {right}\n".encode(),
        "times.txt": "".join(f"{0.1 * k}\n" for k in range(FRAMES)).encode(),
        "poses.txt": "".join(f"1 0 0 {0.1 * k} 0 1 0 0 0 0 1 0\n" for k in range(FRAMES)).encode(),
    }


def call_recording(files: Files, folder: Path) -> None:
    """Open a recording and decode all of it."""
    write_files(files, folder / "s")
    decode(folder / "s")


@cache
def bags() -> dict[str, bytes]:
    """A bag of ROS 1 and one of ROS 2."""
    made = {}
    for name, version in (("a.bag", 1), ("a.mcap", 2)):
        own = Messages(version)
        rng = np.random.default_rng(0)
        depth = rng.uniform(1, 2, (FRAMES, HEIGHT, WIDTH)).astype(np.float32)
        color = rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3)).astype(np.uint8)
        times = [1.0 + k / 30 for k in range(FRAMES)]
        topics = {
            "/depth/image": [
                (t, own.image(t, d, "32FC1")) for t, d in zip(times, depth, strict=True)
            ],
            "/rgb/image": [(t, own.image(t, c, "rgb8")) for t, c in zip(times, color, strict=True)],
            "/depth/camera_info": [(1.0, own.info(1.0, K))],
            "/rgb/camera_info": [(1.0, own.info(1.0, replace(K, fx=20.0)))],
            "/ground_truth": [(t, own.pose(t, np.eye(4), "Odometry")) for t in times],
            "/tf_static": [(1.0, own.transforms(1.0, {("camera", "base_link"): np.eye(4)}))],
        }
        with tempfile.TemporaryDirectory() as folder:
            made[name] = write_bag(Path(folder) / name, own, topics).read_bytes()
    return made


def one_bag(files: dict[str, bytes], rng: np.random.Generator) -> dict[str, bytes]:
    """Some bytes of one of them changed, often numbers of its header or its end."""
    name = sorted(files)[rng.integers(len(files))]
    return {name: mutated_bytes(files[name], rng)}


def call_bag(files: dict[str, bytes], folder: Path) -> None:
    """Open bags and decode all of them."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
        decode(folder / name)


def decode(path: Path) -> None:
    """Decode every frame of a recording."""
    sequence = open_sequence(path)
    times = sequence.timestamps
    assert np.isfinite(times).all()
    assert (np.diff(times) > 0).all()
    known = sequence.poses[sequence.known]
    assert np.abs(known[:, :3, :3] @ known[:, :3, :3].swapaxes(1, 2) - np.eye(3)).max(initial=0) < 1
    shape = sequence.intrinsics.shape
    for frame in sequence.frames:
        assert frame.color.shape == (*shape, 3)
        assert frame.depth.shape == shape
        assert np.isfinite(frame.depth).all()


def call_image(files: Files, folder: Path) -> None:
    """Decode images of both kinds."""
    write_files(files, folder)
    for name in files:
        if "depth" in name:
            assert read_depth(folder / name, K).shape == K.shape
        else:
            assert read_color(folder / name, K).shape == (*K.shape, 3)


def images() -> Files:
    """An image of each kind and format."""
    return {
        **{f"color.{s.lower()}": image("color", 0, s) for s in ("PNG", "JPEG", "TIFF", "PPM")},
        **{f"depth.{s.lower()}": image("depth", 0, s) for s in ("PNG", "TIFF", "PPM")},
    }


def one_image(files: Files, rng: np.random.Generator) -> Files:
    """A mutation of one of them alone."""
    name = sorted(files)[rng.integers(len(files))]
    return mutated_folder({name: files[name]}, rng)


def call_trajectory(files: Files, folder: Path) -> None:
    """Read a trajectory."""
    write_files(files, folder)
    times, poses = read_trajectory(folder / "a.txt")
    assert poses.shape == (len(times), 4, 4)
    assert np.isfinite(poses).all()
    assert np.isfinite(times).all()
    assert (np.diff(times) > 0).all()


@cache
def two_trajectories() -> Files:
    """An estimate, the truth, and which frames were tracked."""
    frames = ["timestamp,tracking_ok,cpu_ms", *(f"{k / 30:.6f},{int(k != 5)},1" for k in range(12))]
    return {"a.txt": trajectory(1), "b.txt": trajectory(2), "f.csv": "\n".join(frames).encode()}


def call_evaluate(files: Files, folder: Path) -> None:
    """Compare two trajectories."""
    write_files(files, folder)
    options = TrajectoryOptions(frames=str(folder / "f.csv"))
    found = evaluate_files(folder / "a.txt", folder / "b.txt", options)
    assert 0 <= found["ate_m"] < np.inf
    assert found["poses"] >= 2


@cache
def meshes() -> Files:
    """A box or a room in the formats that are documented; a folder holds what one file names."""
    box = trimesh.creation.box((2.0, 3.0, 1.0))
    cloud = trimesh.PointCloud(np.random.default_rng(0).normal(size=(40, 3)))
    kinds = ("ply", "obj", "glb", "stl", "off")
    made = {f"box.{kind}": box.export(file_type=kind) for kind in kinds}
    made["cloud.ply"] = cloud.export(file_type="ply")
    made["text.ply"] = box.export(file_type="ply", encoding="ascii")
    made["text.stl"] = box.export(file_type="stl_ascii")
    made["mixed.ply"] = ply([*QUADS, (0, 1, 2)], "binary_big_endian", ("double", "uchar", "int"))
    with tempfile.TemporaryDirectory() as folder:
        write_obj(Path(folder, "obj"), "map_Kd -s 2 2 2 wood.png")
        tree, buffer = textured_gltf()
        write_gltf(Path(folder, "gltf"), tree, buffer)
        textured = ply(QUADS, "ascii", ("float", "uchar", "int")).replace(b"red", b"u")
        Path(folder, "ply").mkdir()
        Path(folder, "ply", "room.ply").write_bytes(
            textured.replace(b"green", b"v").replace(b"made by hand", b"TextureFile wood.png")
        )
        for path in sorted(Path(folder).rglob("*.*")):
            write_png(path.parent / "wood.png")
        paths = sorted(path for path in Path(folder).rglob("*") if path.is_file())
        made |= {str(path.relative_to(folder)): path.read_bytes() for path in paths}
    made["room.glb"] = glb(tree | {"images": [{"uri": "wood.png"}]}, buffer)
    made["embedded.gltf"] = json.dumps(tree | {"buffers": [embedded(buffer)]})
    return {n: data.encode() if isinstance(data, str) else data for n, data in made.items()}


def one_mesh(files: Files, rng: np.random.Generator) -> Files:
    """A mutation of one of them, with what it names."""
    groups = sorted({name.partition("/")[0] for name in files})
    group = groups[rng.integers(len(groups))]
    return mutated_folder({n: d for n, d in files.items() if n.partition("/")[0] == group}, rng)


def mesh_names(files: Files) -> list[str]:
    """Those that are meshes themselves."""
    return [name for name in files if not name.endswith((".mtl", ".png", ".bin"))]


def call_surface(files: Files, folder: Path) -> None:
    """Read a map file."""
    write_files(files, folder)
    for name in mesh_names(files):
        points = read_surface(folder / name, 50).points
        assert points.ndim == 2
        assert points.shape[1] == 3
        assert len(points)
        assert np.isfinite(points).all()


def call_mesh(files: Files, folder: Path) -> None:
    """Read a scene's mesh file."""
    write_files(files, folder)
    for name in mesh_names(files):
        if name.startswith("cloud"):
            continue
        soup = load_soup(folder / name)
        assert soup.corners.shape[1:] == (3, 3)
        assert np.isfinite(soup.corners).all()
        assert len(soup.uv) == len(soup.texture) == len(soup.corners)
        assert soup.texture.max() < len(soup.textures)


def call_calibration(data: bytes, folder: Path) -> None:
    """Read intrinsics."""
    words = data.decode("utf-8", errors="replace").split()
    intrinsics = parse_calibration(words, "--intrinsics").intrinsics.undistorted
    assert 1 <= intrinsics.width <= 4096
    assert 1 <= intrinsics.height <= 4096
    assert np.isfinite(intrinsics.rays_at([[0.0, 0.0]])).all()


def _of_folder(name: str, seed: Any, call: Any, mutate: Any = mutated_folder) -> Entry:
    return Entry(name, seed, mutate, call)


ENTRIES = [
    *(
        _of_folder(seed.__name__.replace("_", "-"), seed, call_recording)
        for seed in (tum, icl_nuim, seven_scenes, plain, euroc, kitti)
    ),
    *(
        _of_folder(f"{seed.__name__}-forms".replace("_", "-"), seed, call_recording, varied_folder)
        for seed in (match3d, scannet, replica, vary_times, tum, euroc)
    ),
    Entry("bag", bags, one_bag, call_bag),
    Entry("image", images, one_image, call_image, in_tests=150),
    _of_folder("trajectory", lambda: {"a.txt": trajectory()}, call_trajectory),
    _of_folder("evaluate", two_trajectories, call_evaluate),
    _of_folder("surface", meshes, call_surface, one_mesh),
    _of_folder("mesh", meshes, call_mesh, one_mesh),
    Entry("calibration", CALIBRATION.encode, mutated_text, call_calibration),
    Entry("lens", LENS.encode, mutated_text, call_calibration),
    Entry("rational-lens", RATIONAL.encode, mutated_text, call_calibration),
    _of_folder("trajectory-forms", lambda: {"a.txt": trajectory()}, call_trajectory, varied_folder),
]
