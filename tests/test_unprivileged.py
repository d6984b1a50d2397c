"""Users who may write next to nothing: no home, a home that is read-only, no right to the results.

The process of another user is started by root, with a right to read everything: Python itself may
lie where only root looks.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ms_slam_env._runtime import warp as _warp
from ms_slam_env.errors import InputError
from ms_slam_env.scenes import mesh_cache

NOBODY = 65534
USER = [
    *("setpriv", "--reuid", str(NOBODY), "--regid", str(NOBODY), "--clear-groups"),
    *("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"),
]
needs_root = pytest.mark.skipif(
    os.name != "posix" or os.geteuid() != 0 or shutil.which("setpriv") is None,
    reason="needs root and setpriv, to become another user",
)
COMMAND = "import sys; from ms_slam_env.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture
def open_to_all(tmp_path: Path) -> Path:
    """A folder that every user may write to; those above it may be entered."""
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and not folder.stat().st_mode & 0o001:
            folder.chmod(folder.stat().st_mode | 0o011)
    tmp_path.chmod(0o777)
    return tmp_path


def as_nobody(code: str, *words: str, place: Path, home: Path | None) -> tuple[int, str]:
    """Run Python code; return the exit code and what was said."""
    told = ("HOME", "XDG_CACHE_HOME", "WARP_CACHE_PATH", "MPLCONFIGDIR", "MS_SLAM_ENV_CACHE")
    environment = {key: value for key, value in os.environ.items() if key not in told}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    if home is not None:
        environment["HOME"] = str(home)
    command = [*USER, sys.executable, "-c", code, *words]
    done = subprocess.run(
        command, cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    if "setpriv" in done.stderr:
        pytest.skip(f"cannot become another user: {done.stderr.strip()}")
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stderr


@needs_root
def test_a_read_only_home_costs_the_kernels_only(open_to_all: Path) -> None:
    home = open_to_all / "home"
    home.mkdir(mode=0o555)
    code = """import os
from ms_slam_env._runtime.warp import wp
assert os.path.isdir(wp.config.kernel_cache_dir)"""
    status, said = as_nobody(code, place=open_to_all, home=home)
    assert status == 0
    assert "compiled kernels cannot be kept" in said
    assert "Permission denied" in said
    assert [path.name for path in open_to_all.rglob("*")] == ["home"]


@needs_root
def test_no_home_leaves_no_folder_that_is_called_so(open_to_all: Path) -> None:
    code = (
        "import os, pwd\n"
        "pwd.getpwuid = lambda uid: {}[uid]\n"  # a user whom the system does not know
        "import ms_slam_env._runtime.warp\n"
        "from ms_slam_env.scenes.mesh_cache import folder, remembered\n"
        "assert folder() is None\n"
        "assert remembered('a', lambda: {'x': 3}) == {'x': 3}"
    )
    status, said = as_nobody(code, place=open_to_all, home=None)
    assert (status, "this user has no home folder" in said) == (0, True)
    assert list(open_to_all.iterdir()) == []


@needs_root
def test_a_command_writes_where_it_may_and_says_where_it_may_not(open_to_all: Path) -> None:
    home = open_to_all / "home"
    home.mkdir(mode=0o555)
    poses = open_to_all / "a.txt"
    poses.write_text("".join(f"{k} 0 0 {0.1 * k * k} 0 0 0 1\n" for k in range(5)))
    words = ["evaluate", str(poses), str(poses), "--out"]
    status, said = as_nobody(COMMAND, *words, str(home / "o"), place=open_to_all, home=home)
    assert (status, said) == (2, f"ms-slam: error: {home}: nothing can be written there\n")
    status, said = as_nobody(COMMAND, *words, str(open_to_all / "o"), place=open_to_all, home=home)
    assert status == 0, said
    assert (open_to_all / "o" / "evaluation.json").stat().st_uid == NOBODY


def test_no_place_for_kernels_at_all_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*_: object, **__: object) -> None:
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(_warp.wp, "init", nowhere)
    monkeypatch.setattr(_warp.tempfile, "mkdtemp", nowhere)
    with pytest.raises(InputError, match=r"^no place for compiled kernels: No usable temp"):
        _warp._init()


def test_meshes_are_worked_out_anew_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MS_SLAM_ENV_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(mesh_cache.os.path, "expanduser", lambda path: path)
    assert mesh_cache.folder() is None
