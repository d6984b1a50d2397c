"""Which process works on a trial, and whether it still lives."""

from __future__ import annotations

import os
import socket
from pathlib import Path


def process_name(pid: int | None = None) -> str:
    """Name of process ``pid`` (this one if None): host, number, and when it began."""
    pid = os.getpid() if pid is None else pid
    return f"{socket.gethostname()}/{pid}/{_start_of(pid)}"


def is_alive(name: str) -> bool:
    """Whether the process called ``name`` lives on this host.

    A study's file lies on one machine: the process of another host is one from before a container
    was started anew, under a new name.
    """
    host, pid, start = name.rsplit("/", 2)
    if host != socket.gethostname():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # it lives, and is another user's
    return _start_of(int(pid)) == start


def _start_of(pid: int) -> str:
    """Start of a process in clock ticks since boot, from proc(5); empty where there is no proc.

    Numbers of processes are used again. A process that ended and was not waited for counts as none.
    """
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "ended" if after_name[0] in "ZX" else after_name[19]
