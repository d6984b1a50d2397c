"""Systems from outside in ``ms-slam compare``: a stand-in program, and one of our own backends."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ms_slam_env import slam
from ms_slam_env.benchmark.command_runs import check_command, run_command
from ms_slam_env.benchmark.compare import Compare
from ms_slam_env.cli import main
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import HandheldPath, open_sequence, read_trajectory
from ms_slam_env.slam.registry import POINT

STAND_IN = """
import sys, time
from pathlib import Path
mode, folder, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
assert not (folder / "groundtruth.txt").exists()
times = [l.split()[0] for l in (folder / "rgb.txt").read_text().splitlines() if l[0] != "#"]
assert all((folder / "depth" / (t + ".png")).exists() for t in times)
values = [float(word) for word in (folder / "intrinsics.txt").read_text().split()]
assert values[4:] == [80, 60, 5000]
lines = [f"{t} {0.001 * k} 0 0 0 0 0 1" for k, t in enumerate(times)]
if mode == "fails":
    print("no camera\\nfound")
    sys.exit(3)
if mode == "sleeps":
    time.sleep(60)
if mode == "silent":
    sys.exit(0)
if mode == "longer":
    lines += [f"{float(times[-1]) + 1 + k} 0 0 0 0 0 0 1" for k in range(4)]
if mode == "garbage":
    lines = ["x y z"]
if mode == "loses":
    lines = lines[::2]
