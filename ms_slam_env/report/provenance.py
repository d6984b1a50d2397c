"""What made a result: command, versions, commit, machine."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = (
    "ms-slam-env",
    "embreex",
    "gymnasium",
    "numpy",
    "opencv-python-headless",
    "scipy",
    "trimesh",
    "warp-lang",
)


def provenance() -> dict[str, Any]:
    """Command, time (UTC), versions, git commit (None outside a checkout) and platform."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": git_commit(),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in _PACKAGES},
        "platform": platform.platform(),
        "cpu": _cpu(),
    }


def git_commit() -> str | None:
    """Commit of the checkout that the package lies in, ``-dirty`` if files differ from it."""
    here = Path(__file__).resolve().parents[1]
    commands = (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no", "."])
    answers = []
    for command in commands:
        try:
            done = subprocess.run(
                ["git", "-C", str(here), *command], capture_output=True, text=True, timeout=10
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        if done.returncode != 0:
            return None
        answers.append(done.stdout.strip())
    commit, changes = answers
    return f"{commit}-dirty" if changes else commit


def _cpu() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
