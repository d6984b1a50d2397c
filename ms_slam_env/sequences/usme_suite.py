"""The eight sequences of USME, declared: scene, way, perturbations, sensor.

Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation Positioning and
Timing 2021, section 3, says in words what they are; the cells of its Table 2, and the numbers of
frames with them, are missing from the text that we have. From the words: residential street and
city street outdoors, factory hall and room indoors; two like long residential sequences, one
without loop and one that closes a single large loop at its end; a residential one with three loops
and the same with motion blur; moving objects in the hall and in the city street, which has no loop;
fast motion and rotation; black frames put into one of the fast sequences. That the fast ones are
those of the room, with its bare walls and changing light, is our reading. USME's scenes are
those of a game engine, its depth is exact; ours are procedural and smaller, the depth is noisy.
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
    """One of the sequences.

    Attributes:
        name: of its folder.
        scene: where.
        path: the camera's way.
        noise: of the sensor.
        perturbations: ``NAME,option=value,...``.
        loops: how often the path comes back to where it was; None where it just wanders.
        about: in words.
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

        With ``frames_scale`` below 1 the same way takes fewer frames, so the camera moves faster.
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
        """The perturbations; those that name frames name them at this scale."""
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
        RoutePath((*_AROUND, "C", "C-S"), **_OUTDOORS),
        "range",
        "long way along residential streets that never comes back",
    ),
    UsmeSequence(
        "residential-one-loop",
        "residential_street",
        RoutePath((*_AROUND, "SW", "S"), **_OUTDOORS),
        "range",
        "the same way, but closing one large loop at its end",
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
"""In the order of the paper's section 3."""


NAMES = tuple(entry.name for entry in SUITE)


def find(name: str) -> UsmeSequence:
    """The sequence of that name.

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
    """The frames of a sequence, rendered when they are asked for.

    ``scene`` is ``scenes.make(entry.scene, seed)``; its seed is that of the way, the noise and the
    perturbations too.

    Raises:
        InputError: an unknown size, or no free way.
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
    """What makes a sequence, for its folder."""
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
    """Write sequences into folders of ``out``; go on where an interrupted call stopped.

    Raises:
        InputError: an unknown name or size, or a folder that holds something else.
    """
    made: dict[str, Scene] = {}
    folders = []
    for name in names:
        entry = find(name)
        if entry.scene not in made:
            made = {entry.scene: scenes.make(entry.scene, seed)}  # one is large enough
        sequence = render(entry, made[entry.scene], image_size, frames_scale)
        about = describe(name, image_size, seed, frames_scale, with_truth)
        write_sequence(sequence, out / name, about, with_truth)
        folders.append(out / name)
    return folders


def made_with(folder: Path) -> dict[str, Any]:
    """The ``image_size``, ``seed`` and ``frames_scale`` that a sequence's folder was made with.

    Raises:
        InputError: it holds none, or one of another suite or version.
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
