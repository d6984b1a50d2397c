"""Configuration of the environment: one frozen dataclass per stage, composed in ``EnvConfig``."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from ms_slam_env._runtime.extension import ExtensionPoint, check_call
from ms_slam_env.camera import Intrinsics, pinhole
from ms_slam_env.config import (
    Checked,
    bounded,
    check_range,
    chosen,
    from_dict,
    parse_named,
)
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.env.registry import POINT as OBSERVATION_POINT
from ms_slam_env.env.registry import Observation
from ms_slam_env.env.reward import DEFAULT, RewardConfig, TargetConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.scenes import SCENES, SEED_SPLITS, seeds_of
from ms_slam_env.scenes.registry import SceneName, check_name, name_of
from ms_slam_env.sensor.noise import NoiseConfig, noise_config
from ms_slam_env.slam import SlamBackend
from ms_slam_env.slam.adaptation import AdaptationConfig, NoAdaptationConfig
from ms_slam_env.slam.configuration import is_file_name, read_configuration
from ms_slam_env.slam.frame_selection import EveryFrameConfig, FrameSelectionConfig

OTHER_OPTIONS = ("embodiment", "render_mode", "task", "max_episode_steps")
"""Options of ``gym.make`` that are not fields of ``EnvConfig``; the last is Gymnasium's own."""

MAP = "map"
"""Value of the option ``mask``: masks from the robot's own map."""

_OF_STATE = (
    "image_size",
    "field_of_view_deg",
    "noise",
    "arm",
    "pose",
    "slam",
    "slam_config",
    "adaptation",
    "frame_management",
    "divergence",
)


@dataclass(frozen=True)
class LookaheadConfig(Checked):
    """How the 49 views are predicted and compared.

    Attributes:
        reference: ``live`` compares with the last live frame, as Algorithm 1 does; ``predicted``
            compares with the view that the map predicts at the current pose.
        scale: size of the predicted views relative to the camera's image.
        projection: ``warped`` renders the map once, from between the candidates, and warps this
            view into theirs; ``exact`` projects the map for each of them, as Algorithm 1, line 5,
            has it, in several times the time.
    """

    reference: str = chosen("predicted", "live", "predicted")
    scale: float = bounded(0.5, 0.125, 1)
    projection: str = chosen("warped", "warped", "exact")


