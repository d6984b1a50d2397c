"""``ms-slam run`` in a process that a signal ends at its imports."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

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
RUN = """
import signal
from ms_slam_env.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's is ignored
sys.exit(main(["run", "table:2000", "--image-size", "80x60", "--out", sys.argv[2]]))
"""


def test_a_signal_at_the_imports_ends_a_run_that_has_written_nothing(tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-c", AT_IMPORT + RUN, str(int(signal.SIGINT)), str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 128 + signal.SIGINT, done.stderr
    assert done.stderr.strip().splitlines()[-1] == "ms-slam: interrupted"
    assert not out.exists()
