"""Reports: what is found in a folder, what its figures show, how text gets into the page."""

import json
import os
import sys
from html import escape
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.benchmark.report.blocks import Figure, Prose, Table
from ms_slam_env.benchmark.report.discovery import find_results
from ms_slam_env.benchmark.report.flatten import flatten, records, table_of
from ms_slam_env.benchmark.report.glossary import heading, meaning, unit, with_unit
from ms_slam_env.benchmark.report.kinds.trajectory import trajectory_figures
from ms_slam_env.benchmark.report.markdown import blocks_of
from ms_slam_env.benchmark.report.page import page
from ms_slam_env.benchmark.report.plots import PALETTE
from ms_slam_env.benchmark.report.sections import section_of
from ms_slam_env.cli import main
from ms_slam_env.geometry import look_at
from ms_slam_env.metrics import absolute_errors
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_number, markdown_table
from ms_slam_env.sequences import write_trajectory

graph_objects = pytest.importorskip("plotly.graph_objects")

RESULTS = Path(__file__).resolve().parents[2] / "docs/results"
KINDS = {
    "arm_masks": "benchmark",
    "compare320": "comparison of SLAM backends",
    "fidelity": "benchmark",
    "frame_skipping": "frame skipping",
    "kidnapping": "benchmark",
    "loop_closure": "benchmark",
    "planners_live_reference": "planner benchmark",
    "pose_sources": "benchmark",
    "slam_speed": "speed",
    "speed": "speed",
    "step_size": "step size",
    "train": "training",
}


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def sections_of(folder):
    return [section_of(result) for result in find_results(folder)]


def figures_of(section):
    return [block for block in section.blocks if isinstance(block, Figure)]


@pytest.mark.parametrize("name", KINDS)
def test_committed_results_give_figures_that_plotly_takes(name):
    for section in sections_of(RESULTS / name):
        assert section.kind == KINDS[name]
        figures = figures_of(section)
        assert figures
        for figure in figures:
            for plot in figure.plots:
                graph_objects.Figure(data=plot.data, layout=plot.layout)  # raises if it is not
                assert any(len(trace["x"]) for trace in plot.data)
        assert any(isinstance(block, Table) for block in section.blocks)


def test_scatter_shows_every_episode_and_the_stored_medians():
    content = json.loads((RESULTS / "planners_live_reference/results.json").read_text())
    (section,) = sections_of(RESULTS / "planners_live_reference")
    data = figures_of(section)[0].plots[0].data
    done = [row for row in content["episodes"] if row["error"] is None]
    assert sum(len(t["x"]) for t in data if not t.get("showlegend", True)) == len(done)
    medians = [trace for trace in data if trace.get("showlegend", True)]
    assert len(medians) == len(content["summary"])
    for trace, measures in zip(medians, content["summary"].values(), strict=True):
        assert trace["x"] == pytest.approx([1e3 * measures["ate_m"]["value"]], rel=1e-5)
        assert trace["y"] == pytest.approx([100 * measures["f_score_5cm"]["value"]], rel=1e-5)


def test_divergence_is_drawn_as_measured(tmp_path):
    statistics = {"depth": {"max": 0.3, "mean": 0.2}, "intensity": {"max": None, "mean": None}}
    sequences = [
        {
            "sequence": name,
            "statistics": statistics,
            "times_s": [0.1, 0.2, 0.3],
            "depth": [0.1, factor * 0.2, 0.3],
            "intensity": [None, None, None],
        }
        for name, factor in (("a", 1), ("b", 2))
    ]
    write(tmp_path / "divergence.json", {"sequences": sequences})
    (section,) = sections_of(tmp_path)
    figure = figures_of(section)[0]
    assert [plot.label for plot in figure.plots] == ["depth divergence"]  # no colour, no figure
    assert [trace["y"][1] for trace in figure.plots[0].data] == [0.2, 0.4]


