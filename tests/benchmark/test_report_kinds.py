"""Kinds of results that a report knows: recognised by their content, drawn as measured."""

import json

import pytest

from ms_slam_env.benchmark.report.blocks import Figure, Table
from ms_slam_env.benchmark.report.discovery import find_results
from ms_slam_env.benchmark.report.sections import section_of

graph_objects = pytest.importorskip("plotly.graph_objects")


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


def figures_of(section):
    return [block for block in section.blocks if isinstance(block, Figure)]


def spread(value):
    return {"value": value, "low": 0.5 * value, "high": 2 * value}


def trial(number, ate_m, ext_ms, **more):
    params = {"icp_rgb_weight": 0.1 * number, "iterations": [4, 5, number]}
    row = {"trial": number, "ate_m": ate_m, "ext_ms": ext_ms, "params": params, "feasible": True}
    return {**row, "on_front": False, "default": False, **more}


ENDS = {"ate_ratio_low": 0.1, "ate_ratio_high": 2}
FRONT = trial(2, 0.001, 4.0, on_front=True)
EXAMPLES = {
    "design-space exploration": {
        "objectives": ["ate_m", "ext_ms"],
        "trials": [
            trial(0, 0.002, 8.0, default=True),
            trial(1, 0.2, 2.0, failure="lost", feasible=False),
            FRONT,
            trial(3, None, None, failure="broke down", feasible=False),
            trial(4, 0.0008, 9.0, on_front=True),
        ],
        "chosen": {"knee": {"file": "../secret.yaml", **FRONT}},
        "hypervolume": [0.1, 0.1, 0.4, 0.4, 0.5],
        "importance": {"ate_m": {"a": 0.9, "b": 0.1}, "ext_ms": {"a": 0.2, "b": 0.8}},
        "held_out": [
            {"configuration": name, "ate_m": 0.1, "ate_ratio": ratio} | ENDS
            for name, ratio in (("default", 1.0), ("knee", 0.5))
        ],
    },
    "samplers of an exploration": {
        "hypervolume": {"random": [[0.1, 0.2], [0.3, 0.4]], "tpe": [[0.2, 0.5], [0.4, 0.5]]},
        "summary": [{"sampler": "random", "gain": 0.0}, {"sampler": "tpe", "gain": 0.1}],
    },
    "error and time at different divergences": {
        "summary": [
            {"keep_every": n, "M_I": 0.1 * n, "ate_m": 0.01 * n, "ext_ms": 5.0} for n in (1, 2, 4)
        ],
        "runs": [
            {"keep_every": n, "sequence": "s", "M_I": 0.1, "M_D": 0.1 * n, "ate_m": 0.01}
            for n in (1, 2, 4)
        ],
    },
    "difficulty of motions": {
        "statistics": [
            {
                "scene": "a/house.glb", "noise": "none", "motion": motion, "setting": "paper",
                "divergence": kind, "mean": 0.1 * index, "max": 0.4,
            }
            for index, motion in enumerate(("kt0", "kt1"))
            for kind in ("intensity", "depth")
        ]
    },
    "USME suite": {
        "summary": [
            {
                "sequence": sequence, "backend": backend, "error": None, "ate_m": 0.01 * place,
                "ext_ms": 5.0, "robustness": 0.9, "relocalisation_s": None,
            }
            for place, (sequence, backend) in enumerate(
                ((s, b) for s in ("room", "street") for b in ("surfel", "sparse")), start=1
            )
        ]
        + [{"sequence": "x", "backend": "sparse", "error": "broke down"}]
    },
    "frame management": {
        "summary": [
            {"management": "none", "processed": 1.0, "ate_m": 0.001},
            {"management": "regular,every=2", "processed": 0.5, "ate_m": 0.002},
            {
                "management": "divergence,threshold=0.1", "processed": 0.4, "ate_m": 0.003,
                "regular_processed": 0.41, "regular_ate_m": 0.004,
            },
        ]
    },
    "run-time adaptation": {
        "summary": [
            {"name": "fast", "ate_m": spread(0.01)}, {"name": "adaptive", "ate_m": spread(0.02)}
        ],
        "sequences": [
            {
                "spec": {"scene": "table", "seed": 1},
                "error": None,
                "result": {
                    "runs": {
                        "fast": {"ate_m": 0.01, "cpu_ms": 3},
                        "adaptive": {"ate_m": 0.02, "cpu_ms": 4},
                    },
                    "change": [0.0, 0.1, 0.2, 0.1], "level": [0, 0, 1, 1],
                    "thresholds": [0.15], "violent": [False, True, True, False],
                },
            },
            {"spec": {"scene": "table", "seed": 2}, "error": "broke down", "result": None},
        ],
    },
    "teams of robots": {
        "summary": [{"setting": "shared", "robots": 2, "wrong": 0}],
        "teams": [
            {
                "scene": "table", "seed": seed, "setting": "shared", "team_ate_m": 0.002 * seed,
                "robots": [{"ate_m": 0.001}, {"ate_m": 0.003 * seed}],
            }
            for seed in (1, 2)
        ],
    },
    "trajectory against the truth": {
        "estimate": "none.txt", "truth": "none.txt", "align": "se3", "ate_m": {"rmse": 0.1},
        "segments": [{"start_s": t, "ate_m": {"rmse": 0.1 * t}} for t in (1.0, 2.0)],
        "drift": [{"length_m": x, "translation_percent": {"mean": x}} for x in (1.0, 2.0)],
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", EXAMPLES)
def test_kinds_are_known_by_their_content_and_give_valid_figures(kind, tmp_path):
    write(tmp_path / "r.json", EXAMPLES[kind])
    (section,) = [section_of(result) for result in find_results(tmp_path)]
    assert section.kind == kind
    figures = figures_of(section)
    assert figures
    for plot in (plot for figure in figures for plot in figure.plots):
        graph_objects.Figure(data=plot.data, layout=plot.layout)
        assert any(len(trace["x"]) for trace in plot.data)


def example_figures(kind, tmp_path):
    write(tmp_path / "r.json", EXAMPLES[kind])
    (section,) = [section_of(result) for result in find_results(tmp_path)]
    return {figure.title: figure for figure in figures_of(section)}


def test_front_is_drawn_from_fast_to_exact_in_shown_units(tmp_path):
    (tmp_path.parent / "secret.yaml").write_text("not of this folder")
    figures = example_figures("design-space exploration", tmp_path)
    traces = {trace["name"]: trace for trace in figures["Pareto front"].plots[0].data}
    assert (traces["Pareto front"]["x"], traces["Pareto front"]["y"]) == ([4.0, 9.0], [1.0, 0.8])
    assert (traces["default"]["x"], traces["default"]["y"]) == ([8.0], [2.0])
    assert traces["failed"]["x"] == [2.0]
    assert "trial" not in traces
    assert "iterations.3 2" in traces["knee"]["text"][0]
    ratio = figures["Held-out sequences"].plots[0].data[0]
    assert (ratio["x"], ratio["error_x"]["array"]) == ([1.0, 0.5], [1.0, 1.5])


def test_a_file_outside_the_folder_is_not_shown(tmp_path):
    (tmp_path / "secret.yaml").write_text("not of this folder")
    write(tmp_path / "a/r.json", EXAMPLES["design-space exploration"])
    (section,) = [section_of(result) for result in find_results(tmp_path / "a")]
    assert "not of this folder" not in str(section.blocks)


def test_filters_stand_beside_regular_skipping_of_as_many_frames(tmp_path):
    figures = example_figures("frame management", tmp_path)
    curve = figures["Measures over the share of frames processed"].plots[0]
    points = {trace["name"]: (trace["x"], trace["y"]) for trace in curve.data}
    assert points["divergence"] == ([40.0], [3.0])
    assert points["regular beside divergence"] == ([41.0], [4.0])
    assert points["regular"] == ([50.0], [2.0])


def test_switching_is_drawn_with_its_thresholds_and_violent_stretch(tmp_path):
    (plot,) = example_figures("run-time adaptation", tmp_path)["Switching along a sequence"].plots
    assert [shape["x0"] for shape in plot.layout["shapes"]] == [0.5]
    assert [shape["x1"] for shape in plot.layout["shapes"]] == [2.5]
    assert plot.data[1]["y"] == [0.15, 0.15]
    assert plot.data[-1]["y"] == [0, 0, 1, 1]


def test_hypervolumes_are_averaged_over_seeds(tmp_path):
    (plot,) = example_figures("samplers of an exploration", tmp_path)[
        "Hypervolume over trials"
    ].plots
    lines = [trace["y"] for trace in plot.data if trace.get("hoverinfo") != "skip"]
    assert lines == [pytest.approx([0.2, 0.3]), pytest.approx([0.3, 0.5])]


def test_a_team_stands_beside_its_robots(tmp_path):
    figures = example_figures("teams of robots", tmp_path)
    (plot,) = figures["Teams beside their robots alone"].plots
    values = {trace["name"]: trace["x"] for trace in plot.data}
    assert values["team, merged"] == [2.0, 4.0]
    assert values["robot 2 alone"] == [3.0, 6.0]


def explained(section):
    """What the section says of each column, by heading."""
    tables = [block for block in section.blocks if isinstance(block, Table)]
    return {name: text for table in tables for name, text in table.meanings.items()}


@pytest.mark.parametrize(
    ("clock", "time"), [("processor", "processor time"), ("wall", "time by the clock")]
)
def test_time_of_an_exploration_is_by_the_clock_of_its_settings(clock, time, tmp_path):
    content = EXAMPLES["design-space exploration"] | {"config": {"clock": clock}}
    write(tmp_path / "r.json", content)
    header = "| ext_ms | load_ms | EXT [ms/frame] | EXT [ms/frame of the sequence] | M_I |"
    (tmp_path / "table.md").write_text(f"{header}\n|{' ---: |' * 5}\n|{' 1 |' * 5}\n")
    (section,) = [section_of(result) for result in find_results(tmp_path)]
    said = explained(section)
    assert said["ext_ms"] == said["EXT [ms/frame]"] == f"Median {time} of a processed frame."
    assert said["load_ms"] == said["EXT [ms/frame of the sequence]"]
    assert "of the sequence" in said["load_ms"]
    assert time in said["load_ms"]
    assert "consecutive processed frames" in said["M_I"]
    assert "above the default's" in section.about


def test_times_of_the_usme_suite_are_by_the_clock(tmp_path):
    write(tmp_path / "r.json", EXAMPLES["USME suite"])
    header = "| scene | noise [%] | EXT [ms] | processor [ms] |"
    (tmp_path / "table.md").write_text(f"{header}\n|{' --- |' * 4}\n|{' 1 |' * 4}\n")
    (section,) = [section_of(result) for result in find_results(tmp_path)]
    said = explained(section)
    assert "by the clock" in said["EXT [ms]"]
    assert "Processor time" in said["processor [ms]"]
    assert "USME 8" in said["noise [%]"]
    assert "scene" in said["scene"]


def test_the_error_column_of_an_evaluation_names_a_measure(tmp_path):
    write(tmp_path / "r.json", EXAMPLES["trajectory against the truth"])
    (tmp_path / "table.md").write_text("| error | rmse |\n| --- | ---: |\n| ATE | 1 |\n")
    (section,) = [section_of(result) for result in find_results(tmp_path)]
    assert "measure" in explained(section)["error"]