@dataclass(frozen=True)
class EnvConfig(Checked):
    """All options of an environment except its id.

    Attributes:
        scene: a scene name, a mesh file, or several to draw from at each reset.
        scene_seed: one seed, or None to draw from ``split`` at each reset.
        split: which seeds to draw from: train, validation or test, or seeds of your choice, such
            as 7000-7003 or 7000,7005.
        num_scene_seeds: how many seeds of the split are used. The shipped agents were trained with
            the default; with only four rooms an agent memorizes them. Building a room takes a
            second, a home longer; the last 20 rooms or five homes are cached.
        episodes_per_scene: consecutive episodes in a drawn scene; a reset with a seed always draws
            again.
        image_size: of the camera, WIDTHxHEIGHT pixels.
        field_of_view_deg: horizontal field of view of the camera; None for the Xtion's, 58.6.
        noise: sensor noise: ``kinect``, ``range`` or ``none``; or a mapping with such a ``name``, a
            ``strength`` (1 unchanged, 0 off) and fields of ``ms_slam_env.sensor.NoiseConfig``.
        arm: options of the arm, for embodiments that have one.
        pose: source of the estimated pose: ``slam``, ``slam-kinematics`` (SLAM initialized from the
            arm's forward kinematics), ``kinematics`` (noisy forward kinematics alone; SLAM only
            maps) or ``ground_truth``. Kinematics need an arm.
        slam: SLAM backend: a name, ``module:Class`` or a class. Options may be appended, as in
            ``surfel,refuse_open=true,motion_mask=none,submaps=off``, which suits motions as large
            as a step in a world that is still; those of ``slam_config`` override them.
        adaptation: how SLAM changes its configuration at run time: ``none``, ``divergence`` or
            ``agent`` (as in ``MSActiveSLAM-Adaptive-v0``); or a mapping with such a ``name`` and
            its options. Every frame is processed, whatever a configuration's ``keep_every``.
        frame_management: which frames SLAM processes: ``none`` (every frame), ``regular``,
            ``divergence`` or ``budget``; or a mapping with such a ``name`` and its options. The
            pose of a dropped frame is predicted; its surface is not mapped.
        slam_config: options of the backend, or a configuration file (YAML), which also sets
            ``slam``, and ``image_size`` where that is not given.
        observation: ``rgbd``, ``images``, ``pixels``, ``features``, ``lookahead``, ``map``,
            ``goals``, ``held``, ``candidates``, ``module:Class`` or a class.
        actions: ``discrete`` motions, or ``continuous``: a ``Box`` of six numbers in [-1, 1], the
            translation in units of ``step_m`` and the rotation vector in units of ``step_rad``. A
            motion that is blocked then stops short, and there are no masks.
        step_m: translation of a motion, metres.
        step_rad: rotation of a motion, radians.
        frames_per_action: frames that a free camera takes per motion, at 30 Hz; an arm takes as
            many as fit in the time it needs.
        lost_patience: consecutive steps that tracking may stay lost before the episode ends.
        away_patience: consecutive steps that the camera may be lost or in submaps not joined to the
            first before the episode ends: its pose relative to the start is then unknown. For SLAM
            without submaps, ``lost_patience`` decides.
        mask: how ``action_masks`` decides which motions are possible: ``true`` tests them in the
            true scene from the true pose, ``map`` in the occupancy grid of the robot's own map from
            the estimated pose, where unseen space is permitted. A motion that then collides is not
            made, like a masked one, and its end is marked occupied.
        seconds: simulated time after which an episode is truncated; None for no such limit.
        divergence: how divergence is measured.
        frame_divergences: whether to measure the divergence of every frame from the one before,
            for evaluation. If false, only that of each step's last frame is measured, which
            ``info`` and the reward use: with the arm, nine out of ten measurements fewer.
        lookahead: how candidates are predicted.
        targets: motion-and-structure parameters and thresholds.
        reward: ``divergence-and-error``, ``mapping`` (that of tasks) or ``paper``; or a mapping
            with such a ``name`` and weights of terms, without a name those of the default; see
            ``RewardConfig``. Or a function, or its name ``module:function``, of a step's
            ``Outcome`` that returns a number, or terms by name whose sum is the reward; a class of
            such functions is made without arguments.
    """

    scene: SceneName | tuple[SceneName, ...] = "living_room"
    scene_seed: int | None = None
    split: str = "train"
    num_scene_seeds: int = 100
    episodes_per_scene: int = bounded(1, 1, 1_000_000)
    image_size: str = "160x120"
    field_of_view_deg: float | None = bounded(None, 10, 150)
    noise: str | NoiseConfig = "kinect"
    arm: ArmConfig = field(default_factory=ArmConfig)
    pose: str = chosen("slam", *POSE_SOURCES)
    slam: str | type[SlamBackend] = "surfel,refuse_open=true,motion_mask=none,submaps=off"
    slam_config: dict[str, object] = field(default_factory=dict)
    adaptation: AdaptationConfig = field(default_factory=NoAdaptationConfig)
    frame_management: FrameSelectionConfig = field(default_factory=EveryFrameConfig)
    observation: str | type[Observation] = "features"
    actions: str = chosen("discrete", "discrete", "continuous")
    step_m: float = bounded(0.12, 0, 1)
    step_rad: float = bounded(math.radians(12), 0, math.pi / 2)
    frames_per_action: int = bounded(1, 1, 100)
    lost_patience: int = bounded(10, 1, 1_000_000)
    away_patience: int = bounded(50, 1, 1_000_000)
    mask: str = chosen("true", "true", MAP)
    seconds: float | None = bounded(None, 0.001, 1e9)
    divergence: DivergenceConfig = field(default_factory=DivergenceConfig)
    frame_divergences: bool = True
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    reward: RewardConfig | Callable[..., Any] = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        """Refuse unknown choices and values out of range."""
        if self.mask is True:  # YAML reads the name as a boolean
            object.__setattr__(self, "mask", "true")
        super().__post_init__()
        _ = self.camera  # refuses a bad size
        if not isinstance(self.noise, str):
            object.__setattr__(self, "noise", noise_config(self.noise))
        noise_config(self.noise)
        most = len(seeds_of(self.split))
        check_range(self, "num_scene_seeds", 1, most if self.split in SEED_SPLITS else 100_000)
        if self.frame_management.uses_clock:
            raise InputError(
                "frame_management.measured is not allowed in an environment, whose infos must be "
                "reproducible; give cost_per_frame instead"
            )
        if self.scene_seed is not None and (
            isinstance(self.scene_seed, bool) or not isinstance(self.scene_seed, (int, np.integer))
        ):
            raise InputError(
                f"EnvConfig.scene_seed = {self.scene_seed!r} must be an integer or None"
            )
        is_name = isinstance(self.scene, str) or callable(self.scene)
        is_names = isinstance(self.scene, (tuple, list)) and len(self.scene) > 0
        names = self.scenes if is_name or is_names else ()
        if not names or not all(isinstance(name, str) or callable(name) for name in names):
            raise InputError(f"EnvConfig.scene = {self.scene!r} must be a name or several")
        for name in names:
            check_name(name)
        if isinstance(self.slam, str):
            name, own = parse_named(self.slam, "backend")
            object.__setattr__(self, "slam", name)
            object.__setattr__(self, "slam_config", {**own, **self.slam_config})
        OBSERVATION_POINT.find(self.observation)
        object.__setattr__(self, "reward", _reward(self.reward))

    @property
    def camera(self) -> Intrinsics:
        """Intrinsics of the camera."""
        return pinhole(self.image_size, self.field_of_view_deg)

    @property
    def scenes(self) -> tuple[SceneName, ...]:
        """The scenes to draw from."""
        return tuple(self.scene) if isinstance(self.scene, (tuple, list)) else (self.scene,)

    def draw_scene(
        self, rng: np.random.Generator, given: Mapping[str, Any] | None = None
    ) -> tuple[SceneName, int]:
        """Name and seed of an episode's scene; ``given`` options of a reset override drawn ones.

        They are always drawn, so that later draws do not depend on ``given``.
        """
        name = self.scenes[int(rng.integers(len(self.scenes)))]
        seed = self.scene_seed
        if seed is None:
            seeds = seeds_of(self.split)
            seed = seeds[int(rng.integers(min(self.num_scene_seeds, len(seeds))))]
        given = given or {}
        if given.get("scene") is not None:
            own = {name_of(one): one for one in self.scenes}
            name = own.get(given["scene"], given["scene"])
        return name, seed if given.get("scene_seed") is None else int(given["scene_seed"])

    def of_state(self, embodiment: str) -> dict[str, Any]:
        """Settings that two environments must share to resume from the same state.

        The observation and the mask as text: they may differ unless one of them needs an occupancy
        grid, of which a state of another environment has none.
        """
        observation = str(getattr(self.observation, "__name__", self.observation))
        shared = {name: getattr(self, name) for name in _OF_STATE}
        return {"embodiment": embodiment, **shared, "observation": observation, "mask": self.mask}


