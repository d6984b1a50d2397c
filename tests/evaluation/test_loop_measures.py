"""Revisits of a camera that turns in a room, by closed form; loops that are right and wrong."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env.camera import xtion
from ms_slam_env.evaluation.loop_closures import AWAY_S, find_revisits, loop_measures
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.slam.slam_backend import Loop

CAMERA = xtion("80x60")
RADIUS_M = 3.0
WIDE_DEG = float(np.degrees(2 * np.arctan(CAMERA.width / 2 / CAMERA.fx)))


def turning(degrees: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of a camera that turns where it stands."""
    return np.stack([make_pose(so3_exp([0, np.radians(a), 0]), [0, 0, 0]) for a in degrees])


def ball(count: int) -> np.ndarray:
    """Depth (N, h, w) seen from the middle of a ball, the same in all directions."""
    depth = RADIUS_M / np.linalg.norm(CAMERA.rays(), axis=-1)
    return np.repeat(depth[None].astype(np.float32), count, axis=0)


def revisits(degrees: np.ndarray, rate_hz: float, reach_m: float = 10.0) -> np.ndarray:
    times = np.arange(len(degrees)) / rate_hz
    return find_revisits(ball(len(degrees)), CAMERA, turning(degrees), times, reach_m)


def test_a_second_turn_sees_the_first_again() -> None:
    degrees = np.arange(0.0, 720.0, 3.0)
    found = revisits(degrees, rate_hz=10.0)
    back = int(np.argmax(found >= 0))
    # The first view is half in sight when the turn is complete but for half the image.
    assert degrees[back] == pytest.approx(360.0 - WIDE_DEG / 2, abs=7.0)
    assert (found[:back] == -1).all()
    assert (found[back:] == 0).all()


def test_what_never_was_out_of_sight_for_long_is_no_revisit() -> None:
    swing = 0.4 * WIDE_DEG * np.sin(np.linspace(0, 20, 200))
    assert (revisits(swing, rate_hz=10.0) == -1).all()
    there, back = np.linspace(0, 1.5 * WIDE_DEG, 20), np.linspace(1.5 * WIDE_DEG, 0, 20)
    glance = np.concatenate([there, back])  # away for about 1.3 of 4 seconds
    assert (revisits(glance, rate_hz=10.0) == -1).all()
    stay = np.full(round(AWAY_S * 10), there[-1])
    assert revisits(np.concatenate([there, stay, back]), rate_hz=10.0)[-1] == 0


def test_a_surface_that_is_elsewhere_by_now_or_out_of_reach_is_not_seen_again() -> None:
    degrees = np.arange(0.0, 720.0, 3.0)
    times = np.arange(len(degrees)) / 10.0
    depths = ball(len(degrees))
    depths[100:] *= 1.2  # before the first turn ends the wall steps back
    found = find_revisits(depths, CAMERA, turning(degrees), times, 10.0)
    assert (found[:200] == -1).all()
    assert (found[-20:] >= 0).all()  # where it has stepped back it is seen again
    assert (revisits(degrees, 10.0, reach_m=RADIUS_M / 2) == -1).all()


def test_places_that_come_one_after_the_other_are_revisits_of_their_own() -> None:
    first = np.arange(0.0, 180.0, 3.0)
    again = np.array([0.0] * 5 + [270.0] * 40 + [120.0] * 5)  # 270 degrees were never seen before
    found = revisits(np.concatenate([first, [270.0] * 40, again]), rate_hz=10.0)
    assert found.max() == 1
    assert found[100] == 0
    assert found[-1] == 1


def test_precision_and_recall() -> None:
    truth = np.stack([make_pose(so3_exp([0, 0.1 * k, 0]), [0.1 * k, 0, 0]) for k in range(20)])

    def stated(frame: int, reference: int, error: np.ndarray, bent: bool = True) -> Loop:
        true = np.linalg.inv(truth[reference]) @ truth[frame]
        return Loop(reference, true @ error, bent)

    fine = make_pose(so3_exp([0, np.radians(2.9), 0]), [0.0, 0.04, 0.0])
    turned = make_pose(so3_exp([0, np.radians(3.1), 0]), [0, 0, 0])
    shifted = make_pose(np.eye(3), [0.0, 0.06, 0.0])
    numbers = np.array([-1] * 10 + [0] * 4 + [-1] + [1] * 5, dtype=np.int32)
    loops = {
        11: stated(11, 0, turned),
        12: stated(12, 1, fine, bent=False),
        14: stated(14, 2, np.eye(4)),
        16: stated(16, 3, shifted),
    }
    found = loop_measures(loops, truth, numbers, tolerance_m=0.05)
    assert found["loop_precision"] == 2 / 4
    assert found["loop_recall"] == 2 / 9  # frames 12 and 13; 14 is in no revisit, 16 is wrong
    assert (found["stated_loops"], found["closed_loops"]) == (4, 3)
    assert (found["revisits"], found["revisiting_frames"]) == (2, 9)
    assert loop_measures(loops, truth, numbers, tolerance_m=0.1)["loop_recall"] == 6 / 9
    none = loop_measures({}, truth, np.full(20, -1, dtype=np.int32), 0.05)
    assert (none["loop_precision"], none["loop_recall"], none["revisits"]) == (None, None, 0)
