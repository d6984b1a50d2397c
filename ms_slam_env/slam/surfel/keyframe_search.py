"""Finding a lost frame again at keyframes that resemble it."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float64, Int32
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.shared.alignment_check import (
    AlignmentStatistics,
    is_photometrically_consistent,
)
from ms_slam_env.slam.shared.alignment_measures import measure_photometric_consistency
from ms_slam_env.slam.shared.device_ferns import DeviceFernEncoder
from ms_slam_env.slam.shared.feature_poses import KeyframeImages, pose_from_features
from ms_slam_env.slam.shared.ferns import (
    Candidate,
    FernCode,
    FernConfig,
    FernDatabase,
    dissimilarities,
)
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.surfel.acceptance import Alignment, acceptance_thresholds
from ms_slam_env.slam.surfel.pose_hypotheses import (
    KEYFRAME_HYPOTHESES,
    NUM_HYPOTHESES,
    UNMOVED,
    is_within,
    tracking_hypotheses,
)
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_config import AcceptanceConfig, SurfelConfig


class FrameAligner(Protocol):
    """What relocalization may ask of the SLAM about the current frames."""

    def align_from(
        self, origins: Float64, hypotheses: Float64, thresholds: NDArray[Any]
    ) -> Alignment:
        """Align with the maps as seen from ``origins`` (B, 4, 4).

        ``hypotheses`` (B, K, 4, 4) are relative to those; ``thresholds`` (B,) are
        ``DeviceThresholds``.
        """

    def render(self, poses: Float64) -> ModelView:
        """The maps as seen from ``poses`` (B, 4, 4)."""


def measure_consistency(
    frames: Images, poses: Float64, wanted: Bool, aligner: FrameAligner, cutoff_m: float
) -> dict[int, AlignmentStatistics]:
    """How the frames of the envs ``wanted`` (B,) agree with the maps' views from ``poses``."""
    if not wanted.any():
        return {}
    view = aligner.render(np.where(wanted[:, None, None], poses, np.eye(4)))
    found = {}
    for env in np.flatnonzero(wanted).tolist():
        seen = view.intensity[env].numpy(), view.vertices[env].numpy()[..., 2]
        found[env] = measure_photometric_consistency(*frames.of(env), *seen, cutoff_m)
    return found


