"""Maps on disk: gone on from, found again in, refused in one line; states compared."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.frame_selection import make_config
from ms_slam_env.slam.shared.state_check import (
    ArrayOf,
    Depending,
    Fields,
    ListOf,
    OrNone,
    Real,
    WholeNumber,
    check_like,
    is_open,
)
from ms_slam_env.slam.shared.state_file import read_state, write_state

CAMERA = xtion("160x120")
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])
OPTIONS: dict[str, dict[str, int]] = {
    name: {"max_surfels": 60_000} for name in ("surfel", "odometry", "sparse")
}


def _path(count: int) -> np.ndarray:
    poses = [START]
    for _ in range(count - 1):
        poses.append(poses[-1] @ make_pose(so3_exp([0, np.radians(-1.5), 0]), [0.02, 0, 0.002]))
    return np.stack(poses)


PATH = _path(14)


def _new(name: str) -> slam.SlamBackend:
    backend = slam.make(name, CAMERA, **OPTIONS.get(name, {}))
    backend.reset(START)
    return backend


@pytest.fixture(scope="module")
def frames(box_scene: BoxScene) -> list[RGBDFrame]:
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)
    return [sensor.capture(pose, index) for index, pose in enumerate(PATH)]


@pytest.fixture(params=sorted(slam.BACKENDS))
def name(request: pytest.FixtureRequest) -> str:
    if request.param in ("volumetric", "kinectfusion"):
        pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    if request.param == "sparse":
        pytest.importorskip("gtsam", reason="GTSAM is not installed", exc_type=ImportError)
    return str(request.param)


def test_a_map_that_was_saved_is_gone_on_from_bit_exactly(name, frames, tmp_path):
    one, other = _new(name), _new(name)
    for frame in frames[:4]:
        one.track(frame)
    one.save(tmp_path / "map.npz")
    other.load(tmp_path / "map.npz", lost=False)
    for frame in frames[4:7]:
        np.testing.assert_array_equal(
            one.track(frame).T_world_camera, other.track(frame).T_world_camera
        )
    np.testing.assert_array_equal(one.surface_points(), other.surface_points())


def test_a_later_session_finds_itself_in_the_map_and_extends_it(name, frames, tmp_path):
    """The camera comes back where the first session began; its poses are in that one's frame."""
    first = _new(name)
    for frame in frames[:6]:
        first.track(frame)
    first.save(tmp_path / "map.npz")
    second = _new(name)
    second.load(tmp_path / "map.npz")
    known = len(second.surface_points())
    assert known == len(first.surface_points())
    results = [second.track(frame) for frame in frames[4:]]
    assert results[0].relocalised
    assert all(result.tracking_ok for result in results)
    estimates = np.stack([result.T_world_camera for result in results])
    assert np.linalg.norm(estimates[:, :3, 3] - PATH[4:, :3, 3], axis=1).max() < 0.03
    assert len(second.surface_points()) > known


def test_a_frame_far_from_where_the_map_was_left_is_found_at_keyframes(frames, tmp_path):
    first = _new("surfel")
    for frame in frames:
        first.track(frame)
    first.save(tmp_path / "map.npz")
    second = _new("surfel")
    second.load(tmp_path / "map.npz")
    result = second.track(frames[0])  # 26 cm and 20 degrees away
    again = second.track(frames[1])
    assert again.tracking_ok
    assert result.relocalised or again.relocalised
    assert np.linalg.norm(again.T_world_camera[:3, 3] - PATH[1, :3, 3]) < 0.02


def test_a_filter_in_front_begins_anew(frames, tmp_path):
    inner = _new("surfel")
    for frame in frames[:4]:
        inner.track(frame)
    inner.save(tmp_path / "map.npz")
    managed = make_config(name="regular", every=2).manage(_new("surfel"))
    managed.load(tmp_path / "map.npz")
    assert managed.frames_counted == 4
    assert [managed.track(frame).processed for frame in frames[3:6]] == [True, False, True]
    managed.save(tmp_path / "more.npz")
    _new("surfel").load(tmp_path / "more.npz")


