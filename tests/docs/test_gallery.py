"""Every environment has its film, none is larger than a page should load."""

from __future__ import annotations

from pathlib import Path

import pytest
from ms_slam_docs.film import SHOWN_IDS
from PIL import Image

from ms_slam_env import ENV_IDS

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"
FILMS = sorted((PICTURES / "environments").glob("*"))


@pytest.mark.parametrize("path", FILMS, ids=lambda path: path.stem)
def test_a_film_moves_and_is_small(path: Path) -> None:
    assert path.stem in SHOWN_IDS
    assert path.stat().st_size <= 200_000
    assert Image.open(path).n_frames > 7


def test_every_environment_is_filmed() -> None:
    assert {path.stem for path in FILMS} >= set(ENV_IDS)


def test_the_picture_on_top_of_the_readme_is_small() -> None:
    path = PICTURES / "home.webp"
    assert path.stat().st_size <= 600_000
    assert Image.open(path).n_frames > 50
