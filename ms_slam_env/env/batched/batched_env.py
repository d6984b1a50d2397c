"""Many environments in one: B free cameras with dense SLAM in the loop, stepped together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float32, Float64, Int64
from ms_slam_env._runtime.timings import Timings
from ms_slam_env._runtime.warp import wp
from ms_slam_env.divergence import Histograms, make_divergence
from ms_slam_env.env.actions import MaskedDiscrete
from ms_slam_env.env.batched.episodes import Episodes
from ms_slam_env.env.batched.worlds import Worlds
from ms_slam_env.env.env_config import EnvConfig, check_reset
from ms_slam_env.env.observations import FeaturesObservation
from ms_slam_env.env.reward import Outcome, RewardConfig, weighted_terms
from ms_slam_env.env.robot_knowledge import state_vectors
from ms_slam_env.env.simulation import START_TRIES
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import check_pose
from ms_slam_env.robot import NUM_MOTIONS, decompose
from ms_slam_env.robot.free_camera import check_room
from ms_slam_env.scenes.registry import SceneName, name_of
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.slam.adaptation import NoAdaptationConfig
from ms_slam_env.slam.frame_selection import EveryFrameConfig
from ms_slam_env.slam.registry import check_parameters
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig

_LARGEST_POOL = 100_000
_EMPTY = "too few depth readings there: SLAM has nothing to map"

_ELSEWHERE = "other environments run in processes: make_vec(..., vectorization_mode='async')"


def supported_slam(config: EnvConfig) -> SurfelConfig:
    """The parameters of the SLAM of environments in a batch.

    Raises:
        InputError: an option that environments in a batch do not have.
    """
    if config.slam != "surfel":
        raise InputError(f"in a batch slam must be surfel, not {config.slam!r}; {_ELSEWHERE}")
    surfel: SurfelConfig = check_parameters("surfel", config.slam_config)
    has: list[tuple[str, Any, Any]] = [
        ("observation", config.observation, "features"),
        ("actions", config.actions, "discrete"),
        ("pose", config.pose, "slam"),
        ("mask", config.mask, "true"),
        ("frames_per_action", config.frames_per_action, 1),
        ("adaptation", config.adaptation, NoAdaptationConfig()),
        ("frame_management", config.frame_management, EveryFrameConfig()),
        ("reward", type(config.reward), RewardConfig),
        *((f"slam_config.{name}", getattr(surfel, name), only) for name, only in _OF_SLAM.items()),
    ]
    for name, value, only in has:
        if value != only:
            raise InputError(f"in a batch {name} must be {only!r}, not {value!r}; {_ELSEWHERE}")
    return surfel


_OF_SLAM = {
    "motion_mask": "none",
    "submaps": "off",
    "loop_closure": "none",
    "readout_s": 0.0,
    "color_registration": "given",
}


class BatchedActiveSlam(VectorEnv[Float32, Int64, Any]):
    """B environments with a free camera, each in a scene of its own, stepped at once.

    Environment i does what ``gym.make`` of the same id does with the i-th seed: on a CPU the same
    starts, masks, frames and, up to the order of sums, poses and rewards. Images, maps and marked
    surface stay on the device; the rest are NumPy arrays (B, ...). ``info`` has the keys of
    ``ActiveSlamEnv``, each an array over the environments.

    Attributes:
        config: of each environment.
        device: of images and maps.
        slam: the SLAM of all.
        timings: of the stages of a step.
        waits: whether a stage waits for the device, so that its time is its own; slower on a GPU.
    """

    def __init__(
        self,
        num_envs: int,
        config: EnvConfig,
        device: str = "cpu",
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        start_pool: int = 0,
    ) -> None:
        """Allocate everything but the scenes.

        Args:
            num_envs: B.
            config: of each environment.
            device: ``cpu`` or ``cuda``.
            max_episode_steps: steps after which an episode is truncated; None: never.
            autoreset_mode: when an environment whose episode has ended is reset: by its next step,
                whose action is ignored, in the same step, or only by ``reset`` (``Disabled``).
            start_pool: how many starts to draw in a scene when it is first entered; episodes then
                begin at one of them, which is faster. 0: each draws its own, as with ``gym.make``.

        Raises:
            InputError: a value out of range, a device that is not there, or an option of the
                configuration that environments in a batch do not have.
        """
        surfel = supported_slam(config)
        if (
            isinstance(num_envs, bool)
            or not isinstance(num_envs, (int, np.integer))
            or num_envs < 1
        ):
            raise InputError(f"num_envs = {num_envs!r} must be an integer >= 1")
        if device not in ("cpu", "cuda") or (device == "cuda" and not wp.is_cuda_available()):
            choices = "cpu, cuda" if wp.is_cuda_available() else "cpu (this machine has no CUDA)"
            raise InputError(f"unknown device {device!r}; valid choices: {choices}")
        try:
            self._autoreset = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise InputError(
                f"unknown autoreset_mode {autoreset_mode!r}; valid choices: {modes}"
            ) from None
        if not isinstance(start_pool, int) or not 0 <= start_pool <= _LARGEST_POOL:
            raise InputError(
                f"start_pool = {start_pool!r} must be an integer in [0, {_LARGEST_POOL}]"
            )
        self._pool_size = start_pool
        self._pools: WeakKeyDictionary[Scene, Float64] = WeakKeyDictionary()
        self.metadata = {"render_modes": [], "autoreset_mode": self._autoreset}
        self.num_envs = batch = int(num_envs)
        self.config, self.device, self._most_steps = config, device, max_episode_steps
        self.single_action_space = MaskedDiscrete(NUM_MOTIONS)
        self.single_observation_space = FeaturesObservation(config.camera, NUM_MOTIONS).space
        self.action_space = batch_space(self.single_action_space, batch)
        self.observation_space = batch_space(self.single_observation_space, batch)
        self.timings, self.waits = Timings(), False

        self._worlds = Worlds(batch, config, device)
        self._episodes = Episodes(batch)
        self.slam = BatchedSurfelSlam(batch, config.camera, surfel, device)
        self._divergence = make_divergence(config.divergence, config.camera, device)
        self._histograms: Histograms | None = None  # of the last frames
        self._motions = decompose(config.step_m, config.step_rad)
        self._rngs: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(batch)]
        self._places: list[tuple[SceneName, int] | None] = [None] * batch
        self._scene_names: NDArray[Any] = np.full(batch, "", dtype=object)
        self._scene_seeds = np.zeros(batch, dtype=np.int64)
        self._episodes_left = np.zeros(batch, dtype=np.int64)  # in the scene drawn last
        self._masks = np.ones((batch, NUM_MOTIONS), dtype=bool)
        self._has_begun = np.zeros(batch, dtype=bool)
        self._ended = np.zeros(batch, dtype=bool)

    # -- Gymnasium ---------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Float32, dict[str, Any]]:
        """Start an episode in every environment.

        Args:
            seed: environment i has ``seed + i``, or the i-th of several; None leaves its generator.
            options: those of ``ActiveSlamEnv.reset``, for all; and ``reset_mask`` (B,) bool, which
                environments are reset.

        Raises:
            InputError: a bad seed or option, or a start from which there is nothing to map.
        """
        given = dict(options or {})
        where = self._checked_mask(given.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        unseen = [env for env, scene in enumerate(self._worlds.scenes) if scene is None]
        if not where[unseen].all():
            raise InputError("reset option reset_mask: the first reset must be of all environments")
        seeds = self._checked_seeds(seed)
        for one in seeds:
            check_reset(one, given, self.config.scenes)
        for env in map(int, np.flatnonzero(where)):
            if seeds[env] is not None:
                self._rngs[env] = seeding.np_random(seeds[env])[0]
                self._episodes_left[env] = 0
        self._begin(where, given)
        return self._observe(), self._info(where & False)

    def step(self, actions: Any) -> tuple[Float32, Float64, Bool, Bool, dict[str, Any]]:
        """Make one motion of every camera, track its frame, and compute the reward.

        Raises:
            InputError: actions that are not in the action space, or an environment that was not
                reset.
        """
        wanted = self._checked_actions(actions)
        starts = self._ended if self._autoreset is AutoresetMode.NEXT_STEP else self._ended & False
        moves = ~starts
        made = moves & self._masks[np.arange(self.num_envs), wanted]
        motions = np.where(made[:, None, None], self._motions[wanted], np.eye(4))
        errors, ate = self._episodes.pose_error.copy(), self._episodes.ate
        self._episodes.move(moves, wanted, motions)
        self._look(starts, {})
        new_surface = self._track(starts)
        lost_for_good = moves & (self._lost_share() >= 1)
        values: dict[str, Any] = {
            "divergence": self._episodes.divergence,
            "pose_error_growth_m": self._episodes.pose_error - errors,
            "ate_growth_m": self._episodes.ate - ate,
            "new_surface_m2": new_surface,
            "tracking_ok": self._episodes.tracking_ok,
            "lost_for_good": lost_for_good,
            "blocked": ~made,
        }
        assert isinstance(self.config.reward, RewardConfig)
        terms = weighted_terms(Outcome(**values), self.config.reward, self.config.targets)
        self._terms = {name: np.where(moves, term, 0.0) + 0.0 for name, term in terms.items()}
        reward: Float64 = np.sum(list(self._terms.values()), axis=0)
        truncated = moves & self._time_is_up()
        self._ended = lost_for_good | truncated
        observation, info = self._observe(), self._info(moves)
        if self._autoreset is AutoresetMode.SAME_STEP and self._ended.any():
            ended = self._ended.copy()
            final = np.full(self.num_envs, None, dtype=object)
            for env in map(int, np.flatnonzero(ended)):
                final[env] = observation[env]
            lasts = {"final_obs": final, "final_info": self._info(moves, ended)}
            self._begin(ended, {})
            observation, info = self._observe(), self._info(moves & ~ended)
            info |= {**lasts, **{f"_{name}": ended.copy() for name in lasts}}
        return observation, reward, lost_for_good, truncated, info

    def action_masks(self) -> Bool:
        """(B, 49) which actions are possible now."""
        return self._masks.copy()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Values of an attribute in each environment, or of ``action_masks()``.

        Raises:
            InputError: any other method; the environments have none of their own.
        """
        if name == "action_masks":
            return tuple(self.action_masks())
        value = getattr(self, name)
        if callable(value):
            raise InputError(f"call({name!r}): the environments of a batch have only action_masks")
        return (value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """See ``call``."""
        return self.call(name)

    # -- Episodes ----------------------------------------------------------------------------

    def _begin(self, where: Bool, options: Mapping[str, Any]) -> None:
        """Start the episodes ``where`` (B,) with one frame each; the others stay as they are."""
        self._look(where, options)
        color, depth = self._images()
        with self._stage("slam"):
            self.slam.start(color, depth, where)
        self._measure(where)
        self._episodes.begin(where)
        with self._stage("coverage"):
            self._worlds.cover(self._episodes.T_world_camera_estimate, where)
        self._ended = self._ended & ~where

    def _look(self, starts: Bool, options: Mapping[str, Any]) -> None:
        """Draw the starts of the episodes ``starts`` (B,), and take the next frame of all.

        Raises:
            InputError: a start that cannot be used, given or after several tries.
        """
        for env in map(int, np.flatnonzero(starts)):
            self._has_begun[env] = False
            self._draw_scene(env, options)
        why = {env: "" for env in map(int, np.flatnonzero(starts))}
        for _ in range(START_TRIES):
            with self._stage("start"):
                refused = {env: self._draw_start(env, options) for env in why}
            with self._stage("render"):
                episodes = self._episodes
                seen = episodes.T_world_camera, episodes.noise_seed, episodes.steps
                self._worlds.capture(*seen)
            if why:
                enough = self.slam.can_start(*self._images())
                empty = {env: "" if enough[env] else _EMPTY for env in why}
                why = {env: refused[env] or empty[env] for env in why}
                why = {env: reason for env, reason in why.items() if reason}
            if not why or options.get("T_world_camera") is not None:
                break
        for env, reason in why.items():
            raise InputError(f"environment {env} cannot start at a drawn or given pose: {reason}")
        with self._stage("move"):
            self._masks = self._worlds.action_masks()
        self._has_begun |= starts

    def _draw_scene(self, env: int, options: Mapping[str, Any]) -> None:
        """Go to the scene of an environment's next episode."""
        chosen = {key: options.get(key) for key in ("scene", "scene_seed")}
        is_chosen = any(value is not None for value in chosen.values())
        place = self._places[env]
        if place is None or not self._episodes_left[env] or is_chosen:
            place = self.config.draw_scene(self._rngs[env], chosen)
            self._episodes_left[env] = 1 if is_chosen else self.config.episodes_per_scene
        self._episodes_left[env] -= 1
        self._places[env] = place
        self._scene_names[env], self._scene_seeds[env] = name_of(place[0]), place[1]
        self._worlds.enter(env, *place)

    def _draw_start(self, env: int, options: Mapping[str, Any]) -> str:
        """Draw the start of an episode; return why it is impossible, or an empty string."""
        rng, scene = self._rngs[env], self._worlds.scenes[env]
        assert scene is not None
        start = options.get("T_world_camera")
        if start is None:
            start = self._sample_start(scene, rng)
        try:
            pose = check_room(scene, check_pose(start, "reset option T_world_camera"))
        except UnreachableError as error:
            return str(error)
        self._episodes.put(env, pose, int(rng.integers(2**31)))
        self.slam.reset(pose, env)
        return ""

    def _sample_start(self, scene: Scene, rng: np.random.Generator) -> Float64:
        """Draw a start (4, 4), from the scene's pool if there is one."""
        if not self._pool_size:
            return scene.sample_start(rng)
        pool = self._pools.get(scene)
        if pool is None:
            draws = np.random.default_rng([scene.seed, self._pool_size])
            pool = np.stack([scene.sample_start(draws) for _ in range(self._pool_size)])
            self._pools[scene] = pool
        return pool[int(rng.integers(self._pool_size))]

    def _track(self, starts: Bool) -> Float64:
        """Track and measure the frames; return the newly mapped areas (B,), m2."""
        with self._stage("slam"):
            found = self.slam.track_arrays(*self._images())
        divergence = self._measure(starts)
        self._episodes.record(~starts, found, divergence)
        self._episodes.begin(starts)
        with self._stage("coverage"):
            return self._worlds.cover(self._episodes.T_world_camera_estimate, found.fused)

    def _images(self) -> Any:
        """Colour and depth of the last frames, on the device."""
        cameras = self._worlds.cameras
        return cameras.color, cameras.depth

    def _measure(self, starts: Bool) -> Float64:
        """(B, 2) divergence of the last frames from the ones before; 0 for first ones."""
        with self._stage("divergence"):
            before = self._histograms
            seen = self._worlds.grey, self._worlds.cameras.depth
            self._histograms = now = self._divergence.histograms(*seen)
            if before is None:
                return np.zeros((self.num_envs, 2))
            return np.where(starts[:, None], 0.0, self._divergence.divergence(now, before))

    def _lost_share(self) -> Float64:
        """(B,) share of the patience for lost tracking used up; 1 or more ends the episode."""
        return self._episodes.steps_lost / self.config.lost_patience

    def _time_is_up(self) -> Bool:
        up = np.zeros(self.num_envs, dtype=bool)
        if self._most_steps is not None:
            up |= self._episodes.steps >= self._most_steps
        if self.config.seconds is not None:
            up |= self._episodes.time_s >= self.config.seconds
        return up

    # -- What is returned --------------------------------------------------------------------

    def _observe(self) -> Float32:
        """The observations (B, n)."""
        with self._stage("observation"):
            episodes = self._episodes
            share = np.minimum(1.0, self._lost_share())
            told = np.stack([episodes.tracking_ok, episodes.inlier_fraction, share], axis=1)
            divergence = episodes.divergence / self.config.targets.maxima
            state = state_vectors(episodes.T_start_camera, divergence, told, episodes.action)
            masks = self._masks.astype(np.float32)
            return np.concatenate([state, *self._worlds.image_features(), masks], axis=1)

    def _info(self, moved: Bool, whose: Bool | None = None) -> dict[str, Any]:
        """Infos of the environments ``whose`` (B,), or all; those that ``moved`` have terms."""
        whose = np.ones(self.num_envs, dtype=bool) if whose is None else whose
        info = {
            **self._episodes.info(),
            "action_mask": self._masks.copy(),
            "mapped_area": self._worlds.mapped_area.copy(),
            "mapped_share": self._worlds.mapped_share.copy(),
            "scene": self._scene_names.copy(),
            "scene_seed": self._scene_seeds.copy(),
        }
        terms: dict[str, Any] = {}
        if moved.any():
            terms = {**self._terms, **{f"_{name}": moved.copy() for name in self._terms}}
        info["reward_terms"] = terms
        return {**info, **{f"_{name}": whose.copy() for name in info}}

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Count the time of the enclosed block."""
        with self.timings.stage(name):
            yield
            if self.waits:
                wp.synchronize_device(self.device)

    # -- Arguments ---------------------------------------------------------------------------

    def _checked_mask(self, mask: Any) -> Bool:
        array = np.asarray(mask)
        if array.shape != (self.num_envs,) or array.dtype != bool or not array.any():
            raise InputError(
                f"reset option reset_mask must be ({self.num_envs},) booleans, one of them true"
            )
        return array

    def _checked_seeds(self, seed: Any) -> list[Any]:
        if seed is None or isinstance(seed, (int, np.integer)):
            check_reset(seed, None, ())
            return [None if seed is None else int(seed) + env for env in range(self.num_envs)]
        if not isinstance(seed, Sequence) or len(seed) != self.num_envs:
            raise InputError(f"reset(seed={seed!r}): must be an integer or {self.num_envs} of them")
        return list(seed)

    def _checked_actions(self, actions: Any) -> Int64:
        array, batch = np.asarray(actions), self.num_envs
        if array.shape != (batch,) or not np.issubdtype(array.dtype, np.integer):
            raise InputError(f"actions must be ({batch},) integers in [0, {NUM_MOTIONS - 1}]")
        if array.min() < 0 or array.max() >= NUM_MOTIONS:
            raise InputError(f"actions {actions!r} are not all in [0, {NUM_MOTIONS - 1}]")
        if not self._has_begun.all():
            raise InputError("the environments must be reset before they are used: call reset()")
        if self._autoreset is AutoresetMode.DISABLED and self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise InputError(f"the episodes of {ended} have ended: reset(options={{'reset_mask'}})")
        return array.astype(np.int64)