REWARDS = ExtensionPoint("reward", "ms_slam_env.rewards", form="module:function")
"""Lookup of reward functions of a step's ``Outcome``, and of classes whose objects are such."""


def _reward(given: object) -> RewardConfig | Callable[..., Any]:
    """Weights, or a function."""
    presets = {DEFAULT: RewardConfig(), **RewardConfig.named()}
    named = ", ".join(presets)
    if isinstance(given, Mapping):
        name, weights = given.get("name", DEFAULT), {**given}
        if not isinstance(name, str) or name not in presets:
            raise unknown("reward.name", name, presets)
        weights.pop("name", None)
        return from_dict(RewardConfig, dataclasses.asdict(presets[name]) | weights, "reward")
    if isinstance(given, str) and given in presets:
        return presets[given]
    if isinstance(given, RewardConfig):
        return given
    if not isinstance(given, str) and not callable(given):
        options = ", ".join(field.name for field in dataclasses.fields(RewardConfig))
        raise InputError(
            f"reward = {given!r} must be a function of an Outcome, module:function, {named}, or a "
            f"mapping of options: {options}"
        )
    if isinstance(given, str) and ":" not in given and given not in REWARDS.names():
        raise REWARDS.unknown(given, presets)
    found: Any = REWARDS.find(given)
    if isinstance(found, type):
        return _reward_of_class(found, given)
    check_call(f"reward {given!r}", found, ("outcome",))
    return cast("Callable[..., Any]", found)


