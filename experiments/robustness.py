"""How often SLAM succeeds over sequences, image sizes and changes that should not matter."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.threads import limit_threads
from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.camera import RGBDFrame, parse_image_size
from ms_slam_env.camera.image_size import NATIVE
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.consistency import COVERAGES
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Row, Table, finished, grouped, make_table, summary
from ms_slam_env.sequences import check_sequence
from ms_slam_env.sequences.sequence import Frames
from ms_slam_env.sequences.sequence import Sequence as Recording
from ms_slam_env.slam.slam_backend import TrackResult

MOST_LOST = 0.05
"""Share of the frames that a successful run may lose."""
WORSE = 2.0
"""Largest error of a successful run, as a multiple of the sequence's best median error."""
FINE_M = 0.01
"""Error of a run that succeeds in any case: less than a Kinect's depth noise at 3 m."""
_SIGMAS = 3.0  # an error of more standard deviations contradicts the covariance
_ONE_IN = 1_000_000  # pixels
_UNIT_M = 0.001  # unit of depth in the images of most recordings
_LARGEST = "640x480"  # the native size of rendered sequences
USME = "usme:"
"""Prefix of one of the eight USME sequences and a seed, as in usme:city-traffic:2000."""

ROOMS = ("living_room", "corridor", "table", "window", "wall", "carpet")
PERTURBED = (
    *("rolling-shutter", "misregistration", "motion-blur", "auto-exposure", "depth-dropout"),
    *("depth-quantisation", "illumination"),
    "moving-objects,kind=box,count=1",
    "moving-objects,kind=box,count=2",
)
PERSON = "moving-objects,kind=person,count=1"
_SEED_OF_PERSON = 1  # added: the person stays out of view in rooms 1000 and 2000


def default_sequences(seed: int) -> tuple[str, ...]:
    """Rooms, a room with each perturbation, and the USME sequences, for one seed."""
    from ms_slam_env.sequences.usme_suite import NAMES

    rooms = [f"{scene}:{seed}" for scene in ROOMS]
    perturbed = [f"living_room:{seed}:kinect+{words}" for words in PERTURBED]
    perturbed.append(f"living_room:{seed + _SEED_OF_PERSON}:kinect+{PERSON}")
    return (*rooms, *perturbed, *(f"{USME}{name}:{seed}" for name in NAMES))


class ChangedFrames(Frames):
    """A selection of another sequence's frames, each changed.

    Args:
        frames: original frames.
        indices: (M,) indices of the selected frames, in order.
        times: (M,) their new times, seconds.
        change: function of a frame and its number in the selection.
    """

    def __init__(
        self,
        frames: Sequence[RGBDFrame],
        indices: Sequence[int],
        times: Float64,
        change: Callable[[RGBDFrame, int], RGBDFrame],
    ) -> None:
        self._frames, self._indices, self._times = frames, indices, times
        self._change = change

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._indices)

    def frame(self, index: int) -> RGBDFrame:
        """Take a frame and change it."""
        taken = replace(self._frames[self._indices[index]], timestamp=float(self._times[index]))
        return self._change(taken, index)


def _same(frame: RGBDFrame, index: int) -> RGBDFrame:
    return frame


def _brighter(frame: RGBDFrame, index: int) -> RGBDFrame:
    return replace(frame, color=np.minimum(frame.color, 254) + np.uint8(1))


def _one_column_less(frame: RGBDFrame, index: int) -> RGBDFrame:
    return replace(
        frame,
        color=np.ascontiguousarray(frame.color[:, :-1]),
        depth=np.ascontiguousarray(frame.depth[:, :-1]),
    )


def _one_unit_of_depth(frame: RGBDFrame, index: int) -> RGBDFrame:
    """Add a millimetre to one pixel in a million, and to one pixel of the second frame."""
    is_moved = np.random.default_rng([index, 7]).random(frame.depth.shape) < 1.0 / _ONE_IN
    if index == 1:
        is_moved.flat[np.flatnonzero(frame.depth)[: 1 if frame.depth.any() else 0]] = True
    depth = frame.depth.copy()
    depth[is_moved & (depth > 0)] += np.float32(_UNIT_M)
    return replace(frame, depth=depth)


def _changed(
    given: Recording,
    indices: Sequence[int] | None = None,
    change: Callable[[RGBDFrame, int], RGBDFrame] = _same,
    width: int = 0,
    mirrored: bool = False,
) -> Recording:
    indices = range(len(given)) if indices is None else indices
    times = given.timestamps
    chosen = times[indices]
    frames = ChangedFrames(
        given.frames, indices, times[0] + times[-1] - chosen if mirrored else chosen, change
    )
    K = replace(given.intrinsics, width=given.intrinsics.width + width)
    return Recording(frames, given.poses[list(indices)], K, given.name)


