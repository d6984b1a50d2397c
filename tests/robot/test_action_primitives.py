"""The 49 motions do to the view what the paper's words say."""

import numpy as np
import pytest

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, look_at, relative_angle
from ms_slam_env.robot import FreeCamera
from ms_slam_env.robot.action_primitives import (
    NUM_MOTIONS,
    NUM_ROTATIONS,
    ROTATIONS,
    TRANSLATIONS,
    decompose,
    describe,
)

STEP_M, STEP_RAD = 0.05, np.deg2rad(5.0)
MOTIONS = decompose(STEP_M, STEP_RAD)
# A level camera at the origin that looks along the world's +x; left of it is +y, up is +z.
LEVEL = look_at([0, 0, 0], [1, 0, 0])


def pose_after(translation, rotation):
    action = NUM_ROTATIONS * TRANSLATIONS.index(translation) + ROTATIONS.index(rotation)
    return LEVEL @ MOTIONS[action]


def test_49_rigid_motions():
    assert MOTIONS.shape == (NUM_MOTIONS, 4, 4)
    assert NUM_MOTIONS == 49
    for action, T in enumerate(MOTIONS):
        check_pose(T)
        translation, rotation = divmod(action, 7)
        length, angle = np.linalg.norm(T[:3, 3]), relative_angle(np.eye(3), T[:3, :3])
        assert length == pytest.approx(STEP_M if translation else 0)
        assert angle == pytest.approx(STEP_RAD if rotation else 0)
    assert len(np.unique(np.round(MOTIONS, 9), axis=0)) == 49


@pytest.mark.parametrize(
    ("translation", "direction"),
    [
        ("up", [0, 0, 1]),
        ("down", [0, 0, -1]),
        ("left", [0, 1, 0]),
        ("right", [0, -1, 0]),
        ("forward", [1, 0, 0]),
        ("backward", [-1, 0, 0]),
    ],
)
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_translations_in_the_world(translation, direction, rotation):
    moved = pose_after(translation, rotation)[:3, 3]
    np.testing.assert_allclose(moved, STEP_M * np.array(direction), atol=1e-12)


def test_rotations_in_the_world():
    def right_of(T):
        return T[:3, 0]

    def view_of(T):
        return T[:3, 2]

    assert right_of(pose_after("none", "roll right"))[2] < 0  # the right side goes down
    assert right_of(pose_after("none", "roll left"))[2] > 0
    assert view_of(pose_after("none", "pitch forward"))[2] < 0  # nods: looks down
    assert view_of(pose_after("none", "pitch backward"))[2] > 0
    assert view_of(pose_after("none", "yaw anticlockwise"))[1] > 0  # from above: to the left
    assert view_of(pose_after("none", "yaw clockwise"))[1] < 0


@pytest.mark.parametrize("pair", [(1, 2), (3, 4), (5, 6)])
def test_opposite_motions_cancel(pair):
    a, b = pair
    np.testing.assert_allclose(MOTIONS[a] @ MOTIONS[b], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(MOTIONS[7 * a] @ MOTIONS[7 * b], np.eye(4), atol=1e-12)


def test_action_is_7_translation_plus_rotation():
    assert describe(0) == "none, none"
    assert describe(7 * 5 + 6) == "forward, yaw clockwise"
    assert describe(48) == "backward, yaw clockwise"


@pytest.mark.parametrize("steps", [(-0.1, 0.1), (0.1, -0.1), (np.nan, 0.1), (0.1, np.inf)])
def test_bad_steps_are_refused(steps):
    with pytest.raises(InputError, match="steps"):
        decompose(*steps)


def test_the_motions_of_a_camera_cannot_be_changed_from_outside():
    motions = FreeCamera(None, 0.1, 0.1).candidate_motions()
    with pytest.raises(ValueError, match="read-only"):
        motions[0, 0, 3] = 1.0
