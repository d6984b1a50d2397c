"""``ms-slam usme``: measures, tables, folders, bad input."""

import json
import sys
from dataclasses import asdict, replace
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
    monkeypatch.setattr(usme, "voxel_m", lambda _: 0.04)


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
    row = {"spec": {"sequence": "room-fast-black", "backend": backend, "seed": SEED}}
    failed = {**row, "result": None, "error": "InputError: no"}
    tables = usme.Usme().tables([{**row, "result": result, "error": None}, failed])
    titles = ["Summary", "Sequences", "Accuracy", "Relative errors", *list(usme.TABLES)[1:]]
    assert [table.title for table in tables] == titles
    assert [len(table.rows) for table in tables] == [1, 1, 1, len(result["by_delta"]), *[1] * 4]
    assert "1 m" in {line["delta_text"] for line in result["by_delta"]}
    (whole,) = (line for line in result["by_delta"] if line["delta_text"] == "1 frames")
    assert (whole["rpe_m"], whole["rpe_median_m"]) == (result["rpe_m"], result["rpe_median_m"])
    _, paths = usme.Usme().charts([{**row, "result": result, "error": None}, failed])
    assert [series.name for series in paths.panels[0].series] == [backend, "truth"]
    del result["loop_recall"]  # of a backend that closes no loops nothing is said of them
    closes_none = usme.Usme().tables([{**row, "result": result, "error": None}])
    assert [len(table.rows) for table in closes_none if table.title == "Loops"] == [0]
    assert tables[1].rows[0]["about"] == "the same with a run of black frames"


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
    spec = {"sequence": "room-fast", "backend": "odometry", "seed": SEED}
    tables = usme.Usme().tables([{"spec": spec, "result": result, "error": None}])
    for table in tables:
        if table.title not in ("Sequences", "Relative errors"):
            names = {column.name for column in table.columns}
            assert names & {"tracked_share", "lost_share"}, table.title
    assert (tables[0].rows[0]["runs_counted"], tables[0].rows[0]["successes"]) == (1, 0)


def _rows(**results):
    spec = {"sequence": "room-fast", "backend": "surfel"}
    base = usme_row()
    return [
        {"spec": {**spec, "seed": k}, "result": {**base, **one}, "error": None}
        for k, one in enumerate(results["results"])
    ]


def usme_row():
    keys = {key for family in usme.TABLES.values() for key in family} | set(usme.SUMMARY)
    return {**dict.fromkeys(keys - {"run_succeeded"}), "path_m": 10.0, "lost_share": 0.0}


def test_several_seeds_have_medians_and_a_count_of_successes():
    results = [
        {"ate_m": 0.02},
        {"ate_m": 0.03},
        {"ate_m": 0.2},  # more than 1 % of the path
        {"ate_m": 0.01, "lost_share": 0.06},
    ]
    tables = usme.Usme().tables(_rows(results=results))
    (line,) = tables[0].rows
    assert (line["runs_counted"], line["successes"]) == (4, 2)
    assert line["ate_m"].value == pytest.approx(0.025)
    assert [row["seed"] for row in tables[2].rows] == [0, 1, 2, 3]
    assert [row["run_succeeded"] for row in tables[2].rows] == [True, True, False, False]


@pytest.mark.usefixtures("cheap")
def test_what_surfel_wrote_is_its_row_again(tmp_path):
    how = {"image_size": "80x60", "seed": SEED, "frames_scale": 0.12}
    own = usme.Usme(
        backends=("surfel",), sequences=("room-fast-black",), seeds=1, keep=tmp_path / "kept", **how
    )
    (spec,) = own.specs()
    first = usme.run_usme(spec)
    folder = tmp_path / "kept/surfel" / f"room-fast-black-{SEED}"
    assert {path.name for path in folder.iterdir()} == {
        *("trajectory.txt", "frames.csv", "map.ply", "map.png")
    }
    assert (folder / "map.png").stat().st_size > 5000
    path = str(tmp_path / "kept/surfel")
    again = usme.Usme(
        backends=(), trajectories=(f"fed={path}",), maps=(f"fed={path}",),
        sequences=("room-fast-black",), seeds=1, **how,
    )  # fmt: skip
    (fed,) = again.specs()
    assert (fed.backend, fed.trajectory) == ("fed", str(folder / "trajectory.txt"))
    second = usme.run_usme(fed)
    costs = [key for key in first if key.startswith(("ext_", "cpu_", "mem_", "ene"))]
    assert second.keys() == first.keys() - costs
    for key in second.keys() - {"drift_by_length", "by_delta", "T_true_map"}:
        if key == "final_ate_m":
            assert second[key] is None
        elif isinstance(first[key], float):
            assert second[key] == pytest.approx(first[key], rel=1e-3, abs=1e-5, nan_ok=True), key
        elif not isinstance(first[key], list):
            assert second[key] == first[key], key
    frames = (folder / "frames.csv").read_text().splitlines()[1:]
    ok = np.array([line.endswith(",1") for line in frames])
    assert first["lost_share"] == pytest.approx(1 - ok.mean())
    # The same by a program, which cannot say what it tracked and has no map.
    script = tmp_path / "copy.py"
    script.write_text("import pathlib, shutil, sys\n"
                      "assert (pathlib.Path(sys.argv[1]) / 'rgb.txt').is_file()\n"
                      "shutil.copy(sys.argv[2], sys.argv[3])\n")  # fmt: skip
    program = f"{sys.executable} {script} {{sequence}} {folder}/trajectory.txt {{trajectory}}"
    run = replace(again, backends=(f"mine=command:{program}",), trajectories=(), maps=())
    (spec,) = run.specs()
    third = usme.run_usme(spec)
    assert spec.backend == "mine"
    assert third["ate_m"] == pytest.approx(first["ate_m"], rel=1e-4)
    assert third["lost_share"] == 0
    assert third["ext_ms"] > 0
    assert (third["map_points"], third["noise_ratio"], third["recall_near"]) == (None,) * 3
    tables = usme.Usme().tables(
        [{"spec": asdict(one), "result": row, "error": None}
         for one, row in ((own.specs()[0], first), (fed, second), (spec, third))]
    )  # fmt: skip
    assert [row["backend"] for row in tables[0].rows] == ["surfel", "fed", "mine"]


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
        (["run", "--backends", "command:ls {sequence}"], "lacks {trajectory}"),
        (["run", "--trajectories", "orb=/nowhere"], "no trajectory of orb: /nowhere"),
        (["run", "--maps", "orb=/nowhere"], "unknown system of a map 'orb'"),
        (["run", "--trajectories", "surfel=/nowhere"], "must differ"),
        (["run", "/nowhere", "--seeds", "2"], "a folder holds one seed"),
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
