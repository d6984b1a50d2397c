"""The harness: finding, running, resuming, checking; one tiny experiment of its own."""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ms_slam_env.benchmark import EXPERIMENTS, Experiment, checking, experiment_class, rows
from ms_slam_env.benchmark.checking import check_results, compare, spec_type
from ms_slam_env.benchmark.rows import run_experiment
from ms_slam_env.benchmark.usme import Usme
from ms_slam_env.cli import main
from ms_slam_env.cli.experiment import run
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import RESULTS_VERSION, check_keys, registry
from ms_slam_env.report.records import Row
from ms_slam_env.report.results import read_results
from ms_slam_env.report.tables import Grouping, Table


@dataclass(frozen=True)
class Wobble:
    scene: str
    seed: int


@dataclass(frozen=True)
class Wobbles(Experiment):
    """Wobbling cameras

    A constant by seed.
    """

    scenes: tuple[str, ...] = ("table", "wall")
    """Names."""
    episodes: int = 2
    """Seeds for each scene."""

    @staticmethod
    def run(spec: Wobble) -> dict[str, Any]:
        if spec.scene == "mars":
            raise RuntimeError("no air")
        return {"ate_m": 0.01 * spec.seed, "cpu_ms_median": 5.0, "lost": False}

    def specs(self) -> list[Wobble]:
        if self.episodes < 1:
            raise InputError("episodes = 0 is too few")
        return [Wobble(s, seed) for s in self.scenes for seed in range(1, 1 + self.episodes)]

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        return [
            Grouping(("scene",), ("ate_m", "lost"), rank_by="ate_m", count="episodes").table(rows)
        ]


def test_rows_are_kept_and_only_failed_ones_run_again(tmp_path: Path) -> None:
    outcome = run_experiment(Wobbles(scenes=("table", "mars")), tmp_path, workers=1)
    assert len(outcome.failures) == 2
    before = (tmp_path / "rows.jsonl").read_text()
    assert "Traceback" in before
    assert "Traceback" not in (tmp_path / "results.json").read_text()  # paths of a machine
    again = run_experiment(Wobbles(), tmp_path, workers=1)
    assert not again.failures
    assert (tmp_path / "rows.jsonl").read_text().startswith(before)
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["results_version"] == RESULTS_VERSION
    assert content["title"] == "Wobbling cameras"
    assert content["about"] == "A constant by seed."
    assert [row["result"]["ate_m"] for row in content["rows"]] == [0.01, 0.02, 0.01, 0.02]
    assert "| table | 2 | 15.0 [10.0, 20.0] | 0 [0, 66] |" in (tmp_path / "table.md").read_text()


