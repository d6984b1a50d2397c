"""The table of sizes and frames by command says what the commands do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ms_slam_env.benchmark.compare import Compare
from ms_slam_env.cli.divergence import Arguments as Divergence
from ms_slam_env.cli.explore import Arguments as Explore
from ms_slam_env.cli.generate import Arguments as Generate
from ms_slam_env.cli.run import Arguments as Run
from ms_slam_env.cli.usme import Make
from ms_slam_env.sequences import HandheldPath, parse_sequence
from ms_slam_env.sequences.naming import RENDERED_SIZE, SequenceName

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sequences.md"


@pytest.fixture(scope="module")
def section() -> str:
    found = re.search(r"^### Sizes and frames by command\n(.*?)^## ", PAGE.read_text(), re.M | re.S)
    assert found
    return found[1]


@pytest.fixture(scope="module")
def rows(section: str) -> dict[str, list[str]]:
    """Cells of each command: sequences, image size, frames."""
    lines = re.findall(r"^\| (`.*) \|$", section, re.M)
    cells = [line.split(" | ") for line in lines]
    return {name: rest for names, *rest in cells for name in re.findall(r"`(.*?)`", names)}


def test_image_sizes_are_the_defaults(rows: dict[str, list[str]]) -> None:
    assert Run("x").image_size is None
    assert Divergence(("x",)).image_size == "native"
    for command in ("run", "divergence"):
        assert rows[command][1].startswith(f"of a recording its own, rendered {RENDERED_SIZE}")
    compare = Compare()
    assert rows["compare"][1] == " and ".join(compare.image_sizes)
    for command, size in (
        ("explore", Explore().image_size),
        ("generate", Generate().image_size),
        ("usme make", Make().image_size),
    ):
        assert rows[command][1].startswith(size)


def test_frames_and_sequences_are_the_defaults(rows: dict[str, list[str]]) -> None:
    frames = {
        "run": HandheldPath().frames,
        "divergence": HandheldPath().frames,
        "compare": Compare().frames,
        "explore": Explore().frames,
        "generate": Generate().path.frames,
    }
    assert {name: int(rows[name][2]) for name in frames} == frames
    assert rows["compare"][0] == f"{len(Compare().sequences)} rendered, seed 2000"
    assert {text.split(":")[1] for text in Compare().sequences} == {"2000"}
    seeds = sorted(text.split(":")[1] for text in Explore().sequences)
    assert rows["explore"][0] == f"{len(seeds)} rendered, seeds {seeds[0]} to {seeds[-1]}"


def test_the_path_is_one_and_the_command_of_the_page_is_that_of_compare(section: str) -> None:
    compare, explore, path = Compare(), Explore(), HandheldPath()
    said = re.search(r"hand-held, at ([\d.]+) m/s and (\d+) degrees/s", section)
    assert said
    speeds = float(said[1]), float(said[2])
    for one in (compare, explore, path, Generate().path):
        assert (one.speed_m_s, one.turn_deg_s) == speeds
    command = re.search(r"`ms-slam run (\S+) --image-size\s(\S+)`", section)
    assert command
    named = parse_sequence(command[1])
    assert isinstance(named, SequenceName)
    spec = next(s for s in compare.specs() if s.sequence == "living_room:2000")
    assert spec.image_size == command[2]
    assert named.camera_path(HandheldPath()) == spec.path
