"""Rendered sequences as folders: what was written is read, and an interrupt leaves no half one."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import numpy as np
import pytest
from box_scene import BoxScene
from PIL import Image

from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import (
    ExposureJumps,
    FrameSkipping,
    HandheldPath,
    RollingShutter,
    render_sequence,
)
from ms_slam_env.sequences.recording import open_recording
from ms_slam_env.sequences.rendering import RenderedFrames
from ms_slam_env.sequences.writing import depth_values, working_folder, write_sequence

ABOUT = {"scene": "box", "seed": 3}


@pytest.fixture(scope="module")
def sequence(box_scene: BoxScene):
    path = HandheldPath(8)
    skipping = (FrameSkipping(keep_every=2), RollingShutter(), ExposureJumps(every=2))
    poses = path.poses(box_scene, 3)
    return render_sequence(
        box_scene, poses, xtion("80x60"), seed=3, perturbations=skipping, timestamps=path.timestamps
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_what_was_written_is_read(sequence, tmp_path) -> None:
    assert write_sequence(sequence, tmp_path / "box", ABOUT, with_truth=True)
    assert not working_folder(tmp_path / "box").exists()
    recording = open_recording(tmp_path / "box")
    assert (recording.layout, len(recording), recording.depth_scale) == ("tum", 4, 5000)
    assert recording.source == sequence.intrinsics
    assert recording.registration is None
    np.testing.assert_allclose(recording.truth, sequence.poses, atol=1e-8)
    for (frame, _), read in zip(sequence, recording, strict=True):
        np.testing.assert_array_equal(read.color, frame.color)
        assert np.abs(read.depth - frame.depth).max() <= 0.5 / 5000 + 1e-6
        np.testing.assert_array_equal(read.depth > 0, frame.depth > 0)
        assert read.timestamp == pytest.approx(frame.timestamp, abs=5e-7)
    assert json.loads((tmp_path / "box/sequence.json").read_text()) == ABOUT


def test_the_truth_beside_it(sequence, tmp_path) -> None:
    write_sequence(sequence, tmp_path / "box", ABOUT, with_truth=True)
    names = dict(
        line.split() for line in (tmp_path / "box/objects.txt").read_text().splitlines()[1:]
    )
    assert names == {"1": "room", "2": "box_0", "3": "box_1"}
    listed = (tmp_path / "box/labels.txt").read_text().splitlines()[1:]
    for index, line in enumerate(listed):
        view = sequence.frames.truth(index)
        labels = np.asarray(Image.open(tmp_path / "box" / line.split()[1]))
        np.testing.assert_array_equal(labels, view.labels + 1)
        true_depth = np.asarray(
            Image.open(tmp_path / "box" / line.split()[1].replace("labels", "depth_true"))
        )
        np.testing.assert_allclose(true_depth / 5000, view.depth, atol=0.5 / 5000 + 1e-6)


@pytest.mark.parametrize("stop_after", [0, 1, 3])
def test_an_interrupted_writing_goes_on_to_the_same_files(
    sequence, tmp_path, monkeypatch, stop_after
) -> None:
    write_sequence(sequence, tmp_path / "whole", ABOUT, with_truth=True)
    take = RenderedFrames.__getitem__
    rendered = []

    def interrupted(frames, index):
        if len(rendered) == stop_after:
            raise KeyboardInterrupt
        rendered.append(index)
        return take(frames, index)

    monkeypatch.setattr(RenderedFrames, "__getitem__", interrupted)
    target = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        write_sequence(sequence, target, ABOUT, with_truth=True)
    assert not target.exists()
    with pytest.raises(InputError, match="was not generated to its end"):
        open_recording(working_folder(target))
    again = []

    def recorded(frames, index):
        again.append(index)
        return take(frames, index)

    monkeypatch.setattr(RenderedFrames, "__getitem__", recorded)
    assert write_sequence(sequence, target, ABOUT, with_truth=True)
    assert again == list(range(stop_after, 4))  # nothing is rendered twice
    assert contents(target) == contents(tmp_path / "whole")
    assert not write_sequence(sequence, target, ABOUT, with_truth=True)


def test_a_half_written_image_is_written_again(sequence, tmp_path) -> None:
    write_sequence(sequence, tmp_path / "whole", ABOUT)
    target = tmp_path / "stopped"
    partial = working_folder(target)
    (partial / "rgb").mkdir(parents=True)
    (partial / "incomplete.json").write_text(json.dumps(ABOUT))
    of_the_dead = f".partial-{socket.gethostname()}-999999999-1-ab"
    (partial / "rgb" / of_the_dead).write_bytes(b"half")
    write_sequence(sequence, target, ABOUT)
    assert contents(target) == contents(tmp_path / "whole")


@pytest.mark.parametrize("place", ["stopped.partial", "stopped.partial/rgb"])
def test_no_link_takes_images_elsewhere(sequence, tmp_path, place) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).symlink_to(tmp_path / "elsewhere")
    if place.endswith("rgb"):
        (tmp_path / "stopped.partial" / "incomplete.json").write_text(json.dumps(ABOUT))
    with pytest.raises(InputError, match="is a link to another folder"):
        write_sequence(sequence, tmp_path / "stopped", ABOUT)
    assert contents(tmp_path / "elsewhere") == {}


def test_another_sequence_is_not_overwritten(sequence, tmp_path) -> None:
    write_sequence(sequence, tmp_path / "box", ABOUT)
    with pytest.raises(InputError, match=r"holds another sequence, see its sequence\.json"):
        write_sequence(sequence, tmp_path / "box", {**ABOUT, "seed": 4})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    with pytest.raises(InputError, match="is no generated sequence"):
        write_sequence(sequence, tmp_path / "mine", ABOUT)
    working_folder(tmp_path / "new").mkdir()
    (working_folder(tmp_path / "new") / "incomplete.json").write_text('{"seed": 9}')
    with pytest.raises(InputError, match="holds the beginning of another sequence"):
        write_sequence(sequence, tmp_path / "new", ABOUT)
    (tmp_path / "empty").mkdir()
    assert write_sequence(sequence, tmp_path / "empty", ABOUT)


def test_depth_beyond_sixteen_bits_is_no_reading() -> None:
    depth = np.array([[0.0, 1.0, 13.107, 13.108, 50.0]], dtype=np.float32)
    np.testing.assert_array_equal(depth_values(depth), [[0, 5000, 65535, 0, 0]])
