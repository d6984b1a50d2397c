"""SLAM configurations as YAML files: what is written is read back, and bad files say why."""

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import (
    SlamConfiguration,
    merged,
    read_configuration,
    write_configuration,
)


@settings(deadline=None)  # the first one loads the backend
@given(
    cutoff=st.floats(0, 10),
    iterations=st.lists(st.integers(0, 100), min_size=1, max_size=5),
    size=st.sampled_from([None, "80x60", "160x120"]),
    keep_every=st.integers(1, 30),
    threads=st.none() | st.integers(1, 8),
    note=st.text(),
)
def test_what_is_written_is_read_back(
    tmp_path_factory, cutoff, iterations, size, keep_every, threads, note
):
    params = {"depth_cutoff_m": cutoff, "iterations": iterations}
    written = SlamConfiguration(
        "surfel", params, size, keep_every, threads, {"note": note, "ate_m": 0.1}
    )
    path = tmp_path_factory.mktemp("configuration") / "slam.yaml"
    write_configuration(path, written)
    assert read_configuration(path) == written


def test_numbers_of_numpy_and_tuples_are_written_plainly(tmp_path):
    path = tmp_path / "slam.yaml"
    params = {"depth_cutoff_m": np.float32(2.5), "iterations": (3, 2)}
    write_configuration(path, SlamConfiguration(slam_config=params, keep_every=2))
    read = read_configuration(path)
    assert read.slam_config == {"depth_cutoff_m": 2.5, "iterations": [3, 2]}
    assert read.keep_every == 2


def test_a_backend_is_made_from_a_file(tmp_path):
    path = tmp_path / "slam.yaml"
    path.write_text("slam_config: {depth_cutoff_m: 2.5, loops: {window: 50}}\n")
    system = slam.make(path, xtion("80x60"), icp_rgb_weight=0.3)
    assert system.config.depth_cutoff_m == 2.5
    assert system.config.icp_rgb_weight == 0.3
    assert slam.make(str(path), xtion("80x60"), depth_cutoff_m=2.0).config.depth_cutoff_m == 2.0


def test_nested_options_are_merged():
    base = {"a": 1, "loops": {"x": 1, "y": 2}}
    assert merged(base, {"b": 2, "loops": {"y": 3}}) == {"a": 1, "b": 2, "loops": {"x": 1, "y": 3}}
    assert base == {"a": 1, "loops": {"x": 1, "y": 2}}


def test_an_environment_takes_a_file(tmp_path):
    path = tmp_path / "slam.yaml"
    path.write_text("slam: odometry\nslam_config: {}\nimage_size: 80x60\nkeep_every: 2\n")
    config = ActiveSlamEnv(slam_config=str(path)).config
    assert (config.slam, config.slam_config, config.image_size) == ("odometry", {}, "80x60")
    assert ActiveSlamEnv(slam_config=path, image_size="160x120").config.image_size == "160x120"
    with pytest.raises(InputError, match=r"slam = 'surfel' but .* configures 'odometry'"):
        ActiveSlamEnv(slam_config=path, slam="surfel")
    with pytest.raises(InputError, match=r"cannot read configuration .*nowhere\.yaml"):
        ActiveSlamEnv(slam_config="nowhere.yaml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("slam: [", "not YAML: "),
        ("", "must hold a mapping of slam, slam_config, image_size"),
        ("- surfel", "must hold a mapping"),
        (
            "slm: surfel",
            "unknown option of SlamConfiguration 'slm'; valid choices: slam, slam_conf",
        ),
        ("slam: orb", "unknown SLAM backend 'orb'; valid choices: surfel"),
        ("slam: 3", "unknown SLAM backend '3'"),
        ("slam_config: 3", "slam_config = 3 must be a mapping"),
        ("slam_config: {depth: 3}", "'slam_config.depth'; valid choices: depth_cutoff_m"),
        ("slam_config: {depth_cutoff_m: 13}", "SurfelConfig.depth_cutoff_m = 13 is outside"),
        ("slam_config: {1: 2}", "must be a mapping of options"),
        ("image_size: 3x2", "unknown image size '3x2'; valid choices: 80x60"),
        ("image_size: [3]", "unknown image size"),
        ("keep_every: 0", "SlamConfiguration.keep_every = 0 is outside"),
        ("keep_every: 1.5", "SlamConfiguration.keep_every = 1.5 must be an integer"),
        ("threads: many", "SlamConfiguration.threads = 'many' is outside"),
        ("about: 3", "about = 3 must be a mapping"),
        ("slam: surfel\nslam: sparse", "key 'slam' is given twice"),
        ("slam_config: {device: tpu}", "unknown device 'tpu'"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(content, message, tmp_path):
    path = tmp_path / "slam.yaml"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        read_configuration(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    for path in (tmp_path / "missing.yaml", tmp_path):
        with pytest.raises(InputError, match="cannot read"):
            read_configuration(path)
    (tmp_path / "picture.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_configuration(tmp_path / "picture.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"threads: {'9' * 5000}\n", "not YAML: .*digits"),
        ("about: {when: 2020-13-45}\n", "not YAML: .*month"),
        (
            "a: &a [x, x]\nb: &b [*a, *a]\nabout: {c: [*b, *b]}\n",
            r"not YAML: aliases \(\*name\) are not read",
        ),
        (f"about: {'[' * 5000}\n", "not YAML"),
    ],
)
def test_what_only_seems_to_be_yaml_is_one_line(tmp_path, text, message):
    path = tmp_path / "slam.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_configuration(path)
    assert "\n" not in str(caught.value)


def test_a_pipe_is_no_configuration(tmp_path):
    os.mkfifo(tmp_path / "slam.yaml")
    with pytest.raises(InputError, match="not a regular file"):
        read_configuration(tmp_path / "slam.yaml")