def test_the_harness_hands_its_options_to_the_pool(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def open_pool(run: object, workers: int, ray: str | None, **options: Any) -> Any:
        given.update(workers=workers, ray=ray, **options)
        return real_pool(run, workers)

    real_pool = rows.open_pool
    monkeypatch.setattr(rows, "open_pool", open_pool)
    monkeypatch.setattr(Wobbles, "fresh_process", True)
    run_experiment(Wobbles(), tmp_path, workers=1, ray="a:1")
    assert (given["workers"], given["ray"], given["fresh"]) == (1, "a:1", True)
    assert "OMP_NUM_THREADS" in {*given["environment"], *os.environ}


def test_the_command_line_is_made_of_the_fields(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--scenes", "wall", "--episodes", "1", "--workers", "1", "--out", str(tmp_path)]
    assert run(Wobbles, options, "test", tmp_path) == 0
    assert "| wall | 1 | 10.0 [10.0, 10.0] |" in capsys.readouterr().out
    with pytest.raises(InputError, match="too few"):
        run(Wobbles, ["--episodes", "0"], "test", tmp_path)
    with pytest.raises(InputError, match="episods"):
        run(Wobbles, ["--episods", "1"], "test", tmp_path)


@dataclass(frozen=True)
class Ride:
    scene: str
    seed: int
    image_size: str = ""


@dataclass(frozen=True)
class Rides(Wobbles):
    """Rides

    Of nothing.
    """

    backends: tuple[str, ...] = ("surfel",)
    image_size: str = "80x60"
    noise: str = "none"
    sequences: tuple[str, ...] | int = 3

    def specs(self) -> list[Ride]:  # type: ignore[override]
        return self.each(Ride, scene=self.scenes, seed=range(2))


def test_specifications_are_every_combination_of_what_there_is() -> None:
    found = [Ride(scene, seed, "80x60") for scene in ("table", "wall") for seed in (0, 1)]
    assert Rides().specs() == found
    for options, message in (
        ({"scenes": ("mars",)}, "unknown scene 'mars'; valid choices: living_room"),
        ({"backends": ("lidar",)}, "unknown SLAM backend 'lidar'; valid choices: surfel"),
        ({"sequences": ("table:x",)}, "neither a folder nor scene:seed"),
        ({"image_size": "1x1"}, "unknown image size '1x1'"),
        ({"noise": "loud"}, "unknown noise model 'loud'"),
    ):
        with pytest.raises(InputError, match=message):
            Rides(**options).specs()


def test_a_check_finds_what_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_experiment(Wobbles(), tmp_path, workers=1)
    committed = read_results(tmp_path / "results.json")
    # The class stands in this test's module, which is no experiment's name.
    assert committed.kind == Wobbles.__module__.rpartition(".")[2]
    assert check_results(Wobbles, committed) == (Wobbles.check_rows, [])
    for wrong, message in (
        (replace(committed, rows=[]), "hold no rows"),
        (replace(committed, kind="planners"), "are of 'planners'"),
    ):
        with pytest.raises(InputError, match=message):
            check_results(Wobbles, wrong)
    ran = []
    monkeypatch.setattr(Wobbles, "run", staticmethod(lambda spec: ran.append(spec)))
    for code in (
        "command:touch x {sequence} {trajectory}",
        "os:abort",
        {"planner": "mine:Own,a=1"},
    ):
        rows = [{**row, "spec": {**row["spec"], "scene": code}} for row in committed.rows]
        with pytest.raises(InputError, match=r"name code, .*not run"):
            check_results(Wobbles, replace(committed, rows=rows))
    assert not ran
    changed = lambda spec: {"ate_m": 0.5, "cpu_ms_median": 9.0, "lost": False}  # noqa: E731
    changed.__annotations__ = {"spec": Wobble}
    monkeypatch.setattr(Wobbles, "run", staticmethod(changed))
    count, found = check_results(Wobbles, committed)
    assert len(found) == count == Wobbles.check_rows
    assert "ate_m was 0.01, is 0.5" in found[0]
    assert "cpu_ms" not in "".join(found)


def test_every_record_is_checked_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    records, out = tmp_path / "records", tmp_path / "check"
    for name in ("right", "wrong", "older"):
        run_experiment(Wobbles(), records / name, workers=1)
    for name in ("wrong", "older"):
        path = records / name / "results.json"
        content = json.loads(path.read_text())
        cheapest = min(content["rows"], key=lambda row: row["elapsed_s"])
        cheapest["result"]["ate_m"] *= 2
        if name == "older":
            content["provenance"]["sources"]["divergence"] = "0" * 12
        path.write_text(json.dumps(content))
    own = Wobbles.__module__.rpartition(".")[2]
    command = ["experiment", "check", "--records", str(records), "--out", str(out)]
    assert main(command) == 0
    assert f"right: not run: {own} is no experiment" in capsys.readouterr().out
    monkeypatch.setattr(checking, "EXPERIMENTS", SimpleNamespace(own=(own,)))
    monkeypatch.setattr(checking, "experiment_class", lambda name: Wobbles)
    assert main([*command, "--row-seconds", "-1"]) == 0
    assert "its cheapest row took" in capsys.readouterr().out
    assert main([*command, "--limit-minutes", "-1"]) == 0
    assert "not run: the time is up" in capsys.readouterr().out
    assert main(command) == 1
    said = capsys.readouterr().out
    assert "right: same\n" in said
    assert re.search(
        r"^wrong: differs: 1 values, as ate_m was 0.0\d, is 0.0\d$", said, re.MULTILINE
    )
    assert "older: differs, as marked: 1 values" in said
    assert said.endswith("1 differs; 1 differs, as marked; 1 same\n")
    monkeypatch.setattr(Wobbles, "run", staticmethod(lambda spec: pytest.fail("again")))
    assert main(command) == 1  # from what is kept
    assert capsys.readouterr().out == said


def test_results_are_compared_to_their_depth() -> None:
    old = {"closures": [{"before_m": 1.0, "after_m": 0.1}], "lost": True}
    assert compare(old, {"closures": [{"before_m": 1.001, "after_m": 0.1}], "lost": True}) == []
    assert compare(old, {"closures": [{"before_m": 1.1, "after_m": 0.1}], "lost": True})
    assert compare(old, {"closures": [], "lost": True})
    assert compare(old, {"lost": True}) == ["closures is missing"]
    assert compare({"map_points": 18314}, {"map_points": 18313}) == []  # as much as 2 % may differ
    assert compare({"map_points": 18314}, {"map_points": 17314})
    assert compare({"losses": 1}, {"losses": 2})
    assert compare({"losses": 20}, {"losses": 21}) == []  # many: at least by one
    assert compare({"losses": 20}, {"losses": 22})


def test_unknown_keys_are_refused_at_any_depth() -> None:
    check_keys({"ate_m": 1.0, "closures": [{"frame": 3}]})
    for result in ({"ate": 1.0}, {"closures": [{"frames_lost": 3}]}):
        with pytest.raises(InputError, match="unknown metric"):
            check_keys(result)


def test_every_metric_says_what_it_is() -> None:
    for of in registry().values():
        assert of.heading, of.key
        assert of.definition.endswith("."), of.key
        assert of.label


@pytest.mark.parametrize("name", EXPERIMENTS.own)
def test_every_experiment_is_complete(name: str) -> None:
    cls = experiment_class(name.replace("_", "-"))
    assert cls.title()
    assert cls.about().endswith(".")
    assert spec_type(cls) is not dict
    assert not inspect.isabstract(cls)


def test_experiments_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "list"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in EXPERIMENTS.own)
    assert main(["experiment", "nonsense"]) == 2
    assert "valid choices: " in capsys.readouterr().err


def test_an_empty_list_is_no_experiment(tmp_path):
    with pytest.raises(InputError, match="no runs to run: an option is an empty list"):
        run_experiment(Usme(backends=()), tmp_path / "out")
    assert not (tmp_path / "out").exists()
