"""The experiment of submaps: what its cameras see, and what it says of the joints."""

from __future__ import annotations

import numpy as np
from ms_slam_experiments.relocalization import map_path
from ms_slam_experiments.submaps import (
    DARK,
    RETURN,
    SubmapsExperiment,
    SubmapsSpec,
    _interruptions,
)

from ms_slam_env import scenes
from ms_slam_env.camera import xtion

SPEC = SubmapsSpec("table", 1000, "80x60", (RETURN, DARK), ("atlas", "off"), 1, 20, 10)


def test_the_camera_turns_away_and_comes_back_to_its_path():
    scene = scenes.make(SPEC.scene, SPEC.seed)
    path = map_path(scene, SPEC.map_frames, SPEC.seed)
    back, dark = _interruptions(SPEC, scene, xtion(SPEC.size), path)
    forward = path[-1][:3, 2]
    for one in (back, dark):
        np.testing.assert_array_equal(one.truth[-1], path[len(path) // 2 + 1])
        steps = np.einsum("nij,nij->n", one.truth[1:, :3, :3], one.truth[:-1, :3, :3])
        turns = np.degrees(np.arccos(np.clip((steps - 1) / 2, -1, 1)))
        assert turns.max() < 5
        assert len(one.frames) == len(one.truth)
        assert all(frame.color.any() == (k >= one.black) for k, frame in enumerate(one.frames))
    assert back.black == 0 < dark.black
    away = np.degrees(np.arccos(back.truth[0][:3, 2] @ forward))
    tilt = np.degrees(np.arcsin(abs(forward[2])))
    assert 147 - 2 * tilt < away <= 147


def test_a_wrong_joint_is_counted(monkeypatch):
    """The same run, told that the truth is elsewhere: what was right is wrong."""
    right = {(a["setting"], a["variant"]): a for a in SubmapsExperiment.run(SPEC)["attempts"]}
    assert all(a["wrong_joins"] == 0 for a in right.values())
    joined = [a for a in right.values() if a["joined_submaps"]]
    assert joined
    assert all(max(a["link_error_m"]) < 0.02 for a in joined)
    monkeypatch.setattr("ms_slam_experiments.submaps.WRONG_M", 1e-6)
    wrong = SubmapsExperiment.run(SPEC)["attempts"]
    assert sum(a["wrong_joins"] for a in wrong) == sum(a["joined_submaps"] for a in joined)
