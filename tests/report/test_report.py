"""Reports: what is found in a folder, what its charts show, how text gets into the page."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from html import escape, unescape
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ms_slam_env.benchmark.experiment import Experiment, experiment_class
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import CHANGED_KINDS, metric
from ms_slam_env.report.charts import Chart, Guide, Panel, Series
from ms_slam_env.report.discovery import find_results
from ms_slam_env.report.page import write_report
from ms_slam_env.report.plotly_charts import PALETTE, plots_of
from ms_slam_env.report.results import RESULTS, read_results, write_result_folder, write_results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Column, make_table

graph_objects = pytest.importorskip("plotly.graph_objects")

HOSTILE = "</script><script>owned=1</script><img src=x onerror=owned=1>\"'&"


def example_charts() -> list[Chart]:
    """Every kind of mark and axis."""
    names = ["greedy", "random"]
    over_steps = [
        Series(name, [1, 2, 4], [0.001, 0.01, k], [0.0005, 0.005, k], [0.002, None, 2 * k], "lines")
        for k, name in enumerate(names, start=1)
    ]
    groups = [
        Series("greedy", [0.1, 0.2, None], ["greedy"] * 3, mode="dots"),
        Series("greedy", [0.15], ["greedy"], [0.1], [0.2], "markers"),
        Series("random", [0.4], ["random"], [0.3], [float("inf")], "markers"),
    ]
    bars = [Series(name, ["table", "lab"], [0.1, 0.2], mode="bars") for name in names]
    plan = [Series("truth", [0, 1], [0, 1], mode="lines", text=["start", "end"])]
    guides = [Guide(0.02, "y", "target"), Guide(3, "x")]
    return [
        Chart(
            "every",
            "Every kind",
            "Marks of every kind.",
            [
                Panel("steps", "ate_m", over_steps, "y", guides),
                Panel("f_score_5cm", "", groups),
                Panel("", "ate_m", bars, title="scenes"),
                Panel("path_m", "path_m", plan, equal=True),
            ],
        )
    ]


def write_example(path: Path, **more: Any) -> Path:
    """A result with everything that a page shows."""
    table = make_table(
        ["planner", "ate_m", Column("table", "f_score_5cm", "table")],
        [
            {"planner": "greedy", "ate_m": Interval(0.0123, 0.01, 0.02), "table": 0.5},
            {"planner": "random", "ate_m": float("inf"), "table": None},
        ],
        "By planner",
        "A note.",
    )
    rows = [
        {
            "key": str(seed),
            "spec": {"planner": "greedy", "seed": seed, "step_m": 0.1, "options": {}},
            "result": {"ate_m": 0.01 * seed, "ate_over_steps": [0.1, 0.2]},
            "error": None,
        }
        for seed in (1, 2)
    ] + [{"key": "3", "spec": {"planner": "random", "seed": 3, "step_m": 0.1, "options": {}},
          "result": None, "error": "ValueError: it broke"}]  # fmt: skip
    given = {"tables": [table], "charts": example_charts(), "rows": rows, "rows_key": "episodes"}
    write_results(path, "planners", "Planner benchmark", "About it.", **(given | more))
    return path


def edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def report_of(folder: Path) -> str:
    assert main(["report", str(folder)]) == 0
    text = (folder / "report.html").read_text(encoding="utf-8")
    return re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)


def test_plotly_takes_every_chart() -> None:
    for plot in plots_of(example_charts()[0]):
        graph_objects.Figure(data=plot.data, layout=plot.layout)  # raises if it is not valid


def test_series_are_drawn_in_the_shown_unit_with_their_intervals() -> None:
    over_steps, groups, bars, plan = plots_of(example_charts()[0])
    assert [plot.label for plot in (over_steps, groups, bars)] == [
        *("ATE [mm]", "F-score at 5 cm [%]", "scenes")
    ]
    band, line, *_ = over_steps.data
    assert (line["x"], line["y"]) == ([1, 2, 4], [1, 10, 1000])
    assert (band["x"], band["y"]) == ([1, 4, 4, 1], [2, 2000, 1000, 0.5])  # no upper end, no band
    assert over_steps.layout["yaxis"]["type"] == "log"
    target, limit = over_steps.layout["shapes"]
    assert (target["y0"], target["name"], limit["x0"]) == (pytest.approx(20), "target", 3)
    _, middle, endless = groups.data
    assert (middle["x"], middle["error_x"]["array"]) == ([15], [pytest.approx(5)])
    assert endless["error_x"]["array"] == [None]
    assert groups.layout["yaxis"]["categoryarray"] == ["greedy", "random"]
    assert not groups.layout["showlegend"]  # the axis names them already
    assert [trace["type"] for trace in bars.data] == ["bar", "bar"]
    assert plan.layout["yaxis"]["scaleanchor"] == "x"


def test_a_name_looks_alike_in_all_panels_and_stands_in_a_legend_once() -> None:
    plots = plots_of(example_charts()[0])
    colours = {
        (trace["name"], trace["marker"]["color"])
        for plot in plots
        for trace in plot.data
        if "marker" in trace
    }
    assert len(colours) == len({name for name, _ in colours})
    for plot in plots:
        entries = [trace["name"] for trace in plot.data if trace["showlegend"]]
        assert sorted(entries) == sorted({trace["name"] for trace in plot.data})


def test_names_that_are_cut_alike_stay_different() -> None:
    names = [f"{'a' * 30}{k}{'b' * 30}" for k in range(3)]
    panel = Panel("", "ate_m", [Series("", names, [1, 2, 3], mode="bars")])
    (plot,) = plots_of(Chart("c", "t", "c", [panel]))
    assert len(set(plot.data[0]["x"])) == 3


def test_panels_of_one_measure_are_told_apart_by_their_titles() -> None:
    line = [Series("", [1], [1])]
    panels = [Panel("steps", key, line, title="table") for key in ("ate_m", "rpe_m")]
    plots = plots_of(Chart("c", "t", "c", panels))
    assert [plot.label for plot in plots] == ["table: ATE [mm]", "table: RPE [mm]"]


def test_the_page_shows_tables_with_what_columns_mean(tmp_path: Path) -> None:
    write_example(tmp_path / "results.json")
    text = report_of(tmp_path)
    for part in ("About it.", "A note.", "By planner", "ATE [mm]", "table [%]", "Made by"):
        assert part in text
    assert escape(metric("ate_m").explanation) in text
    assert '<td class="n" data-n="12.3"><span>12.3</span> <span>[10.0, 20.0]</span></td>' in text
    assert '<td class="n" data-n="Infinity">never</td>' in text
    assert "<td>-</td>" in text


def test_the_page_shows_every_row_and_says_once_what_is_the_same(tmp_path: Path) -> None:
    write_example(tmp_path / "results.json")
    text = report_of(tmp_path)
    assert "<summary>3 episodes</summary>" in text
    assert "The same in every row: step_m 0.1." in text
    assert "ValueError: it broke" in text


def test_results_of_older_algorithms_say_so(tmp_path: Path) -> None:
    path = write_example(tmp_path / "results.json")
    assert 'class="stale"' not in report_of(tmp_path)
    edit(path, results_version=3)
    stale = read_results(path).stale
    assert "version 4: " in stale
    assert escape(stale) in report_of(tmp_path)


def test_only_what_a_version_changed_is_older_than_it(tmp_path: Path) -> None:
    path = write_example(tmp_path / "results.json")
    edit(path, results_version=4, kind="planners")
    assert "version 5: environments have" in read_results(path).stale
    edit(path, kind="loop_closure")
    stale = read_results(path).stale
    assert "version 5: " not in stale
    assert "version 6: SLAM judges" in stale  # changed all kinds


def test_what_an_uncommitted_state_made_says_so(tmp_path: Path) -> None:
    path = write_example(tmp_path / "results.json")
    content = json.loads(path.read_text())
    said = "Made with code that is in no commit"
    content["provenance"]["commit"] = "0123abcd"
    path.write_text(json.dumps(content))
    assert said not in read_results(path).as_markdown()
    content["provenance"]["commit"] = "0123abcd-dirty"
    path.write_text(json.dumps(content))
    assert f"*{said}.*" in read_results(path).as_markdown()
    content[content["rows_key"]][0]["commit"] = "0123abcd-dirty"
    path.write_text(json.dumps(content))
    of_rows = f"1 of {len(content[content['rows_key']])} rows were m{said[1:]}"
    assert f"*{of_rows}.*" in read_results(path).as_markdown()
    assert of_rows in report_of(tmp_path)
    glossary = (Path(__file__).parents[2] / "docs" / "glossary.md").read_text()
    assert f"### {said[10:].capitalize()}" in glossary


def test_tables_of_older_results_have_the_titles_of_today(tmp_path: Path) -> None:
    path = write_example(tmp_path / "results.json")
    content = json.loads(path.read_text())
    old = (
        "home: Sooner than each other",
        "Policies as one",
        "Policies as one: Better than each other",
    )
    table = content["tables"][0]
    content["tables"] = [{**table, "title": title} for title in (*old, "Details")]
    path.write_text(json.dumps(content))
    pooled = "Policies of each training pooled"
    assert [table.title for table in read_results(path).tables] == [
        "home: Share of pairs, by area under the F-score",
        pooled,
        f"{pooled}: Share of pairs, by final F-score",
        "Details",
    ]


@pytest.mark.parametrize("log", ["9", "yx", "x ", "\ud800"])
def test_other_axes_than_x_and_y_are_refused(log: str) -> None:
    with pytest.raises(InputError, match=r"unknown logarithmic axes .*; valid choices: x, y, xy"):
        Panel("steps", "ate_m", [Series("", [1], [2.0])], log)


NO_EXPERIMENTS = {"train", "evaluation"}


@pytest.mark.parametrize("kind", sorted(set(chain(*CHANGED_KINDS.values())) - NO_EXPERIMENTS))
def test_kinds_that_a_version_changed_are_experiments(kind: str) -> None:
    assert issubclass(experiment_class(kind), Experiment)


def test_files_beside_a_result_are_shown_with_it(tmp_path: Path) -> None:
    for size in ("160x120", "320x240"):
        write_example(tmp_path / f"k_{size}.json")
        (tmp_path / f"setting_{size}.yaml").write_text("a: 1")
        (tmp_path / f"table_{size}.md").write_text("the same tables")
    (tmp_path / "every.png").write_bytes(b"drawn from a chart")
    (tmp_path / "map_320x240.png").write_bytes(b"a picture")
    (tmp_path / "long.txt").write_bytes(b"0" * 200_000)
    (first, second), absent = find_results(tmp_path)
    assert first.title.endswith(": k_160x120")
    assert [path.name for path in first.texts] == ["setting_160x120.yaml"]
    assert first.pictures == []
    assert [path.name for path in second.pictures] == ["map_320x240.png"]
    assert [(missing.name, missing.reason) for missing in absent] == [("long.txt", "is too large")]


def test_figures_that_the_next_result_has_not_go(tmp_path: Path) -> None:
    first, second = (replace(example_charts()[0], name=name) for name in ("first", "second"))
    outside = tmp_path.parent / f"{tmp_path.name}_outside.png"
    outside.write_bytes(b"not of this result")
    hostile = replace(first, name=f"../{outside.stem}")
    for charts in ([first, second], [second]):
        write_result_folder(
            tmp_path,
            RESULTS,
            kind="planners",
            title="",
            about="",
            tables=[],
            charts=charts,
            rows=[],
        )
        (tmp_path / "mine.png").write_bytes(b"a picture")
        if len(charts) == 2:
            edit(tmp_path / RESULTS, charts=[chart.as_json() for chart in (*charts, hostile)])
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["mine.png", "second.png"]
    assert outside.exists()


@pytest.mark.parametrize("value", ["Infinity", float("nan")])
def test_a_guide_without_a_place_is_left_out(tmp_path: Path, value: Any) -> None:
    path = write_example(tmp_path / "results.json")
    charts = json.loads(path.read_text())["charts"]
    charts[0]["panels"][0]["guides"][0]["value"] = value
    edit(path, charts=charts)
    assert '"name":"target"' not in report_of(tmp_path)


def test_what_is_no_result_is_named_and_not_guessed_at(tmp_path: Path) -> None:
    write_example(tmp_path / "a/results.json")
    (tmp_path / "list.json").write_text('[{"ate_m": 0.123456}]')
    (tmp_path / "broken.json").write_text('{"a": ')
    (tmp_path / "deep.json").write_text(600 * "[" + 600 * "]")
    edit(write_example(tmp_path / "b/unknown.json"), tables=[{"columns": [{"name": "zz"}]}])
    text = report_of(tmp_path)
    shown = text.partition("Not shown")[2]
    for name in ("list.json", "broken.json", "deep.json", "b/unknown.json"):
        assert name in shown
    assert "0.123456" not in text


def luminance(colour: str) -> float:
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("colour", PALETTE)
@pytest.mark.parametrize("ground", ["#f6f7f9", "#1d2329"])
def test_colours_stand_out_on_both_grounds(colour: str, ground: str) -> None:
    light, dark = sorted((luminance(colour), luminance(ground)), reverse=True)
    assert (light + 0.05) / (dark + 0.05) >= 3  # WCAG 2.1, 1.4.11: graphical objects


def with_texts_replaced(content: Any, keep: tuple[str, ...] = ()) -> Any:
    """JSON whose texts are hostile, but those under keys ``keep``."""
    if isinstance(content, dict):
        return {
            key: value if key in keep else with_texts_replaced(value, keep)
            for key, value in content.items()
        }
    if isinstance(content, list):
        return [with_texts_replaced(value, keep) for value in content]
    return HOSTILE if isinstance(content, str) else content


def test_hostile_text_reaches_the_page_only_escaped(tmp_path: Path) -> None:
    name = f"{HOSTILE.replace('/', '')}.json"
    path = write_example(tmp_path / name, content={"config": {"a": "b"}})
    content = json.loads(path.read_text())
    keys = ("key", "name", "x", "y", "high", "log", "mode", "axis")
    keys += ("rows_key", "commit")
    content = with_texts_replaced(content, keys)
    content["provenance"] |= {HOSTILE: HOSTILE, "versions": {HOSTILE: HOSTILE}}
    for series in content["charts"][0]["panels"][1]["series"]:
        series |= {"name": HOSTILE, "y": [HOSTILE] * len(series["y"])}
    content["episodes"][0]["spec"][HOSTILE] = HOSTILE
    path.write_text(json.dumps(content))
    (tmp_path / "a.yaml").write_text(HOSTILE)
    (tmp_path / "no.json").write_text(HOSTILE)
    text = report_of(tmp_path)
    assert text.count(escape(HOSTILE)) > 10
    assert "<img" not in text
    assert "owned=1<" not in text
    (data,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    assert "<img" not in str(json.loads(data))  # Plotly takes some tags for markup
    assert HOSTILE in unescape(text)


def test_a_text_in_another_encoding_is_no_obstacle(tmp_path: Path) -> None:
    write_example(tmp_path / "results.json")
    (tmp_path / "notes.md").write_bytes("Größe".encode("latin-1"))
    assert "notes.md" in report_of(tmp_path)


def test_the_page_is_one_file_with_plotly_in_it_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        write_example(tmp_path / name / "results.json")
    out = tmp_path / "deep/er/page.html"
    assert main(["report", str(tmp_path), "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out
    written = out.read_text(encoding="utf-8")
    assert written.count("plotly.js v") == 1
    assert written.count('<figure class="plot"') == 2
    assert 'href="#s2"' in written
    assert not list(out.parent.glob("*.partial"))


def make_nothing(folder: Path) -> None:
    folder.mkdir()
    (folder / "notes.txt").write_text("no result")
    (folder / "list.json").write_text("[1, 2]")


def make_broken(folder: Path) -> None:
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
def test_bad_folders_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Callable[[Path], None], message: str
) -> None:
    make(tmp_path / "folder")
    assert main(["report", str(tmp_path / "folder")]) == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert str(tmp_path / "folder") in complaint
    assert complaint.count("\n") == 1


def test_out_that_is_a_folder_and_missing_plotly_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_example(tmp_path / "results.json")
    assert main(["report", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    assert main(["report", str(tmp_path)]) == 2
    assert "pip install ms-slam-env[report]" in capsys.readouterr().err


def test_only_regular_files_of_the_folder_are_read(tmp_path: Path) -> None:
    """A pipe would block, a device never end, a link show a file from elsewhere."""
    folder = tmp_path / "results"
    write_results(folder / "results.json", "k", "mine", "")
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "secret.json").write_text((folder / "results.json").read_text())
    (folder / "link.txt").symlink_to(tmp_path / "secret.txt")
    (folder / "other.json").symlink_to(tmp_path / "secret.json")
    (folder / "zero.png").symlink_to("/dev/zero")
    (folder / "gone.json").symlink_to(tmp_path / "gone.json")
    for name in ("a.txt", "b.json", "c.png"):
        os.mkfifo(folder / name)
    found, _ = find_results(folder)
    assert [(one.path.name, one.pictures, one.texts) for one in found] == [("results.json", [], [])]
    assert "secret" not in write_report(folder).read_text()
    with pytest.raises(InputError, match="not a regular file"):
        read_results(folder / "b.json")


def test_pictures_of_a_folder_are_bounded_together(tmp_path: Path) -> None:
    write_results(tmp_path / "results.json", "k", "mine", "")
    for number in range(26):
        with (tmp_path / f"p{number:02d}.png").open("wb") as file:
            file.truncate(4_000_000)
    (found,), absent = find_results(tmp_path)
    assert len(found.pictures) == 25
    assert [missing.name for missing in absent] == ["p25.png"]