def test_a_backend_is_made_as_the_file_says(frames, tmp_path):
    one = slam.make("surfel", CAMERA, max_surfels=60_000, icp_rgb_weight=0.25)
    one.track(frames[0])
    one.save(tmp_path / "map.npz")
    made = slam.open_map(tmp_path / "map.npz")
    assert made.config == one.config
    assert made.intrinsics == CAMERA
    np.testing.assert_array_equal(made.surface_points(), one.surface_points())
    assert slam.open_map(tmp_path / "map.npz", icp_rgb_weight=0.5).config.icp_rgb_weight == 0.5


@pytest.fixture(scope="module")
def saved(frames: list[RGBDFrame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    backend = _new("surfel")
    for frame in frames[:2]:
        backend.track(frame)
    path = tmp_path_factory.mktemp("maps") / "map.npz"
    backend.save(path)
    return path


def _refusal(path: Path, name: str = "surfel") -> str:
    """What is said of a file; the backend is as it was."""
    backend = _new(name)
    before = len(backend.surface_points())
    with pytest.raises(InputError) as caught:
        backend.load(path)
    assert len(backend.surface_points()) == before
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def test_what_is_no_map_is_refused_in_one_line(saved, tmp_path):
    data = saved.read_bytes()
    path = tmp_path / "bad.npz"
    assert "No such file" in _refusal(path)
    for broken in (b"", b"no map", data[: len(data) // 2], _with_flipped_bytes(data)):
        path.write_bytes(broken)
        assert "damaged, or no map" in _refusal(path)
    np.savez(path, a=np.zeros(3))
    assert "damaged, or no map" in _refusal(path)


def _with_flipped_bytes(data: bytes) -> bytes:
    middle = len(data) // 2
    return (
        data[:middle] + bytes(255 - one for one in data[middle : middle + 64]) + data[middle + 64 :]
    )


def test_another_backend_camera_or_version_is_named(saved, tmp_path):
    assert "a map of SurfelSlam, not of OdometrySlam" in _refusal(saved, "odometry")
    other = slam.make("surfel", xtion("80x60"), max_surfels=60_000)
    with pytest.raises(InputError, match="made from images of 160x120, not 80x60; continue at"):
        other.load(saved)
    path = tmp_path / "version.npz"
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.namelist():
            content = old.read(entry)
            if entry == "tree.json":
                content = json.dumps({**json.loads(content), "version": 99}).encode()
            new.writestr(entry, content)
    assert "version 99; this program reads 1" in _refusal(path)


def test_a_state_that_does_not_fit_leaves_the_backend_as_it_was(saved, frames):
    about, state = read_state(saved)
    small = slam.make("surfel", CAMERA, max_surfels=1000)
    with pytest.raises(InputError, match="there is room for 1000"):
        small.load(saved)
    backend = _new("surfel")
    first = backend.track(frames[0])
    state["poses"] = np.full((1, 4, 4), np.nan)
    path = saved.with_name("nan.npz")
    write_state(path, about, state)
    with pytest.raises(InputError, match=r"does not fit this backend.*poses"):
        backend.load(path)
    assert first.tracking_ok
    assert backend.track(frames[1]).tracking_ok
    assert backend.frames_counted == 2


def test_nothing_in_a_file_is_executed(saved, tmp_path):
    """An array of pickled objects is refused before anything reads it."""
    path = tmp_path / "pickle.npz"
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.namelist():
            if entry == "0.npy":
                with new.open(entry, "w") as file:
                    objects = np.array([{"a": 1}], dtype=object)
                    np.lib.format.write_array(file, objects, allow_pickle=True)
            else:
                new.writestr(entry, old.read(entry))
    assert "damaged, or no map" in _refusal(path)


def test_the_state_of_another_backend_names_what_it_lacks():
    states = {name: _new(name).get_state() for name in ("surfel", "odometry")}
    with pytest.raises(
        InputError, match="not a saved state of OdometrySlam: it lacks pose, motion"
    ):
        _new("odometry").set_state(states["surfel"])
    with pytest.raises(InputError, match="not a saved state of SurfelSlam: it lacks submaps"):
        _new("surfel").set_state(states["odometry"])
    managed = make_config(name="regular", every=2).manage(_new("surfel"))
    with pytest.raises(InputError, match="not a saved state of SelectiveSlam: it lacks"):
        managed.set_state(states["surfel"])


def _forged(saved: Path, change: Callable[[dict[str, Any]], None], **members: bytes) -> Path:
    """A copy of a map with another header, and more in its archive."""
    path = saved.with_name("forged.npz")
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        header = json.loads(old.read("tree.json"))
        change(header)
        new.writestr("tree.json", json.dumps(header))
        for name in old.namelist():
            if name != "tree.json":
                new.writestr(name, old.read(name))
        for name, data in members.items():
            new.writestr(f"{name}.npy", data)
    return path


def _with_poses(tree: Any) -> Callable[[dict[str, Any]], None]:
    return lambda header: header["state"]["mapping"].update(poses=tree)


def _array(shape: tuple[int, ...]) -> bytes:
    data = io.BytesIO()
    np.lib.format.write_array(data, np.zeros(shape, np.float32), allow_pickle=False)
    return data.getvalue()


def test_a_file_that_grows_once_unpacked_is_refused_before_anything_is_read(saved):
    zeros = _array((50_000_000,))
    path = _forged(saved, _with_poses({"array": 900}), **{"900": zeros})
    assert path.stat().st_size < 2e6
    assert "MB once unpacked" in _refusal(path)
    path = _forged(saved, lambda header: header.update(more="x" * 17_000_000))
    assert "tree.json is larger than 17 MB" in _refusal(path)


def test_an_array_that_stands_in_several_places_is_refused(saved):
    """Two hundred names of 4 MB would grow to 800 MB."""
    tree = {"list": [{"array": 900}] * 200}
    path = _forged(saved, _with_poses(tree), **{"900": _array((1_000_000,))})
    assert "900.npy stands for several arrays" in _refusal(path)


def test_a_map_with_room_for_more_than_there_is_memory_is_refused(saved, monkeypatch):
    def no_memory(*_: Any) -> None:
        raise OSError(12, "Cannot allocate memory")

    path = _forged(saved, lambda header: header["about"]["config"].update(max_surfels=50_000_000))
    monkeypatch.setattr("ms_slam_env.slam.surfel.surfels.roomy_zeros", no_memory)
    with pytest.raises(InputError, match=f"{path}: no memory for a map of max_surfels = 50000000"):
        slam.open_map(path)


@pytest.mark.parametrize("old", [b"'shape'", b"(2, 4", b"{", b"}"])
def test_a_broken_header_of_an_array_is_no_map(saved, old):
    """NumPy reads it as Python and raises what Python's tokens raise."""
    data = _array((2, 4)).replace(old, b"[" * len(old), 1)
    path = _forged(saved, _with_poses({"array": 900}), **{"900": data})
    assert "damaged, or no map" in _refusal(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda about: about["intrinsics"].pop("fy"), "intrinsics lacks fy"),
        (lambda about: about["intrinsics"].clear(), "lacks fx, fy, cx, cy, width, height"),
        (lambda about: about.update(backend=["surfel"]), "unknown SLAM backend"),
        (lambda about: about.update(backend={}), "unknown SLAM backend"),
    ],
)
def test_what_a_map_is_of_may_not_be_left_open(saved, change, said):
    path = _forged(saved, lambda header: change(header["about"]))
    with pytest.raises(InputError, match=said):
        slam.open_map(path)


NEEDS = {"sparse": "gtsam", "volumetric": "open3d", "kinectfusion": "open3d"}
VARIANTS = [
    *((name, {}) for name in sorted(slam.BACKENDS)),
    ("surfel", {"loop_closure": "deformation", "submaps": "atlas", "relocalisation": "features"}),
    ("surfel", {"color_registration": "estimated", "motion_mask": "geometric", "readout_s": 0.02}),
]


@pytest.mark.parametrize(("name", "options"), VARIANTS)
def test_nothing_in_a_state_of_ours_is_left_undescribed(name, options):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], exc_type=ImportError)
    backend = slam.make(name, xtion("80x60"), **options)
    assert not is_open(backend.state_like())
    check_like(backend.get_state(), backend.state_like(), "slam")


