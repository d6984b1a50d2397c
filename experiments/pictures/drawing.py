"""What the hand-drawn pictures share: a command each, titled rows of images, a PNG file."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ms_slam_env._runtime.arrays import Image
from ms_slam_env._runtime.command_line import exit_code, parse
from ms_slam_env._runtime.output_files import check_out_file, write_bytes

BORDER, TITLE = 4, 18  # pixels


def run_script(
    options: type[Any],
    draw: Callable[[Any], Image | str],
    arguments: Sequence[str] | None = None,
    check_out: Callable[[Path], None] = check_out_file,
) -> int:
    """Draw by the command line of dataclass ``options``; return the exit code.

    ``draw`` returns an RGB picture, which is written to the PNG file ``out`` of the options, or has
    written ``out`` and returns a line to print.
    """
    name = f"python -m ms_slam_experiments.pictures.{Path(inspect.getfile(options)).stem}"

    def run() -> int:
        args: Any = parse(options, arguments, name, check_out)
        drawn = draw(args)
        if isinstance(drawn, str):
            print(f"{args.out}: {drawn}")
        else:
            save_image(args.out, drawn, compression=9)
        return 0

    return exit_code(run, name)


def save_image(path: Path, image: Image, compression: int = 1) -> Path:
    """Write an RGB image (H, W, 3) as PNG, whole or not at all."""
    _, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, compression])
    write_bytes(path, data.tobytes())
    return path


def titled_row(images: Iterable[Image], title: str) -> Image:
    """RGB images of one height side by side, framed in white, below a title."""
    framed = [
        cv2.copyMakeBorder(i, 0, BORDER, 0, BORDER, cv2.BORDER_CONSTANT, value=(255,) * 3)
        for i in images
    ]
    strip = np.concatenate(framed, 1)
    head = np.full((TITLE, strip.shape[1], 3), 255, np.uint8)
    at = (2, TITLE - 5)
    cv2.putText(head, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
    return np.concatenate([head, strip], 0)


def shrunk(image: Image, width: int) -> Image:
    """An image of 4:3 at another width."""
    size = (width, 3 * width // 4)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