@pytest.fixture
def run_folder(tmp_path):
    """What ``ms-slam run`` leaves: an estimate that is moved and noisy, and the truth."""
    rng = np.random.default_rng(3)
    times = 0.1 * np.arange(40)
    truth = np.stack([look_at([t, np.sin(t), 1.0], [t, 5.0, 1.0]) for t in times])
    estimate = truth.copy()
    estimate[:, :3, 3] += rng.normal(0, 0.01, (40, 3))
    moved = look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.0]) @ estimate
    folder = tmp_path / "run"
    folder.mkdir()
    write_trajectory(folder / "groundtruth.txt", times, truth)
    write_trajectory(folder / "trajectory.txt", times, moved)
    lines = ["timestamp,tracking_ok,ext_ms,cpu_ms,mem_mb,ene_j"]
    lines += [f"{t:.6f},{int(k != 7)},5.0,{4 + k},," for k, t in enumerate(times)]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    content = {"complete": True, "frames": 40, "backend": "surfel", "sequence": "s", "ate_m": 0.01}
    write(folder / "metrics.json", {**content, "command": "ms-slam run s", "versions": {}})
    return folder, moved, truth


def test_error_of_a_run_equals_the_metric(run_folder):
    folder, estimate, truth = run_folder
    (section,) = sections_of(folder)
    path, error, cost = figures_of(section)
    assert [trace["name"] for trace in path.plots[0].data] == ["truth", "estimate"]
    expected = 1e3 * absolute_errors(estimate, truth)
    np.testing.assert_allclose(error.plots[0].data[0]["y"], expected, rtol=1e-4)
    assert [plot.label for plot in cost.plots] == ["processor time [ms]", "EXT [ms]"]
    lost = cost.plots[0].data[1]
    assert (lost["x"], lost["y"]) == ([7.0], [11.0])
    assert dict(section.provenance)["command"] == "ms-slam run s"


def test_an_estimate_without_truth_is_drawn_alone(run_folder):
    folder, _, _ = run_folder
    figures = trajectory_figures(folder / "none.txt", {"estimate": folder / "trajectory.txt"})
    assert [figure.title for figure in figures] == ["Path"]
    assert trajectory_figures(folder / "groundtruth.txt", {"estimate": folder / "no.txt"}) == []


def test_known_words_with_another_form_give_a_plain_section(tmp_path):
    episodes = [{"spec": {"planner": "p"}, "error": None}]
    write(tmp_path / "a/results.json", {"summary": {"p": {"f_score_5cm": 3}}, "episodes": episodes})
    write(tmp_path / "b/x.json", {"sequences": [{"times_s": 3, "depth": None}], "level": 4})
    assert [section.kind for section in sections_of(tmp_path)] == ["benchmark", "benchmark"]


def test_texts_and_pictures_go_to_the_result_that_is_named_like_them(tmp_path):
    for size in ("160x120", "320x240"):
        write(tmp_path / f"k_{size}.json", {"size": size})
        (tmp_path / f"table_{size}.md").write_text(f"Made at {size}.\n")
    first, second = sections_of(tmp_path)
    assert [b.text for b in first.blocks if isinstance(b, Prose)] == ["Made at 160x120."]
    assert [b.text for b in second.blocks if isinstance(b, Prose)] == ["Made at 320x240."]
    assert first.title.endswith(": k_160x120")


def test_units_and_headings():
    assert unit("ate_m") == ("mm", 1000.0)
    assert unit("ate_m.median") == ("mm", 1000.0)
    assert unit("path_length_m") == ("m", 1.0)
    assert heading("ate_m") == "ATE [mm]"
    assert heading("cpu_ms") == "CPU [ms]"
    assert heading("f_score_5cm") == "F-score 5 cm [%]"
    assert heading("summary.mapped_area_m2") == "summary: mapped area [m²]"
    assert heading("lost_share") == "lost share [%]"
    assert "trajectory" in meaning("ATE [mm]")
    assert meaning("ate_max_m") != meaning("ate_m")
    assert meaning("zzz") == ""
    assert heading("rotation_deg_per_m.mean") == "rotation: mean [deg/m]"


