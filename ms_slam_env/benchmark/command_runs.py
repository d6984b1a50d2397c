"""Run an external SLAM system as a command line over the frames of a sequence.

The command comes only from what the user types after ``--backends command:``, never from a file of
results, configurations or studies (SECURITY.md). It is split like a shell command, but no shell
runs it. The system reads the frames from a folder without true poses.
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
_LAST_WORDS = 200  # characters kept of the output of a program that failed


@dataclass(frozen=True)
class CommandCost:
    """Cost of a program for a whole sequence, including its start and its reading of images.

    Attributes:
        ext_s: wall-clock time.
        cpu_s: processor time of the program and of the child processes that it waited for.
    """

    ext_s: float
    cpu_s: float


_NAMED = re.compile(rf"(?:([^=,:]+)=)?({PREFIX}.*)", re.DOTALL)
"""Matches ``[NAME=]command:PROGRAM ...``."""


def is_command(backend: str) -> bool:
    """Tell whether a backend is a command line, ``[NAME=]command:PROGRAM ...``."""
    return _NAMED.fullmatch(backend) is not None


def name_of(backend: str) -> str:
    """Return a backend's name in tables: NAME of ``NAME=command:...``, else the whole text."""
    found = _NAMED.fullmatch(backend)
    return found[1] if found and found[1] else backend


def command_of(backend: str) -> str:
    """Return ``command:PROGRAM ...`` without the name in front of it."""
    return backend[backend.index(PREFIX) :]


def check_command(backend: str) -> list[str]:
    """Split ``[NAME=]command:PROGRAM ... {sequence} ... {trajectory}`` into words.

    Raises:
        InputError: no such program, a missing placeholder, an unclosed quote, or a file named by a
            relative path, since the program runs in another folder.
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
    for word in words:
        if is_named(Path(word)) and not Path(word).is_absolute():
            raise InputError(
                f"command {text!r} runs in a temporary folder: give {word!r} as an absolute path"
            )
    return words


def run_command(
    backend: str, sequence: Sequence, trajectory: Path, timeout_s: float
) -> CommandCost:
    """Run a program over a sequence; it must write a TUM trajectory, camera to world.

    ``{sequence}`` becomes a folder made by ``write_frames``, ``{trajectory}`` the file to write. A
    frame without a pose counts as lost.

    Args:
        backend: ``command:PROGRAM ...``.
        sequence: sequence whose frames the program reads.
        trajectory: file to copy its trajectory to.
        timeout_s: seconds after which the program is stopped.

    Raises:
        InputError: the program cannot be run, fails, takes too long, writes no trajectory, or
            writes a pose that matches no frame in time.
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
                start_new_session=True,  # so that its child processes end with it
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
    """Refuse a trajectory with poses at times of no frame."""
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
