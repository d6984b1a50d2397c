"""The measurement of batches of SLAMs, with a tiny budget."""

import pytest

from ms_slam_env._warp import wp
from ms_slam_env.cli import main
from ms_slam_env.experiments.slam_batch import SlamBatch, device_bytes

TINY = {"scene": "carpet", "seed": 1000, "size": "80x60", "frames": 4, "sequences": 2}


def test_batches_are_measured_with_their_memory():
    specs = SlamBatch(batch=(1, 3), warm_up=1, max_surfels=8000, **TINY).specs()
    results = [SlamBatch.run(spec) for spec in specs]
    for spec, result in zip(specs, results, strict=True):
        assert result["lost_frames"] == 0
        assert result["ate_unaligned_m"] > 0
        assert result["frames_per_s"] == pytest.approx(1000 * spec.batch / result["batch_ms"])
        assert 0.5 < result["mb_per_env"] < 20
    assert results[1]["mb_per_env"] == pytest.approx(results[0]["mb_per_env"], rel=0.2)


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU")
def test_says_that_nothing_was_measured_without_a_gpu(tmp_path, capsys):
    words = ["experiment", "slam-batch", "--device", "cuda", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "not measured on a GPU" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_bytes_of_arrays_and_their_views():
    made, size = device_bytes(lambda: (array := wp.zeros((5, 4), dtype=wp.vec3), array.flatten()))
    assert made[0].shape == (5, 4)
    assert size == 5 * 4 * 12
