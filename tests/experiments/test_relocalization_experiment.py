"""The kidnapping benchmark: its scenarios in a known room, its judgement of a scripted SLAM."""

from __future__ import annotations

import math

import numpy as np
import pytest
from box_scene import BoxScene
from ms_slam_experiments.relocalization import (
    SETTINGS,
    Interruption,
    MappedSpace,
    Relocalization,
    about_the_maps,
    draw_interruption,
    interrupt,
    map_path,
)

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.geometry import look_at, make_pose, relative_angle
from ms_slam_env.slam import TrackResult

AFTER = 5


@pytest.fixture(scope="module")
def path(box_scene: BoxScene) -> np.ndarray:
    return map_path(box_scene, 120, 0)


@pytest.fixture(scope="module")
def space(box_scene: BoxScene, path) -> MappedSpace:
    return MappedSpace(box_scene, path)


def test_mapped_space_is_what_the_path_saw(space, path):
    assert space.share(path[0]) > 0.95
    assert space.share(path[60]) > 0.95
    # All of the room but what the camera looked at is new.
    eye = path[0][:3, 3]
    behind = look_at(eye, eye - path[0][:3, 2] * (1, 1, 0.2))
    assert space.share(behind) < space.share(path[0])
    one_view = MappedSpace(BoxScene(seed=0), look_at([0, 0, 1.2], [1.5, 0, 0.6])[None])
    assert one_view.share(look_at([0, 0, 1.2], [-1.5, 0, 0.6])) == 0


@pytest.mark.parametrize("name", SETTINGS)
def test_interruptions_satisfy_their_setting(box_scene, path, space, name):
    setting = SETTINGS[name]
    draws = [
        draw_interruption(box_scene, path, space, setting, AFTER, np.random.default_rng(4))
        for _ in range(2)
    ]
    one, again = draws
    assert one is not None
    assert again is not None
    np.testing.assert_array_equal(one.poses, again.poses)
    assert one.poses.shape == (AFTER, 4, 4)
    assert one.mapped == space.share(one.poses[0]) >= setting.mapped
    near = path[one.source]
    assert np.linalg.norm(one.poses[0][:3, 3] - near[:3, 3]) <= setting.offset_m
    turned = relative_angle(one.poses[0][:3, :3], near[:3, :3])
    assert turned <= np.radians(setting.offset_deg) + 1e-6
    if setting.black is None:
        assert one.black == 0
        moved = np.linalg.norm(one.poses[0][:3, 3] - path[-1][:3, 3])
        angle = relative_angle(one.poses[0][:3, :3], path[-1][:3, :3])
        assert moved >= 0.3 or angle >= np.radians(30)
    else:
        assert setting.black[0] <= one.black <= setting.black[1]
        assert one.source == len(path) - 1 - one.black
    assert box_scene.clearance(one.poses[:, :3, 3]).min() >= 0.1


class ScriptedSlam:
    """Answers with the results that it was given, one a frame; black frames have none."""

    frames_counted = 0

    def __init__(self, results: list[TrackResult | None]) -> None:
        self.results = list(results)

    def track(self, frame: RGBDFrame) -> TrackResult:
        if not frame.color.any():
            return TrackResult(np.eye(4), False)
        return self.results.pop(0) or TrackResult(np.eye(4), False)


def _at(x: float) -> TrackResult:
    return TrackResult(make_pose(np.eye(3), [x, 0.0, 0.0]), True)


def _outcome(results, expected=True, black=0):
    image = RGBDFrame(np.full((4, 5, 3), 9, np.uint8), np.ones((4, 5), np.float32))
    truth = np.tile(np.eye(4), (len(results), 1, 1))
    one = Interruption(black, truth, 0, 1.0)
    frames = [image] * len(results)
    return interrupt(ScriptedSlam(results), one, frames, truth if expected else None)


def test_finding_is_judged_by_the_error():
    good = _outcome([None, None, _at(0.04), _at(0.0)], black=3)
    assert (good["found"], good["wrong"], good["frames_to_pose"]) == (True, False, 2)
    assert good["relocalisation_s"] == pytest.approx(2 / 30)
    assert good["first_error_m"] == pytest.approx(0.04)
    assert (good["black_frames"], good["black_tracked"]) == (3, 0)
    vague = _outcome([_at(0.08)])
    assert (vague["found"], vague["wrong"], vague["relocalisation_s"]) == (False, False, 0)
    mixed = _outcome([_at(0.5), _at(0.0)])
    assert (mixed["found"], mixed["wrong"]) == (True, True)
    never = _outcome([None, None])
    assert (never["found"], never["wrong"], never["frames_to_pose"]) == (False, False, math.inf)
    assert never["relocalisation_s"] == math.inf
    assert _outcome([None, _at(0.0)], expected=False)["wrong"]
    assert not _outcome([None, None], expected=False)["wrong"]


def test_shares_and_times_of_known_attempts():
    def attempt(found, wrong, first):
        return {
            "variant": "ferns",
            "setting": "near",
            "found": found,
            "wrong": wrong,
            "frames_to_pose": first,
            "relocalisation_s": first / 30,
            "lost_frame_cpu_ms": 20.0,
            "black_tracked": 1,
        }

    attempts = [attempt(True, False, 3), attempt(True, False, 6), attempt(False, False, math.inf)]
    maps = [{"ate_unaligned_m": 0.002, "lost_frames": 0}, {"ate_unaligned_m": 1, "lost_frames": 2}]
    row = {"error": None, "spec": {"size": "160x120"}}
    rows = [
        {**row, "result": {"attempts": attempts, "maps": maps}},
        {**row, "result": {"attempts": [attempt(False, True, 0)], "maps": []}},
    ]
    experiment = Relocalization()
    (line,) = experiment.tables(rows)[0].rows
    assert (line["attempts_count"], line["found"].value, line["wrong"].value) == (4, 0.5, 0.25)
    assert line["found"].low < 0.5 < line["found"].high
    assert line["frames_to_pose"].value == 3
    assert line["relocalisation_s"] == pytest.approx(0.1)
    assert line["black_tracked"] == 4
    assert about_the_maps(rows).startswith("1 of 2 maps were used")
    rows[1]["result"]["attempts"][0]["setting"] = "foreign"
    near, foreign, every = experiment.tables(rows)[0].rows
    assert [(c["setting"], c["attempts_count"]) for c in (near, foreign, every)] == [
        ("near", 3),
        ("foreign", 1),
        ("all", 4),
    ]
    assert every["wrong"] == line["wrong"]
    assert experiment.charts(rows)[0].panels[0].series[0].x == ["near", "all"]


def test_maps_take_the_scenes_in_turns():
    specs = Relocalization(scenes=("table", "wall"), sizes=("160x120", "320x240"), maps=3).specs()
    assert [(s.size[:3], s.scene, s.seed) for s in specs[:4]] == [
        ("160", "table", 1000),
        ("160", "wall", 1001),
        ("160", "table", 1002),
        ("320", "table", 1000),
    ]
