"""The benchmark of the pose's covariance, on errors whose distribution is known and a short run."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ms_slam_env.benchmark import pose_covariance as pc
from ms_slam_env.errors import InputError


def _errors(factor: float, count: int = 20_000) -> pc.Errors:
    """Errors of random covariances that are ``factor`` times too small."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(count, 6, 6))
    twists = np.sqrt(factor) * (roots @ rng.normal(size=(count, 6, 1)))[..., 0]
    return pc.Errors(twists, roots @ roots.transpose(0, 2, 1), 0, 0)


def test_right_covariances_hold_their_promises():
    errors = _errors(1.0)
    np.testing.assert_allclose(pc.coverage(errors.squared), pc.BOUNDS, atol=0.01)
    assert pc.scale(errors.squared) == pytest.approx(1.0, rel=0.03)


def test_the_factor_repairs_wrong_ones():
    errors = _errors(4.0)
    assert pc.coverage(errors.squared)[1] < 0.5
    assert pc.scale(errors.squared) == pytest.approx(4.0, rel=0.03)
    np.testing.assert_allclose(
        pc.coverage(errors.squared, pc.scale(errors.squared)), pc.BOUNDS, atol=0.01
    )


def test_a_short_run_writes_table_and_picture_and_is_about_calibrated(tmp_path):
    config = pc.PoseCovarianceConfig(
        tmp_path,
        scenes=("wall",),
        validation_seeds=(1000,),
        test_seeds=(1000,),
        size="80x60",
        frames=20,
    )
    report = pc.run(config)
    rows = {row["sequences"]: row for row in report["rows"]}
    assert rows["test, wall"]["frames"] == 15
    assert 0.1 < report["validation_factor"] < 4
    assert rows["test, wall"]["predicted_mm"] == pytest.approx(
        rows["test, wall"]["error_mm"], rel=0.7
    )
    assert json.loads((tmp_path / "pose_covariance.json").read_text())["rows"]
    assert "| test, wall | 15 |" in (tmp_path / "pose_covariance.md").read_text()
    assert (tmp_path / "pose_covariance.png").stat().st_size > 5000


def test_too_few_frames_are_refused(tmp_path):
    with pytest.raises(InputError, match="frames"):
        pc.PoseCovarianceConfig(tmp_path, frames=3)