out.write_text("\\n".join(lines) + "\\n")
"""
SEQUENCE = "table:1000:none"


@pytest.fixture
def program(tmp_path: Path) -> str:
    path = tmp_path / "stand in.py"  # with a blank in its name
    path.write_text(STAND_IN)
    return f"command:{sys.executable} '{path}' {{}} {{{{sequence}}}} {{{{trajectory}}}}"


def opened():
    return open_sequence(SEQUENCE, "80x60", path=HandheldPath(10), with_truth=True)


def test_a_stand_in_program_stands_in_the_table(program, tmp_path) -> None:
    backends = ["mine=" + program.format("tracks"), program.format("loses")]
    options = ["--sequences", SEQUENCE, "--image-sizes", "80x60", "--frames", "10"]
    assert main(["compare", *options, "--backends", *backends, "--out", str(tmp_path / "o")]) == 0
    rows = json.loads((tmp_path / "o" / "results.json").read_text())["rows"]
    assert [row["spec"]["backend"] for row in rows] == ["mine", backends[1]]
    tracks, loses = (row["result"] for row in rows)
    assert (tracks["frames"], tracks["lost_share"], loses["lost_share"]) == (10, 0.0, 0.5)
    assert tracks["ate_unaligned_m"] > 0  # it does not know where the camera goes
    assert tracks["ext_ms"] > 0
    assert tracks["cpu_ms_mean"] > 0
    assert "map_points" not in tracks


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("fails", r"failed with exit code 3: no camera found"),
        ("silent", r"wrote no trajectory to \{trajectory\}"),
        ("longer", r"wrote 14 poses for 10 frames, 4 of them at times of no frame"),
        ("garbage", r"its trajectory"),
    ],
)
def test_what_goes_wrong_is_said_in_one_line(program, tmp_path, mode, message) -> None:
    with pytest.raises(InputError, match=message) as raised:
        run_command(program.format(mode), opened(), tmp_path / "t.txt", 30.0)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "t.txt").exists()


def test_a_program_that_takes_too_long_is_stopped(program, tmp_path) -> None:
    began = time.monotonic()
    with pytest.raises(InputError, match=r"was stopped after 1 s"):
        run_command(program.format("sleeps"), opened(), tmp_path / "t.txt", 1.0)
    assert time.monotonic() - began < 30


def test_what_a_program_started_ends_with_it(tmp_path) -> None:
    known = tmp_path / "pid"
    words = f"sleep 60 & echo $! > {known}; wait # {{sequence}} {{trajectory}}"
    with pytest.raises(InputError, match=r"was stopped after 1 s"):
        run_command(f"command:sh -c '{words}'", opened(), tmp_path / "t.txt", 1.0)
    _ends(int(known.read_text()))


def test_a_worker_that_is_ended_ends_its_program_and_leaves_no_frames(tmp_path) -> None:
    known = tmp_path / "pid"
    words = f"pwd > {tmp_path}/folder; echo $$ > {known}; sleep 60 # {{sequence}} {{trajectory}}"
    code = (
        "from pathlib import Path; from test_command_backend import opened;"
        "from ms_slam_env.benchmark.command_runs import run_command;"
        f"run_command({f'command:sh -c {words!r}'!r}, opened(), Path('x'), 60.0)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    worker = subprocess.Popen([sys.executable, "-c", code], env=environment)
    began = time.monotonic()
    while not (known.exists() and known.read_text()) and time.monotonic() - began < 60:
        time.sleep(0.1)
    worker.terminate()
    assert worker.wait(30) == 128 + signal.SIGTERM
    _ends(int(known.read_text()))
    assert not Path((tmp_path / "folder").read_text().strip()).exists()


def _ends(pid: int) -> None:
    """Wait until a process is gone, or a zombie that nobody asks for."""
    status, began = Path(f"/proc/{pid}/status"), time.monotonic()
    while time.monotonic() - began < 20:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if "State:\tZ" not in status.read_text():
                time.sleep(0.1)
                continue
        return
    raise AssertionError(f"process {pid} goes on")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("command:prog --in {sequence}", r"lacks \{trajectory\}"),
        ("command:prog --out {trajectory}", r"lacks \{sequence\}"),
        ("command:no-such-program {sequence} {trajectory}", "there is no program"),
        ("command:prog '{sequence} {trajectory}", "No closing quotation"),
        ("mine=command:no-such-program {sequence} {trajectory}", "there is no program"),
        ("command:sh -c x=command: {sequence}", r"lacks \{trajectory\}"),
    ],
)
def test_a_bad_command_is_refused_before_anything_runs(command, message) -> None:
    with pytest.raises(InputError, match=message):
        Compare(backends=(command,))


def test_a_script_in_the_current_folder_needs_an_absolute_path(tmp_path, monkeypatch) -> None:
    (tmp_path / "peer.py").touch()
    monkeypatch.chdir(tmp_path)
    command = "command:{} {} {{sequence}} {{trajectory}}"
    with pytest.raises(InputError, match=r"give 'peer.py' as an absolute path"):
        Compare(backends=(command.format(sys.executable, "peer.py"),))
    Compare(backends=(command.format(sys.executable, tmp_path / "peer.py"),))


def test_two_commands_of_one_name_are_refused() -> None:
    command = "mine=command:sh {sequence} {trajectory}"
    with pytest.raises(InputError, match="must differ"):
        Compare(backends=(command, command + " x"))


def test_no_shell_reads_the_command(tmp_path) -> None:
    target = tmp_path / "made"
    words = check_command(f"command:{sys.executable} {{sequence}} {{trajectory}} ; touch {target}")
    assert words[-3:] == [";", "touch", str(target)]


def test_no_file_can_name_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    # The backends of configurations, maps and environments are looked up here.
    for name in ("command:prog {sequence} {trajectory}", "orb=command:prog {sequence}"):
        with pytest.raises(InputError, match="an external program is run by ms-slam compare alone"):
            POINT.find(name)
    assert main(["run", "table:2000", "--backend", "command:prog {sequence} {trajectory}"]) == 2
    assert "ms-slam compare --backends 'NAME=command:PROGRAM" in capsys.readouterr().err
    with pytest.raises(InputError, match="run by ms-slam compare alone"):
        ActiveSlamEnv(slam="command:prog {sequence} {trajectory}")


OURS = """
import sys
from ms_slam_env import slam
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.sequences import open_sequence, write_trajectory
sequence = open_sequence(sys.argv[1], "native")
run = run_sequence(slam.make("odometry", sequence.intrinsics), sequence)
write_trajectory(sys.argv[2], run.timestamps, run.estimates)
"""


def test_our_own_backend_by_a_command_is_as_good_as_it_is(tmp_path) -> None:
    path = tmp_path / "ours.py"
    path.write_text(OURS)
    sequence = opened()
    command = f"command:{sys.executable} {path} {{sequence}} {{trajectory}}"
    run_command(command, sequence, tmp_path / "t.txt", 300.0)
    _, poses = read_trajectory(tmp_path / "t.txt")
    within = run_sequence(slam.make("odometry", sequence.intrinsics), sequence)
    # Depth went through 16-bit images of 0.2 mm.
    assert ate_rmse(poses, within.estimates) < 1e-3