ROWS, IDS = ArrayOf(np.float64, ("rows", 3)), ArrayOf(np.int64, ("ids",), 0, index_of="rows")
PAIRS = ListOf({"a": ArrayOf(np.int8, ("n",)), "b": ArrayOf(np.int8, ("n",))}, "pairs")


@pytest.mark.parametrize(
    ("value", "like", "message"),
    [
        ({"x": np.zeros((4, 3)), "y": np.zeros((5, 3))}, {"x": ROWS, "y": ROWS}, "y has length 5"),
        ({"i": np.array([3]), "x": np.zeros((3, 3))}, {"i": IDS, "x": ROWS}, r"outside \[0, 2\]"),
        ({"i": np.array([0]), "x": np.zeros((0, 3))}, {"i": IDS, "x": ROWS}, r"outside \[0, -1\]"),
        ([{"a": np.zeros(2, np.int8), "b": np.zeros(3, np.int8)}], PAIRS, r"\[0\].b has length 3"),
        ({"p": [], "n": 1}, {"p": PAIRS, "n": WholeNumber(most="pairs")}, "n counts to 1"),
        ([np.zeros((2, 2)), np.zeros((3, 2))], ListOf(ArrayOf(float, ("h", 2))), "has length 3"),
        ([np.eye(4), np.eye(4, dtype="f4")], ListOf(np.eye(4)), "several shapes or types"),
        ([{"t": 1}, {"t": 1}], ListOf({"t": 0}, rising="t"), "not in the order of t"),
        ([0, 0, 0], ListOf(0, 2), "has 3 elements"),
        ("x", OrNone(0), "is a str"),
        (2**30 + 1, 0, "counts to"),
        (True, WholeNumber(), "is a bool"),
        (np.nan, Real(), "no number"),
        (-0.5, Real(0, 1), r"no number in \[0, 1\]"),
        ({"a": 1}, Fields({"a": 0}, lambda value: "is odd" if value["a"] % 2 else ""), "is odd"),
        ({"k": 1}, Depending(lambda value: {"k": WholeNumber(most=value["k"] - 1)}), "counts to 1"),
        (np.full(3, 3e38, "f4"), ArrayOf("f4", ("n",)), "not finite"),
        (np.full(3, 300.0), ArrayOf(float, ("n",), 0, 255), r"outside \[0, 255\]"),
        (np.full((1, 4), 0.3), ArrayOf(float, (1, 4), 0, is_distribution=True), "distributions"),
    ],
)
def test_a_value_that_does_not_fit_its_description_is_refused_by_its_place(value, like, message):
    with pytest.raises(InputError, match=message):
        check_like(value, like, "x")


def test_what_fits_is_taken():
    like = {"i": IDS, "x": ROWS, "pairs": PAIRS, "one": OrNone(WholeNumber(index_of="pairs"))}
    pairs = [{"a": np.zeros(n, np.int8), "b": np.zeros(n, np.int8)} for n in (2, 5)]
    value = {"i": np.array([0, 2]), "x": np.zeros((3, 3)), "pairs": pairs, "one": 1}
    check_like(value, like, "x")
    check_like({**value, "one": None, "pairs": []}, like, "x")
    check_like({"frames": 5}, {"frames": WholeNumber(most="all")}, "x", {"all": 5})
    check_like(np.inf, Real(0), "x")
