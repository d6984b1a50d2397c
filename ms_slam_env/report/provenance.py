"""What made a result: command, versions, commit, machine."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
import sys
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parents[1]
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


DIRTY = "-dirty"
"""What follows a commit whose files were changed."""


def provenance() -> dict[str, Any]:
    """Command, time (UTC), versions, git commit (None outside its checkout) and platform."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": git_commit(),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in _PACKAGES},
        "platform": platform.platform(),
        "cpu": _cpu(),
    }


def git_commit(package: Path = _PACKAGE) -> str | None:
    """Commit of the checkout that the package's files are in, ``-dirty`` if files differ from it.

    None where the package is not tracked: the repository around an environment is the user's. Only
    what git has recorded is asked, and the files are compared here: ``git status`` would run what
    the repository configures (file-system monitor, hooks, filters).
    """
    commit = _git(package, "rev-parse", "--verify", "HEAD")
    listing = _git(package, "ls-tree", "-r", "-z", "HEAD", ".")
    blobs = {}
    for entry in filter(None, (listing or "").split("\0")):
        about, _, name = entry.partition("\t")
        blobs[name] = about.split()[-1]
    if commit is None or "__init__.py" not in blobs:
        return None
    is_dirty = any(not _is_blob(package / name, blob) for name, blob in blobs.items())
    return f"{commit}{DIRTY}" if is_dirty else commit


def _git(folder: Path, *command: str) -> str | None:
    """What git answers in a folder, of which nothing is run or fetched; None if it fails."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    environment |= {"GIT_NO_LAZY_FETCH": "1", "GIT_OPTIONAL_LOCKS": "0"}
    off = ("core.fsmonitor=false", f"core.hooksPath={os.devnull}", "protocol.allow=never")
    options = [word for setting in off for word in ("-c", setting)]
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *options, *command],
            capture_output=True,
            env=environment,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return None if done.returncode else done.stdout.decode(errors="replace").strip()


def _is_blob(path: Path, blob: str) -> bool:
    """Whether a file's content, whatever its line ends, is that of an object of git."""
    try:
        data = path.read_bytes()
    except OSError:
        return False
    algorithm = "sha1" if len(blob) == 40 else "sha256"
    return any(
        hashlib.new(algorithm, b"blob %d\0" % len(text) + text, usedforsecurity=False).hexdigest()
        == blob
        for text in (data, data.replace(b"\r\n", b"\n"))
    )


def _cpu() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
