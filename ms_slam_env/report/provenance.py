"""Provenance of a result: command, versions, commit, machine."""

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
"""Suffix of a commit if its files were changed."""


def provenance() -> dict[str, Any]:
    """Command, time (UTC), versions, git commit (None outside its checkout) and platform."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": git_commit(),
        "python": platform.python_version(),
        "versions": {name: version for name in _PACKAGES if (version := _version(name))},
        "platform": platform.platform(),
        "cpu": _cpu(),
    }


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:  # embreex exists for most processors only
        return ""


def git_commit(package: Path = _PACKAGE) -> str | None:
    """Commit of the package's own checkout, with ``-dirty`` if files differ from it.

    None if git does not track the package, since a repository around an installed environment is
    the user's. Git is asked only for recorded objects, and files are compared here, because
    ``git status`` would run programs that the repository configures (file-system monitor, hooks,
    filters).
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
    """Output of git in a folder, without running its hooks or fetching; None if it fails."""
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
    """Whether a file's content, apart from line endings, equals that of a git object."""
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