def _reward_of_class(cls: type, given: object) -> RewardConfig | Callable[..., Any]:
    """An object of a class, made without arguments."""
    if not (issubclass(cls, RewardConfig) or "__call__" in dir(cls)):
        raise InputError(
            f"reward {given!r} is a class whose objects are not callable; give a function of an "
            f"Outcome, or a class with __call__(self, outcome)"
        )
    try:
        inspect.signature(cls).bind()
    except (TypeError, ValueError):
        raise InputError(
            f"reward {given!r} is a class that takes arguments; give an object of it"
        ) from None
    made = cls()
    if not isinstance(made, RewardConfig):
        check_call(f"reward {given!r}", made, ("outcome",))
    return cast("RewardConfig | Callable[..., Any]", made)


def make_config(
    options: Mapping[str, Any], others: Sequence[str] = OTHER_OPTIONS, taken: Sequence[str] = ()
) -> EnvConfig:
    """Build the configuration from the options that an environment was given.

    Args:
        options: fields of :class:`EnvConfig`; nested ones as dataclass or mapping.
        others: further valid options to list in the error message.
        taken: fields to leave out of that list.

    Raises:
        InputError: an unknown option (the message lists the valid ones), a bad value, or a bad
            configuration file as ``slam_config``.
    """
    fields = [field.name for field in dataclasses.fields(EnvConfig)]
    for name in options:
        if name not in fields:
            valid = [*others, *(field for field in fields if field not in taken)]
            raise unknown("option of the environment", name, valid)
    return from_dict(EnvConfig, _read_slam_config(options))


def _read_slam_config(options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replace a file given as ``slam_config`` with its contents."""
    given = options.get("slam_config")
    if given is None or not is_file_name(given):
        return options
    file = read_configuration(given)
    if options.get("slam", file.slam) != file.slam:
        raise InputError(f"slam = {options['slam']!r} but {given} configures {file.slam!r}")
    size = {} if file.image_size is None else {"image_size": file.image_size}
    return {**size, **options, "slam": file.slam, "slam_config": file.slam_config}


RESET_OPTIONS = ("T_world_camera", "scene", "scene_seed")


def check_reset(seed: Any, options: Any, own: Sequence[SceneName]) -> None:
    """Check the arguments of ``reset`` of an environment whose scenes are ``own``.

    Raises:
        InputError: a wrong type, an unknown option, or a scene that is neither built in nor one of
            ``own``.
    """
    if seed is not None and not _is_seed(seed):
        raise InputError(f"reset(seed={seed!r}): must be an integer >= 0 or None")
    if options is not None and not isinstance(options, Mapping):
        raise InputError(f"reset(options={options!r}): must be a mapping or None")
    given = options or {}
    unknown_options = set(given) - {*RESET_OPTIONS}
    if unknown_options:
        names = sorted(map(str, unknown_options))
        valid = ", ".join(RESET_OPTIONS)
        raise InputError(f"unknown reset option {names}; valid choices: {valid}")
    scene, scene_seed = given.get("scene"), given.get("scene_seed")
    known = dict.fromkeys([*map(name_of, own), *SCENES])
    if scene is not None and (not isinstance(scene, str) or scene not in known):
        raise unknown("reset option scene", scene, known)
    if scene_seed is not None and not _is_seed(scene_seed):
        raise InputError(f"reset option scene_seed = {scene_seed!r} must be an integer >= 0")


def _is_seed(value: Any) -> bool:
    is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return is_whole and bool(value >= 0)
