"""Recorded kernel launches.

Packing the arguments of a launch costs more time than a small kernel (24 against 4 microseconds
measured on one core); tracking repeats the same hundred launches every frame.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

from ms_slam_env._warp import wp


class Launches:
    """Launches by key, for kernels whose arguments are the same objects every time."""

    def __init__(self, device: str) -> None:
        """Start with nothing recorded."""
        self._device = device
        self._commands: dict[Hashable, wp.Launch] = {}

    def clear(self) -> None:
        """Forget all: the arguments have become other objects."""
        self._commands.clear()

    def replay(self, key: Hashable) -> bool:
        """Launch what was recorded under ``key``; False if nothing was."""
        command = self._commands.get(key)
        if command is None:
            return False
        command.launch()
        return True

    def record(
        self,
        key: Hashable,
        kernel: Any,
        dim: int | Sequence[int],
        inputs: Sequence[Any],
        outputs: Sequence[Any],
    ) -> None:
        """Launch a kernel and keep the launch under ``key``."""
        command = wp.launch(
            kernel,
            dim=dim,
            inputs=inputs,
            outputs=outputs,
            device=self._device,
            record_cmd=True,
        )
        self._commands[key] = command
        command.launch()
