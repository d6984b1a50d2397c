"""An error of a user's is one line, whatever it quotes."""

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.errors import InputError, UnreachableError, unknown
from ms_slam_env.sequences import read_trajectory


@given(st.text())
def test_a_message_is_one_line(text):
    message = str(InputError(f"a {text} b"))
    assert len(message.splitlines()) == 1
    assert message.split() == f"a {text} b".split()


def test_errors_come_back_from_other_processes():
    error = pickle.loads(pickle.dumps(UnreachableError("too\nfar")))
    assert (type(error), str(error)) == (UnreachableError, "too far")


LONG = 10_000_000


@pytest.mark.parametrize(
    "text",
    [
        f"line 3: expected 8 numbers, got {'x ' * LONG!r}",
        f"scale = {'7' * LONG} is outside [0, 1]",
        f"unknown key {['a' * 50] * 9999!r}; valid choices: b, c",
        f"line 3: {b'x' * LONG!r}",
    ],
)
def test_what_is_quoted_is_cut(text: str) -> None:
    told = str(InputError(text))
    assert len(told) < 250
    assert told[:9] == text[:9]
    assert told[-3:] == text[-3:]


@pytest.mark.parametrize("text", ["x" * 400, "x " * 200, "it's " * 100])
def test_of_a_quotation_some_80_characters_are_shown(text: str) -> None:
    told = str(unknown("planner's colour", text, ["red", "green"]))
    assert told.startswith("unknown planner's colour ")
    assert told.endswith("; valid choices: red, green")
    assert len(told) < 150


@pytest.mark.parametrize(
    "told",
    [
        "mesh file '/a/rather/long/path/" + "of/folders/" * 14 + "mesh.ply' cannot be read",
        "the planner's options are " + "name, " * 100 + "and the robot's are 'x'",
    ],
)
def test_paths_and_lists_of_choices_are_shown_whole(told: str) -> None:
    assert str(InputError(told)) == told


def test_a_line_of_megabytes_in_a_file_is_not_shown_whole(tmp_path):
    (tmp_path / "t.txt").write_text("x y " * 1_000_000)
    with pytest.raises(InputError, match=r"line 1: expected the 8 numbers .* got 'x y ") as caught:
        read_trajectory(tmp_path / "t.txt")
    assert len(str(caught.value)) < 200 + len(str(tmp_path))
