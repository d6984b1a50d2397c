"""The measurement of batches of SLAMs, with a tiny budget."""

import json

import pytest

from ms_slam_env._warp import wp
from ms_slam_env.benchmark.slam_batch import SlamBatchConfig, device_bytes, main
from ms_slam_env.errors import InputError

WORDS = "--scene carpet --seed 1000 --size 80x60 --frames 4 --warm-up 1 --sequences 2"


def test_batches_are_measured_with_their_memory(tmp_path, capsys):
    words = [*WORDS.split(), "--max-surfels", "8000", "--out", str(tmp_path)]
    assert main([*words, "--batch", "1", "3"]) == 0
    rows = json.loads((tmp_path / "slam_batch.json").read_text())["results"]
    assert [row["batch"] for row in rows] == [1, 3]
    for row in rows:
        assert row["lost_frames"] == 0
        assert row["ate_mm"] > 0
        assert row["frames_per_s"] == pytest.approx(1000 * row["batch"] / row["ms_per_batch"])
        assert 0.5 < row["mb_per_env"] < 20
    assert rows[1]["mb_per_env"] == pytest.approx(rows[0]["mb_per_env"], rel=0.2)
    assert capsys.readouterr().out.startswith("| device | batch |")


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU")
def test_says_that_nothing_was_measured_without_a_gpu(tmp_path, capsys):
    assert main([*WORDS.split(), "--device", "cuda", "--out", str(tmp_path)]) == 0
    assert "not measured on a GPU" in capsys.readouterr().out
    data = json.loads((tmp_path / "slam_batch.json").read_text())
    assert data["not_measured"] == "no CUDA device"
    assert data["results"] == []


def test_bytes_of_arrays_and_their_views():
    made, size = device_bytes(lambda: (array := wp.zeros((5, 4), dtype=wp.vec3), array.flatten()))
    assert made[0].shape == (5, 4)
    assert size == 5 * 4 * 12


@pytest.mark.parametrize(
    ("fields", "reason"),
    [({"device": "tpu"}, "device"), ({"batch": (0,)}, "must hold"), ({"frames": 1}, "frames")],
)
def test_bad_input(fields, reason):
    with pytest.raises(InputError, match=reason):
        SlamBatchConfig(**fields)
