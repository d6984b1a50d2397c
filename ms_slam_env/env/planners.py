"""Planner interface, and lookup of planners by name."""

from __future__ import annotations

import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, MultiDiscrete
from numpy.typing import NDArray

from ms_slam_env._runtime.extension import ExtensionPoint, check_options
from ms_slam_env.config import parse_named
from ms_slam_env.env.robot_view import PrivilegedView, RobotView, without_truth
from ms_slam_env.errors import InputError

RECOVERY = "recovery"
_OPPOSITE = (0, 2, 1, 4, 3, 6, 5)  # of a translation or rotation, in the paper's order
_REMEMBERED = 12  # motions that can be undone
_DOUBT_M = 0.006
"""Standard deviation of the position, along any axis, above which the pose counts as doubtful.

Of 585 motions of training seeds in four scenes, 99 % of those tracked within 2 cm stayed below
3.2 mm; of the 16 others, 12 were lost or above 10 mm.
"""


class Planner(ABC):
    """Chooses actions for one robot.

    It knows only what the robot knows: the observation, ``info`` without the truth (``known``) and
    its ``robot``. A planner that needs the truth is a `PrivilegedPlanner`.

    Args:
        robot: the robot's view; an unwrapped environment is converted to a `RobotView`.
        seed: of the planner's random choices; independent of an environment reset with the same
            seed.
    """

    robot: RobotView
    view: ClassVar[type[RobotView]] = RobotView
    """The view of the environment that the planner gets."""

    observation: str = "features"
    """The observation variant that ``act`` expects, unless ``observation_for`` is overridden."""
    recovers: bool = False
    """Default of the option ``recovery``: undo the last motions while tracking is lost."""
    motions_only: bool = False
    """Whether the planner cannot choose a SLAM configuration."""

    def __init__(self, robot: RobotView, seed: int = 0) -> None:
        self.robot = self.seen_of(robot)
        child = np.random.SeedSequence(seed).spawn(1)[0]  # the environment draws from the parent
        self.rng = np.random.default_rng(child)

    @classmethod
    def seen_of(cls, env: Any) -> RobotView:
        """The view that this class gets of an unwrapped environment; a view is returned as is.

        Raises:
            InputError: a view without the truth, which this planner needs.
        """
        if isinstance(env, cls.view):
            return env
        if isinstance(env, RobotView):
            raise InputError(f"{cls.__name__} needs the truth, which no {type(env).__name__} has")
        return cls.view(env)

    def known(self, info: dict[str, Any]) -> dict[str, Any]:
        """The part of ``info`` from ``reset`` or ``step`` that ``act`` may see."""
        return without_truth(info)

    @classmethod
    def observation_for(cls, **options: Any) -> str:
        """The observation variant that ``act`` expects with these options."""
        return cls.observation

    def reset(self) -> None:  # noqa: B027 -- most planners keep nothing between episodes
        """Prepare for a new episode; called after the environment's reset."""

    @abstractmethod
    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Return the next action, given what ``reset`` or ``step`` last returned."""

    def preferences(self) -> NDArray[np.float64] | None:
        """Probabilities (n,) that the last `act` gave the actions; None: 1 for the one chosen."""
        return None

    def choices(self) -> NDArray[np.bool_] | None:
        """Actions (n,) that the last `act` offered to an inner policy; None: it used no policy."""
        return None

    def instead(self, action: int) -> None:  # noqa: B027 -- most planners see what came of it
        """Learn that ``action`` was taken instead of the one that ``act`` returned last."""

    def see(self, observation: Any, info: dict[str, Any]) -> None:  # noqa: B027 -- see `instead`
        """Observe a step in which another planner acts; called in place of ``act``."""

    def lost_by(self, action: int) -> None:  # noqa: B027 -- most planners learn nothing from it
        """Learn that the last action lost tracking; SLAM keeps the pose from before it."""


class PrivilegedPlanner(Planner):
    """A planner that knows the truth: a teacher or an upper bound, not a fair competitor."""

    robot: PrivilegedView
    view = PrivilegedView

    def known(self, info: dict[str, Any]) -> dict[str, Any]:
        """All of ``info``."""
        return info


class Recovering(Planner):
    """Undoes the last motions, newest first, while SLAM does not know its pose.

    Otherwise it delegates to another planner. SLAM does not know its pose while tracking is lost,
    or while the pose covariance is too large.

    Motion [R | t] is undone by the motion with the opposite rotation and translation. Because the
    rotation turns the translation, this is off by some 2 cm at 12 cm and 12 deg. If that motion is
    blocked, only the rotation or only the translation is undone.
    """

    def __init__(self, robot: RobotView, planner: Planner) -> None:
        super().__init__(robot)
        self.planner = planner
        self._begin()

    def reset(self) -> None:
        """Forget the motions of the last episode."""
        self._begin()
        self.planner.reset()

    def _begin(self) -> None:
        self.made: list[int] = []
        self.was_tracked = False
        self.has_chosen = False

    def instead(self, action: int) -> None:
        """Record the motion that was made, so that it can be undone."""
        before = self.made[:-1] if self.has_chosen else [*self.made, self.undoing]
        self.made = [*before, action]
        self.planner.instead(action)

    def known(self, info: dict[str, Any]) -> dict[str, Any]:
        """The part of ``info`` that the wrapped planner may see."""
        return self.planner.known(info)

    def preferences(self) -> NDArray[np.float64] | None:
        """The wrapped planner's probabilities; 1 for a motion that undoes another."""
        return self.planner.preferences() if self.has_chosen else None

    def choices(self) -> NDArray[np.bool_] | None:
        """The wrapped planner's choices; None when undoing a motion."""
        return self.planner.choices() if self.has_chosen else None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Undo a motion, or delegate to the wrapped planner."""
        self.has_chosen = is_known(info) or not self.made
        if self.has_chosen:
            action = self.planner.act(observation, info)
            self.made = [*self.made[1 - _REMEMBERED :], action]
            self.was_tracked = is_known(info)
            return action
        if self.was_tracked:  # only the first motion undone lost tracking
            self.planner.lost_by(self.made[-1])
        self.was_tracked = False
        self.planner.see(observation, info)
        self.undoing = self.made.pop()
        possible = self.robot.action_masks()
        undone = opposite(self.undoing, possible.size)
        parts = (undone, undone % 7, undone - undone % 7)  # its rotation takes more out of view
        return next((part for part in parts if possible[part]), 0)


def goal_of(planner: Planner | None) -> NDArray[np.float64] | None:
    """The pose (4, 4) that a planner is heading for, in its map; None if it has no goal."""
    chooses = planner.planner if isinstance(planner, Recovering) else planner
    return getattr(chooses, "goal", None)


def is_known(info: dict[str, Any]) -> bool:
    """Whether SLAM tracks and is sure of its pose; without a covariance, tracking suffices."""
    covariance = info.get("pose_covariance")
    if not info["tracking_ok"] or covariance is None:
        return bool(info["tracking_ok"])
    variances = np.diag(covariance)[:3]
    return bool(np.isinf(variances).any() or variances.max() <= _DOUBT_M**2)


def opposite(action: int, actions: int = 49) -> int:
    """The motion that undoes ``action``, among 49 motions or 7 rotations.

    >>> opposite(7 * 5 + 1)  # forward and roll right: backward and roll left
    44
    """
    rotation = _OPPOSITE[action % 7]
    return rotation if actions == 7 else 7 * _OPPOSITE[action // 7] + rotation


PLANNERS = ExtensionPoint("planner", "ms_slam_env.planners", Planner)
"""Lookup of planners by name."""


def make_planner(text: str, env: Any, seed: int = 0, **more: Any) -> Planner:
    """Build the planner that ``NAME,option=value,...`` describes for the unwrapped ``env``.

    Every planner has the option ``recovery``: undo the last motions while tracking is lost.

    Args:
        text: the planner and its options.
        env: the unwrapped environment.
        seed: of the planner's random choices.
        **more: further options, such as paths that contain commas.

    Raises:
        InputError: an unknown planner or option, a value that the planner refuses, or a planner
            that chooses motions only where the agent also chooses the SLAM configuration.
    """
    cls, options = _parsed(text, more)
    recovery = options.pop(RECOVERY, cls.recovers)
    space = getattr(env, "action_space", None)
    if isinstance(space, Box) and (cls.motions_only or recovery):
        raise InputError(
            f"planner {text!r} chooses among discrete motions; this environment's actions are "
            "continuous, which random or a planner of your own can choose"
        )
    if isinstance(space, MultiDiscrete) and (cls.motions_only or recovery):
        raise InputError(
            f"planner {text!r} chooses motions only; this environment also needs a "
            "SLAM configuration, which random, policy or a planner of your own can choose"
        )
    robot = cls.seen_of(env)
    planner: Planner = cls(robot, seed=seed, **options)
    return Recovering(robot, planner) if recovery else planner


def planner_observation(text: str) -> str:
    """The observation variant that the planner ``NAME,option=value,...`` expects.

    Raises:
        InputError: an unknown planner or option, or a value that the planner refuses.
    """
    cls, options = _parsed(text, {})
    options.pop(RECOVERY, None)
    return cls.observation_for(**options)


def check_planner(text: str, **more: Any) -> None:
    """Refuse what ``make_planner`` would refuse, without an environment.

    Raises:
        InputError: an unknown planner or option.
    """
    _parsed(text, more)


def is_privileged(text: str) -> bool | None:
    """Whether the planner ``NAME,option=value,...`` sees the truth; None if it is not known.

    The text may come from a record, so it imports nothing of its own: a class counts by the name of
    an entry point of an installed package, or if its module is loaded already.
    """
    name = re.split(r",| \(", text, maxsplit=1)[0]
    module, _, path = name.partition(":")
    if path:
        found: Any = sys.modules.get(module)
        for part in path.split("."):
            found = getattr(found, "__dict__", {}).get(part)
    else:
        try:
            found = PLANNERS.find(name) if name in PLANNERS.names() else None
        except InputError:  # its package lacks something
            found = None
    return issubclass(found, PrivilegedPlanner) if isinstance(found, type) else None


def _parsed(text: str, more: Mapping[str, Any]) -> tuple[type[Planner], dict[str, Any]]:
    """The class and options that ``text`` describes, plus the options in ``more``."""
    name, options = parse_named(text, "planner")
    options = {**options, **more}
    cls: type[Planner] = PLANNERS.find(name)
    check_options(f"planner {name}", cls, options, ("env", "robot", "seed"), (RECOVERY,))
    if not isinstance(options.get(RECOVERY, False), bool):
        raise InputError(f"option {RECOVERY} of planner {name} is true or false")
    return cls, options
