"""Progress where standard error is a log, and where it is a terminal."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ms_slam_env._runtime import progress
from ms_slam_env._runtime.progress import Bar

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_log_gets_a_line_every_half_minute_and_one_at_the_end(clock, capsys) -> None:
    with Bar(total=1000, desc="frames", unit="frame") as bar:
        bar._time = lambda: clock[0]
        for k in range(950):
            clock[0] += 0.125
            bar.update()
            bar.set_postfix({"loss": k})
            if k == 500:
                Bar.write("said on the way", file=sys.stderr)
    text = capsys.readouterr().err
    assert "\r" not in text
    lines = text.splitlines()
    assert [line.split(",")[0] for line in lines] == [
        "frames: 240 of 1000",
        "frames: 480 of 1000",
        "said on the way",
        "frames: 720 of 1000",
        "frames: 950 of 1000",
    ]
    assert all("loss=" in line for line in lines if "of 1000" in line)


def test_a_bar_without_a_total_and_one_that_is_disabled(capsys) -> None:
    assert list(Bar(range(3), "steps", disable=True)) == [0, 1, 2]
    assert capsys.readouterr().err == ""
    for _ in Bar(iter(range(3)), "steps"):
        pass
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("steps: 3 of ?, ")


def test_a_text_that_changes_has_one_colon(capsys) -> None:
    with Bar(total=2, desc="references") as bar:
        bar.set_description("reference: greedy")
    assert capsys.readouterr().err.startswith("reference: greedy: 0 of 2, ")


@pytest.mark.skipif(os.name != "posix", reason="needs a terminal")
def test_a_terminal_gets_a_bar() -> None:
    import fcntl
    import pty
    import struct
    import termios

    code = "from ms_slam_env._runtime.progress import Bar\nfor _ in Bar(range(3), 'steps'): pass"
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    subprocess.run([sys.executable, "-c", code], stderr=theirs, check=True)
    os.close(theirs)
    text = b""
    try:
        while part := os.read(ours, 4096):
            text += part
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    assert b"\r" in text
    assert b"100%" in text


def test_no_bar_goes_around() -> None:
    """A tqdm elsewhere would write its bar into logs."""
    found = [
        str(path.relative_to(ROOT))
        for folder in ("ms_slam_env", "agents", "baselines")
        for path in (ROOT / folder).rglob("*.py")
        if "import tqdm" in path.read_text()
    ]
    # The two do not draw one: a lock for workers, and stages of a mesh in a terminal only.
    allowed = ["_runtime/progress.py", "_runtime/parallel.py", "scenes/mesh_file.py"]
    assert sorted(found) == sorted(f"ms_slam_env/{name}" for name in allowed)
