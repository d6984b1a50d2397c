"""Tasks by name: the scenes, the episode length, and the surface to map.

The built-in tasks each have a Gymnasium id (:data:`ms_slam_env.TASK_IDS`). Add others as entry
points (group ``ms_slam_env.tasks``) or pass ``module:function``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError

REFERENCES = ("nearby", "scene", "arm")


@dataclass(frozen=True)
class Task(Checked):
    """What an agent is asked to do; the same for every agent compared.

    Attributes:
        scenes: names of the scenes to explore.
        env_id: Gymnasium id of the environment.
        steps: length of an episode.
        reference: the true surface that a map should cover: ``nearby``, visible from within a
            straight path of 1 m of the start; ``scene``, visible from anywhere the camera can go;
            ``arm``, visible from anywhere the arm can bring it.
        options: environment options; ``slam_config`` applies to ``surfel`` only, and ``reward`` is
            ``mapping`` if not given.
        perturbations: camera perturbations, name to options.
    """

    scenes: tuple[str, ...]
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    steps: int = bounded(100, 1, 1_000_000)
    reference: str = chosen("nearby", *REFERENCES)
    options: Mapping[str, Any] = field(default_factory=dict)
    perturbations: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


_ROOM = ("living_room", "corridor", "table", "wall")


def room() -> Task:
    """A free camera, 100 steps in a room."""
    return Task(_ROOM)


def home() -> Task:
    """A free camera, 600 steps in a home of several rooms.

    A step is 30 cm and 24 degrees, taken in three frames: the motion from frame to frame is that of
    `room`, and the camera gets through a home. No surfel is removed within an episode: by default
    those seen by fewer than ten frames go after 200 more frames, which cost ``nbv`` a third of the
    completeness. The map had 1.6 million surfels after 350 steps.
    """
    steps = {"step_m": 0.3, "step_rad": math.radians(24), "frames_per_action": 3}
    slam_config = {"max_surfels": 4_000_000, "unstable_window": 2000}
    options = {**steps, "slam_config": slam_config}
    return Task(("home",), steps=600, reference="scene", options=options)


def arm() -> Task:
    """The paper's robot experiment: an arm, 60 simulated seconds in front of a table-top scene.

    Lost tracking does not end the episode. No motion is shorter than a frame at 30 Hz.
    """
    patience = {"lost_patience": 1_000_000, "away_patience": 1_000_000}
    return Task(
        ("window", "table", "wall", "carpet"),
        "MSActiveSLAM-v0",
        steps=1800,
        reference="arm",
        options={"seconds": 60.0, **patience},
    )


def disturbed() -> Task:
    """The room with a person walking in it, motion blur and automatic exposure.

    A step of a free camera takes 1/30 s. In that time a person at 1.5 m/s walks 5 cm, and an
    exposure of 3 ms blurs a turn of 12 degrees over 3 pixels.
    """
    return Task(
        _ROOM,
        perturbations={
            "moving-objects": {"kind": "person", "count": 1, "speed_m_s": 1.5},
            "motion-blur": {"exposure_s": 0.003},
            "auto-exposure": {},
        },
    )


OWN = {"room": room, "home": home, "arm": arm, "disturbed": disturbed}
"""The built-in tasks; together they form the leaderboard."""

TASKS = ExtensionPoint("task", "ms_slam_env.tasks", own=OWN, form="module:function", takes=())
"""Lookup of tasks by name: functions that return a `Task`."""


def find_task(name: Any) -> Task:
    """Find a task by name, by ``module:function``, or from the function itself.

    Raises:
        InputError: an unknown name, or a function that does not return a `Task`.
    """
    task = TASKS.find(name)()
    if not isinstance(task, Task):
        raise InputError(f"task {name!r} made {type(task).__name__}, no ms_slam_env.tasks.Task")
    return task


def env_id_of(name: str) -> str:
    """Gymnasium id of a built-in task, such as ``MSActiveSLAM-Room-v0``."""
    return f"MSActiveSLAM-{name.capitalize()}-v0"
