"""Save the state of a simulation, and resume from it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from ms_slam_env.env.simulation import Simulation, World
from ms_slam_env.env.state import (
    check_episode,
    check_parts,
    check_same_grid,
    check_same_settings,
)
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.state_check import check_like, is_open


def save_state(
    simulation: Simulation, settings: Mapping[str, Any], rng: np.random.Generator
) -> dict[str, Any]:
    """Everything needed to resume bit-exactly from within an episode."""
    assert simulation.episode is not None
    return {
        "settings": settings,
        "episode": simulation.episode.copy(),
        "slam": simulation.slam.get_state(),
        "embodiment": simulation.world.embodiment.get_state(),
        "coverage": simulation.world.coverage.get_state(),
        "camera_feed": simulation.camera_feed.get_state(),
        "T_world_kinematic": simulation.T_world_kinematic.copy(),
        "random": rng.bit_generator.state,
    }


def load_state(
    simulation: Simulation,
    state: Mapping[str, Any],
    settings: Mapping[str, Any],
    rng: np.random.Generator,
) -> None:
    """Resume from a state that `save_state` returned.

    Raises:
        InputError: not a saved state, or one with other settings; nothing has changed.
    """
    check_parts(state)
    check_same_settings(state["settings"], settings)
    check_same_grid(state["settings"], settings, state["episode"], simulation.carves)
    motions, shape = simulation.embodiment_type.num_motions, simulation.intrinsics.shape
    own, blank = simulation.episode, simulation.blank
    check_episode(state["episode"], own, blank, shape, motions, simulation.carves)
    episode = state["episode"]
    place = simulation.place_of(episode)
    stays = place == simulation.place
    world = simulation.world if stays else simulation.world_of(*place)
    _check_parts_of(state, simulation, world, rng)
    _take_up(state, simulation, world)
    simulation.place, simulation.world = place, world
    world.coverage.set_state(state["coverage"])
    simulation.T_world_kinematic = state["T_world_kinematic"].copy()
    rng.bit_generator.state = state["random"]
    simulation.episode = episode.copy()
    simulation.episode.predicted_divergences = None  # they belong to the options at saving


def _check_parts_of(
    state: Mapping[str, Any], simulation: Simulation, world: World, rng: np.random.Generator
) -> None:
    """Refuse parts of a state that do not fit a world."""
    like = {
        "slam": simulation.fresh_slam,
        "embodiment": world.embodiment.state_like(),
        "coverage": world.coverage.get_state(),
        "T_world_kinematic": np.eye(4),
        "random": rng.bit_generator.state,
        "camera_feed": simulation.camera_feed.state_like,
    }
    for name, own in like.items():
        check_like(state[name], own, name)
    if state["camera_feed"]["noise_seed"] != state["episode"].noise_seed:
        raise InputError("not a saved state: camera_feed is of another episode")


def _take_up(state: Mapping[str, Any], simulation: Simulation, world: World) -> None:
    """Load the states of SLAM, camera and robot; all or none."""
    robot, feed, slam = world.embodiment, simulation.camera_feed, simulation.slam
    start = state["episode"].frames[0].T_world_camera
    undo = [partial(robot.set_state, robot.get_state())]
    if simulation.episode is not None and feed.has_begun:
        own = feed.get_state(), simulation.world.scene, simulation.world.sensor
        began = simulation.episode.frames[0].T_world_camera
        undo.append(partial(feed.set_state, *own, began))
    if is_open(simulation.fresh_slam):
        undo.append(partial(slam.set_state, slam.get_state()))
    try:
        robot.set_state(state["embodiment"])
        feed.set_state(state["camera_feed"], world.scene, world.sensor, start)
        slam.set_state(state["slam"])
    except Exception as error:  # a part may fail in any way on a malformed state
        for back in undo:
            back()
        raise InputError(f"not a saved state: {error!r}") from error