@pytest.mark.parametrize(
    ("label", "shown"),
    [
        ("turn deg s", "turn [deg/s]"),
        ("motions speed m s", "motions speed [m/s]"),
        ("image motion deg s", "image motion [deg/s]"),
        ("max per s", "max [1/s]"),
        ("depth m", "depth [m]"),
        ("ate_m", "ate_m"),
        ("path, m", "path, m"),
        ("frames", "frames"),
    ],
)
def test_units_at_the_end_of_a_written_heading_stand_in_brackets(label, shown):
    assert with_unit(label) == shown
    (table,) = blocks_of(f"| {label} |\n| ---: |\n| 1 |\n")
    assert table.columns == (shown,)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("EXT [ms]", "by the clock"),
        ("ext_ms_p95", "by the clock"),
        ("cpu_ms_mean", "Processor time"),
        ("M_I", "chosen motions"),
        ("importance of", "PED-ANOVA"),
        ("noise ratio", "USME 8"),
        ("processed frames", "Number"),
        ("points_per_level", "Pixels"),
        ("map points", "Surface points"),
    ],
)
def test_a_column_means_what_its_whole_name_says(name, part):
    assert part in meaning(name)


@pytest.mark.parametrize(
    "name",
    ["points_of_the_grid", "intensity_noise", "depth_noise_m", "seeds", "wall 0", "path_overlaps"],
)
def test_a_part_of_a_name_explains_nothing(name):
    assert meaning(name) == ""


def test_numbers_keep_their_value_through_text_and_intervals():
    row = flatten(
        {"spec": {"scene": "a"}, "result": {"ate_m": {"value": 0.01, "low": 0.0, "high": 0.02}}}
    )
    assert row == {"scene": "a", "ate_m": Interval(0.01, 0.0, 0.02)}
    table = table_of([row, {"scene": "b", "ate_m": 0.5}], "t")
    assert table.columns == ("scene", "ATE [mm]")
    assert [cells[1].number for cells in table.rows] == [10.0, 500.0]
    assert table.rows[0][1].text == "10.0 [0, 20.0]"


def test_nested_objects_become_rows():
    value = {"s": {"p": {"x": 1, "y": 2}, "q": {"x": 3}}, "t": {"p": {"x": 5}}}
    assert records(value, ["scene", "planner"]) == [
        {"scene": "s", "planner": "p", "x": 1, "y": 2},
        {"scene": "s", "planner": "q", "x": 3},
        {"scene": "t", "planner": "p", "x": 5},
    ]
    assert records({"a": 1}) is None


def test_columns_that_never_change_are_said_once():
    rows = [{"name": str(k), "steps": 100, "x": k} for k in range(5)]
    table = table_of(rows, "t")
    assert table.columns == ("name", "x")
    assert table.note == "The same in every row: steps 100."


def luminance(colour):
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("colour", PALETTE)
@pytest.mark.parametrize("ground", ["#f6f7f9", "#1d2329"])
def test_colours_stand_out_on_both_grounds(colour, ground):
    light, dark = sorted((luminance(colour), luminance(ground)), reverse=True)
    assert (light + 0.05) / (dark + 0.05) >= 3  # WCAG 2.1, 1.4.11: graphical objects


@settings(max_examples=30)
@given(st.lists(st.floats(-1e6, 1e6).map(lambda x: round(x, 3)), min_size=1, max_size=6))
def test_tables_in_markdown_sort_by_their_numbers(values):
    text = markdown_table(
        ["a", "b"], [[f"n{k}", format_number(v, 12)] for k, v in enumerate(values)]
    )
    (table,) = blocks_of(f"### Title\n\n{text}\n")
    assert table.title == "Title"
    assert [row[1].number for row in table.rows] == pytest.approx(values, rel=1e-9, abs=1e-9)


@settings(max_examples=50)
@given(st.text(alphabet="ab|-:\n #`\\1.<é", max_size=80))
def test_any_text_is_read(text):
    for block in blocks_of(text):
        if isinstance(block, Table):
            assert all(len(row) == len(block.columns) for row in block.rows)


