"""What a motion mask is: which readings of the live frames belong to things that move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import ModelView

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]


class MotionMask(Saved):
    """Tells which readings of the live frames of B envs belong to things that move.

    This one takes the world to be still.

    Attributes:
        can_doubt: whether it ever finds anything.
    """

    can_doubt = False

    def __init__(self, batch: int, intrinsics: Intrinsics, device: str) -> None:
        self._batch, self._device = batch, device
        self.resize(intrinsics)

    def resize(self, intrinsics: Intrinsics) -> None:
        """Go on with frames of another size; what was seen at the old one is forgotten."""

    def forget(self, env: int) -> None:
        """Forget what one env has seen."""

    def expect(self, live: LiveFrame, T_world_live: Float64, is_known: Bool) -> None:
        """Take what moved in the last frames to new ones at about ``T_world_live`` (B, 4, 4).

        Where that is not known, ``is_known`` (B,), nothing is masked.
        """

    def find(self, T_world_live: Float64, is_known: Bool, strict: bool = False) -> Bool:
        """Look for what moves in the frames, taken at poses (B, 4, 4).

        If ``strict``, what no earlier frame but the last few has seen is taken for moving; in the
        first frames, all that is near.

        Returns:
            (B,) whether so much is new in the mask that the frame should be aligned again.
        """
        return np.zeros(self._batch, dtype=bool)

    def doubts(self) -> Bool:
        """Where (B,) what is new in the frames is enough to lead a pose astray, were it moving."""
        return np.zeros(self._batch, dtype=bool)

    def confirm(self, where: Bool) -> None:
        """Believe what the last ``strict`` look found, for the envs ``where`` (B,)."""

    def hide(self, view: ModelView, T_world_model: Float64) -> bool:
        """Empty a view of the maps where masked readings lie; whether there are any.

        ``T_world_model`` (B, 4, 4) are the poses of the view.
        """
        return False

    def remember(self, live: LiveFrame, T_world_live: Float64, good: Bool) -> None:
        """Mask ``live``; take it as seen from poses (B, 4, 4), where that is ``good`` (B,)."""

    def share(self) -> Float64:
        """Share (B,) of the readings that are masked."""
        return np.zeros(self._batch)

    def mask(self, env: int) -> Bool | None:
        """Every n-th row and column (h, w) of an env's mask; None if nothing is ever masked."""
        return None
