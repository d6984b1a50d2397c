"""Localize live frames: align pose hypotheses with the map, in a search that widens step by step.

Holds the state of the cameras between frames, the alignment of frames with the views of their maps,
and the searches for frames that are not found near the expected pose.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import adjoint, invert, se3_log
from ms_slam_env.slam.shared.alignment_check import (
    DISPUTED,
    AlignmentStatistics,
    TrackingStatus,
    status_on_appeal,
)
from ms_slam_env.slam.shared.feature_poses import FeaturePose, LastFrames
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.state import Stateful, check_has
from ms_slam_env.slam.surfel.acceptance import (
    FARTHEST_DEG,
    FARTHEST_M,
    Alignment,
    accept_any_fit,
    acceptance_thresholds,
    at_usual_noise,
    fit_of_noise,
    follow_drift,
    follow_usual,
    geometric_thresholds,
    is_nearly_accepted,
)
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.free_space_mask import MotionMask
from ms_slam_env.slam.surfel.keyframe_search import Relocalization, measure_consistency
from ms_slam_env.slam.surfel.photometry import (
    InvalidFrameDetector,
    geometry_only,
    is_leap,
    next_photometry,
    same_exposure,
)
from ms_slam_env.slam.surfel.pipeline import Pipeline
from ms_slam_env.slam.surfel.pose_hypotheses import (
    NUM_FIRST,
    NUM_HYPOTHESES,
    UNMOVED,
    damped,
    is_within,
    relocalization_hypotheses,
    tracking_hypotheses,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_map import SurfelMap


class CameraStates(Stateful):
    """State of the cameras of B envs between frames.

    The attributes are read-only arrays. Only the methods change them, and only
    ``BatchedSurfelSlam`` calls those.

    Attributes:
        poses: (B, 4, 4) T_world_camera.
        motions: (B, 4, 4) of the last frame, which predict the next.
        photometry: (B,) how the live grey values relate to the map's.
        started: (B,) whether a frame has been taken.
        lost: (B,) frames since tracking was lost.
        time: (B,) frames taken.
        doubted: (B,) frames in a row whose pose is uncertain.
        usual: (B,) running cost and inlier ratios of the alignments accepted recently,
            ``acceptance.USUAL`` each.
        drift: (B, 6, 6) covariances of where the maps about the cameras lie in the world, as
            twists of the cameras.
    """

    poses: Float64
    motions: Float64
    photometry: NDArray[Any]
    started: NDArray[np.bool_]
    lost: NDArray[np.int32]
    time: NDArray[np.int32]
    doubted: NDArray[np.int32]
    usual: NDArray[Any]
    drift: Float64

    def __init__(self, batch: int) -> None:
        """Cameras at the identity pose that have seen nothing."""
        identity, zeros = np.tile(np.eye(4), (batch, 1, 1)), np.zeros(batch, dtype=np.int32)
        own: dict[str, NDArray[Any]] = {"poses": identity, "motions": identity.copy()}
        own |= {"photometry": same_exposure(batch), "started": np.zeros(batch, dtype=bool)}
        own |= {name: zeros.copy() for name in ("lost", "time", "doubted")}
        own["usual"], own["drift"] = fit_of_noise(batch), np.zeros((batch, 6, 6))
        self._own = own
        for name, array in own.items():
            shown = array.view()
            shown.flags.writeable = False
            setattr(self, name, shown)

    def reset(self, envs: NDArray[np.integer[Any]], poses: Float64) -> None:
        """Start the ``envs`` (N,) anew at poses (N, 4, 4)."""
        fresh = CameraStates(1)
        for name, array in self._own.items():
            array[envs] = getattr(fresh, name)[0]
        self._own["poses"][envs] = poses

    def start(self, where: NDArray[np.bool_]) -> None:
        """Take note that the envs ``where`` (B,) have a first frame."""
        self._own["started"][where] = True

    def accept(self, where: NDArray[np.bool_], alignment: Alignment, least_scale: float) -> None:
        """Move the envs ``where`` (B,) on to where their frames were tracked."""
        own = self._own
        sure = where & alignment.tracked
        surprise = _surprise(alignment.T_model_live, self.motions)[sure]
        own["usual"][sure] = follow_usual(self.usual[sure], alignment.statistics[sure], surprise)
        own["poses"][where] = alignment.T_world_live[where]
        # Across a gap the motion is not one frame's.
        is_next = where & (self.lost == 0)
        own["motions"][where] = np.eye(4)
        own["motions"][is_next] = alignment.T_model_live[is_next]
        # What a degenerate view leaves open was predicted itself: let it die away.
        is_open = alignment.statistics["degenerate_directions"] > 0
        for env in np.flatnonzero(where & is_open):
            own["motions"][env] = damped(self.motions[env])
        own["doubted"][where] = np.where(alignment.uncertain, self.doubted + 1, 0)[where]
        own["lost"][where] = 0
        own["photometry"][where] = next_photometry(
            self.photometry[where],
            alignment.photometry[where],
            alignment.statistics["term_conflict"][where],
            least_scale,
        )

    def follow_drift(self, alignment: Alignment, focal_px: float) -> Float64:
        """Let the drift of the maps grow by what frames add; return it (B, 6, 6) without that."""
        moved = self.started & (alignment.tracked | alignment.uncertain)
        here, self._own["drift"][:] = follow_drift(self.drift, alignment, moved, focal_px)
        return here

    def expect_drift(self, env: int, T_old_new: Float64, drift: Float64) -> None:
        """Give an env the ``drift`` (6, 6) that a camera had which has moved by ``T_old_new``."""
        carry = adjoint(invert(T_old_new))
        self._own["drift"][env] = carry @ drift @ carry.T

    def hold(self, where: NDArray[np.bool_]) -> None:
        """Leave the envs ``where`` (B,) as their frames were not tracked."""
        self._own["motions"][where] = np.eye(4)
        self._own["lost"][where] += 1
        self._own["doubted"][where] = 0

    def follow(self, poses: Float64, motions: Float64) -> None:
        """Take known poses (B, 4, 4) and the motions (B, 4, 4) that led there."""
        self._own["poses"][:], self._own["motions"][:], self._own["lost"][:] = poses, motions, 0
        self._own["drift"][:] = 0

    def move_to(self, env: int, pose: Float64) -> None:
        """Put one env's camera at another pose (4, 4): its map has moved."""
        self._own["poses"][env] = pose

    def forget_exposure(self, env: int) -> None:
        """Assume that an env's next frame is exposed like the map; keep its noise."""
        noise = self.noise(env)
        self._own["photometry"][env] = same_exposure(1)[0]
        self.expect_noise(env, *noise)

    def noise(self, env: int) -> tuple[np.void, float]:
        """Noise that an env's recording has shown: ``usual``, and the scale of residuals."""
        return self.usual[env].copy(), float(self.photometry[env]["reference"])

    def expect_noise(self, env: int, usual: np.void, reference: float) -> None:
        """Judge an env's frames by noise that ``noise`` returned, for any map."""
        self._own["usual"][env] = usual
        self._own["photometry"][env]["reference"] = reference

    def count(self, frames: int | Int32 = 1) -> None:
        """Count frames of every env, or (B,) of each; -1 takes the last one back."""
        self._own["time"] += frames

    def set_time(self, env: int, frame: int) -> None:
        """Set the index of an env's next frame."""
        self._own["time"][env] = frame

    def get_state(self) -> dict[str, Any]:
        """Copies of the arrays."""
        return {name: array.copy() for name, array in self._own.items()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        check_has(state, self._own, type(self).__name__)
        for name, array in self._own.items():
            array[...] = state[name]


class MapAligner:
    """Aligns the frames of B envs with their maps, and keeps the view of the map that it used."""

    def __init__(
        self, states: CameraStates, surfel_map: SurfelMap, motion_mask: MotionMask
    ) -> None:
        self._states = states
        self._map = surfel_map
        self._motion_mask = motion_mask
        self._device_poses = SavedBuffer(surfel_map.batch, wp.mat44, surfel_map.device)
        self._strict = np.ones(surfel_map.batch, dtype=bool)
        self._view: ModelView
        self._view_poses: Float64 | None = None  # of ``_view``; None: the maps have changed since

    def use(self, pipeline: Pipeline) -> None:
        """Process frames with ``pipeline`` from now on."""
        self._tracker = pipeline.tracker
        self._config = pipeline.config
        self.forget_view()

    def forget_view(self) -> None:
        """Render again next time; call it when the maps or their selected surfels have changed."""
        self._view_poses = None

    def render(self, poses: Float64) -> ModelView:
        """Render the maps from ``poses`` (B, 4, 4), unless that view is at hand."""
        if self._view_poses is None or not np.array_equal(self._view_poses, poses):
            self._device_poses.write(poses)
            self._view = self._map.render_model(self._device_poses.array)
            self._view_poses = poses.copy()
        return self._view

    def set_frame(self, live: LiveFrame) -> None:
        """Take the frames that ``align_from`` aligns next."""
        self._tracker.set_frame(live)

    def align_from(
        self, origins: Float64, hypotheses: Float64, thresholds: NDArray[Any]
    ) -> Alignment:
        """Align the current frames with the maps as seen from ``origins`` (B, 4, 4)."""
        return self._align(origins, hypotheses, thresholds, self._states.photometry)

    def align_strictly(self, origins: Float64, hypotheses: Float64) -> Alignment:
        """Align like ``align_from`` under the strict thresholds of a wide search."""
        return self.align_from(origins, hypotheses, self._thresholds(self._strict))

    def _thresholds(self, strict: NDArray[np.bool_]) -> NDArray[Any]:
        """Thresholds (B,) for alignments, ``strict`` (B,) or ordinary."""
        return acceptance_thresholds(self._config.acceptance, strict, self._states.lost)

    def track(self, invalid: NDArray[np.bool_], guesses: Float64 | None) -> Alignment:
        """Align with the views from the last poses; a lost env searches wider at every frame."""
        states = self._states
        lost = states.lost > 0
        hypotheses = tracking_hypotheses(states.motions)
        for env in np.flatnonzero(lost):
            hypotheses[env] = relocalization_hypotheses(int(states.lost[env]) - 1)
        thresholds = self._thresholds(lost)
        alignment = self._align(states.poses, hypotheses, thresholds, states.photometry, guesses)
        alignment = alignment.with_status(invalid, TrackingStatus.BLANK)
        return self._without_color(hypotheses, alignment)

    def refine(self, starts: Float64) -> Alignment:
        """Align with the views from the last poses at the finest level alone.

        ``starts`` (B, 4, 4) are T_model_live.
        """
        states = self._states
        thresholds = self._thresholds(states.lost > 0)
        view = self._view_from(states.poses)
        relaxed = at_usual_noise(thresholds, states.usual)
        return self._tracker.refine(view, states.poses, starts, relaxed, states.photometry)

    def _without_color(self, hypotheses: Float64, alignment: Alignment) -> Alignment:
        """Align the envs whose grey values do not fit by geometry alone, from the nearest poses.

        Lights are switched, cameras glare, and a recording's colour may not be registered with its
        depth. Geometry must then constrain the pose without help, near to where it is expected.
        """
        states = self._states
        failed = states.started & (alignment.status == TrackingStatus.PHOTOMETRIC_MISMATCH)
        if not failed.any():
            return alignment
        near = np.repeat(hypotheses[:, :1], NUM_HYPOTHESES, axis=1)
        near[:, :NUM_FIRST] = hypotheses[:, :NUM_FIRST]
        thresholds = geometric_thresholds(self._config.acceptance, states.lost)
        again = self._align(states.poses, near, thresholds, geometry_only(states.photometry))
        return alignment.replace(failed & again.tracked, again)

    def realign(self, live: LiveFrame, alignment: Alignment, where: NDArray[np.bool_]) -> Alignment:
        """Align the envs ``where`` (B,) again from where they were found, with other images."""
        self._tracker.set_frame(live)
        states = self._states
        starts = np.where(where[:, None, None], alignment.T_model_live, np.eye(4))
        hypotheses = np.repeat(starts[:, None], NUM_HYPOTHESES, axis=1)
        thresholds = self._thresholds(states.lost > 0)
        again = self.align_from(states.poses, hypotheses, thresholds)
        return alignment.replace(where & again.tracked, again)

    def _align(
        self,
        origins: Float64,
        hypotheses: Float64,
        thresholds: NDArray[Any],
        photometry: NDArray[Any],
        guesses: Float64 | None = None,
    ) -> Alignment:
        """Align with the views from ``origins``, judged by the noise that recordings have shown."""
        view = self._view_from(origins)
        relaxed = at_usual_noise(thresholds, self._states.usual)
        return self._tracker.align(view, origins, hypotheses, relaxed, guesses, photometry)

    def _view_from(self, origins: Float64) -> ModelView:
        """The maps' views from ``origins`` (B, 4, 4), without moving things."""
        view = self.render(origins)
        if self._motion_mask.hide(view, origins):
            self.forget_view()  # it is whole no more
        return view


MOSTLY_MOVING = 0.6  # share of the readings: rather the pose is wrong, or too little is left
CLEARLY_APART = 30.0  # squared Mahalanobis distance; below 20 where nothing leads a pose
APART_M, APART_RAD = (0.006, 0.1), np.radians((0.4, 6.0))  # more than noise, less than a jump
QUESTIONED = 0.15  # above the usual cost, from which an alignment is questioned
MENDED = 0.9  # of the cost of an alignment that may have slipped
SURPRISE = 0.1  # metres or radians between a motion and the expected one, likewise,
UNUSUAL = 2.0  # if it is so many times what is usual: some cameras move by leaps
DENIED = 1.25  # of that cost, where features are sure that the pose is elsewhere
FEATURES_ERR = 3.0  # times what the noise of their corners lets expect
AGREED = 1.01  # of that cost, where features are sure of the other
# Of the cost of one that left a direction open, in which it is no judge: of 36 such frames of
# validation seeds for which features led to an alignment it takes 34, 30 nearer, 2 farther.
AS_GOOD = 1.5
LONGEST_DOUBT = 10  # frames in a row that the map may leave uncertain
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
        self._feature_poses: dict[int, tuple[Float64, FeaturePose] | None] = {}  # of the frame

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
        if guesses is not None:
            is_guessed = np.isfinite(guesses[:, :1, :1])
            expected = np.where(is_guessed, guesses, expected)
        self._motion_mask.expect(live, expected, states.started & (states.lost == 0))
        invalid = self.invalid_frames.find(frames, states.started)
        self._feature_poses = {}

        def track() -> Alignment:
            tracked = self._aligner.track(invalid, guesses)
            return self._question(tracked, frames, invalid) if self._config.check_slips else tracked

        alignment = track()
        if self._motion_mask.can_doubt:
            alignment = self._mask_moving(alignment, expected, invalid, track)
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

    def _question(
        self, alignment: Alignment, frames: Images, invalid: NDArray[np.bool_]
    ) -> Alignment:
        """Align anew, at the finest level alone, what fits worse than is usual.

        Coarser levels may lead to a wrong minimum: fine texture that is much the same everywhere,
        such as a carpet's, is gone there, blur and noise leave little of the rest. So the frame is
        aligned from where it was expected, and from where the features of the last one put it,
        without them. Where a direction was left open, the pose along it is the predicted one, and
        a camera that goes where it likes is not there: if the features do not know better, the
        pose may be refused.
        """
        states, poses = self._states, self._states.poses
        asked = states.started & (states.lost == 0) & ~invalid
        cost = alignment.statistics["cost"]
        is_open = asked & (alignment.statistics["degenerate_directions"] > 0)
        slipped = asked & is_leap(states.photometry, alignment.photometry, self._config.cauchy_rgb)
        is_dear = asked & (cost > states.usual["cost"] + QUESTIONED)
        failed = asked & ~alignment.tracked
        surprise = _surprise(alignment.T_model_live, states.motions)
        surprises = asked & (surprise > np.maximum(SURPRISE, UNUSUAL * states.usual["surprise"]))
        questioned = slipped | is_open | is_dear | failed | surprises
        if not questioned.any():
            return alignment
        by_features = np.full_like(poses, np.nan)
        most = np.where(is_open, AS_GOOD, MENDED)
        for env in map(int, np.flatnonzero(questioned)):
            found = self._feature_pose(env, frames)
            if found is not None:
                by_features[env] = found[0]
                if found[1].is_strong:
                    is_denied = _is_denied(alignment, env, *found)
                    most[env] = max(most[env], DENIED if is_denied else AGREED)
        for starts, whose, share in (
            (states.motions, slipped | failed, MENDED),
            (invert(poses) @ by_features, questioned, most),
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
        if env not in self._feature_poses:
            cutoff_m = self._config.depth_cutoff_m
            found = self.last_frames.find(env, *frames.of(env), cutoff_m)
            self._feature_poses[env] = found
        return self._feature_poses[env]

    def _mask_moving(
        self,
        alignment: Alignment,
        expected: Float64,
        invalid: NDArray[np.bool_],
        track: Callable[[], Alignment],
    ) -> Alignment:
        """Look for what moves, align without it, and refuse a pose by which most would move."""
        if self._motion_mask.find(*self._trusted(alignment, expected)).any():
            alignment = track()
        alignment = self._doubt(alignment, expected, invalid, track)
        self._motion_mask.find(*self._trusted(alignment, expected))
        is_most = alignment.tracked & (self._motion_mask.share() > MOSTLY_MOVING)
        return alignment.with_status(is_most, TrackingStatus.GEOMETRIC_MISMATCH)

    def _doubt(
        self,
        alignment: Alignment,
        expected: Float64,
        invalid: NDArray[np.bool_],
        track: Callable[[], Alignment],
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
        again = track()
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
        """Check nearly accepted frames against the map's view from the pose that was found.

        Also check accepted frames that follow uncertain ones: a frame after a wrong pose fits it.
        """
        states, acceptance = self._states, self._config.acceptance
        appealed = self._failed(alignment) & np.isin(alignment.status, DISPUTED)
        for env in np.flatnonzero(appealed).tolist():
            usual = states.usual[env : env + 1]
            appealed[env] = is_nearly_accepted(alignment, env, acceptance, usual)
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
        """Status of a frame after that check; a long series of uncertain frames ends in refusal.

        A frame that the thresholds accept is at worst uncertain.
        """
        status = status_on_appeal(found)
        if not was_refused:
            is_refuted = status == TrackingStatus.PHOTOMETRIC_MISMATCH
            status = TrackingStatus.UNCERTAIN if is_refuted else TrackingStatus.OK
        is_over = status == TrackingStatus.UNCERTAIN and self._states.doubted[env] >= LONGEST_DOUBT
        return TrackingStatus.PHOTOMETRIC_MISMATCH if is_over else status

    def _search_by_features(self, alignment: Alignment, frames: Images) -> Alignment:
        """Align the envs that failed from where features put them.

        A pose supported by many features all over the image is kept as uncertain if the map does
        not confirm it.
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
            farthest = FARTHEST_M, np.radians(FARTHEST_DEG)
            is_near = is_within(origins[env], states.poses[env], *farthest)
            alone[env] = states.lost[env] == 0 and found[int(env)].is_strong and is_near
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
    """Whether (B,) the pose differs from that of a part of the frame by more than its error."""
    is_worse = alignment.statistics["cost"] > again.statistics["cost"]
    for env in np.flatnonzero(is_worse):
        twist = se3_log(invert(again.T_world_live[env]) @ alignment.T_world_live[env])
        distance = twist @ np.linalg.pinv(again.covariance[env]) @ twist
        is_worse[env] = distance > CLEARLY_APART
    return is_worse


def _is_denied(alignment: Alignment, env: int, pose: Float64, found: FeaturePose) -> bool:
    """Whether an env's alignment is farther from where features put it than both err."""
    twist = se3_log(invert(pose) @ alignment.T_world_live[env])
    covariance = FEATURES_ERR**2 * found.covariance + alignment.covariance[env]
    return bool(twist @ np.linalg.pinv(covariance) @ twist > CLEARLY_APART)


def _is_apart(poses: Float64, others: Float64) -> NDArray[np.bool_]:
    """Which poses (B, 4, 4) differ from ``others`` by more than noise and less than a jump."""
    step, turn = _differences(poses, others)
    is_more = (step > APART_M[0]) | (turn > APART_RAD[0])
    return is_more & (step < APART_M[1]) & (turn < APART_RAD[1])


def _differences(
    poses: Float64, others: Float64
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Metres (B,) and radians (B,) between poses (B, 4, 4)."""
    step = np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1)
    # The trace of R_other^T R is the sum of the products of all elements.
    cosine = ((poses[:, :3, :3] * others[:, :3, :3]).sum(axis=(1, 2)) - 1) / 2
    return step, np.arccos(np.clip(cosine, -1, 1))


def _surprise(motions: Float64, expected: Float64) -> NDArray[np.float64]:
    """Difference (B,) of motions (B, 4, 4): the larger of metres and radians."""
    return np.maximum(*_differences(motions, expected))
