"""The sensor as a whole: determinism, batches, bad input."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.sensor import RGBDSensor, depth_noise, images, rays, shading
from ms_slam_env.sensor.noise import noise_config

K = xtion("80x60")


@pytest.fixture(scope="module")
def pose(box_scene: BoxScene) -> np.ndarray:
    return box_scene.sample_start(np.random.default_rng(0))


def same(a, b) -> bool:
    return np.array_equal(a.color, b.color) and np.array_equal(a.depth, b.depth)


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**40), index=st.integers(0, 2**31))
def test_noise_is_a_function_of_seed_and_index(box_scene, pose, sensor, seed, index) -> None:
    first = sensor.capture(pose, index, seed=seed)
    other = sensor.capture(pose, index + 1, seed=seed)
    reseeded = sensor.capture(pose, index, seed=seed + 1)
    again = RGBDSensor(box_scene, K, seed=seed).capture(pose, index)
    assert same(first, again)
    for different in (other, reseeded):
        assert not np.array_equal(first.color, different.color)
        assert not np.array_equal(first.depth, different.depth)


@pytest.fixture(scope="module")
def sensor(box_scene: BoxScene) -> RGBDSensor:
    return RGBDSensor(box_scene, K)


def test_noise_of_successive_frames_is_uncorrelated(sensor: RGBDSensor, pose) -> None:
    frames = [sensor.capture(pose, index).color.astype(float) for index in range(8)]
    truth = np.mean(frames, axis=0)
    noise = [(frame - truth).ravel() for frame in frames]
    # Taking the mean of n frames off leaves a correlation of -1 / (n - 1).
    correlations = np.corrcoef(noise)[np.triu_indices(8, 1)]
    assert np.abs(correlations + 1 / 7).max() < 0.05
    shifted = [np.corrcoef(noise[0][:-lag], noise[1][lag:])[0, 1] for lag in (3, 6, 240)]
    assert np.abs(shifted).max() < 0.06


def test_a_batch_equals_its_single_frames(sensor: RGBDSensor, box_scene: BoxScene) -> None:
    rng = np.random.default_rng(1)
    poses = np.stack([box_scene.sample_start(rng) for _ in range(3)])
    batch = sensor.capture_batch(poses, [4, 9, 2])
    singles = [sensor.capture(T, index) for T, index in zip(poses, (4, 9, 2), strict=True)]
    assert all(same(a, b) for a, b in zip(batch, singles, strict=True))


@pytest.mark.parametrize("size", [(80, 60), (37, 23)])
def test_vectorised_rows_equal_single_pixels(box_scene: BoxScene, monkeypatch, size) -> None:
    """A thread does a row on the CPU and a pixel on a GPU: the images are the same."""
    width, height = size
    camera = Intrinsics(70.0, 70.0, width / 2 - 0.5, height / 2 - 0.5, width, height)
    rows = RGBDSensor(box_scene, camera)
    pixels = RGBDSensor(box_scene, camera)
    for seed in range(4):
        T = box_scene.sample_start(np.random.default_rng(seed))
        expected = rows.capture(T, seed)
        with monkeypatch.context() as patch:
            patch.setattr(images, "span_of", lambda width, device: 1)
            assert same(pixels.capture(T, seed), expected)


def test_kernels_compile_for_cuda(tmp_path) -> None:
    """Into PTX, which needs no GPU; Embree's packets are for the CPU alone."""
    if not wp.get_cuda_supported_archs():
        pytest.skip("this build of Warp has no CUDA compiler")
    for module in (shading, depth_noise, rays):
        wp.compile_aot_module(module, module_dir=tmp_path, arch=80, use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 3


def test_many_batch_sizes_keep_few_buffers(box_scene: BoxScene, pose) -> None:
    sensor = RGBDSensor(box_scene, K)
    first = sensor.capture(pose, 0)
    for size in range(1, 12):
        frames = sensor.capture_batch(np.tile(pose, (size, 1, 1)), range(size))
        assert same(frames[0], first)
    assert len(sensor._of_thread.images) == 8
    assert same(sensor.capture(pose, 0), first)


def test_a_sensor_with_another_noise_is_one_made_with_it(box_scene, sensor, pose) -> None:
    strong = noise_config({"name": "kinect", "strength": 1.5})
    before = sensor.capture(pose, 3).depth.copy()
    frame = sensor.with_noise(strong).capture(pose, 3)
    assert same(frame, RGBDSensor(box_scene, K, strong).capture(pose, 3))
    np.testing.assert_array_equal(sensor.capture(pose, 3).depth, before)
    assert (before != frame.depth).any()


def test_frames_do_not_share_memory(sensor: RGBDSensor, pose) -> None:
    first = sensor.capture(pose, 0)
    color, depth = first.color.copy(), first.depth.copy()
    sensor.capture(pose, 1)
    sensor.ground_truth(pose)
    assert np.array_equal(first.color, color)
    assert np.array_equal(first.depth, depth)


def test_time_stamps(sensor: RGBDSensor, pose) -> None:
    assert sensor.capture(pose, 15).timestamp == pytest.approx(0.5)
    assert sensor.capture(pose, 15, timestamp=2.0).timestamp == 2.0


def test_unknown_noise_is_refused(box_scene: BoxScene) -> None:
    with pytest.raises(InputError, match=r"unknown noise model 'gauss'; valid choices: kinect"):
        RGBDSensor(box_scene, K, noise="gauss")


@pytest.mark.parametrize(
    "bad", [np.full((4, 4), np.nan), np.eye(3), 2 * np.eye(4), np.zeros((4, 4))]
)
def test_bad_poses_are_refused(sensor: RGBDSensor, bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="T_world_camera"):
        sensor.capture(bad, 0)
    with pytest.raises(InputError, match="T_world_camera"):
        sensor.ground_truth(bad)


@pytest.mark.parametrize(("seed", "index"), [(-1, 0), (0, -1), (0, 1.5), (True, 0)])
def test_bad_seeds_and_indices_are_refused(sensor: RGBDSensor, pose, seed, index) -> None:
    with pytest.raises(InputError, match="integer >= 0"):
        sensor.capture(pose, index, seed=seed)


def test_a_batch_needs_one_index_a_pose(sensor: RGBDSensor, pose) -> None:
    with pytest.raises(InputError, match="2 frame indices"):
        sensor.capture_batch(pose[None], [0, 1])


def test_a_batch_takes_time_stamps(sensor: RGBDSensor, pose) -> None:
    frames = sensor.capture_batch([pose, pose], [3, 4], timestamps=[0.25, 0.75])
    assert [frame.timestamp for frame in frames] == [0.25, 0.75]
    frames = sensor.capture_batch([pose, pose], [3, 6])
    assert [frame.timestamp for frame in frames] == pytest.approx([0.1, 0.2])
    with pytest.raises(InputError, match="1 time stamps for 2 frames"):
        sensor.capture_batch([pose, pose], [3, 4], timestamps=[0.25])
    with pytest.raises(InputError, match="finite"):
        sensor.capture(pose, 3, timestamp=float("nan"))


def test_threads_share_a_sensor(box_scene: BoxScene) -> None:
    """Each thread gets the frames, and the true depth, that it would get alone."""
    sensor = RGBDSensor(box_scene, K)
    rng = np.random.default_rng(2)
    poses = [box_scene.sample_start(rng) for _ in range(4)]
    alone = [[sensor.capture(T, index, seed=7) for index in range(15)] for T in poses]
    truth = [sensor.ground_truth(T).depth for T in poses]
    start = threading.Barrier(len(poses))

    def work(which: int) -> list[bool]:
        start.wait()
        equal = []
        for index, expected in enumerate(alone[which]):
            frame = sensor.capture(poses[which], index, seed=7)
            equal.append(same(frame, expected))
            equal.append(np.array_equal(sensor.last_true_depth(), truth[which]))
        return equal

    with ThreadPoolExecutor(len(poses)) as pool:
        assert all(all(equal) for equal in pool.map(work, range(len(poses))))


def test_true_depth_of_the_last_frame(box_scene: BoxScene, pose) -> None:
    sensor = RGBDSensor(box_scene, K)
    with pytest.raises(InputError, match="captured no frame"):
        sensor.last_true_depth()
    sensor.capture(pose, 0)
    truth = sensor.ground_truth(pose).depth
    assert np.array_equal(sensor.last_true_depth(), truth)
    other = box_scene.sample_start(np.random.default_rng(5))
    sensor.capture_batch([pose, other], [0, 1])
    assert np.array_equal(sensor.last_true_depth(), sensor.ground_truth(other).depth)