VARIATIONS: dict[str, Callable[[Recording], Recording]] = {
    "none": _changed,
    "depth-unit": lambda given: _changed(given, change=_one_unit_of_depth),
    "first-dropped": lambda given: _changed(given, range(1, len(given))),
    "five-dropped": lambda given: _changed(given, range(5, len(given))),
    "column-cropped": lambda given: _changed(given, change=_one_column_less, width=-1),
    "brighter": lambda given: _changed(given, change=_brighter),
    "reversed": lambda given: _changed(given, range(len(given) - 1, -1, -1), mirrored=True),
}
"""Name to change of a sequence that makes it no harder."""


@dataclass(frozen=True)
class RobustnessSpec:
    """A run; see :class:`Robustness` for the fields."""

    sequence: str
    source: str
    layout: str
    image_size: str
    variation: str
    backend: str
    frames: int

    def opened(self) -> Recording:
        """The changed sequence."""
        from ms_slam_env import scenes
        from ms_slam_env.sequences import HandheldPath, open_sequence, usme_suite

        if self.source.startswith(USME):
            name, seed = _usme(self.source)
            entry = usme_suite.find(name)
            size = _LARGEST if self.image_size == NATIVE else self.image_size
            given: Recording = usme_suite.render(entry, scenes.make(entry.scene, seed), size)
        else:
            path = HandheldPath(self.frames)
            size = self.image_size
            if self.layout:  # a recording may have another aspect ratio
                size = size if size == NATIVE else f"{size}+crop"
            elif size == NATIVE:
                size = _LARGEST
            given = open_sequence(
                self.source, size, path=path, with_truth=True, layout=self.layout or "auto"
            )
        return VARIATIONS[self.variation](given)


