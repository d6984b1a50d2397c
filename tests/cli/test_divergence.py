"""``ms-slam divergence`` against the divergence functions, frame by frame."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.camera import xtion
from ms_slam_env.cli import main
from ms_slam_env.divergence import DivergenceConfig, depth_divergence, intensity_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.sequence_divergence import SequenceDivergence, sequence_divergence
from ms_slam_env.geometry import look_at
from ms_slam_env.sequences import open_sequence, render_sequence

FRAMES = 5


def write_folder(folder, frames, intrinsics, with_color=True):
    names = ("depth", "rgb") if with_color else ("depth",)
    for name in names:
        (folder / name).mkdir(parents=True)
    for index, frame in enumerate(frames):
        values = np.rint(frame.depth * 5000).astype(np.uint16)
        Image.fromarray(values).save(folder / f"depth/{index}.png")
        if with_color:
            Image.fromarray(frame.color).save(folder / f"rgb/{index}.png")
    for name in names:
        lines = [f"{0.1 * k:.6f} {name}/{k}.png" for k in range(len(frames))]
        (folder / f"{name}.txt").write_text("\n".join(lines))
    i = intrinsics
    (folder / "intrinsics.txt").write_text(f"{i.fx} {i.fy} {i.cx} {i.cy} {i.width} {i.height}")
    return folder


@pytest.fixture(scope="module")
def frames(box_scene):
    eye = box_scene.sample_start(np.random.default_rng(0))[:3, 3]
    middle = box_scene.mesh.vertices.mean(axis=0)
    poses = [look_at(eye + 0.03 * k * np.eye(3)[0], middle) for k in range(FRAMES)]
    return render_sequence(box_scene, np.stack(poses), xtion("80x60")).frames


@pytest.fixture(scope="module")
def folder(frames, tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("s") / "box", frames, xtion("80x60"))


def test_values_are_those_of_the_functions(folder, capsys, tmp_path):
    out = tmp_path / "out"
    assert main(["divergence", str(folder), "--paper", "--out", str(out)]) == 0
    assert "| box | intensity |" in capsys.readouterr().out
    content = json.loads((out / "divergence.json").read_text())["sequences"][0]
    sequence = open_sequence(folder)
    read = list(sequence.frames)
    pairs = list(zip(read[1:], read, strict=False))
    intensity = [intensity_divergence(a, b) for a, b in pairs]
    depth = [depth_divergence(a, b, sequence.intrinsics) for a, b in pairs]
    np.testing.assert_allclose(content["intensity_divergence"], intensity, rtol=1e-5)
    np.testing.assert_allclose(content["depth_divergence"], depth, rtol=1e-5)
    numbers = content["statistics"][0]
    assert numbers["divergence_max"] == pytest.approx(max(intensity))
    assert numbers["divergence_mean"] == pytest.approx(np.mean(intensity))
    assert numbers["divergence_variance"] == pytest.approx(np.var(intensity))
    assert numbers["divergence_mean_per_s"] == pytest.approx(sum(intensity) / 0.4)
    assert numbers["divergence_max_per_s"] == pytest.approx(max(intensity) / 0.1)
    assert (out / "divergence.png").stat().st_size > 1000


def test_without_colour_there_is_no_intensity_divergence(frames, tmp_path):
    bare = write_folder(tmp_path / "bare", frames, xtion("80x60"), with_color=False)
    found = sequence_divergence(open_sequence(bare), DivergenceConfig.paper())
    assert np.isnan(found.divergences[:, 0]).all()
    assert found.statistics()["intensity"]["max"] is None
    assert found.statistics()["depth"]["max"] > 0


def test_fewer_frames_diverge_more(folder):
    sequence = open_sequence(folder)
    one, two = (sequence_divergence(sequence, every=n) for n in (1, 2))
    assert len(two.times) == 2
    assert two.divergences[:, 0].mean() > one.divergences[:, 0].mean()


def test_rates_follow_the_time_between_frames():
    values = np.array([[2.0, 1.0], [6.0, 1.0]])
    times, gaps = np.array([1.0, 4.0]), np.array([1.0, 3.0])
    found = SequenceDivergence("s", times, values, gaps, np.array([1, 2]), ["", ""])
    assert found.statistics()["intensity"]["mean_per_s"] == 2.0
    assert found.statistics()["intensity"]["max_per_s"] == 2.0


def test_bad_input(folder, capsys):
    assert main(["divergence"]) == 2
    assert main(["divergence", str(folder / "none")]) == 2
    assert main(["divergence", str(folder), "--every", "9"]) == 2
    assert "a divergence needs two" in capsys.readouterr().err
    with pytest.raises(InputError, match="every must be"):
        sequence_divergence(open_sequence(folder), every=0)


def test_the_hardest_frames_are_named(folder, tmp_path, capsys):
    sequence = open_sequence(folder)
    assert main(["divergence", str(folder), "--every", "2", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "divergence.json").read_text())
    values = np.array(content["sequences"][0]["depth_divergence"])
    rows = [row for row in content["tables"][1]["rows"] if row["divergence"] == "depth"]
    assert [row["frame"] for row in rows] == (2 * (1 + np.argsort(-values))).tolist()
    assert [row["change"] for row in rows] == sorted(values, reverse=True)
    names = [sequence.frames.entries[row["frame"]].depth.name for row in rows]
    assert [row["frame_file"] for row in rows] == names
    assert names[0] in capsys.readouterr().out


@pytest.mark.parametrize("name", ["a$b$c", r"$\frac{", "p|q", os.fsdecode(b"x\xff")])
def test_any_name_of_a_folder_will_do(folder, tmp_path, monkeypatch, name):
    place = tmp_path / name
    shutil.copytree(folder, place)
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "utf-8", "strict"))
    assert main(["divergence", str(place), "--out", str(tmp_path / "out")]) == 0
    sys.stdout.flush()
    assert (tmp_path / "out/divergence.png").is_file()
    content = json.loads((tmp_path / "out/divergence.json").read_text())
    assert content["sequences"][0]["sequence"] == name
