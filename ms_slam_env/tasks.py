"""Tasks by name: where the camera is, how long it has, and what there is to be mapped.

Our own stand here, each with a Gymnasium id (:data:`ms_slam_env.TASK_IDS`); others are entry points
(group ``ms_slam_env.tasks``) or ``module:function``.
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
    """What an agent is asked to do, alike for all who are compared.

    Attributes:
        scenes: to explore, by name.
        env_id: environment that it is in.
        steps: length of an episode.
        reference: the true surface that a map should have: ``nearby``, what can be seen from within
            a straight way of 1 m of the start; ``scene``, from wherever the camera can come to;
            ``arm``, from wherever the arm can bring it to.
        options: of the environment; ``slam_config`` is that of ``surfel``, for no other SLAM.
        perturbations: of the camera's frames, name to options.
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
    """A free camera, 600 steps in a dwelling of several rooms.

    A step is 30 cm and 24 degrees, in three frames: as far from frame to frame as in `room`, and
    far enough to come through a dwelling. What was seen stays in the map: by default surfels that
    fewer than ten frames have seen go after 200 more, which cost ``nbv`` a third of the
    completeness. It had 1.6 million surfels after 350 steps.
    """
    steps = {"step_m": 0.3, "step_rad": math.radians(24), "frames_per_action": 3}
    slam_config = {"max_surfels": 4_000_000, "unstable_window": 2000}
    options = {**steps, "slam_config": slam_config}
    return Task(("home",), steps=600, reference="scene", options=options)


def arm() -> Task:
    """The paper's robot experiment: an arm, 60 simulated seconds in front of a table-top setting.

    Lost tracking does not end it. No motion is shorter than a frame at 30 Hz.
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
    """The room with somebody walking in it, motion blur and automatic exposure.

    A step of a free camera takes 1/30 s. At 1.5 m/s a person walks 5 cm meanwhile; an exposure of
    3 ms blurs a turn of 12 degrees over 3 pixels.
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
"""Our tasks; together they are the leaderboard."""

TASKS = ExtensionPoint("task", "ms_slam_env.tasks", own=OWN, form="module:function")
"""Where tasks are found: functions that return a `Task`."""


def find_task(name: Any) -> Task:
    """The task of a name; ``module:function`` or the function itself as well.

    Raises:
        InputError: an unknown name, or something that makes no task.
    """
    task = TASKS.find(name)()
    if not isinstance(task, Task):
        raise InputError(f"task {name!r} made {type(task).__name__}, no ms_slam_env.tasks.Task")
    return task


def env_id_of(name: str) -> str:
    """Gymnasium id of one of our tasks, as ``MSActiveSLAM-Room-v0``."""
    return f"MSActiveSLAM-{name.capitalize()}-v0"
