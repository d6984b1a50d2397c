"""Where live frames were taken: pose hypotheses aligned with the map, tried in widening circles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, se3_log
from ms_slam_env.slam.shared.alignment_check import (
    DISPUTED,
    AlignmentStatistics,
    TrackingStatus,
    status_on_appeal,
)
from ms_slam_env.slam.shared.feature_poses import FeaturePose, LastFrames
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.acceptance import Alignment, accept_any_fit, is_nearly_accepted
from ms_slam_env.slam.surfel.camera_states import CameraStates
from ms_slam_env.slam.surfel.free_space_mask import MotionMask
from ms_slam_env.slam.surfel.keyframe_search import Images, Relocalization, measure_consistency
from ms_slam_env.slam.surfel.map_alignment import MapAligner
from ms_slam_env.slam.surfel.photometry import InvalidFrameDetector, is_leap
from ms_slam_env.slam.surfel.pipeline import Pipeline
from ms_slam_env.slam.surfel.pose_hypotheses import (
    UNMOVED,
    relocalization_hypotheses,
    tracking_hypotheses,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame

MOSTLY_MOVING = 0.6  # share of the readings: rather the pose is wrong, or too little is left
CLEARLY_APART = 30.0  # squared Mahalanobis distance; below 20 where nothing leads a pose
APART_M, APART_RAD = (0.006, 0.1), np.radians((0.4, 6.0))  # more than noise, less than a jump
MENDED = 0.9  # of the cost of an alignment that may have slipped
# Of the cost of one that left a direction open, in which it is no judge: of 36 such frames of
# validation seeds for which features led to an alignment it takes 34, 30 nearer, 2 farther.
AS_GOOD = 1.5
RETRIES = 2  # further searches within a frame whose tracking failed


class Localizer:
    """Finds where the frames of B envs were taken.

    Attributes:
        invalid_frames: tells frames with nothing to track in them.
        last_frames: whose features lead to a frame that is not found near the expected pose.
    """

    def __init__(
        self,
        states: CameraStates,
        aligner: MapAligner,
        relocalization: Relocalization,
        motion_mask: MotionMask,
        intrinsics: Intrinsics,
    ) -> None:
        self.invalid_frames = InvalidFrameDetector(len(states.poses))
        self.last_frames = LastFrames(len(states.poses), intrinsics)
        self._states = states
        self._aligner = aligner
        self._relocalization = relocalization
        self._motion_mask = motion_mask

    def use(self, pipeline: Pipeline) -> None:
        """Look at frames in this way from now on."""
        self._config = pipeline.config
        self.last_frames.use(pipeline.intrinsics)
        self._aligner.use(pipeline)

    def locate(self, live: LiveFrame, frames: Images, guesses: Float64 | None) -> Alignment:
        """Align the frames: near the last poses, at the guesses, around, at keyframes.

        ``guesses`` (B, 4, 4) are NaN for an env without; None if none has one.
        """
        self._aligner.set_frame(live)
        states = self._states
        expected = states.poses @ states.motions
        self._motion_mask.expect(live, expected, states.started & (states.lost == 0))
        invalid = self.invalid_frames.find(frames.color, states.started)
        alignment = self._aligner.track(invalid, guesses)
        if self._config.check_slips:
            alignment = self._mend_slips(alignment, frames, invalid)
        if self._motion_mask.can_doubt:
            alignment = self._mask_moving(alignment, expected, invalid, guesses)
        if self._is_settled(alignment):
            return alignment
        if self._config.refuse_bad_fits:
            alignment = self._search_by_features(self._appeal(alignment, frames), frames)
        else:
            alignment = accept_any_fit(alignment)
        if guesses is not None:
            alignment = self._search_at_guess(alignment, guesses)
        alignment = self._search_around(alignment)
        if self._config.refuse_bad_fits:
            alignment = self._search_elsewhere(alignment, frames)
        self._motion_mask.find(*self._trusted(alignment, expected))
        return alignment

    def _is_settled(self, alignment: Alignment) -> bool:
        """Whether every env is tracked, was so before and beyond doubt: nothing more to ask."""
        states = self._states
        is_open = states.started & (~alignment.tracked | (states.lost > 0) | (states.doubted > 0))
        return self._config.refuse_bad_fits and not is_open.any()

    def _mend_slips(
        self, alignment: Alignment, frames: Images, invalid: NDArray[np.bool_]
    ) -> Alignment:
        """Align anew, at the finest level alone, what may have slipped along a surface.

        Fine texture that is much the same everywhere, such as a carpet's, is gone at the coarser
        levels, which then slip along what geometry leaves open, and the texture all at once fits
        badly. So the frame is aligned from where it was expected, and from where the features of
        the last one put it, without them. Where a direction was left open, the pose along it is
        the predicted one, and a camera that goes where it likes is not there: if the features do
        not know better, the pose may be refused.
        """
        states, poses = self._states, self._states.poses
        asked = states.started & (states.lost == 0) & ~invalid
        is_open = asked & (alignment.statistics["degenerate_directions"] > 0)
        slipped = asked & is_leap(states.photometry, alignment.photometry, self._config.cauchy_rgb)
        if not (slipped | is_open).any():
            return alignment
        by_features = np.full_like(poses, np.nan)
        for env in np.flatnonzero(slipped | is_open):
            found = self._feature_pose(int(env), frames)
            if found is not None:
                by_features[env] = found[0]
        at_most = np.where(is_open, AS_GOOD, MENDED)
        for starts, whose, share in (
            (states.motions, slipped, MENDED),
            (invert(poses) @ by_features, slipped | is_open, at_most),
        ):
            given = whose & np.isfinite(starts[:, 0, 0])
            if not given.any():
                continue
            again = self._aligner.refine(np.where(given[:, None, None], starts, np.eye(4)))
            is_better = again.statistics["cost"] < share * alignment.statistics["cost"]
            taken = given & again.tracked & (is_better | ~alignment.tracked)
            alignment = alignment.replace(taken, again)
            is_open &= ~taken
        is_refused = is_open & alignment.tracked & self._config.refuse_open
        return alignment.with_status(is_refused, TrackingStatus.UNCONSTRAINED)

    def _feature_pose(self, env: int, frames: Images) -> tuple[Float64, FeaturePose] | None:
        """Where (4, 4) the features of an env's last frame put the present one."""
        images = frames.color[env], frames.depth[env]
        return self.last_frames.find(env, *images, self._config.depth_cutoff_m)

    def _mask_moving(
        self,
        alignment: Alignment,
        expected: Float64,
        invalid: NDArray[np.bool_],
        guesses: Float64 | None,
    ) -> Alignment:
        """Look for what moves, align without it, and refuse a pose by which most would move."""
        if self._motion_mask.find(*self._trusted(alignment, expected)).any():
            alignment = self._aligner.track(invalid, guesses)
        alignment = self._doubt(alignment, expected, invalid, guesses)
        self._motion_mask.find(*self._trusted(alignment, expected))
        is_most = alignment.tracked & (self._motion_mask.share() > MOSTLY_MOVING)
        return alignment.with_status(is_most, TrackingStatus.GEOMETRIC_MISMATCH)

    def _doubt(
        self,
        alignment: Alignment,
        expected: Float64,
        invalid: NDArray[np.bool_],
        guesses: Float64 | None,
    ) -> Alignment:
        """Ask whether the camera has moved or what it sees, where that may be confused.

        The pose follows what is near, which is measured best, and then nothing seems to move. So
        where much is new, or the motion sudden, frames are aligned once more without what is new.
        If it was that which drew the pose along, the rest puts the camera elsewhere, by more than
        it errs.
        """
        states, mask = self._states, self._motion_mask
        asked = states.started & (states.lost == 0) & ~invalid
        is_apart = alignment.tracked & _is_apart(alignment.T_world_live, expected)
        doubtful = asked & (is_apart | mask.doubts())
        if not doubtful.any():
            return alignment
        moving = doubtful & mask.find(expected, doubtful, strict=True)
        if not moving.any():
            return alignment
        again = self._aligner.track(invalid, guesses)
        taken = moving & again.tracked & (again.statistics["degenerate_directions"] == 0)
        taken &= ~alignment.tracked | _is_refuted(alignment, again)
        mask.confirm(taken)
        return alignment.replace(taken, again)

    def _trusted(
        self, alignment: Alignment, expected: Float64
    ) -> tuple[Float64, NDArray[np.bool_]]:
        """Poses (B, 4, 4) that the frames were taken at, as far as is known, and whether it is."""
        is_known = self._states.started & (alignment.tracked | (self._states.lost == 0))
        tracked = alignment.tracked[:, None, None]
        return np.where(tracked, alignment.T_world_live, expected), is_known

    def _appeal(
        self, alignment: Alignment, frames: Images, where: NDArray[np.bool_] | None = None
    ) -> Alignment:
        """Lay frames that are nearly accepted upon the map's view from where they were found.

        So are those that are accepted after uncertain ones: what follows a wrong pose fits it.
        """
        states, acceptance = self._states, self._config.acceptance
        appealed = self._failed(alignment) & np.isin(alignment.status, DISPUTED)
        for env in np.flatnonzero(appealed).tolist():
            appealed[env] = is_nearly_accepted(alignment, env, acceptance)
        asked = (appealed | (alignment.tracked & (states.doubted > 0))) & (states.lost == 0)
        if where is not None:
            asked &= where
        poses, cutoff_m = alignment.T_world_live, self._config.depth_cutoff_m
        seen = measure_consistency(frames, poses, asked, self._aligner, cutoff_m)
        for number, found in seen.items():
            alignment.status[number] = self._status_on_appeal(number, found, bool(appealed[number]))
        return alignment

    def _status_on_appeal(
        self, env: int, found: AlignmentStatistics, was_refused: bool
    ) -> TrackingStatus:
        """What becomes of a frame that is laid upon the map's view; doubt does not last for ever.

        One that the thresholds accept is at worst uncertain.
        """
        status, longest = status_on_appeal(found), self._config.acceptance.doubted.longest
        if not was_refused:
            is_refuted = status == TrackingStatus.PHOTOMETRIC_MISMATCH
            status = TrackingStatus.UNCERTAIN if is_refuted else TrackingStatus.OK
        is_over = status == TrackingStatus.UNCERTAIN and self._states.doubted[env] >= longest
        return TrackingStatus.PHOTOMETRIC_MISMATCH if is_over else status

    def _search_by_features(self, alignment: Alignment, frames: Images) -> Alignment:
        """Align the envs that failed from where features put them.

        A pose that many features all over the image speak for is kept, uncertain, where the map
        does not bear it out.
        """
        states, found = self._states, {}
        origins = states.poses.copy()
        for env in np.flatnonzero(self._failed(alignment)):
            pose = self._feature_pose(int(env), frames)
            if pose is not None:
                origins[env], found[int(env)] = pose
        if not found:
            return alignment
        where = np.isin(np.arange(len(origins)), list(found))
        again = self._aligner.align_strictly(origins, np.tile(UNMOVED, (len(origins), 1, 1, 1)))
        again = self._appeal(again, frames, where)
        taken = where & (again.tracked | (again.uncertain & ~alignment.uncertain))
        alignment = alignment.replace(taken, again.seen_from(states.poses))
        alone = np.zeros(len(origins), dtype=bool)
        for env in np.flatnonzero(self._failed(alignment) & ~alignment.uncertain & where):
            longest = self._config.acceptance.doubted.longest
            may_doubt = states.lost[env] == 0 and states.doubted[env] < longest
            alone[env] = may_doubt and found[int(env)].is_strong
        there = again.doubtful_at(origins, states.photometry)
        return alignment.replace(alone, there.seen_from(states.poses))

    def _search_at_guess(self, alignment: Alignment, guesses: Float64) -> Alignment:
        """Align the envs that failed with the view from their guess, under stricter thresholds.

        A large motion leaves little of the last pose's view in sight.
        """
        failed = self._failed(alignment) & np.isfinite(guesses[:, 0, 0])
        if not failed.any():
            return alignment
        poses = self._states.poses
        origins = np.where(failed[:, None, None], guesses, poses)
        hypotheses = np.tile(tracking_hypotheses(np.eye(4)), (len(poses), 1, 1, 1))
        again = self._aligner.align_strictly(origins, hypotheses)
        return alignment.replace(failed & again.tracked, again.seen_from(poses))

    def _search_around(self, alignment: Alignment) -> Alignment:
        """Give the envs that failed more hypotheses, under stricter thresholds."""
        states = self._states
        for attempt in range(1, 1 + RETRIES):
            failed = self._failed(alignment) & ~alignment.uncertain
            if not failed.any():
                break
            hypotheses = np.stack(
                [relocalization_hypotheses(attempt + RETRIES * int(lost)) for lost in states.lost]
            )
            again = self._aligner.align_strictly(states.poses, hypotheses)
            alignment = alignment.replace(failed & again.tracked, again)
        return alignment

    def _search_elsewhere(self, alignment: Alignment, frames: Images) -> Alignment:
        """Let the relocalization verify and find the envs that were lost before."""
        lost = self._states.lost > 0
        again = lost & alignment.tracked
        verified = self._relocalization.verify(frames, alignment.T_world_live, again, self._aligner)
        alignment = alignment.with_status(again & ~verified, TrackingStatus.PHOTOMETRIC_MISMATCH)
        found = self._relocalization.relocalize(
            frames, lost & self._failed(alignment), self._aligner
        )
        if found is None:
            return alignment
        where, elsewhere = found
        return alignment.replace(where, elsewhere.seen_from(self._states.poses))

    def _failed(self, alignment: Alignment) -> NDArray[np.bool_]:
        """Which envs (B,) may be searched for: also those whose pose is uncertain."""
        is_blank = alignment.status == TrackingStatus.BLANK
        return self._states.started & ~alignment.tracked & ~is_blank


def _is_refuted(alignment: Alignment, again: Alignment) -> NDArray[np.bool_]:
    """Whether (B,) the pose is further from that of a part of the frame than this part errs."""
    is_worse = alignment.statistics["cost"] > again.statistics["cost"]
    for env in np.flatnonzero(is_worse):
        twist = se3_log(invert(again.T_world_live[env]) @ alignment.T_world_live[env])
        distance = twist @ np.linalg.pinv(again.covariance[env]) @ twist
        is_worse[env] = distance > CLEARLY_APART
    return is_worse


def _is_apart(poses: Float64, others: Float64) -> NDArray[np.bool_]:
    """Which of the poses (B, 4, 4) differ, but not so much that ``others`` tell nothing."""
    step = np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1)
    # The trace of R_other^T R is the sum of the products of all elements.
    cosine = ((poses[:, :3, :3] * others[:, :3, :3]).sum(axis=(1, 2)) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1))
    is_more = (step > APART_M[0]) | (turn > APART_RAD[0])
    return is_more & (step < APART_M[1]) & (turn < APART_RAD[1])
