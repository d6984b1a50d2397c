"""Numbers that no place has: refused where they are read, before they overflow."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_files import read_surface
from ms_slam_env.evaluation.trajectory_charts import path_panel, widest_axes
from ms_slam_env.evaluation.trajectory_measures import evaluate_files
from ms_slam_env.geometry import check_pose, make_pose
from ms_slam_env.scenes.mesh_file import load_soup
from ms_slam_env.sequences import read_trajectory


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=8, max_size=8))
def test_a_trajectory_is_finite_in_every_measure_or_refused(tmp_path_factory, numbers):  # type: ignore[no-untyped-def]
    path = tmp_path_factory.getbasetemp() / "hostile.txt"
    hostile = " ".join(map(repr, numbers[:4])) + " 0 0 0 1\n"
    path.write_text(hostile)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            times, poses = read_trajectory(path)
        except InputError as error:
            assert "line 1" in str(error)  # noqa: PT017
        else:
            assert np.isfinite(times**2).all()
            assert np.isfinite(poses**2).all()


def test_positions_of_1e200_are_refused(tmp_path: Path) -> None:
    near = "".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(4))
    (tmp_path / "near.txt").write_text(near)
    (tmp_path / "far.txt").write_text(near.replace("3 3 0", "3 1e200 0"))
    assert evaluate_files(tmp_path / "near.txt", tmp_path / "near.txt")["ate_m"] < 1e-9
    with pytest.raises(InputError, match=r"far\.txt, line 4: a position beyond 1e\+09 m"):
        evaluate_files(tmp_path / "near.txt", tmp_path / "far.txt")
    with pytest.raises(InputError, match="farther than"):
        check_pose(make_pose(np.eye(3), [0, 1e200, 0]))


@pytest.mark.parametrize("place", [1e300, 1e38, -2e9])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_vertex_beyond_all_places_is_refused(tmp_path: Path, place: float) -> None:
    lines = [f"v {place} 0 0", "v 0 1 0", "v 0 0 1", "v 1 1 1", "f 1 2 3", "f 2 3 4"]
    path = tmp_path / "far.obj"
    path.write_text("\n".join(lines) + "\n")
    for read in (load_soup, lambda file: read_surface(file, 10)):
        with pytest.raises(InputError, match=r"far\.obj.*(reaches farther|beyond)"):
            read(path)


def test_a_map_that_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "map.ply").symlink_to("/dev/zero")
    for read in (load_soup, lambda file: read_surface(file, 10)):
        with pytest.raises(InputError, match="not a regular file"):
            read(tmp_path / "map.ply")


@given(st.permutations([0, 1, 2]))
def test_the_axis_that_is_not_drawn_is_the_one_of_least_extent(order: list[int]) -> None:
    """Whichever axis is up: a walk in a flat is drawn as its plan."""
    box = trimesh.creation.box([6.0, 4.0, 2.5]).vertices[:, order]
    a, b = widest_axes(box)
    assert {a, b} == {0, 1, 2} - {order.index(2)}
    panel = path_panel({"walk": box})
    assert (panel.x, panel.y) == (f"position_{'xyz'[a]}_m", f"position_{'xyz'[b]}_m")
