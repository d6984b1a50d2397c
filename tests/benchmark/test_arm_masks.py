"""The mask experiment: its summary from cases of known content, and one real walk."""

import json

import numpy as np
import pytest

from ms_slam_env import scenes
from ms_slam_env.benchmark import arm_masks
from ms_slam_env.benchmark.arm_masks import Arguments, WalkSpec, main, run_walk
from ms_slam_env.benchmark.arm_masks_report import as_markdown, summarise
from ms_slam_env.errors import InputError
from ms_slam_env.experiments.harness.arm_truth import furniture_cloud

# reason, reached, stopped, gap_m, touches_itself: right where allowed and possible agree
CASES = [
    ("ok", True, False, 0.05, False),  # right
    ("ok", True, False, 0.05, False),  # right
    ("ok", True, False, -0.01, False),  # wrong: touched furniture
    ("ok", False, True, 0.01, False),  # wrong: stopped
    ("ok", True, False, 0.05, True),  # wrong: touched itself
    ("furniture", False, False, 0.01, False),  # right
    ("furniture", True, False, -0.01, False),  # right: it went through
    ("joint limit", True, False, 0.05, False),  # wrong: it can
]
AT_REST = ("sag_m", "offset_m", "kinematic_m", "kinematic_rad")


def row(scene, seed, cases):
    reason, reached, stopped, gap, itself = zip(*cases, strict=True)
    count = len(cases)
    return {
        "spec": {"scene": scene, "seed": seed},
        "error": None,
        "result": {
            "cases": {
                "state": [0] * count,
                "action": list(range(1, count + 1)),
                "reason": list(reason),
                "reached": list(reached),
                "stopped": list(stopped),
                "gap_m": list(gap),
                "touches_itself": list(itself),
                "error_m": [0.001] * count,
                "error_rad": [0.01] * count,
            },
            "states": {
                **{name: [0.002, 0.004] for name in AT_REST},
                "sees_itself": [False, False],
            },
        },
    }


def test_summary():
    summary = summarise([row("table", 1000, CASES), row("wall", 1000, CASES[:2])])
    table, everywhere = summary["masks"]["table"], summary["masks"]["all"]
    assert table["cases"] == 8
    assert table["allowed"]["value"] == 5 / 8
    assert table["right"]["value"] == 4 / 8
    assert table["wrong_of_allowed"]["value"] == 3 / 5
    assert table["wrong_of_forbidden"]["value"] == 1 / 3
    assert summary["masks"]["wall"]["right"]["value"] == 1
    assert everywhere["right"]["value"] == everywhere["right_over_walks"]["value"] == 6 / 10
    assert (everywhere["right_over_walks"]["low"], everywhere["right_over_walks"]["high"]) == (
        0.5,
        1,
    )
    assert summary["reasons"]["furniture"]["right"]["value"] == 1
    assert summary["reasons"]["joint limit"]["right"]["value"] == 0
    assert "unreachable" not in summary["reasons"]
    assert summary["wrongly_allowed"] == {
        "not followed": 0,
        "protective stop": 1,
        "touched furniture": 1,
        "touched itself": 1,
    }
    sag = summary["errors"]["camera below its command at rest (sag) [mm]"]
    assert (sag["count"], sag["median"]) == (4, pytest.approx(3))
    assert summary["sees_itself"]["value"] == 0
    text = as_markdown(summary)
    assert "| table | 1 | 8 |" in text
    assert "| joint limit | 1 | 0 " in text


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"scenes": ("garage",)}, "unknown scene 'garage'; valid choices: living_room"),
        ({"options": ("targets.M_I=0.1",)}, "only those of the arm"),
        ({"options": ("arm.colour=red",)}, "unknown option of ArmConfig 'arm.colour'"),
        ({"states": 0}, "states = 0 is outside"),
        ({"episodes": 101}, "outside"),
    ],
)
def test_bad_input(fields, reason):
    with pytest.raises(InputError, match=reason):
        Arguments(**fields).specs()


SPEC = WalkSpec("carpet", 1000, states=1, moves=1)


@pytest.fixture(scope="module")
def walk():
    """Two runs of the same walk, in one scene and with a truth that is quick to prepare."""
    scene = scenes.make(SPEC.scene, SPEC.seed)
    cloud = furniture_cloud(scene, spacing_m=0.04)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arm_masks.scene_library, "make", lambda name, seed: scene)
        patch.setattr(arm_masks, "furniture_of", lambda name, seed: cloud)
        return run_walk(SPEC), run_walk(SPEC)


def test_a_walk_attempts_every_motion(walk):
    cases = {name: np.array(values) for name, values in walk[0]["cases"].items()}
    assert (cases["action"] == np.arange(49)).all()
    assert (cases["state"] == 0).all()
    allowed = cases["reason"] == "ok"
    assert allowed[0]  # standing still is always possible
    assert cases["reached"][allowed].mean() > 0.9
    assert (cases["error_m"] < 0.02).all()
    assert all(len(column) == 1 for column in walk[0]["states"].values())


def test_a_walk_can_be_repeated(walk):
    assert walk[0] == walk[1]


def test_command(walk, tmp_path, capsys, monkeypatch):
    def run_all(specs, run, out, workers, description):
        return [{"spec": vars(spec), "result": walk[0], "error": None} for spec in specs]

    monkeypatch.setattr(arm_masks, "run_all", run_all)
    words = "--scenes carpet --episodes 1 --states 1 --moves 1"
    assert main([*words.split(), "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "arm_masks.json").read_text())
    assert content["summary"]["masks"]["carpet"]["cases"] == 49
    assert (tmp_path / "table.md").read_text() in capsys.readouterr().out
