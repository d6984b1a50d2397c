"""The commit of a result: only of the package's own checkout, and nothing of it is run."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

from ms_slam_env.report.provenance import git_commit

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder: Path, *command: str) -> str:
    who = ("-c", "user.name=Test", "-c", "user.email=test@example.org")
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    done = subprocess.run(
        ["git", *who, "-C", str(folder), *command],
        check=True, capture_output=True, text=True, env=environment,
    )  # fmt: skip
    return done.stdout.strip()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two files in a folder of a repository, not committed."""
    folder = tmp_path / "repository" / "source" / "package"
    (folder / "sub").mkdir(parents=True)
    (folder / "__init__.py").write_text("one = 1\n")
    (folder / "sub" / "a file.py").write_text("two = 2\n")
    (tmp_path / "repository" / "other.txt").write_text("of the user\n")
    git(tmp_path / "repository", "init", "-q")
    return folder


def commit(package: Path, what: str = ".") -> str:
    git(package.parents[1], "add", what)
    git(package.parents[1], "commit", "-q", "-m", "A commit")
    return git(package.parents[1], "rev-parse", "HEAD")


def test_the_commit_of_a_checkout_and_whether_files_differ(package: Path) -> None:
    assert git_commit(package) is None  # no commit yet
    made = commit(package)
    assert git_commit(package) == made
    (package.parents[1] / "other.txt").write_text("changed\n")
    assert git_commit(package) == made
    (package / "sub" / "a file.py").write_bytes(b"two = 2\r\n")  # as a checkout on Windows has it
    assert git_commit(package) == made
    (package / "sub" / "a file.py").write_text("two = 3\n")
    assert git_commit(package) == f"{made}-dirty"
    again = commit(package)
    assert git_commit(package) == again != made
    (package / "sub" / "a file.py").unlink()
    assert git_commit(package) == f"{again}-dirty"


def test_a_repository_around_an_installed_package_is_not_asked(package: Path) -> None:
    commit(package, "other.txt")
    assert git_commit(package) is None


def test_another_repository_in_the_environment_is_not_asked(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = commit(package)
    git(tmp_path, "init", "-q", "other")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "other" / ".git"))  # as within a hook
    assert git_commit(package) == made


def test_nothing_that_the_repository_configures_is_run(package: Path, tmp_path: Path) -> None:
    made = commit(package)
    repository = package.parents[1]
    ran = tmp_path / "ran"
    script = tmp_path / "script"
    script.write_text(f'#!/bin/sh\necho "$0" "$@" >> "{ran}"\ncat\n')
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    hooks = tmp_path / "hooks"
    hooks.mkdir()
    shutil.copy(script, hooks / "post-index-change")
    settings = {
        "core.fsmonitor": script,
        "core.hooksPath": hooks,
        "core.pager": script,
        "diff.external": script,
        "filter.trap.clean": script,
        "core.sshCommand": script,
    }
    for name, value in settings.items():
        git(repository, "config", name, str(value))
    (repository / ".git" / "info" / "attributes").write_text("*.py filter=trap diff=trap\n")
    os.utime(package / "__init__.py", (1, 1))  # so that git would look at its content
    git(repository, "status")
    assert ran.exists(), "the trap does not work"
    os.utime(package / "__init__.py", (2, 2))
    ran.unlink()
    assert git_commit(package) == made
    assert not ran.exists()