class Relocalization(Saved):
    """Searches for the lost frames of B envs elsewhere than around the last good pose.

    This base class is the variant "local", which searches nowhere else.
    """

    def add_keyframes(self, frames: Images, poses: Float64, time: Int32, tracked: Bool) -> None:
        """Record the frames that were ``tracked`` (B,) at ``poses`` (B, 4, 4)."""

    def verify(self, frames: Images, poses: Float64, found: Bool, aligner: FrameAligner) -> Bool:
        """Which of the frames that were ``found`` (B,) again are really at ``poses`` (B, 4, 4)."""
        return found

    def relocalize(
        self, frames: Images, lost: Bool, aligner: FrameAligner
    ) -> tuple[Bool, Alignment] | None:
        """Search the maps for the frames of the envs that are ``lost`` (B,).

        Returns:
            Which of them were found (B,), and where; None if none was.
        """
        return None

    def propose(
        self, frames: Images, lost: Bool, attempts: Int32, aligner: FrameAligner
    ) -> Float64:
        """Candidate poses (B, 4, 4) of the envs that are ``lost`` (B,); NaN: none.

        The map's view from there agrees with the frame, but nothing has confirmed them yet. Every
        attempt (B,) looks elsewhere.
        """
        return np.full((len(lost), 4, 4), np.nan)

    def similar(self, env: int, frames: Images, before: int) -> list[Candidate]:
        """The best few keyframes from before a time that resemble an env's frame, best first."""
        return []

    def move_keyframes(self, env: int, time: Int32, poses: Float64) -> None:
        """Move keyframes with a deformed map: frames ``time`` (N,) are at ``poses`` (N, 4, 4)."""

    def adapt(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Prepare for frames of another size and another depth cutoff."""

    def clear(self, env: int) -> None:
        """Forget everything about one env."""

    def keyframe_poses(self, env: int) -> Float64:
        """Poses (K, 4, 4) of the keyframes of one env."""
        return np.zeros((0, 4, 4))

    def least_dissimilarity(self, env: int, frames: Images, keyframes: dict[str, Any]) -> float:
        """Dissimilarity in [0, 1] of an env's frame and the most similar of some keyframes.

        Infinity without keyframes.
        """
        return np.inf

    def get_keyframes(self, env: int) -> dict[str, Any]:
        """The keyframes of one env, as arrays."""
        return {}

    def keyframes_like(self) -> dict[str, Any]:
        """Description of what ``get_keyframes`` returns; see ``Stateful.state_like``."""
        return {}

    def set_keyframes(self, env: int, keyframes: dict[str, Any]) -> None:
        """Know these keyframes of one env, and nothing else."""


TRIALS = 3  # keyframes tried a frame
ROUNDS = 3  # frames until the same ones are tried again
REFINEMENTS = 3  # alignments with the view from the pose found so far
HOPELESS_COST = 2.45  # an alignment with a keyframe's view that costs more is no start
GOOD_COST = 1.6  # with one that costs less the other keyframes are left untried
_FARTHEST_TESTED_M = 4.0  # rooms differ in what is near
FEWEST_MATCHES = 8  # that speak for a pose
_LOOKED_AT = 40  # keyframes among which those tried are chosen
_STEP_M, _STEP_RAD = 0.03, np.radians(3.0)  # frames between such steps are no new keyframes
_APART = 0.10, np.radians(10.0)  # two of them differ by at least so much


def _strict_thresholds(config: AcceptanceConfig, lost: int) -> NDArray[Any]:
    return acceptance_thresholds(config, np.ones(1, dtype=bool), np.full(1, lost, dtype=np.int32))


def _lax_thresholds(config: AcceptanceConfig) -> NDArray[Any]:
    """Thresholds of an alignment that is repeated and checked before it is accepted.

    A keyframe's view hides what the camera sees from elsewhere, so that even a perfect alignment
    with it leaves much unexplained.
    """
    thresholds = _strict_thresholds(config, 7)
    thresholds["overlap"], thresholds["cost"] = 0.3, HOPELESS_COST
    thresholds["inlier_ratio"] = thresholds["photometric_inlier_ratio"] = 0.35
    thresholds["depth_conflict_ratio"] = 0.6
    return thresholds


class FernRelocalization(Relocalization):
    """Searches from the keyframes that resemble the lost frame (Glocker et al., TVCG 2015).

    The best of a few alignments is refined, and accepted if the map's view from there is like the
    frame (``is_photometrically_consistent``) and the next frame is found close by. Only then is
    anything fused.
    """

    saved: ClassVar[tuple[str, ...]] = ("databases", "_tentative", "_attempts", "_looked_from")

    def __init__(
        self,
        batch: int,
        intrinsics: Intrinsics,
        depth_cutoff_m: float,
        acceptance: AcceptanceConfig | None = None,
    ) -> None:
        config = FernConfig(
            far_m=min(max(depth_cutoff_m, 2 * FernConfig.near_m), _FARTHEST_TESTED_M)
        )
        self.databases = [FernDatabase(intrinsics, config) for _ in range(batch)]
        self._device_encoder: DeviceFernEncoder | None = None
        self._cutoff_m = depth_cutoff_m
        acceptance = acceptance or AcceptanceConfig()
        self._strict = _strict_thresholds(acceptance, 0)
        self._lax = _lax_thresholds(acceptance)
        self._tentative: Float64 = np.full((batch, 4, 4), np.nan)  # to be confirmed; NaN: none
        self._attempts = np.zeros(batch, dtype=np.int32)  # since tracking was lost
        self._looked_from: Float64 = np.full((batch, 4, 4), np.nan)  # the last frame encoded

    def add_keyframes(self, frames: Images, poses: Float64, time: Int32, tracked: Bool) -> None:
        """Keep the tracked frames that resemble no keyframe; look at one every few centimetres."""
        self._tentative[tracked] = np.nan
        self._attempts[tracked] = 0
        moved = tracked & _has_moved(self._looked_from, poses)
        self._looked_from[moved] = poses[moved]
        envs = np.flatnonzero(moved).astype(np.int32)
        if not len(envs):
            return
        databases = [self.databases[env] for env in envs]
        codes = self._encode(frames, envs)
        kept = FernDatabase.observe_codes(databases, codes, poses[envs], time[envs])
        for env in envs[kept].tolist():
            self._keep(env, frames, int(time[env]))

    def _encode(self, frames: Images, envs: Int32) -> FernCode:
        """Codes (N, F) of the frames of ``envs`` (N,), encoded where they lie."""
        encoder = self.databases[0].encoder
        if not (frames.on_device and encoder.tests.run_on_device):
            return encoder.encode_all(frames, envs)
        if self._device_encoder is None or self._device_encoder.tests is not encoder.tests:
            batch, device = len(self.databases), str(frames.depth.device)
            self._device_encoder = DeviceFernEncoder(encoder.tests, batch, device)
        return FernCode(*self._device_encoder.encode(frames, envs))

    def _keep(self, env: int, frames: Images, time: int) -> None:
        """Take note of a new keyframe."""

    def verify(self, frames: Images, poses: Float64, found: Bool, aligner: FrameAligner) -> Bool:
        """Those that are like the map's view from there."""
        verified = found.copy()
        seen = measure_consistency(frames, poses, found, aligner, self._cutoff_m)
        for env, found_there in seen.items():
            verified[env] = is_photometrically_consistent(found_there)
        return verified

    def relocalize(
        self, frames: Images, lost: Bool, aligner: FrameAligner
    ) -> tuple[Bool, Alignment] | None:
        """Confirm the poses that the last frames were found at, or find poses to confirm."""
        if not lost.any():
            return None
        found, alignment = np.zeros(len(lost), dtype=bool), None
        expected = lost & _has_pose(self._tentative)
        if expected.any():
            hypotheses = tracking_hypotheses(np.eye(4))
            alignment = _align(aligner, self._tentative, hypotheses, self._strict)
            found = expected & alignment.tracked
            found = self.verify(frames, alignment.T_world_live, found, aligner)
        self._tentative[lost] = np.nan
        missing = lost & ~found
        if missing.any():
            proposed = self.propose(frames, missing, self._attempts, aligner)
            self._tentative[missing] = proposed[missing]
            self._attempts[missing] += 1
        return (found, alignment) if alignment is not None and found.any() else None

    def propose(
        self, frames: Images, lost: Bool, attempts: Int32, aligner: FrameAligner
    ) -> Float64:
        """From other keyframes at every attempt; see the base class."""
        return self._refine(frames, self._find(frames, lost, attempts, aligner), aligner)

    def _find(self, frames: Images, lost: Bool, attempts: Int32, aligner: FrameAligner) -> Float64:
        """Poses (B, 4, 4) that the best alignments with keyframes' views lead to; NaN: none."""
        hypotheses = KEYFRAME_HYPOTHESES[attempts % len(KEYFRAME_HYPOTHESES)]
        best = np.full((len(lost), 4, 4), np.nan)
        cost = np.full(len(lost), np.inf)
        for starts in self._keyframes_to_try(frames, lost, attempts):
            wanted = _has_pose(starts) & (cost > GOOD_COST)
            if not wanted.any():
                break
            found = _align(aligner, starts, hypotheses, self._lax)
            better = wanted & found.tracked & (found.statistics["cost"] < cost)
            best[better] = found.T_world_live[better]
            cost[better] = found.statistics["cost"][better]
        return best

    def _refine(self, frames: Images, poses: Float64, aligner: FrameAligner) -> Float64:
        """Align again with the views from ``poses`` (B, 4, 4); keep what is like them, else NaN."""
        kept = np.full_like(poses, np.nan)
        for _ in range(REFINEMENTS):
            wanted = _has_pose(poses)
            if not wanted.any():
                break
            again = _align(aligner, poses, UNMOVED, self._lax)
            wanted &= again.tracked
            verified = self.verify(frames, again.T_world_live, wanted, aligner)
            kept[verified] = again.T_world_live[verified]
            going_on = wanted & ~verified
            poses = np.where(going_on[:, None, None], again.T_world_live, np.nan)
        return kept

    def _keyframes_to_try(self, frames: Images, lost: Bool, attempts: Int32) -> Float64:
        """Poses (TRIALS, B, 4, 4) of keyframes, NaN for none; others at every attempt."""
        poses = np.full((TRIALS, len(lost), 4, 4), np.nan)
        for env in np.flatnonzero(lost):
            near = self.databases[env].candidates(*frames.of(int(env)), _LOOKED_AT)
            first = TRIALS * int(attempts[env] % ROUNDS)
            apart = _spread(near, first + TRIALS)
            chosen = apart[first:] or apart[:TRIALS]
            for rank, candidate in enumerate(chosen):
                poses[rank, env] = candidate.T_world_camera
        return poses

    def similar(self, env: int, frames: Images, before: int) -> list[Candidate]:
        """At most ``TRIALS``, apart from each other."""
        near = self.databases[env].candidates(*frames.of(env), _LOOKED_AT, before)
        return _spread(near, TRIALS)

    def move_keyframes(self, env: int, time: Int32, poses: Float64) -> None:
        """Put the keyframes where their frames are now."""
        database = self.databases[env]
        moved = database.poses
        index = np.searchsorted(time, database.times)
        known = (index < len(time)) & (time[np.minimum(index, len(time) - 1)] == database.times)
        moved[known] = poses[index[known]]
        database.move(moved)

    def adapt(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Keep the keyframes, which are compared as small images of one size; see the base."""
        for database in self.databases:
            database.expect_size(intrinsics)
        self._cutoff_m = depth_cutoff_m

    def clear(self, env: int) -> None:
        """Forget the keyframes of one env."""
        self.databases[env].clear()
        self._tentative[env] = np.nan
        self._attempts[env] = 0
        self._looked_from[env] = np.nan

    def keyframe_poses(self, env: int) -> Float64:
        """Poses (K, 4, 4) of the keyframes of one env."""
        return self.databases[env].poses

    def least_dissimilarity(self, env: int, frames: Images, keyframes: dict[str, Any]) -> float:
        """See the base class."""
        code = self.databases[env].encode(*frames.of(env))
        found = dissimilarities(code, keyframes["bits"], keyframes["known"])
        return float(found.min(initial=np.inf))

    def get_keyframes(self, env: int) -> dict[str, Any]:
        """State of the database of one env."""
        return self.databases[env].get_state()

    def keyframes_like(self) -> dict[str, Any]:
        """See the base class."""
        return dict(self.databases[0].state_like())

    def set_keyframes(self, env: int, keyframes: dict[str, Any]) -> None:
        """Know these keyframes of one env, and nothing else."""
        self.clear(env)
        self.databases[env].set_state(keyframes)


class FeatureRelocalization(FernRelocalization):
    """Also searches where ORB features of similar keyframes put the frame.

    Alignment converges only from within a few centimetres and degrees; features measure how far
    from a keyframe the frame was taken.
    """

    saved = (*FernRelocalization.saved, "_images")

    def __init__(
        self,
        batch: int,
        intrinsics: Intrinsics,
        depth_cutoff_m: float,
        acceptance: AcceptanceConfig | None = None,
    ) -> None:
        super().__init__(batch, intrinsics, depth_cutoff_m, acceptance)
        self._images = [KeyframeImages(intrinsics) for _ in range(batch)]

    def _keep(self, env: int, frames: Images, time: int) -> None:
        self._images[env].keep(*frames.of(env), time)

    def propose(
        self, frames: Images, lost: Bool, attempts: Int32, aligner: FrameAligner
    ) -> Float64:
        """Use the keyframes' features if their views lead nowhere; see the base class."""
        poses = super().propose(frames, lost, attempts, aligner)
        starts = np.full_like(poses, np.nan)
        for env in np.flatnonzero(lost & ~_has_pose(poses)):
            starts[env] = self._by_features(int(env), frames, int(attempts[env]))
        found = self._refine(frames, starts, aligner)
        return np.where(_has_pose(poses)[:, None, None], poses, found)

    def _by_features(self, env: int, frames: Images, attempt: int) -> Float64:
        """Pose (4, 4) supported by most features; NaN: none."""
        images, best, pose = self._images[env], FEWEST_MATCHES, np.full((4, 4), np.nan)
        color, depth = frames.of(env)
        near = self.databases[env].candidates(color, depth, _LOOKED_AT)
        known = _spread([one for one in near if one.time in images.times], TRIALS * ROUNDS)
        first = TRIALS * (attempt % ROUNDS)
        features = images.features_of(color, depth, self._cutoff_m)
        for one in known[first : first + TRIALS] or known[:TRIALS]:
            keyframe = images.features(one.time, self._cutoff_m)
            found = pose_from_features(keyframe, features, images.intrinsics)
            if found is not None and found.inliers > best:
                best, pose = found.inliers, one.T_world_camera @ found.T_reference_frame
        return pose

    def adapt(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Images of another size are forgotten."""
        super().adapt(intrinsics, depth_cutoff_m)
        self._images = [one.fitting(intrinsics) for one in self._images]

    def clear(self, env: int) -> None:
        """See the base class."""
        super().clear(env)
        self._images[env].clear()


def _has_pose(poses: Float64) -> Bool:
    """Which of ``poses`` (B, 4, 4) are not NaN."""
    return np.isfinite(poses[:, 0, 0])


def _has_moved(before: Float64, now: Float64) -> Bool:
    """Which poses (B, 4, 4) are a step away from those ``before``, or have none before."""
    step = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
    # The trace of R_before^T R_now is the sum of the products of all elements.
    cosine = ((before[:, :3, :3] * now[:, :3, :3]).sum(axis=(1, 2)) - 1) / 2
    near = (step <= _STEP_M) & (cosine >= np.cos(_STEP_RAD))
    return ~near  # comparisons with NaN are false


def _align(
    aligner: FrameAligner, starts: Float64, hypotheses: Float64, thresholds: NDArray[Any]
) -> Alignment:
    """Align from ``starts`` (B, 4, 4); results for NaN starts are meaningless."""
    batch = len(starts)
    origins = np.where(np.isfinite(starts), starts, np.eye(4))
    hypotheses = np.broadcast_to(hypotheses, (batch, NUM_HYPOTHESES, 4, 4))
    return aligner.align_from(origins, hypotheses, np.repeat(thresholds, batch))


def _spread(candidates: list[Candidate], count: int) -> list[Candidate]:
    """The first ``count`` candidates that are apart from all better ones."""
    chosen: list[Candidate] = []
    for one in candidates:
        if len(chosen) == count:
            break
        if not any(
            is_within(one.T_world_camera, other.T_world_camera, *_APART) for other in chosen
        ):
            chosen.append(one)
    return chosen


def make_relocalization(batch: int, intrinsics: Intrinsics, config: SurfelConfig) -> Relocalization:
    """The relocalization ``config.relocalisation`` for B envs with one camera model."""
    if config.relocalisation == "local":
        return Relocalization()
    kind = FeatureRelocalization if config.relocalisation == "features" else FernRelocalization
    return kind(batch, intrinsics, config.depth_cutoff_m, config.acceptance)
