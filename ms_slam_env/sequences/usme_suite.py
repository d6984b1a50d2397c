"""The eight sequences of USME: scene, path, perturbations, sensor.

Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation Positioning and
Timing 2021, section 3, describes them in words; the cells of its Table 2, including the numbers of
frames, are missing from the text available to us. The description: residential street and city
street outdoors, factory hall and room indoors; two similar long residential sequences, one without
a loop and one that closes a single large loop at its end; a residential one with three loops and
the same with motion blur; moving objects in the hall and in the city street, which has no loop;
fast motion and rotation; black frames inserted into one of the fast sequences. We take the fast
ones to be those of the room, with its bare walls and changing light. USME's scenes come from a game
engine and its depth is exact; ours are procedural and smaller, with noisy depth.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_slam_env import __version__, scenes
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import read_json
from ms_slam_env.camera import xtion
from ms_slam_env.config import parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.scenes import Scene
from ms_slam_env.sequences import HandheldPath, RoutePath
from ms_slam_env.sequences.writing import DESCRIPTION, write_sequence

if TYPE_CHECKING:
    from ms_slam_env.sequences import Perturbation, RenderedSequence


_OUTDOORS = {"rate_hz": 15.0, "speed_m_s": 1.4, "turn_deg_s": 25.0}
_AROUND = ("SW-S", "S", "SE", "E", "NE", "N", "NW", "W")

_HAND = HandheldPath(frames=900)
_FAST = "fast-motion,factor=4,share=0.5,length_s=1.5"
_LIGHT = "illumination,dim=0.4,period_s=8"


@dataclass(frozen=True)
class UsmeSequence:
    """One of the eight sequences.

    Attributes:
        name: name of its folder.
        scene: name of the scene.
        path: camera path.
        noise: noise model of the sensor.
        perturbations: ``NAME,option=value,...``.
        loops: number of times the path returns to an earlier place; None if it only wanders. With
            0, no frame shows again what was out of sight (`find_revisits`).
        about: description.
    """

    name: str
    scene: str
    path: RoutePath | HandheldPath
    noise: str
    about: str
    perturbations: tuple[str, ...] = ()
    loops: int | None = 0

    def motion(self, scene: Scene, seed: int, frames_scale: float = 1.0) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4).

        With ``frames_scale`` below 1 the same path takes fewer frames, so the camera moves faster.
        """
        if isinstance(self.path, RoutePath):
            return self.path.with_frames_scaled(frames_scale).motion(scene, seed)
        path = self.path
        scaled = replace(
            path,
            frames=max(2, round(path.frames * frames_scale)),
            speed_m_s=path.speed_m_s / frames_scale,
            turn_deg_s=path.turn_deg_s / frames_scale,
            max_step_m=min(10.0, path.max_step_m / frames_scale),
            max_turn_deg=min(180.0, path.max_turn_deg / frames_scale),
        )
        return scaled.timestamps, scaled.poses(scene, seed)

    def made_perturbations(self, frames_scale: float = 1.0) -> list[Perturbation]:
        """The perturbations, with frame numbers scaled."""
        from ms_slam_env.sequences import make_perturbation

        made = []
        for text in self.perturbations:
            name, options = parse_named(text, "perturbation")
            if name == "black-frames":
                for option in ("start", "length"):
                    options[option] = max(1, round(options[option] * frames_scale))
            made.append(make_perturbation(name, options))
        return made


SUITE: tuple[UsmeSequence, ...] = (
    UsmeSequence(
        "residential-no-loop",
        "residential_street",
        RoutePath((*_AROUND, "W-SW"), **_OUTDOORS),
        "range",
        "long way along residential streets that sees no place twice",
    ),
    UsmeSequence(
        "residential-one-loop",
        "residential_street",
        RoutePath((*_AROUND, "SW", "S"), **_OUTDOORS),
        "range",
        "the same way, but going on until it closes one large loop at its end",
        loops=1,
    ),
    UsmeSequence(
        "residential-three-loops",
        "residential_street",
        RoutePath(
            ("W-C", "C", "E", "NE", "N", "NW", "W", "C", "S", "SW", "W", "C", "N", "N-NW"),
            **_OUTDOORS,
        ),
        "range",
        "three loops around residential blocks",
        loops=3,
    ),
    UsmeSequence(
        "residential-three-loops-blur",
        "residential_street",
        RoutePath(
            ("W-C", "C", "E", "NE", "N", "NW", "W", "C", "S", "SW", "W", "C", "N", "N-NW"),
            **_OUTDOORS,
        ),
        "range",
        "the same three loops with motion blur",
        ("motion-blur,exposure_s=0.04,samples=4",),
        loops=3,
    ),
    UsmeSequence(
        "city-traffic",
        "city_street",
        RoutePath(("SW", "NW", "N", "S", "SE", "NE"), **_OUTDOORS),
        "range",
        "city streets without a loop, cars and people on the move",
        (
            "moving-objects,kind=car,count=3,speed_m_s=5",
            "moving-objects,kind=person,count=5,speed_m_s=1.2",
        ),
    ),
    UsmeSequence(
        "factory-moving",
        "factory_hall",
        RoutePath(("A-B", "B", "F", "E", "D", "C", "H", "G"), height_m=1.4, **_OUTDOORS),
        "range",
        "factory hall with rows of like racks, boxes and people on the move",
        (
            "moving-objects,kind=box,count=5,speed_m_s=0.8",
            "moving-objects,kind=person,count=3,speed_m_s=1.2",
        ),
        loops=None,
    ),
    UsmeSequence(
        "room-fast",
        "living_room",
        _HAND,
        "kinect",
        "a room with stretches of fast motion and rotation, and changing light",
        (_FAST, _LIGHT),
        loops=None,
    ),
    UsmeSequence(
        "room-fast-black",
        "living_room",
        _HAND,
        "kinect",
        "the same with a run of black frames",
        (_FAST, _LIGHT, "black-frames,start=250,length=20"),
        loops=None,
    ),
)
"""The sequences in the order of the paper's section 3."""


