"""One grammar for naming sequences: words, defaults, truth, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ms_slam_env import scenes
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import (
    DepthDropout,
    HandheldPath,
    MotionBlur,
    MotionSegments,
    UnevenPath,
    WanderingPath,
    check_sequence,
    open_sequence,
    parse_sequence,
    read_trajectory,
    render_sequence,
)
from ms_slam_env.sequences.naming import SequenceName
from ms_slam_env.sequences.writing import write_sequence


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("table:7", SequenceName("table", 7)),
        ("table:7:none", SequenceName("table", 7, "none")),
        (
            "table:7:none+motion-blur+depth-dropout",
            SequenceName("table", 7, "none", (MotionBlur(), DepthDropout())),
        ),
        (
            "table:7:motion-blur,samples=3+uneven,frames=40",
            SequenceName("table", 7, "kinect", (MotionBlur(samples=3),), "uneven", {"frames": 40}),
        ),
        ("a/b.glb,up=z,scale=0.01:7:none", SequenceName("a/b.glb,up=z,scale=0.01", 7, "none")),
        ("table:7:steady", SequenceName("table", 7, path="steady")),
    ],
)
def test_what_a_name_says(text: str, named: SequenceName) -> None:
    assert parse_sequence(text) == named


def test_the_path_is_named_or_that_of_the_command() -> None:
    default = UnevenPath(frames=50)
    assert parse_sequence("table:7").camera_path(default) is default  # type: ignore[union-attr]
    for word, path in (
        ("steady", HandheldPath(50)),
        ("handheld,loop=true,frames=99", HandheldPath(99, loop=True)),
        ("segments", MotionSegments(50)),
        ("wander,step_deg=2", WanderingPath(50, step_deg=2)),
    ):
        named = parse_sequence(f"table:7:{word}")
        assert named.camera_path(default) == path  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("table", "sequence 'table' is neither a folder nor scene:seed"),
        ("table:x", "neither a folder nor scene:seed"),
        ("table:" + "9" * 5000, "neither a folder nor scene:seed"),
        ("table:1:" + "x" * 5000, "unknown part of sequence"),
        ("table:1:2:3", "unknown part of sequence .* .2:3.; valid choices: kinect"),
        ("table:1:fog", "'fog'; valid choices: kinect, range, none, .*rolling-shutter, .*handheld"),
        ("table:1:uneven+steady", "'steady'; valid choices"),
        ("table:1:motion-blur+none", "'none'"),
        ("table:1:motion-blur,fog=1", "motion-blur.fog"),
        ("table:1:motion-blur,fog", "'fog' is not option=value"),
        ("table:1:uneven,frames=1", "UnevenPath.frames = 1 is outside"),
        ("no-such-scene:1", "valid choices: living_room"),
    ],
)
def test_bad_names_are_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_sequence(text)


@pytest.mark.parametrize("more", [{"layout": "tum"}, {"register": True}, {"layout": "nonsense"}])
def test_a_rendered_sequence_has_no_options_of_folders(more) -> None:
    with pytest.raises(InputError, match="layout, intrinsics and register are of folders"):
        open_sequence("table:1", "80x60", **more)


def test_a_generated_sequence_is_that_of_its_parts() -> None:
    path = HandheldPath(4)
    sequence = open_sequence("table:1000:none+depth-dropout", "80x60", path=path)
    scene = scenes.make("table", 1000)
    poses = path.poses(scene, 1000)
    other = render_sequence(
        scene,
        poses,
        xtion("80x60"),
        "none",
        1000,
        perturbations=[DepthDropout()],
        timestamps=path.timestamps,
    )
    np.testing.assert_array_equal(sequence.poses, poses)
    for one, two in zip(sequence.frames, other.frames, strict=True):
        np.testing.assert_array_equal(one.depth, two.depth)
        np.testing.assert_array_equal(one.color, two.color)
    assert sequence.known.all()
    some = open_sequence("table:1000:none+depth-dropout", "80x60", path=path, every=3)
    np.testing.assert_array_equal(some.frames[1].depth, sequence.frames[3].depth)
    np.testing.assert_array_equal(some.timestamps, sequence.timestamps[::3])
    np.testing.assert_array_equal(some.poses, poses[::3])


def test_the_same_sequence_from_a_folder_and_with_part_of_its_truth(tmp_path: Path) -> None:
    name = "table:1000"
    rendered = open_sequence(name, "80x60", path=HandheldPath(5))
    write_sequence(rendered, tmp_path / "s", {})  # type: ignore[arg-type]
    recorded = open_sequence(tmp_path / "s")
    assert len(recorded) == 5
    np.testing.assert_allclose(recorded.poses, rendered.poses, atol=1e-6)
    np.testing.assert_array_equal(recorded.frames[2].color, rendered.frames[2].color)
    truth = tmp_path / "s/groundtruth.txt"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join([*lines[:1], *lines[3:5]]))
    partly = open_sequence(tmp_path / "s")
    assert partly.known.tolist() == [False, False, True, True, False]
    assert partly.start is None
    np.testing.assert_array_equal(read_trajectory(truth)[1], partly.true_trajectory()[1])  # type: ignore[index]
    placed = open_sequence(tmp_path / "s", with_truth=True)
    np.testing.assert_array_equal(placed.poses, partly.poses[2:4])
    np.testing.assert_array_equal(placed.timestamps, partly.timestamps[2:4])
    truth.unlink()
    with pytest.raises(InputError, match=r"groundtruth\.txt is missing; every generated"):
        open_sequence(tmp_path / "s")
    (tmp_path / "s/sequence.json").unlink()
    assert not open_sequence(tmp_path / "s").known.any()
    with pytest.raises(InputError, match="sequence s has no true trajectory"):
        check_sequence(tmp_path / "s")
