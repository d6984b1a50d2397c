"""Planners: their interface, and how they are found by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import MultiDiscrete
from numpy.typing import NDArray

from ms_slam_env._runtime.extension import ExtensionPoint, check_options
from ms_slam_env.config import parse_named
from ms_slam_env.env.robot_view import PrivilegedView, RobotView, without_truth
from ms_slam_env.errors import InputError

RECOVERY = "recovery"
_OPPOSITE = (0, 2, 1, 4, 3, 6, 5)  # of a translation or rotation, in the paper's order
_REMEMBERED = 12  # motions that can be undone
_DOUBT_M = 0.006
"""Standard deviation of the position along some axis beyond which SLAM is taken to doubt it.

Of 585 motions of training seeds in four scenes 99 in 100 of those that were tracked within 2 cm
kept below 3.2 mm; of 16 that were not, 12 were lost or above 10 mm.
"""


class Planner(ABC):
    """Chooses actions for one robot.

    It knows what the robot does: the observation, ``info`` without the truth (``known``) and its
    ``robot``. One that needs the truth is a `PrivilegedPlanner`.

    Args:
        robot: what it sees; an unwrapped environment is looked at as a `RobotView`.
        seed: of the planner's own random choices; an environment that was reset with the same one
            draws others.
    """

    robot: RobotView
    view: ClassVar[type[RobotView]] = RobotView
    """What it is given to see of an environment."""

    observation: str = "features"
    """The observation variant that ``act`` expects, unless ``observation_for`` says otherwise."""
    recovers: bool = False
    """Whether it undoes its last motions while tracking is lost, unless told not to."""
    motions_only: bool = False
    """Whether it cannot choose a SLAM configuration beside the motion."""

    def __init__(self, robot: RobotView, seed: int = 0) -> None:
        self.robot = self.seen_of(robot)
        child = np.random.SeedSequence(seed).spawn(1)[0]  # the environment draws from the parent
        self.rng = np.random.default_rng(child)

    @classmethod
    def seen_of(cls, env: Any) -> RobotView:
        """What a planner of this class sees of an unwrapped environment; a view stays as it is.

        Raises:
            InputError: a view without the truth, of which this planner needs to know.
        """
        if isinstance(env, cls.view):
            return env
        if isinstance(env, RobotView):
            raise InputError(f"{cls.__name__} needs the truth, which no {type(env).__name__} has")
        return cls.view(env)

    @property
    def env(self) -> Any:
        """``robot``, by the name that it had before."""
        return self.robot

    def known(self, info: dict[str, Any]) -> dict[str, Any]:
        """What ``act`` is to be told of the ``info`` that ``reset`` or ``step`` returned."""
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
        """Probabilities (n,) of the actions as `act` weighed them; None: all for the one chosen."""
        return None

    def choices(self) -> NDArray[np.bool_] | None:
        """Actions (n,) of which `act` let a policy within choose; None: it chose by itself."""
        return None

    def instead(self, action: int) -> None:  # noqa: B027 -- most planners see what came of it
        """Be told that another action was taken than ``act`` returned last."""

    def see(self, observation: Any, info: dict[str, Any]) -> None:  # noqa: B027 -- see `instead`
        """Be shown, in place of ``act``, a step in which another chooses."""

    def lost_by(self, action: int) -> None:  # noqa: B027 -- most planners learn nothing from it
        """Be told that its last action lost tracking; SLAM holds the pose from before it."""


class PrivilegedPlanner(Planner):
    """Knows the truth: a teacher, or a bound on what there is to gain, and no rival."""

    robot: PrivilegedView
    view = PrivilegedView

    def known(self, info: dict[str, Any]) -> dict[str, Any]:
        """All of it."""
        return info


class Recovering(Planner):
    """Undoes the last motions, newest first, while SLAM does not know where it is.

    Otherwise it asks another planner. SLAM does not know while tracking is lost, or while it says
    by the covariance of its pose that this is doubtful.

    The opposite of [R | t] is taken as the motion with the opposite rotation and translation: off
    by the step's own rotation of its translation, some 2 cm at 12 cm and 12 deg. Where something is
    in its way, its rotation alone is undone, or its translation.
    """

    def __init__(self, robot: RobotView, planner: Planner) -> None:
        super().__init__(robot)
        self.planner = planner
        self._begin()

    def reset(self) -> None:
        """Nothing was done yet."""
        self._begin()
        self.planner.reset()

    def _begin(self) -> None:
        self.made: list[int] = []
        self.was_tracked = False
        self.has_chosen = False

    def instead(self, action: int) -> None:
        """Remember the motion that was made, to undo that one."""
        before = self.made[:-1] if self.has_chosen else [*self.made, self.undoing]
        self.made = [*before, action]
        self.planner.instead(action)

    def known(self, info: dict[str, Any]) -> dict[str, Any]:
        """What the planner is to be told."""
        return self.planner.known(info)

    def preferences(self) -> NDArray[np.float64] | None:
        """What the planner says; all for the motion that undoes another."""
        return self.planner.preferences() if self.has_chosen else None

    def choices(self) -> NDArray[np.bool_] | None:
        """What the planner says; None where a motion is undone."""
        return self.planner.choices() if self.has_chosen else None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Undo a motion, or what the planner says."""
        self.has_chosen = is_known(info) or not self.made
        if self.has_chosen:
            action = self.planner.act(observation, info)
            self.made = [*self.made[1 - _REMEMBERED :], action]
            self.was_tracked = is_known(info)
            return action
        if self.was_tracked:  # the motions undone after the first lost nothing
            self.planner.lost_by(self.made[-1])
        self.was_tracked = False
        self.planner.see(observation, info)
        self.undoing = self.made.pop()
        possible = self.robot.action_masks()
        undone = opposite(self.undoing, possible.size)
        parts = (undone, undone % 7, undone - undone % 7)  # its rotation takes more out of view
        return next((part for part in parts if possible[part]), 0)


