"""A SLAM system outside of this package, run by a command line over the frames of a sequence.

The command is what the user types after ``--backends command:``, nowhere else: no file of results,
configurations or studies is asked for one (SECURITY.md). It is split as a shell would split it, but
no shell sees it, and the frames stand in a folder without true poses.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from ms_slam_env._runtime.input_files import MAX_TEXT_BYTES, is_named, read_bytes
from ms_slam_env._runtime.interrupts import sigterm_exits
from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import Sequence, associate, read_trajectory
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S
from ms_slam_env.sequences.writing import write_frames

PREFIX = "command:"
SEQUENCE, TRAJECTORY = "{sequence}", "{trajectory}"
_LAST_WORDS = 200  # characters of what a program said before it failed


@dataclass(frozen=True)
class CommandCost:
    """What a program took for a whole sequence, its start and its reading of images included.

    Attributes:
        ext_s: by the clock.
        cpu_s: processor time of it and of what it started and waited for.
    """

    ext_s: float
    cpu_s: float


_NAMED = re.compile(rf"(?:([^=,:]+)=)?({PREFIX}.*)", re.DOTALL)
"""``command:PROGRAM ...``, a name in front of it or not."""


def is_command(backend: str) -> bool:
    """Whether a backend is a command line, ``[NAME=]command:PROGRAM ...``."""
    return _NAMED.fullmatch(backend) is not None


def name_of(backend: str) -> str:
    """What tables call a backend: of ``NAME=command:...`` NAME, of others all that was given."""
    found = _NAMED.fullmatch(backend)
    return found[1] if found and found[1] else backend


def command_of(backend: str) -> str:
    """``command:PROGRAM ...`` without its name."""
    return backend[backend.index(PREFIX) :]


def check_command(backend: str) -> list[str]:
    """The words of ``[NAME=]command:PROGRAM ... {sequence} ... {trajectory}``.

    Raises:
        InputError: no program, a blank that is missing, or quotes that are not closed; a program
            that is not there.
    """
    text = command_of(backend).removeprefix(PREFIX)
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"command {text!r}: {error}") from None
    for blank in (SEQUENCE, TRAJECTORY):
        if blank not in text:
            raise InputError(
                f"command {text!r} lacks {blank}: write it as NAME=command:PROGRAM --in "
                f"{SEQUENCE} --out {TRAJECTORY}"
            )
    if shutil.which(words[0]) is None:
        raise InputError(f"command {text!r}: there is no program {words[0]!r}")
    return words


def run_command(
    backend: str, sequence: Sequence, trajectory: Path, timeout_s: float
) -> CommandCost:
    """Let a program track a sequence; it must write a TUM trajectory, camera to world.

    Its folder ``{sequence}`` is as ``write_frames`` has it; ``{trajectory}`` is the file that it
    is to write. A frame without a pose is one that it has lost.

    Args:
        backend: ``command:PROGRAM ...``.
        sequence: whose frames it is shown.
        trajectory: where its trajectory is kept.
        timeout_s: after so many seconds it is stopped.

    Raises:
        InputError: it cannot be run, fails, takes too long, writes no trajectory, or one with more
            poses than there are frames or at other times.
    """
    words = check_command(backend)
    about = f"command {backend.removeprefix(PREFIX)!r}"
    with sigterm_exits(), tempfile.TemporaryDirectory(prefix="ms-slam-command-") as name:
        folder, made = Path(name) / "sequence", Path(name) / "trajectory.txt"
        write_frames(sequence, folder)
        blanks = {SEQUENCE: str(folder), TRAJECTORY: str(made)}
        for blank, path in blanks.items():
            words = [word.replace(blank, path) for word in words]
        cost = _run(words, Path(name), about, timeout_s)
        if not is_named(made):
            raise InputError(f"{about} wrote no trajectory to {TRAJECTORY}")
        _check_trajectory(made, sequence, about)
        write_bytes(trajectory, read_bytes(made, "trajectory", MAX_TEXT_BYTES))
    return cost


def _run(words: list[str], folder: Path, about: str, timeout_s: float) -> CommandCost:
    began, used = time.perf_counter(), _children_s()
    said = folder / "output.txt"
    with said.open("wb") as output:
        try:
            program = subprocess.Popen(
                words,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # what it starts in turn ends with it
            )
        except OSError as error:
            raise InputError(f"{about} cannot be run: {error.strerror}") from None
        try:
            exit_code = program.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise InputError(f"{about} was stopped after {timeout_s:g} s") from None
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(program.pid, signal.SIGKILL)
            program.wait()
    if exit_code:
        words_said = " ".join(said.read_bytes()[-4096:].decode(errors="replace").split())
        last = f": {words_said[-_LAST_WORDS:]}" if words_said else ""
        raise InputError(f"{about} failed with exit code {exit_code}{last}")
    return CommandCost(time.perf_counter() - began, _children_s() - used)


def _check_trajectory(path: Path, sequence: Sequence, about: str) -> None:
    """Refuse a trajectory that cannot be of these frames."""
    try:
        times, _ = read_trajectory(path)
    except InputError as error:
        reason = str(error).replace(str(path), "its trajectory")
        raise InputError(f"{about}: {reason}") from None
    matched = len(associate(times, sequence.timestamps, MAX_DIFFERENCE_S)[0])
    if matched < len(times):
        raise InputError(
            f"{about} wrote {len(times)} poses for {len(sequence)} frames, "
            f"{len(times) - matched} of them at times of no frame"
        )


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
