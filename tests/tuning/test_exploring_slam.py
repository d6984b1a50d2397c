"""Explorations of a real backend: what is measured, written, chosen, and refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ms_slam_experiments.shared.sampler_studies import Grid
from scipy.spatial import cKDTree

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.seen_surface import seen_surface
from ms_slam_env.evaluation.sequence_divergence import sequence_divergence
from ms_slam_env.geometry import look_at
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.metrics.cost import energy_counters
from ms_slam_env.metrics.cost.energy import NoEnergy
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.results import read_results
from ms_slam_env.sequences import open_sequence, render_sequence
from ms_slam_env.sequences.writing import write_sequence
from ms_slam_env.slam.configuration import SlamConfiguration, read_configuration
from ms_slam_env.tuning import (
    Exploration,
    ExplorationSettings,
    SlamEvaluator,
    make_space,
    run_exploration,
)
from ms_slam_env.tuning import evaluator as evaluator_module
from ms_slam_env.tuning import exploration as exploration_module
from ms_slam_env.tuning.evaluator import CLOCKS, summarise, worst_ratio
from ms_slam_env.tuning.held_out import compare_configurations
from ms_slam_env.tuning.objectives import METRICS, as_metrics, key_of

FRAMES = 12


def recorded(box_scene, folder, shift) -> str:
    """A short sequence of the box scene in the TUM layout, 80x60."""
    eye = box_scene.sample_start(np.random.default_rng(0))[:3, 3]
    low, high = box_scene.mesh.vertices.min(0), box_scene.mesh.vertices.max(0)
    poses = [look_at(eye + k * np.array(shift), (low + high) / 2) for k in range(FRAMES)]
    rendered = render_sequence(box_scene, np.stack(poses), xtion("80x60"))
    write_sequence(rendered, folder, {"shift": shift})
    return str(folder)


@pytest.fixture(scope="module")
def sequences(box_scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequences")
    return (
        recorded(box_scene, folder / "right", [0.01, 0.0, 0.0]),
        recorded(box_scene, folder / "up", [0.0, 0.0, 0.01]),
    )


@pytest.fixture(scope="module")
def evaluator(sequences):
    return SlamEvaluator(sequences[:1], image_size="80x60", map_error=True)


def test_measures_what_a_run_by_hand_gives(evaluator, sequences):
    configuration = SlamConfiguration(slam_config={"icp_rgb_weight": 0.2}, keep_every=2)
    row = evaluator(configuration)
    sequence = open_sequence(sequences[0])
    frames = list(sequence.frames)[::2]
    system = slam.make("surfel", sequence.intrinsics, icp_rgb_weight=0.2)
    system.reset(sequence.poses[0])
    poses = np.stack([system.track(frame).T_world_camera for frame in frames])
    assert row["ate_m"] == pytest.approx(ate_rmse(poses, sequence.poses[::2]), rel=1e-9)
    divergences = sequence_divergence(sequence, every=2).divergences
    assert (row["M_I"], row["M_D"]) == tuple(pytest.approx(m) for m in divergences.max(axis=0))
    assert row["load_ms"] == pytest.approx(row["ext_ms"] / 2)
    surface = seen_surface(sequence)
    distances, _ = cKDTree(surface).query(voxel_downsample(system.surface_points(), 0.01))
    assert row["map_error_mm"] == pytest.approx(1e3 * np.median(distances))
    assert row["mem_mb"] is None or row["mem_mb"] > 0
    assert "failure" not in row


def test_lost_tracking_is_a_result(evaluator):
    blind = evaluator(SlamConfiguration(slam_config={"depth_cutoff_m": 0.01}))
    assert "tracking lost in" in blind["failure"]
    assert blind["lost"] > 0.5
    assert np.isfinite(blind["ext_ms"])


def test_a_backend_that_breaks_down_is_a_result(evaluator, monkeypatch):
    def broken(*_, **__):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(evaluator_module.slam, "make", broken)
    monkeypatch.setattr(evaluator_module, "_warm_up", lambda *_: None)
    row = evaluator(SlamConfiguration())
    assert "Singular matrix" in row["failure"]
    assert (row["lost"], row.get("ate_m")) == (1.0, None)


def test_several_sequences_make_one_row():
    rows = [
        {"sequence": "a", "ate_m": 0.1, "ate_max_m": 0.2, "mem_mb": None, "lost": 0.0},
        {"sequence": "b", "ate_m": 0.3, "ate_max_m": 0.1, "mem_mb": 3.0, "failure": "lost"},
    ]
    assert summarise(rows) == {
        "ate_m": pytest.approx(0.2),
        "ate_max_m": 0.2,
        "ate_worst_m": 0.3,
        "failure": "b: lost",
    }


@pytest.fixture(scope="module")
def explored(evaluator, sequences, tmp_path_factory):
    out = tmp_path_factory.mktemp("explore") / "out"
    exploration = Exploration(
        evaluator,
        ExplorationSettings(("ate_m", "ext_ms", "map_error_mm"), sampler="random"),
        ("points_per_level", "depth_cutoff_m", "iterations.0"),
        held_out=sequences[1:],
    )
    return exploration, out, run_exploration(exploration, out, 4)


def test_results_on_disk(explored):
    _, out, results = explored
    again = read_results(out / "explore.json")
    assert (again.kind, again.rows_key) == ("exploration", "trials")
    trials = [{**row["spec"], **row["result"]} for row in again.rows]
    assert len(trials) == len(again.content["hypervolume"]) == 4
    assert trials[0]["is_default"]
    assert trials[0]["params"]["points_per_level"] == 5000
    assert all(trial["M_I"] > 0 and trial["cpu_ms_median"] > 0 for trial in trials)
    held_out: Any = again.tables[1].rows
    front = {trial["trial"] for trial in trials if trial["on_front"]}
    chosen = {name: point["trial"] for name, point in again.content["chosen"].items()}
    others = front - set(chosen.values())
    judged = {str(line["configuration"]).replace(" ", "_") for line in held_out}
    assert judged == {"default", *chosen, *(f"trial_{number}" for number in others)}
    assert held_out[0]["ate_m_ratio"].value == 1.0
    measured_again: Any = again.tables[2].rows
    assert again.tables[2].title == "Default and chosen, measured again"
    assert "Of one sequence" in again.tables[2].note
    lines = {str(line["configuration"]).replace(" ", "_"): line for line in measured_again}
    assert set(lines) == {"default", *chosen}
    # The same frames again: the error is that of the trial, the time is another.
    by_number = {trial["trial"]: trial for trial in trials}
    assert lines["default"]["ate_m"] == trials[0]["ate_m"]
    for name, number in chosen.items():
        assert lines[name]["ate_m"] == by_number[number]["ate_m"]
    assert lines["default"]["cpu_ms_median"] != trials[0]["cpu_ms_median"]
    for name in ("pareto.png", "hypervolume.png", "held_out.png", "study.db"):
        assert (out / name).stat().st_size > 0
    assert len(again.charts[0].panels) == 3  # pairs of the three objectives
    assert "4 finished trials" in (out / "table.md").read_text()
    assert again.as_markdown() == results.as_markdown()


def test_going_on_keeps_what_is_there(explored, monkeypatch):
    exploration, out, before = explored
    monkeypatch.setattr(SlamEvaluator, "measure", None)  # nothing is left to measure
    after = run_exploration(exploration, out, 4)
    assert after.rows == before.rows
    assert after.tables == before.tables


def test_the_best_for_a_divergence_is_an_answer(explored, monkeypatch):
    exploration, out, _ = explored
    monkeypatch.setattr(SlamEvaluator, "measure", None)  # nothing is left to measure
    trials = read_results(out / "explore.json").rows
    M = trials[0]["result"]["M_I"], trials[0]["result"]["M_D"]
    asked = replace(exploration, for_divergence=M, tolerance=1000.0)
    run_exploration(asked, out, 4)
    number = read_results(out / "explore.json").content["for_divergence"]
    feasible = [t for t in trials if t["result"]["feasible"]]
    assert number == min(feasible, key=lambda t: t["result"]["cpu_ms_median"])["spec"]["trial"]
    made = read_configuration(out / "for-divergence.yaml")
    assert made.about["trial"] == number
    with pytest.raises(
        InputError, match=r"no feasible trial was measured at M_I >= 9 and M_D >= 0"
    ):
        run_exploration(replace(exploration, for_divergence=(9.0, 0.0)), out, 4)


def test_the_worst_sequence_counts(sequences):
    base = SlamConfiguration()
    evaluator = SlamEvaluator(sequences, image_size="80x60", baseline=base)
    assert evaluator(base)["ate_worst_ratio"] == 1.0
    other = SlamConfiguration(slam_config={"points_per_level": 300})
    rows = [[evaluator.measure(c, s)["ate_m"] for s in sequences] for c in (other, base)]
    measured = evaluator(other)
    assert measured["ate_worst_m"] == max(rows[0])
    assert measured["ate_worst_ratio"] == max(
        max(a, 1e-3) / max(b, 1e-3) for a, b in zip(*rows, strict=True)
    )


def test_fractions_of_a_millimetre_are_no_worst_sequence():
    errors = [[{"ate_m": e} for e in each] for each in ((9e-4, 4e-3, None), (3e-4, 2e-3, 1e-3))]
    assert worst_ratio(*errors) == 2.0
    assert worst_ratio(*errors[::-1]) == 1.0
    assert np.isnan(worst_ratio([{"ate_m": None}], [{"ate_m": 1.0}]))


def test_chosen_configurations_are_taken_everywhere(explored, sequences, tmp_path):
    exploration, out, _ = explored
    for name, row in read_results(out / "explore.json").content["chosen"].items():
        path = out / row["file"]
        configuration = read_configuration(path)
        assert configuration.about["purpose"] == name
        assert configuration.image_size == exploration.evaluator.image_size
        assert configuration.slam_config["points_per_level"] == row["params"]["points_per_level"]
        assert slam.make(path, xtion("80x60")).config.iterations[0] == row["params"]["iterations.0"]
    command = ["run", sequences[0], "--config", str(path), "--out", str(tmp_path / "run")]
    assert main(command) == 0


def test_held_out_ratios(tmp_path, monkeypatch):
    figures = {4.0: (0.02, 8.0), 2.0: (0.01, 2.0), 1.0: (0.5, 1.0)}

    def measure(self, configuration, sequence):
        ate, ext = figures[configuration.slam_config["depth_cutoff_m"]]
        failure = {"failure": "lost"} if ate == 0.5 else {}
        ate *= 2 if sequence.endswith("1") else 1
        return {"ate_m": ate, "ext_ms": ext, "load_ms": ext / 2, **failure}

    monkeypatch.setattr(SlamEvaluator, "measure", measure)
    configurations = {
        name: SlamConfiguration(slam_config={"depth_cutoff_m": cutoff})
        for name, cutoff in (("default", 4.0), ("fastest", 2.0), ("knee", 1.0))
    }
    evaluator = SlamEvaluator(("table:0",))
    file = tmp_path / "runs.jsonl"
    lines = compare_configurations(evaluator, configurations, ("table:1", "table:2"), file)
    default, fastest, knee = lines
    assert (default["ate_m_ratio"].value, default["cpu_ms_median_ratio"].value) == (1.0, 1.0)
    assert (fastest["ate_m"], fastest["cpu_ms_median"]) == (pytest.approx(0.015), 2.0)
    assert fastest["ate_m_ratio"].value == pytest.approx(0.5)
    ratio = fastest["cpu_ms_median_ratio"]
    assert ratio.low == ratio.high == pytest.approx(0.25)
    assert (knee["failed_runs"], knee["ate_m"]) == (2, None)
    assert compare_configurations(evaluator, configurations, (), file) == []
    file.write_text(file.read_text().replace("0.04", '"x"', 1))
    with pytest.raises(InputError, match=r"runs\.jsonl: row \w+ holds no measures"):
        compare_configurations(evaluator, configurations, ("table:1",), file)


def test_results_have_the_keys_of_the_registry():
    measured = {"ate_m": 0.1, "ext_ms": 2.0, "map_error_mm": 3.0, "energy_j": None, "lost": 0.5}
    assert as_metrics(measured, "processor") == {
        **{"ate_m": 0.1, "cpu_ms_median": 2.0, "ene_frame_j": None, "lost_share": 0.5},
        "map_error_median_m": pytest.approx(0.003),
    }
    assert as_metrics(measured, "wall")["ext_ms_median"] == 2.0
    for name in METRICS:
        assert all(metric(key_of(name, clock)).better == "lower" for clock in CLOCKS)


def test_a_grid_measures_each_point_once(sequences, tmp_path):
    space = make_space(["points_per_level=500:16000:log", "keep_every=1:4"])
    evaluator = SlamEvaluator(sequences[:1], image_size="80x60")
    grid = Grid(space, evaluator, 3, tmp_path / "evaluations.jsonl")
    assert grid.levels == {"points_per_level": [500, 5000, 16000], "keep_every": [1, 2, 4]}
    assert grid.size == 9
    assert grid.nearest({"points_per_level": 1700, "keep_every": 3}) == {
        "points_per_level": 5000,  # nearer in ratio, though not in difference
        "keep_every": 2,
    }
    first = grid({"points_per_level": 4800, "keep_every": 4})
    assert grid({"points_per_level": 5100, "keep_every": 4}) == first
    assert grid.measured == 1
    again = Grid(space, evaluator, 3, tmp_path / "evaluations.jsonl")
    assert again({"points_per_level": 5000, "keep_every": 4}) == first
    assert again.measured == 1
    with pytest.raises(InputError, match="'image_size' has no order"):
        Grid(make_space(["image_size"]), evaluator, 3, tmp_path / "other.jsonl")


def test_energy_is_refused_where_there_is_none(sequences, monkeypatch):
    if not energy_counters()["cpu"].reason:
        pytest.skip("this machine counts energy")
    with pytest.raises(InputError, match="energy_j is not available: "):
        Exploration(SlamEvaluator(sequences), ExplorationSettings(("ate_m", "energy_j")))
    modelled = ExplorationSettings(("ate_m", "energy_model_j"))
    small = SlamEvaluator(sequences, image_size="80x60")
    row = Exploration(small, modelled).evaluator.measure(SlamConfiguration(), sequences[0])
    assert row["energy_j"] is None
    assert row["energy_model_j"] > 0
    counted = {"cpu": NoEnergy("")}
    monkeypatch.setattr(exploration_module, "energy_counters", lambda: counted)
    with pytest.raises(InputError, match="use energy_j"):
        Exploration(SlamEvaluator(sequences), modelled)
    with pytest.raises(InputError, match="ate_worst_ratio is not measured"):
        Exploration(SlamEvaluator(sequences), ExplorationSettings(("ate_worst_ratio", "ext_ms")))
    with pytest.raises(InputError, match="map_error_mm is not measured"):
        Exploration(SlamEvaluator(sequences), ExplorationSettings(("ate_m", "map_error_mm")))