leaves = (
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=6)
)
json_values = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=14,
)
KEYS = st.sampled_from(
    (
        *("summary", "episodes", "sequences", "points", "results", "stages_ms", "runs", "config"),
        *("statistics", "trials", "objectives", "hypervolume", "x"),
    )
)


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(KEYS, json_values, min_size=1, max_size=4))
def test_any_object_gives_a_section(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("any")
    write(folder / "any.json", content)
    (section,) = sections_of(folder)
    assert "NaN" not in page("any", [section]).rpartition("</main>")[0]  # JSON has no such number


@pytest.mark.parametrize(
    "content",
    [
        {"summary": {}, "episodes": [None]},
        {"summary": {}, "episodes": [{"spec": None}]},
        {"sequences": [{"result": [1]}]},
    ],
)
def test_rows_of_another_shape_are_shown_as_they_are(content, tmp_path):
    write(tmp_path / "any.json", content)
    assert len(sections_of(tmp_path)) == 1


HOSTILE = "</script><script>owned=1</script><img src=x onerror=owned=1>\"'&"


def test_hostile_text_reaches_the_page_only_escaped(tmp_path):
    rows = [{"planner": HOSTILE, "ate_m": 0.1}, {"planner": "b", "ate_m": 0.2}]
    provenance = {"command": HOSTILE, "versions": {HOSTILE: "1"}}
    write(tmp_path / "r.json", {"provenance": provenance, HOSTILE: HOSTILE, "summary": rows})
    (tmp_path / "table.md").write_text(f"| {HOSTILE} |\n| --- |\n| {HOSTILE} |\n\n`{HOSTILE}`\n")
    assert main(["report", str(tmp_path)]) == 0
    written = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert escape(HOSTILE) in written
    assert "<img src=x" not in written
    assert "<script>owned" not in written


def test_a_cell_that_is_not_finite_has_no_place_in_the_order(tmp_path):
    write(tmp_path / "r.json", {"a": 1})
    (tmp_path / "table.md").write_text("| a |\n| --- |\n| 2 |\n| 1e999 |\n")
    assert main(["report", str(tmp_path)]) == 0
    written = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<td class="n" data-n="2.0">2</td>' in written
    assert "<td>1e999</td>" in written


def test_a_text_in_another_encoding_is_no_obstacle(tmp_path):
    write(tmp_path / "r.json", {"a": 1})
    (tmp_path / "table.md").write_bytes("Größe".encode("latin-1"))
    assert main(["report", str(tmp_path)]) == 0


def test_the_page_is_one_file_with_plotly_in_it_once(tmp_path, capsys):
    for name in ("a", "b"):
        rows = [{"planner": p, "ate_m": 0.1 * k} for k, p in enumerate("xyz")]
        write(tmp_path / name / "r.json", {"summary": rows})
    out = tmp_path / "deep/er/page.html"
    assert main(["report", str(tmp_path), "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out
    written = out.read_text(encoding="utf-8")
    assert written.count("plotly.js v") == 1
    assert written.count('<figure class="plot"') == 2
    assert 'href="#s2"' in written
    assert not list(out.parent.glob("*.partial"))


def test_a_failed_write_leaves_the_old_page(tmp_path, monkeypatch):
    write(tmp_path / "r.json", {"a": 1})
    (tmp_path / "report.html").write_text("old")

    def fail(source, target):
        raise OSError(28, "No space left on device", str(target))

    monkeypatch.setattr(os, "replace", fail)
    assert main(["report", str(tmp_path)]) == 2
    assert (tmp_path / "report.html").read_text() == "old"


def make_nothing(folder):
    folder.mkdir()
    (folder / "notes.txt").write_text("no result")
    (folder / "list.json").write_text("[1, 2]")


def make_broken(folder):
    folder.mkdir()
    (folder / "results.json").write_text('{"a": ')


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: None, "is not a folder"),
        (make_nothing, "holds no results"),
        (make_broken, "results.json is not a JSON file"),
    ],
)
def test_bad_folders_are_one_line(tmp_path, capsys, make, message):
    make(tmp_path / "folder")
    assert main(["report", str(tmp_path / "folder")]) == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert str(tmp_path / "folder") in complaint
    assert complaint.count("\n") == 1


def test_out_that_is_a_folder_and_missing_plotly_are_said(tmp_path, capsys, monkeypatch):
    rows = [{"planner": p, "ate_m": 0.1 * k} for k, p in enumerate("xyz")]
    write(tmp_path / "r.json", {"summary": rows})
    assert main(["report", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    assert main(["report", str(tmp_path)]) == 2
    assert "pip install ms-slam-env[report]" in capsys.readouterr().err
