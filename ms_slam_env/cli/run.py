"""``ms-slam run``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from ms_slam_env._runtime.command_line import for_a_page, parse
from ms_slam_env._runtime.output_files import check_out_file
from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from ms_slam_env.sequences import Sequence as RGBDSequence

_PRINTED = (
    *("frames", "processed_frames", "lost_frames", "uncertain_frames"),
    *("cpu_ms_median", "ext_ms", "ext_ms_p95", "mem_peak_mb", "ene_j"),
    *("path_m", "ate_m", "ate_tracked_m", "tracked_share", "ate_rad", "rpe_m"),
)


@dataclass(frozen=True)
class Arguments:
    """Run a SLAM backend over an RGB-D sequence.

    Layouts: TUM RGB-D, ICL-NUIM, 7-Scenes, 3DMatch, ScanNet, Replica, EuRoC and KITTI odometry
    (depth by stereo matching), ROS bags and MCAP files, or folders depth and rgb with an
    intrinsics.txt of "fx fy cx cy width height [depth_scale] [MODEL k...]", MODEL
    radial-tangential, rational or equidistant. Writes trajectory.txt (TUM), map.ply, metrics.json
    and frames.csv (the cost of each frame).
    """

    sequence: tyro.conf.Positional[str]
    """Folder or bag of a recording, or scene:seed[:word[+word ...]] such as
    living_room:2000:kinect+misregistration."""
    config: Path | None = None
    """Configuration file (YAML): backend, parameters, image size, frame selection and threads."""
    backend: str | None = None
    """SLAM backend; by default that of the configuration file, else surfel."""
    image_size: str | None = None
    """Reduce the images to this size, such as 160x120; 160x120+crop first crops them centrally to
    that aspect ratio, 160x120+crop=480x360 to that size. By default that of the configuration file
    or of the map, else "native": of a rendered sequence 160x120."""
    layout: str = "auto"
    """auto, tum, icl-nuim, 7-scenes, folder, replica, euroc, kitti or bag."""
    intrinsics: str | None = None
    """Intrinsics of the images on disk, in the format of intrinsics.txt; by default those of
    intrinsics.txt in the folder, else the published ones of the dataset."""
    register: bool | None = None
    """Register colour to the depth camera: True, as for an uncalibrated Kinect, or False. By
    default only for 7-scenes and, with their own calibration, for bags and ScanNet."""
    topics: tuple[str, ...] = ()
    """Topics of a bag, as in depth=/camera/depth/image_rect color=/camera/rgb/image_rect
    info=/camera/depth/camera_info pose=/vicon/camera; those left out are found by type and name."""
    params: tuple[str, ...] = ()
    """Parameters of the backend, as in icp_rgb_weight=0.2; they override those of the file."""
    frame_management: str = "none"
    """Frame selection: none (process every frame), regular,every=2, divergence,threshold=0.01,
    budget,share=0.5 and so on. The poses of skipped frames are predicted."""
    map_in: Path | None = None
    """Resume from the map in this file, written by --map-out of another run; the camera is
    relocalised in it. Backend, parameters and image size come from the file; a backend of your own
    (module:Class) must be named again, with --params as before."""
    map_out: Path | None = None
    """Save the map to this file, to resume from with --map-in."""
    mesh: bool = False
    """Also write mesh.ply, a Poisson reconstruction of the map (extra open3d)."""
    core_watts: float = 10.0
    """Watts of a busy core, used to estimate energy from processor time where neither RAPL nor NVML
    can be read; the estimate is reported separately (ene_model_j)."""
    out: Path = Path("results/run")
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Run the backend, write the results and print the measurements."""
    args = parse(Arguments, arguments, "ms-slam run")
    if args.backend is not None:
        from ms_slam_env.slam.registry import POINT

        POINT.find(args.backend)  # report a typo before the slow imports
    from ms_slam_env._runtime.threads import limit_threads
    from ms_slam_env.camera.image_size import ImageSizeError
    from ms_slam_env.config import from_dict, nested_options
    from ms_slam_env.evaluation.run_sequence import lost_throughout
    from ms_slam_env.evaluation.run_to_folder import WRITTEN, run_to_folder
    from ms_slam_env.sequences import open_sequence
    from ms_slam_env.sequences.recording import Topics, parse_calibration
    from ms_slam_env.slam.configuration import (
        SlamConfiguration,
        configuration_of_map,
        merged,
        read_configuration,
    )
    from ms_slam_env.slam.frame_selection import parse_frame_selection

    management = parse_frame_selection(args.frame_management)
    slam = SlamConfiguration(slam=args.backend or "surfel")
    if args.config is not None and args.map_in is not None:
        raise InputError("--config and --map-in both say the backend and its parameters; give one")
    if args.config is not None:
        slam = read_configuration(args.config)
        if args.backend not in (None, slam.slam):
            raise InputError(f"--backend {args.backend} but {args.config} is of {slam.slam}")
    if args.map_in is not None:
        slam = configuration_of_map(args.map_in, args.backend, nested_options(args.params))
    if args.map_out is not None:
        check_out_file(args.map_out)
    given = None
    if args.intrinsics is not None:
        given = parse_calibration(args.intrinsics.replace(",", " ").split(), "--intrinsics")
    try:
        sequence = open_sequence(
            args.sequence,
            args.image_size or slam.image_size,
            every=slam.keep_every,
            layout=args.layout,
            intrinsics=given,
            register=args.register,
            topics=from_dict(Topics, nested_options(args.topics), "topics"),
        )
    except ImageSizeError as error:
        if args.image_size is not None or args.map_in is None:
            raise
        asked = f"{args.map_in} was made at {slam.image_size}, which is kept"
        raise InputError(f"{error} ({asked})") from None
    registration = getattr(sequence.frames, "registration", None)
    if registration is not None:
        print(registration, file=sys.stderr)
    if slam.threads is not None:
        limit_threads(slam.threads)
    params = merged(slam.slam_config, nested_options(args.params))
    fed = {"keep_every": slam.keep_every, "threads": slam.threads}
    _say_what_is_missing(sequence)
    sequence.check_depth()
    with slam.machine():
        result = run_to_folder(
            sequence,
            slam.slam,
            params,
            args.out,
            fed,
            management,
            map_in=args.map_in,
            map_out=args.map_out,
            mesh=args.mesh,
            core_watts=args.core_watts,
        )
    if "poses" in result:
        print(f"{'true poses':16} {result['poses']} of {result['frames']} frames")
    for name in _PRINTED:
        if result.get(name) is not None:
            print(f"{name:16} {result[name]:.4g}")
    if result.get("ene_j") is None and "ene_source" in result:
        print(f"{'ene_j':16} {result['ene_source']}")
        print(f"{'ene_model_j':16} {result['ene_model_j']:.4g} ({result['energy_source']})")
    for reason in result["lost_reasons"]:
        print(f"lost {reason}", file=sys.stderr)
    written = [name for name in WRITTEN if (args.out / name).exists()]
    print(f"written: {args.out}/{', '.join(written)}{for_a_page(args.out)}", file=sys.stderr)
    complaint = lost_throughout(result["processed_frames"], result["lost_frames"])
    if complaint:
        raise RuntimeError(f"sequence {sequence.name}: {complaint}")
    return 0


def _say_what_is_missing(sequence: RGBDSequence) -> None:
    """Warn about missing colour and missing true poses."""
    if not sequence.has_color:
        print("no colour: SLAM has depth alone", file=sys.stderr)
    if sequence.true_trajectory() is None:
        print("no true trajectory: errors are not measured", file=sys.stderr)
    elif not sequence.known.all():
        are = "are" if sequence.known.sum() > 1 else "need two and are not"
        print(f"{sequence.said_known()}; errors {are} measured over these", file=sys.stderr)
