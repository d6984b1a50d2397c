"""Films of episodes: as many pictures as asked for, in a file as small as asked for."""

import io
import itertools

import numpy as np
import pytest
from ms_slam_docs import film
from ms_slam_docs.film import Plan, run_script
from PIL import Image, ImageSequence

from ms_slam_env.errors import InputError
from ms_slam_env.planning.occupancy_grid import OccupancyGrid

RNG = np.random.default_rng(0)


def frames_of(data):
    """Pictures (N, H, W, 3) and how long each is shown, milliseconds."""
    frames = [
        (np.asarray(f.convert("RGB")), f.info["duration"])
        for f in ImageSequence.Iterator(Image.open(data))
    ]
    return np.stack([picture for picture, _ in frames]), [ms for _, ms in frames]


@pytest.mark.parametrize(
    ("name", "view", "shape"),
    [("a.webp", "exploration", (131, 240)), ("a.gif", "camera", (90, 240))],
)
def test_a_film_shows_the_start_every_so_many_steps_and_the_end(tmp_path, name, view, shape):
    words = ["--planner", "random", "--env-id", "MSActiveSLAM-FreeCamera-v0", "--scene", "table"]
    words += ["--steps", "5", "--every", "2", "--view", view, "--width", "240"]
    words += ["--options", "image_size=80x60", "--out", str(tmp_path / name)]
    assert run_script(film.Options, film.draw, arguments=words) == 0
    pictures, pauses = frames_of(tmp_path / name)
    assert pictures.shape == (4, *shape, 3)  # 0, 2, 4 and 5
    assert pauses == [150, 150, 150, 2500]
    assert all((a != b).any() for a, b in itertools.pairwise(pictures))


def test_a_film_is_kept_small_by_its_quality(tmp_path):
    pictures = list(RNG.integers(0, 255, (4, 80, 120, 3), dtype=np.uint8))
    large = film.encoded(pictures, film.Options(out=tmp_path / "a.webp"))
    most_kb = len(large) // 1500
    small = film.encoded(pictures, film.Options(out=tmp_path / "a.webp", most_kb=most_kb))
    assert len(small) <= 1000 * most_kb < len(large)
    shown, _ = frames_of(io.BytesIO(small))
    assert np.abs(shown.mean(axis=(1, 2)) - np.mean(pictures, axis=(1, 2))).max() < 5
    with pytest.raises(InputError, match="take fewer steps"):
        film.encoded(20 * pictures, film.Options(out=tmp_path / "a.gif", most_kb=10))


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--out", "a.png"], "a.png is neither .webp nor .gif"), (["--view", "above"], "above")],
)
def test_bad_options_are_one_line(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert run_script(film.Options, film.draw, arguments=words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_the_plan_shows_each_cell_where_it_is():
    grid = OccupancyGrid(cell_m=0.5)
    grid.first = np.array([-4, -6, 0])
    grid.log_odds = RNG.integers(-1, 2, (8, 12, 6)).astype(np.int8)
    box = np.array([[-2, -3, 0], [2, 3, 3.0]])
    for ahead in ([0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]):
        plan = Plan(box, np.array(ahead), 0.0)
        picture = plan.draw(grid)
        cells = np.stack(np.meshgrid(*map(np.arange, (8, 12)), indexing="ij"), -1).reshape(-1, 2)
        across, down = plan.pixels(np.c_[(cells + grid.first[:2] + 0.5) * 0.5, np.zeros(96)]).T
        columns = grid.log_odds[..., :3]  # from 0.3 to 1.5 m
        for (x, y), color in zip(cells, picture[down, across], strict=True):
            state = 2 if (columns[x, y] > 0).any() else int((columns[x, y] < 0).any())
            assert color.tolist() == [[216, 218, 222], [255] * 3, [60, 66, 82]][state]
        assert across.min() > 0
        assert down.min() > 20
        assert across.max() < 319
        assert down.max() < 239
        north = plan.pixels(np.array([[0.0, 0, 0], ahead]))
        assert north[1, 1] < north[0, 1]  # ahead is up
