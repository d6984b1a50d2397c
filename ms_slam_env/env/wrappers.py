"""Wrappers of the environments."""

from __future__ import annotations

import gc
import importlib.util
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.env.active_slam import ActiveSlamEnv
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.perturbations import make_perturbation


class FollowStates(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Keeps Gymnasium's time limit and order check in step with loaded states.

    Both count from a reset. Without this wrapper, an environment that goes back in time, as in tree
    search, would be truncated by the steps of all its attempts, and one that loads a state without
    a reset would refuse to step. ``gym.make`` puts it around every environment.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self._watch()

    def _watch(self) -> None:
        inner = self.env.unwrapped
        assert isinstance(inner, ActiveSlamEnv)
        inner.on_load = self._follow

    def _follow(self, steps: int) -> None:
        """Tell Gymnasium's wrappers that the episode has had ``steps`` steps."""
        env = self.env
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, gymnasium.wrappers.TimeLimit):
                env._elapsed_steps = steps  # type: ignore[assignment]
            elif isinstance(env, gymnasium.wrappers.OrderEnforcing):
                env._has_reset = True
            env = env.env

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        """Watch the unpickled environment, and update Gymnasium's wrappers."""
        self.__dict__.update(pickled)
        self._watch()


class Perturbed(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Perturbs the frames that the sensor of an ``ActiveSlamEnv`` gives.

    SLAM and the agent both see the perturbed frames; true poses stay true, also in the reward and
    ``info``. Wrap again to combine perturbations; those of one kind apply in the order of wrapping.
    Takes effect at the next reset::

        env = Perturbed(gym.make("MSActiveSLAM-FreeCamera-v0"), "motion-blur", exposure_s=0.03)
        env = Perturbed(env, "moving-objects", kind="box", count=2)
    """

    def __init__(self, env: gymnasium.Env[Any, Any], name: str, **options: Any) -> None:
        """Add a perturbation.

        Args:
            env: an ``ActiveSlamEnv``, wrapped or not.
            name: one of ``ms_slam_env.sequences.PERTURBATIONS`` except ``fast-motion``.
            **options: of the perturbation; its defaults otherwise.

        Raises:
            InputError: unknown name or option, a value out of range, or no ``ActiveSlamEnv``.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(self, name=name, **options)
        super().__init__(env)
        inner = env.unwrapped
        if not isinstance(inner, ActiveSlamEnv):
            raise InputError(f"Perturbed wraps an ActiveSlamEnv, not {type(inner).__name__}")
        inner.perturb(make_perturbation(name, options))

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which actions are possible now, under the name that sb3-contrib expects."""
        return self.get_wrapper_attr("unwrapped").action_masks()


def _is_filmed(episode: int) -> bool:
    """Whether the episode's number is a cube, or a multiple of 1000."""
    return round(episode ** (1 / 3)) ** 3 == episode if episode < 1000 else episode % 1000 == 0


class RecordVideo(gymnasium.wrappers.RecordVideo):
    """Gymnasium's wrapper of the same name, but videos are written by FFmpeg through imageio.

    Gymnasium's uses MoviePy, which requires an older Pillow than other dependencies accept.
    Without a trigger it records the same episodes: 0, 1, 8, 27, ..., 1000, 2000, ...

    Raises:
        InputError: imageio-ffmpeg, the extra ``video``, is not installed.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        video_folder: str | Path,
        episode_trigger: Callable[[int], bool] | None = None,
        step_trigger: Callable[[int], bool] | None = None,
        **options: Any,
    ) -> None:
        if importlib.util.find_spec("imageio_ffmpeg") is None:
            needed = "imageio-ffmpeg: pip install 'ms-slam-env[video]'"
            raise InputError(f"recording videos needs {needed}")
        if episode_trigger is None and step_trigger is None:
            episode_trigger = _is_filmed  # Gymnasium's own needs MoviePy
        with suppress(gymnasium.error.DependencyNotInstalled):  # it ends by importing MoviePy
            super().__init__(env, str(video_folder), episode_trigger, step_trigger, **options)

    def stop_recording(self) -> None:
        """Write the video, and reset for the next one."""
        frames, self.recorded_frames = self.recorded_frames, []
        if frames:
            self._write(Path(self.video_folder, f"{self._video_name}.mp4"), frames)
        self.recording, self._video_name = False, None
        if self.gc_trigger and self.gc_trigger(self.episode_id):
            gc.collect()

    def _write(self, path: Path, frames: list[Any]) -> None:
        even = [frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames]
        film = iio.imwrite(  # the codec needs even numbers of rows and columns
            "<bytes>",
            np.stack(even),
            extension=".mp4",
            plugin="FFMPEG",
            fps=self.frames_per_sec,
            macro_block_size=2,
        )
        write_bytes(path, film)
