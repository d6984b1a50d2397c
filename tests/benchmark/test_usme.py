import json
from functools import cache

import numpy as np
import pytest
from large_scenes import SEED, large_scene

from ms_slam_env import scenes, slam
from ms_slam_env.benchmark import usme, usme_report, usme_run, usme_suite
from ms_slam_env.benchmark.usme_loops import count_loops, revisits
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at
from ms_slam_env.sequences import MotionBlur, MovingObjects

WITHOUT_BLUR = "residential-three-loops-blur"  # has the way of another
LARGE = [
    entry
    for entry in usme_suite.SUITE
    if entry.scene in scenes.LARGE_SCENES and entry.name != WITHOUT_BLUR
]
make_scene = cache(scenes.make)


@pytest.fixture
def cheap(monkeypatch):
    """Scenes are built once, the true surface is seen in small images."""
    monkeypatch.setattr(scenes, "make", make_scene)
    monkeypatch.setattr(usme_run, "_VIEW_SIZE", "80x60")


def circle(rounds: float, radius_m: float = 10.0, frames: int = 300) -> np.ndarray:
    angles = np.linspace(0.0, 2 * np.pi * rounds, frames)
    eyes = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(frames)], -1)
    ahead = np.stack([-np.sin(angles), np.cos(angles), np.zeros(frames)], -1)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, ahead, strict=True)])


def test_loops_of_a_circle():
    assert count_loops(circle(0.9)) == 0
    assert count_loops(circle(1.1)) == 1
    assert count_loops(circle(2.5)) == 1, "the second round revisits without a break"
    again = revisits(circle(1.5))
    np.testing.assert_array_equal(again[:190], False)
    assert again[205:].all()


def test_passing_a_place_in_another_direction_is_no_loop():
    there = circle(1.0)
    turned = there.copy()
    turned[:, :3, [0, 2]] *= -1.0  # looks backwards
    assert count_loops(np.concatenate([there[:-20], turned[:-20]])) == 0


def test_two_separate_returns_are_two_loops():
    a, b = circle(1.1), circle(1.1)
    b[:, 0, 3] += 40.0
    assert count_loops(np.concatenate([a, b])) == 2


def test_the_suite_is_what_the_paper_says_in_words():
    names = [entry.name for entry in usme_suite.SUITE]
    assert len(names) == len(set(names)) == 8
    assert {entry.scene for entry in usme_suite.SUITE} == {
        "residential_street",
        "city_street",
        "factory_hall",
        "living_room",
    }
    no, one, three, blurred = usme_suite.SUITE[:4]
    assert no.path.via[:8] == one.path.via[:8], "two like sequences"
    assert (no.loops, one.loops, three.loops) == (0, 1, 3)
    assert blurred.path == three.path
    assert [type(p) for p in blurred.made_perturbations()] == [MotionBlur]
    for entry in usme_suite.SUITE[4:6]:
        kinds = {p.kind for p in entry.made_perturbations() if isinstance(p, MovingObjects)}
        assert kinds
    fast, black = usme_suite.SUITE[6:]
    assert black.perturbations[:-1] == fast.perturbations
    assert black.path == fast.path


@pytest.mark.parametrize("entry", LARGE, ids=lambda entry: entry.name)
def test_a_way_has_the_loops_it_claims_and_is_free(entry):
    scene = large_scene(entry.scene)
    times, poses = entry.motion(scene, SEED)
    assert count_loops(poses) == entry.loops
    assert scene.clearance(poses[:, :3, 3]).min() > 0.25
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() > 70.0
    assert (np.diff(times) > 0).all()


def test_the_fast_sequence_is_fast_and_the_black_frames_are_there():
    scene = make_scene("living_room", SEED)
    fast, black = (
        usme_suite.render(usme_suite.find(name), scene, "80x60", 0.5)
        for name in ("room-fast", "room-fast-black")
    )
    np.testing.assert_array_equal(fast.poses, black.poses)
    _, calm = usme_suite.find("room-fast").motion(scene, SEED, 0.5)
    pace = [
        np.percentile(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), 95)
        for poses in (fast.poses, calm)
    ]
    assert pace[0] > 2.0 * pace[1]
    dark = [not black.frames[k].color.any() for k in (124, 125, 134, 135)]
    assert dark == [False, True, True, False]
    assert fast.frames[130].color.any()


def test_moving_objects_are_in_the_hall():
    entry = usme_suite.find("factory-moving")
    sequence = usme_suite.render(entry, large_scene("factory_hall"), "80x60", 0.2)
    extra = set(sequence.frames.labels) - set(large_scene("factory_hall").mesh.labels)
    assert len(extra) == 8


def test_options_of_a_backend_are_those_of_the_scene():
    assert usme_suite.slam_options("living_room", "surfel") == {}
    for backend in slam.BACKENDS:
        options = usme_suite.slam_options("city_street", backend)
        assert options["depth_cutoff_m"] == 10.0


@pytest.mark.usefixtures("cheap")
def test_one_run_has_every_measure():
    spec = usme_run.UsmeSpec("room-fast-black", "surfel", "80x60", SEED, frames_scale=0.12)
    result = usme_run.run_here(spec)
    assert result["frames"] > 30
    assert 0.0 <= result["lost"] <= 1.0
    assert result["relocalisation_s"] is not None
    assert result["ate_m"] <= result["ate_max_m"]
    assert result["drift"] == pytest.approx(result["end_error_m"] / result["path_m"])
    assert 0.0 <= result["noise_ratio"] < 1.0
    assert result["hausdorff_m"] >= result["c2c_mean_m"] > 0.0
    assert result["ene_source"]
    row = {"spec": {"sequence": "room-fast-black", "backend": "surfel", "params": {}}}
    text = usme_report.tables([{**row, "result": result, "error": None}])
    for heading in ("### Accuracy", "### Map", "### Robustness", "### Cost"):
        assert heading in text
    failed = usme_report.tables([{**row, "result": None, "error": "InputError: no"}])
    assert "surfel on room-fast-black: InputError: no" in failed
    assert "stretches" not in failed
    assert "the same with a run of black frames" in failed


def test_a_map_against_itself_is_without_error():
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(0, 2, (20_000, 2)), 0.003 * rng.standard_normal(20_000)])
    found = usme_run.map_measures(plane, plane, "living_room")
    assert found["c2c_mean_m"] < 1e-3
    assert found["completion"] > 0.99
    empty = usme_run.map_measures(np.zeros((0, 3)), plane, "living_room")
    assert (empty["points"], empty["c2c_mean_m"]) == (0, None)


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
    monkeypatch.setattr(usme, "run_all", lambda specs, *_: [_run(spec) for spec in specs])
    ran = ["usme", "run", str(tmp_path / "made"), *few, "--backends", "odometry"]
    assert main([*ran, "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "| room-fast | odometry |" in text
    content = json.loads((tmp_path / "out/usme.json").read_text())
    assert content["summary"][0]["frames"] >= 5
    assert "provenance" in content
    assert (tmp_path / "out/usme.png").stat().st_size > 1000
    other = [*ran, "--seed", "7", "--out", str(tmp_path / "other")]
    assert main(other) == 2
    assert "another seed" in capsys.readouterr().err


def _run(spec: usme_run.UsmeSpec) -> dict:
    row = {"key": "k", "spec": spec.__dict__, "error": None}
    return {**row, "result": usme_run.run_here(spec)}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "make, run, picture"),
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
        usme.UsmeOptions(frames_scale=0.0)
    with pytest.raises(InputError, match="empty"):
        usme.UsmeOptions(sequences=())
