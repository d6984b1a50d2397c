"""``ms-slam usme``: measures, tables, folders, bad input."""

import json
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from large_scenes import SEED
from PIL import Image

from ms_slam_env import scenes, slam
from ms_slam_env.benchmark import rows as harness_rows
from ms_slam_env.benchmark import usme
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.usme_suite import NAMES, find
from ms_slam_env.slam.slam_backend import TrackResult

make_scene = cache(scenes.make)


@pytest.fixture
def cheap(monkeypatch):
    """Scenes are built once, the true surface is seen in small images."""
    monkeypatch.setattr(scenes, "make", make_scene)
    monkeypatch.setattr(usme, "_VIEW_SIZE", "80x60")


def test_options_of_a_backend_are_those_of_the_sequence():
    assert usme.slam_options(find("room-fast"), "surfel") == {}
    for backend in slam.BACKENDS:
        options = usme.slam_options(find("city-traffic"), backend)
        assert options["depth_cutoff_m"] == 10.0
        assert options.get("motion_mask") == ("geometric" if backend == "surfel" else None)
    assert "motion_mask" not in usme.slam_options(find("residential-no-loop"), "surfel")


@pytest.mark.usefixtures("cheap")
def test_one_run_has_every_measure():
    backend = "surfel,loop_closure=deformation"
    spec = usme.UsmeSpec("room-fast-black", backend, "80x60", SEED, frames_scale=0.12)
    result = usme.run_usme(spec)
    assert result["frames"] > 30
    assert 0.0 <= result["lost_share"] <= 1.0
    assert not np.isnan(result["relocalisation_s"])
    assert result["ate_m"] <= result["ate_max_m"]
    assert result["tracked_pieces"] >= 1
    assert 0.0 <= result["noise_ratio"] < 1.0
    assert result["hausdorff_directed_m"] >= result["c2c_mean_m"] > 0.0
    assert result["ene_source"]
    assert result["revisits"] <= result["revisiting_frames"] < result["frames"]
    assert len(result["path_x_m"]) == len(result["true_y_m"]) == result["frames"]
    assert result["true_x_m"][0] == result["path_x_m"][0]  # it starts at the true pose
    row = {"spec": {"sequence": "room-fast-black", "backend": backend}}
    failed = {**row, "result": None, "error": "InputError: no"}
    tables = usme.Usme().tables([{**row, "result": result, "error": None}, failed])
    assert [table.title for table in tables] == ["Sequences", *usme.TABLES]
    assert [len(table.rows) for table in tables] == [1] * 6
    _, paths = usme.Usme().charts([{**row, "result": result, "error": None}, failed])
    assert [series.name for series in paths.panels[0].series] == [backend, "truth"]
    del result["loop_recall"]  # of a backend that closes no loops nothing is said of them
    closes_none = usme.Usme().tables([{**row, "result": result, "error": None}])
    assert [len(table.rows) for table in closes_none] == [1, 1, 1, 1, 0, 1]
    assert tables[0].rows[0]["about"] == "the same with a run of black frames"


@pytest.mark.usefixtures("cheap")
@pytest.mark.parametrize("tracked", [None, 6])
def test_a_system_lost_for_good_has_no_good_values(tracked, monkeypatch):
    def make(name, intrinsics, **params):
        system = slam.make(name, intrinsics, **params)
        track, results = system.track, []

        def lost_after(frame):
            if tracked is None or len(results) < tracked:
                results.append(track(frame))
                return results[-1]
            return TrackResult(results[-1].T_world_camera, False)

        system.track = lost_after
        return system

    monkeypatch.setattr(usme, "slam", SimpleNamespace(make=make))
    spec = usme.UsmeSpec("room-fast", "odometry", "80x60", SEED, frames_scale=0.3)
    monkeypatch.setattr(
        usme, "_frames", lambda sequence, _: (sequence.frames[k] for k in range(20))
    )
    render = usme.render
    monkeypatch.setattr(usme, "render", lambda *a: render(*a).picked(np.arange(20)))
    result = usme.run_usme(spec)
    if tracked is None:
        assert (result["tracked_pieces"], result["robustness"], result["lost_share"]) == (1, 0, 0)
        assert result["end_error_share"] == pytest.approx(result["end_error_m"] / result["path_m"])
        return
    assert result["lost_share"] == pytest.approx(1 - tracked / 20)
    assert result["tracked_pieces"] == 1
    for key in ("robustness", "end_error_m", "end_error_share"):
        assert result[key] is None, key
    row = {"spec": {"sequence": "room-fast", "backend": "odometry"}, "result": result}
    for table in usme.Usme().tables([{**row, "error": None}])[1:]:
        names = {column.name for column in table.columns}
        assert names & {"tracked_share", "lost_share"}, table.title


def test_a_map_against_itself_is_without_error():
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(0, 2, (20_000, 2)), 0.003 * rng.standard_normal(20_000)])
    found = usme.map_measures(plane, plane, "living_room", 0.01)
    assert found["noise_ratio"] == 0
    assert found["c2c_mean_m"] < 1e-3
    assert found["recall_near"] > 0.99
    empty = usme.map_measures(np.zeros((0, 3)), plane, "living_room", 0.01)
    assert empty["map_points"] == 0
    assert (empty["c2c_mean_m"], empty["noise_ratio"], empty["recall_near"]) == (None,) * 3