@dataclass(frozen=True)
class Robustness(Experiment, Checked):
    """How often SLAM succeeds when nothing that matters changes

    Every backend runs over every sequence at every image size, unchanged and with small changes
    that make it no harder: one depth pixel in a million 1 mm farther, the first frame or the first
    five left out, a column cropped, one grey level brighter, reversed in time. A run succeeds if it
    loses at most 5 % of the frames and its error is at most twice the best median error of the
    sequence over sizes and backends, or at most 1 cm: small images err by more than large ones
    where both are right. SLAM reveals a failed run if it lost more frames, or if its
    covariance explains the error.
    The covariance is judged, too: by the shares of errors within the ellipsoids that promise 50, 90
    and 95 %, and by the share of frames that are wrong without a sign of it.
    """

    sequences: tuple[str, ...] = ()
    """scene:seed[:word[+word ...]] or usme:NAME:seed; by default rooms, a room with each
    perturbation, and the USME sequences, of ``seeds``."""
    seeds: tuple[int, ...] = (1000, 2000)
    """Seeds of the default sequences: those below 2000 are for tuning, others for judging."""
    recordings: tuple[str, ...] = ()
    """NAME=FOLDER, or NAME=LAYOUT:FOLDER if the layout cannot be detected, as in
    hololens=folder:data/hololens."""
    image_sizes: tuple[str, ...] = (
        *("100x75", "128x96", "160x120", "213x160", "240x180", "320x240"),
        NATIVE,
    )
    """Image sizes such as 160x120; recordings with another aspect ratio are cropped."""
    variations: tuple[str, ...] = tuple(VARIATIONS)
    """Changes of a sequence that make it no harder."""
    backends: tuple[str, ...] = ("surfel",)
    """NAME, parameters appended as in surfel,check_slips=true."""
    frames: int = bounded(150, 10, 100_000)
    """Number of frames of a rendered sequence, except USME's."""

    tracks = True

    def __post_init__(self) -> None:
        """Refuse settings that no run could use."""
        super().__post_init__()
        check_each("variation", self.variations, VARIATIONS)
        for size in self.image_sizes:
            parse_image_size(size)
        if not self.image_sizes or not self.backends:
            raise InputError("image_sizes and backends need one value each at least")
        for text in self.backends:
            slam.check_parameters(*parse_named(text, "backend"))
        for _, text, layout in self.sources():
            if not layout:
                check: Callable[[str], object] = _usme if text.startswith(USME) else check_sequence
                check(text)

    def sources(self) -> list[tuple[str, str, str]]:
        """Name, source and layout of every sequence; the layout is empty for rendered ones."""
        rendered = self.sequences
        if not rendered and not self.recordings:
            rendered = tuple(name for seed in self.seeds for name in default_sequences(seed))
        return [*((text, text, "") for text in rendered), *map(_recording, self.recordings)]

    def specs(self) -> list[RobustnessSpec]:
        """Every run."""
        return [
            RobustnessSpec(name, source, layout, size, variation, backend, self.frames)
            for name, source, layout in self.sources()
            for size in self.image_sizes
            for variation in self.variations
            for backend in self.backends
        ]

    @staticmethod
    def run(spec: RobustnessSpec) -> dict[str, Any]:
        """Track the changed sequence from its true first pose."""
        from ms_slam_env.evaluation.run_sequence import run_backend

        limit_threads(1)
        given = spec.opened()
        run = run_backend(spec.backend, given)
        ate = metrics.ate_statistics(run.estimates, given.poses)
        said = [_in_world(one) for one in run.results]
        return {
            "frames": len(run),
            "path_m": metrics.path_length(given.poses),
            "lost_share": run.lost,
            "uncertain_frames": run.uncertain_frames,
            "ate_m": ate.rmse,
            "ate_max_m": ate.max,
            **metrics.tracked_errors(run.estimates, given.poses, run.tracking_ok),
            "position_sigma_m": position_sigma(said),
            **consistency(run.results, given.poses),
            "cpu_ms_median": float(np.median(run.cpu_ms)),
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Shares of success by backend, then by sequence, size and change."""
        lines = judged(rows)
        tables = [_shares(lines, ("backend", "part"), "")]
        for field in ("sequence", "image_size", "variation"):
            tables.append(_shares(lines, ("backend", field), f"By {field.replace('_', ' ')}"))
        told = [line for line in lines if line.get("silent_share") is not None]
        if told:
            tables.append(_covariance(told, ("backend", "part"), "Covariance"))
            by = ("backend", "part", "sequence")
            tables.append(_covariance(told, by, "Covariance by sequence"))
        failed = [line for line in lines if not line["succeeded"]]
        shown = ("backend", "sequence", "image_size", "variation", "lost_share", "ate_m", "told")
        return [*tables, make_table(shown, failed, "Runs that failed")]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Share of runs that succeed at each image size, a line per backend."""
        lines = judged(rows)
        series = []
        for backend in dict.fromkeys(line["backend"] for line in lines):
            own = [line for line in lines if line["backend"] == backend]
            groups = {
                size: [x for x in own if x["image_size"] == size] for size in self.image_sizes
            }
            shares = {size: summary(x, "succeeded").value for size, x in groups.items() if x}
            series.append(Series(backend, list(shares), list(shares.values())))
        panel = Panel("", "succeeded", series)
        return [Chart("robustness", "Success by image size", "Share of the runs.", [panel])]


def _recording(text: str) -> tuple[str, str, str]:
    """Name, folder and layout of NAME=FOLDER or NAME=LAYOUT:FOLDER."""
    name, sign, place = text.partition("=")
    if not (name and sign and place):
        raise InputError(f"recording {text!r} is not NAME=FOLDER or NAME=LAYOUT:FOLDER")
    layout, colon, folder = place.partition(":")
    if not colon or Path(place).exists():
        return name, place, "auto"
    return name, folder, layout


def _usme(text: str) -> tuple[str, int]:
    """Name and seed of usme:NAME:SEED.

    Raises:
        InputError: malformed text, or unknown sequence; the message lists the valid choices.
    """
    from ms_slam_env.sequences.usme_suite import find

    name, _, seed = text.removeprefix(USME).rpartition(":")
    if not seed.isdecimal():
        raise InputError(f"sequence {text!r} is not usme:NAME:SEED, as in usme:city-traffic:2000")
    return find(name).name, int(seed)


def position_sigma(covariances: Iterable[Float64 | None]) -> float | None:
    """RMS over frames of the predicted standard deviation of the position, m; None if unknown."""
    said = [np.trace(one[:3, :3]) for one in covariances if one is not None]
    return float(np.sqrt(np.mean(said))) if said else None


def _in_world(result: TrackResult) -> Float64 | None:
    """Covariance (6, 6) of a pose in the world of the first, as far as the backend knows it."""
    if result.covariance is None or result.drift is None:
        return result.covariance
    return result.covariance + result.drift


def consistency(results: Sequence[TrackResult], truth: Float64) -> dict[str, float]:
    """How well covariances explain errors; empty for a backend that computes none.

    Motions are those between two frames, one after the other, in the first submap, without a jump;
    poses are compared in the world of the first, which is true.

    Args:
        results: of N frames.
        truth: T_world_camera (N, 4, 4).
    """
    said = [_in_world(one) for one in results]
    known = np.array([one is not None for one in said])
    if not known.any():
        return {}
    poses = np.array([one.T_world_camera for one in results])
    C, in_world = (
        np.array([np.zeros((6, 6)) if one is None else one for one in each])
        for each in ([one.covariance for one in results], said)
    )
    jumps = [one.relocalised or one.loop_closed or one.submaps_joined for one in results]
    first_submap = known & np.array([one.submap == 0 for one in results])
    second = np.flatnonzero(first_submap[1:] & first_submap[:-1] & ~np.array(jumps)[1:]) + 1
    doubted = np.array([one.uncertain for one in results])[known]
    silent = metrics.silently_wrong(poses[known], truth[known], in_world[known]) & ~doubted
    errors = {
        "motion": metrics.motion_twists(poses, truth, C, second - 1, second),
        "pose": (metrics.pose_twists(poses[known], truth[known]), in_world[known]),
    }
    found: dict[str, float] = {"silent_share": float(silent.mean())}
    for name, (twists, covariances) in errors.items():
        if not len(twists):
            continue
        squared = metrics.nees(twists, covariances)
        found[f"{name}_nees"] = float(squared.mean()) / twists.shape[1]
        shares = metrics.covariance_coverage(squared)
        found |= {f"{name}_{key}": share for key, share in shares.items()}
    return found


def judged(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Every finished run with whether it succeeded, and whether SLAM revealed a failure."""
    lines = [{**row["spec"], **row["result"]} for row in finished(rows)]
    cells: dict[tuple[str, ...], list[float]] = {}
    for line in lines:
        key = tuple(line[name] for name in ("sequence", "image_size", "backend"))
        cells.setdefault(key, []).append(line["ate_m"])
    best: dict[str, float] = {}
    for (sequence, *_), errors in cells.items():
        best[sequence] = min(best.get(sequence, np.inf), float(np.median(errors)))
    for line in lines:
        is_kept = line["lost_share"] <= MOST_LOST
        line["near_best"] = is_kept and line["ate_m"] <= WORSE * best[line["sequence"]]
        line["succeeded"] = line["near_best"] or (is_kept and line["ate_m"] <= FINE_M)
        sigma = line["position_sigma_m"]
        explained = sigma is not None and line["ate_m"] <= _SIGMAS * sigma
        line["told"] = None if line["succeeded"] else line["lost_share"] > MOST_LOST or explained
        line["part"] = part_of(line["source"])
    return lines


def part_of(source: str) -> str:
    """Part that a sequence belongs to: options are chosen only on ``tuning`` sequences."""
    seeds = [word for word in source.split(":")[1:] if word.isdecimal()]
    return "tuning" if seeds and int(seeds[0]) < 2000 else "judging"


def _covariance(lines: Sequence[Mapping[str, Any]], by: Sequence[str], title: str) -> Table:
    """How well covariances explain errors, for lines with the same ``by``."""
    keys = [f"{name}_{key}" for name in ("motion", "pose") for key in ("nees", *COVERAGES)]
    made = [
        {
            **dict(zip(by, group, strict=True)),
            "runs_counted": len(own),
            **{key: summary(own, key) for key in keys if key.endswith("nees")},
            **{key: _mean(own, key) for key in (*keys, "silent_share") if "nees" not in key},
            "silent_share_worst": max(line["silent_share"] for line in own),
        }
        for group, own in _grouped(lines, by).items()
    ]
    note = (
        "A right covariance has NEES of 1, and 50, 90 and 95 % within the ellipsoids that promise "
        "it. Motions are those from frame to frame, poses those in the world of the first, with "
        "the drift of the map. Medians of NEES over the runs, means of shares."
    )
    columns = (*by, "runs_counted", *keys, "silent_share", "silent_share_worst")
    return make_table(columns, made, title, note)


def _grouped(
    lines: Sequence[Mapping[str, Any]], by: Sequence[str]
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """The lines by the values of their fields ``by``."""
    return grouped(({"spec": line, "result": line, "error": None} for line in lines), by)


def _mean(lines: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Mean of a value over the runs that have it."""
    values = [line[key] for line in lines if line.get(key) is not None]
    return float(np.mean(values)) if values else None


_SUMMARIES = ("succeeded", "near_best", "ate_m", "lost_share")


def _shares(lines: Sequence[Mapping[str, Any]], by: Sequence[str], title: str) -> Table:
    """Shares of success, medians and the worst run, for lines with the same ``by``."""
    made = [
        {
            **dict(zip(by, group, strict=True)),
            "runs_counted": len(own),
            **{key: summary(own, key) for key in _SUMMARIES},
            "worst_ate_m": max(line["ate_m"] for line in own),
            "lost_share_worst": max(line["lost_share"] for line in own),
            "told": summary([x for x in own if not x["succeeded"]], "told"),
            "cpu_ms_median": summary(own, "cpu_ms_median"),
        }
        for group, own in _grouped(lines, by).items()
    ]
    columns = (
        *by,
        "runs_counted",
        "succeeded",
        "near_best",
        "ate_m",
        "worst_ate_m",
        "lost_share",
        "lost_share_worst",
    )
    return make_table((*columns, "told", "cpu_ms_median"), made, title)