def goal_of(planner: Planner | None) -> NDArray[np.float64] | None:
    """The pose (4, 4) that a planner is on its way to, as it believes; None for one without."""
    chooses = planner.planner if isinstance(planner, Recovering) else planner
    return getattr(chooses, "goal", None)


def is_known(info: dict[str, Any]) -> bool:
    """Whether SLAM tracks and is sure of its pose; one that gives no covariance is."""
    covariance = info.get("pose_covariance")
    if not info["tracking_ok"] or covariance is None:
        return bool(info["tracking_ok"])
    variances = np.diag(covariance)[:3]
    return bool(np.isinf(variances).any() or variances.max() <= _DOUBT_M**2)


def opposite(action: int, actions: int = 49) -> int:
    """The motion that leads back, of 49 motions or of 7 rotations.

    >>> opposite(7 * 5 + 1)  # forward and roll right: backward and roll left
    44
    """
    rotation = _OPPOSITE[action % 7]
    return rotation if actions == 7 else 7 * _OPPOSITE[action // 7] + rotation


PLANNERS = ExtensionPoint("planner", "ms_slam_env.planners", Planner)
"""Where planners are found."""


def make_planner(text: str, env: Any, seed: int = 0, **more: Any) -> Planner:
    """Build the planner that ``NAME,option=value,...`` describes for the unwrapped ``env``.

    Every planner has the option ``recovery``: while tracking is lost its last motions are undone.

    Args:
        text: what to build.
        env: the unwrapped environment.
        seed: of the planner's draws.
        **more: options beside those of the text, as paths with commas in them.

    Raises:
        InputError: an unknown planner or option, a value that the planner refuses, or an
            environment that wants more than motions of one that has no more.
    """
    cls, options = _parsed(text, more)
    recovery = options.pop(RECOVERY, cls.recovers)
    if isinstance(getattr(env, "action_space", None), MultiDiscrete) and (
        cls.motions_only or recovery
    ):
        raise InputError(
            f"planner {text!r} chooses motions only; this environment asks for a SLAM "
            "configuration too, as random, policy or one of your own chooses it"
        )
    robot = cls.seen_of(env)
    planner: Planner = cls(robot, seed=seed, **options)
    return Recovering(robot, planner) if recovery else planner


def planner_observation(text: str) -> str:
    """The observation variant that the planner ``NAME,option=value,...`` is to be shown.

    Raises:
        InputError: an unknown planner or option, or what the planner refuses.
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


def _parsed(text: str, more: Mapping[str, Any]) -> tuple[type[Planner], dict[str, Any]]:
    """Class and options that ``text`` describes, with ``more`` of these."""
    name, options = parse_named(text, "planner")
    options = {**options, **more}
    cls: type[Planner] = PLANNERS.find(name)
    check_options(f"planner {name}", cls, options, ("env", "robot", "seed"), (RECOVERY,))
    if not isinstance(options.get(RECOVERY, False), bool):
        raise InputError(f"option {RECOVERY} of planner {name} is true or false")
    return cls, options