def test_rounding_changes_no_measure_of_a_map(true_room):
    rng = np.random.default_rng(2)
    true_room = true_room[::10]
    cloud = true_room[true_room[:, 2] < 1.0]  # with the floor, which is at z = 0
    assert (np.abs(cloud[:, 2]) < 1e-6).sum() > 500
    exact = usme.map_measures(cloud, true_room, "living_room", 0.01)
    moved = usme.map_measures(*(c + rng.uniform(-1e-7, 1e-7, c.shape) for c in (cloud, true_room)),
                              "living_room", 0.01)  # fmt: skip
    assert 0.2 < exact["recall_near"] < 0.9
    for key in ("recall_near", "noise_ratio", "outlier_share", "noise_beyond_m", "spacing_m"):
        assert moved[key] == pytest.approx(exact[key], abs=2e-5), key
    assert moved["c2c_mean_m"] == pytest.approx(exact["c2c_mean_m"], abs=1e-6)


def test_the_noise_of_a_map_grows_with_the_noise_of_its_points(true_room):
    rng = np.random.default_rng(1)
    true_room = true_room[::4]
    cloud = true_room[rng.permutation(len(true_room))[:10_000]]
    error, sigmas = rng.standard_normal(cloud.shape), (0.0, 0.005, 0.05, 0.3)
    found = [usme.map_measures(cloud + s * error, true_room, "living_room", 0.01) for s in sigmas]
    ratios = [one["noise_ratio"] for one in found]
    assert ratios == sorted(ratios)
    assert ratios[1] < 0.01
    assert ratios[1] + 0.1 < ratios[2] < ratios[3] - 0.2
    dropped = [one["outlier_share"] for one in found]  # what the filter drops says nothing of it
    assert max(dropped) < 0.1


def run_here(specs, run, *_, **__):
    """In this process, in which the scenes are."""
    return [
        {"key": spec.backend, "spec": spec.__dict__, "result": run(spec), "error": None}
        for spec in specs
    ]


@pytest.fixture(scope="module")
def true_room():
    return make_scene("living_room", SEED).surface_points(0.02)[0]


@pytest.mark.usefixtures("cheap")
def test_make_writes_what_run_reads(tmp_path, capsys, monkeypatch):
    few = [
        "--seed",
        str(SEED),
        "--sequences",
        "room-fast",
        "--frames-scale",
        "0.02",
        "--image-size",
        "80x60",
    ]
    assert main(["usme", "make", *few, "--out", str(tmp_path / "made")]) == 0
    assert (tmp_path / "made/room-fast/groundtruth.txt").is_file()
    assert main(["usme", "make", *few, "--out", str(tmp_path / "made")]) == 0
    monkeypatch.setattr(usme, "limit_threads", lambda _: None)
    monkeypatch.setattr(harness_rows, "run_all", run_here)
    ran = ["usme", "run", str(tmp_path / "made"), "--backends", "odometry"]
    assert main([*ran, "--out", str(tmp_path / "out")]) == 1  # ten frames of a path for hundreds
    text, said = capsys.readouterr()
    assert "| room-fast | odometry |" in text
    assert said.endswith("sequence room-fast, backend odometry: lost in 9 of 10 frames\n")
    content = json.loads((tmp_path / "out/results.json").read_text())
    assert content["rows"][0]["result"]["frames"] >= 5
    assert (tmp_path / "out/usme.png").stat().st_size > 1000
    spec = content["rows"][0]["spec"]
    made = (spec["image_size"], spec["seed"], spec["frames_scale"])
    assert made == ("80x60", SEED, 0.02)
    for option, message in (
        (["--seed", "7"], f"another seed: {SEED}, not 7"),
        (["--frames-scale", "0.5"], "another frames scale: 0.02, not 0.5"),
        (["--sequences", "city-fast"], "unknown USME sequence"),
    ):
        assert main([*ran, *option, "--out", str(tmp_path / "other")]) == 2
        assert message in capsys.readouterr().err
    for path in (tmp_path / "made/room-fast/depth").iterdir():
        Image.fromarray(np.zeros((60, 80), np.uint16)).save(path)
    (blank,) = usme.Usme(tmp_path / "made", ("odometry",)).specs()
    with pytest.raises(InputError, match="sequence room-fast: no frame has a depth reading"):
        usme.run_usme(blank)
    (tmp_path / "made/room-fast/sequence.json").write_text('{"suite": "usme"}')
    assert main([*ran, "--out", str(tmp_path / "other")]) == 2
    assert "describes no sequence" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "valid choices: make, run"),
        (["run", "--backends", "magic"], "unknown SLAM backend 'magic'"),
        (["run", "--backends", "odometry,magic=1"], "slam_config.magic"),
        (["make", "--sequences", "x"], "unknown USME sequence 'x'"),
        (["make", "--image-size", "1x1"], "unknown image size"),
        (["run", "/nowhere"], "holds no finished sequence"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys):
    assert main(["usme", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_options_out_of_range_are_refused():
    with pytest.raises(InputError, match="frames_scale"):
        usme.Usme(frames_scale=0.0)
    assert {spec.sequence for spec in usme.Usme().specs()} == set(NAMES)
