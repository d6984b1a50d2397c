"""The measures of motion masks, and the experiment on moving objects."""

from __future__ import annotations

import numpy as np
import pytest
from ms_slam_experiments.moving_objects import (
    MASKED,
    UNMASKED,
    MovingObjectsExperiment,
    MovingObjectsSpec,
    found_masks,
    mask_measures,
    true_masks,
)

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.records import Row
from ms_slam_env.sequences import HandheldPath, open_sequence
from ms_slam_env.slam.slam_backend import TrackResult

SEQUENCE = "living_room:110:kinect+moving-objects,kind=box,count=3"


def result(mask: np.ndarray | None) -> TrackResult:
    return TrackResult(np.eye(4), True, moving=mask)


def test_measures_of_masks_count_pixels_with_depth() -> None:
    found, true = np.zeros((2, 1, 3, 4), dtype=bool)
    found[0, 0, :3], true[0, 0, 1:], true[0, 1, 0] = True, True, True
    is_read = np.ones_like(found)
    is_read[0, 0, 3] = False
    measures = mask_measures(found, true, is_read)
    assert measures["mask_precision"] == pytest.approx(2 / 3)
    assert measures["mask_recall"] == pytest.approx(2 / 3)
    assert measures["mask_iou"] == pytest.approx(2 / 4)
    assert measures["mask_false_share"] == pytest.approx(1 / 11)
    assert measures["moving_share"] == pytest.approx(3 / 11)
    assert all(metric(name).unit == "share" for name in measures)


def test_where_nothing_moves_only_the_false_share_is_known() -> None:
    found = np.zeros((1, 2, 2), dtype=bool)
    found[0, 0, 0] = True
    measures = mask_measures(found, np.zeros_like(found), np.ones_like(found))
    assert measures["mask_false_share"] == 0.25
    assert measures["mask_iou"] is measures["mask_precision"] is measures["mask_recall"] is None


@pytest.mark.parametrize(("height", "width"), [(6, 8), (5, 7), (3, 4)])
def test_masks_get_the_size_of_the_images(height: int, width: int) -> None:
    step = 1 if height == 3 else 2
    small = np.random.default_rng(0).random((3, 4)) > 0.5
    masks = found_masks([result(None), result(small)], (height, width))
    assert masks is not None
    assert masks.shape == (2, height, width)
    assert not masks[0].any()
    np.testing.assert_array_equal(masks[1][::step, ::step], small)
    assert found_masks([result(None)], (height, width)) is None


def test_true_masks_are_where_the_depth_changes() -> None:
    """What moves is what the same room without it has behind."""
    path = HandheldPath(frames=3)
    moving, still = (
        open_sequence(name, "80x60", path=path) for name in (SEQUENCE, "living_room:110:kinect")
    )
    masks = true_masks(moving.frames)
    for k in range(3):
        nearer = moving.frames.truth(k).depth < still.frames.truth(k).depth - 1e-4
        np.testing.assert_array_equal(masks[k], nearer)
    assert masks.any()


def test_a_small_run_fills_every_table() -> None:
    backends = (UNMASKED, MASKED)
    experiment = MovingObjectsExperiment((SEQUENCE, "living_room:109"), backends, "80x60", 10)
    rows = [
        Row(spec=vars(spec), result=experiment.run(spec), error=None) for spec in experiment.specs()
    ]
    medians, runs = experiment.tables(rows)
    assert [(row["setting"], row["backend"]) for row in medians.rows] == [
        (setting, backend) for setting in ("moving", "still") for backend in backends
    ]
    assert len(runs.rows) == 4
    assert rows[0]["result"]["moving_share"] > 0 == rows[1]["result"]["moving_share"]
    assert "mask_iou" not in rows[0]["result"]["runs"][0]
    assert rows[0]["result"]["runs"][1]["mask_iou"] is not None
    assert experiment.charts(rows)


def test_a_recording_and_an_unknown_backend_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="does not say what moves"):
        MovingObjectsExperiment(sequences=(str(tmp_path),))
    with pytest.raises(InputError, match="unknown SLAM backend"):
        MovingObjectsExperiment(backends=("none",)).specs()
    assert isinstance(MovingObjectsExperiment().specs()[0], MovingObjectsSpec)
