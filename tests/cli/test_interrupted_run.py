"""``ms-slam run`` in a process of its own that gets signals: at its imports, and between frames."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

from ms_slam_env.sequences import read_trajectory

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")

AT_IMPORT = """
import os, signal, sys

class Sender:
    '''Sends a signal when a module is imported, in code that goes on whatever is raised.'''

    def find_spec(self, name, path=None, target=None):
        if name == "scipy":
            sys.meta_path.remove(self)
            try:  # as trimesh imports what it can do without
                os.kill(os.getpid(), int(sys.argv[1]))
                sum(range(10**6))  # meanwhile it arrives
            except BaseException:
                pass
        return None

sys.meta_path.insert(0, Sender())
"""
AT_FRAME = """
import os, sys
from ms_slam_env.sequences.rendering import RenderedFrames

take = RenderedFrames.frame

def send(frames, index):
    if index == 3:
        os.kill(os.getpid(), int(sys.argv[1]))
    return take(frames, index)

RenderedFrames.frame = send
"""
RUN = """
import signal
from ms_slam_env.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's is ignored
sys.exit(main(["run", "table:2000", "--image-size", "80x60", "--out", sys.argv[2]]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("when", [AT_IMPORT, AT_FRAME], ids=["import", "frame"])
def test_a_signal_ends_a_run_and_what_is_complete_is_kept(number, when, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-c", when + RUN, str(int(number)), str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 128 + number, done.stderr
    last = done.stderr.strip().splitlines()[-1]
    said = {signal.SIGINT: "interrupted", signal.SIGTERM: "interrupted by SIGTERM"}[number]
    if when is AT_IMPORT:
        assert last == f"ms-slam: {said}"
        assert not out.exists()
        return
    assert last == f"ms-slam: {said}; 3 of 300 frames are kept in {out}"
    assert sorted(path.name for path in out.iterdir()) == [
        "frames.csv",
        "metrics.json",
        "trajectory.incomplete.txt",
    ]
    written = json.loads((out / "metrics.json").read_text())
    assert (written["complete"], written["interrupted"], written["frames"]) == (False, True, 3)
    assert written["error"] == f"interrupted by {number.name}"
    assert len(read_trajectory(out / "trajectory.incomplete.txt")[0]) == 3
    assert len((out / "frames.csv").read_text().splitlines()) == 1 + 3