NAMES = tuple(entry.name for entry in SUITE)


def find(name: str) -> UsmeSequence:
    """Find a sequence by name.

    Raises:
        InputError: there is none.
    """
    known = {entry.name: entry for entry in SUITE}
    if name not in known:
        raise unknown("USME sequence", name, known)
    return known[name]


def render(
    entry: UsmeSequence, scene: Scene, image_size: str = "160x120", frames_scale: float = 1.0
) -> RenderedSequence:
    """Render a sequence, frame by frame on request.

    ``scene`` is ``scenes.make(entry.scene, seed)``; its seed is also that of the path, the noise
    and the perturbations.

    Raises:
        InputError: an unknown size, or no free path.
    """
    from ms_slam_env.sequences import render_sequence

    intrinsics, seed = xtion(image_size), scene.seed
    times, poses = entry.motion(scene, seed, frames_scale)
    return render_sequence(
        scene,
        poses,
        intrinsics,
        entry.noise,
        seed,
        entry.name,
        perturbations=entry.made_perturbations(frames_scale),
        timestamps=times,
    )


def describe(
    name: str,
    image_size: str = "160x120",
    seed: int = 2000,
    frames_scale: float = 1.0,
    with_truth: bool = False,
) -> dict[str, Any]:
    """Describe how a sequence is made, for its folder."""
    return {
        "version": __version__,
        "suite": "usme",
        "sequence": asdict(find(name)),
        "image_size": image_size,
        "seed": seed,
        "frames_scale": frames_scale,
        **({"truth": True} if with_truth else {}),
    }


_OPTIONS: Mapping[str, Any] = {"image_size": str, "seed": int, "frames_scale": (int, float)}


def make_suite(
    out: Path,
    names: Iterable[str] = NAMES,
    image_size: str = "160x120",
    seed: int = 2000,
    frames_scale: float = 1.0,
    with_truth: bool = False,
) -> list[Path]:
    """Write sequences into folders of ``out``; resume an interrupted call.

    Raises:
        InputError: an unknown name or size, or a folder that holds something else.
    """
    made: dict[str, Scene] = {}
    folders = []
    for name in names:
        entry = find(name)
        if entry.scene not in made:
            made = {entry.scene: scenes.make(entry.scene, seed)}  # one at a time: it is large
        sequence = render(entry, made[entry.scene], image_size, frames_scale)
        about = describe(name, image_size, seed, frames_scale, with_truth)
        write_sequence(sequence, out / name, about, with_truth)
        folders.append(out / name)
    return folders


def made_with(folder: Path) -> dict[str, Any]:
    """The ``image_size``, ``seed`` and ``frames_scale`` that a sequence's folder was made with.

    Raises:
        InputError: the folder holds none, or one of another suite or version.
    """
    file = folder / DESCRIPTION
    if not file.is_file():
        raise InputError(f"{folder} holds no finished sequence; ms-slam usme make writes it")
    found = read_json(file, "description")
    named = found if isinstance(found, dict) else {}
    options: dict[str, Any] = {name: named.get(name) for name in _OPTIONS}
    if not all(isinstance(options.get(name), kinds) for name, kinds in _OPTIONS.items()):
        raise InputError(f"{file} describes no sequence")
    for name, value in json.loads(json.dumps(describe(folder.name, **options))).items():
        if found.get(name) != value:
            raise InputError(f"{folder} was made with another {name}, see its {DESCRIPTION}")
    return options
