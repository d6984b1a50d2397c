"""Find results in a folder tree, each with the pictures and texts next to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ms_slam_env.errors import InputError
from ms_slam_env.report.results import PACKED, Results, read_results

PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".gif": "image/gif"}
_TEXTS = (".yaml", ".yml", ".md", ".txt", ".csv")
MAX_PICTURE_BYTES = 4_000_000
MAX_TEXT_BYTES = 100_000
_MAX_PICTURES_BYTES = 100_000_000  # per folder, since the page is built in memory


@dataclass(frozen=True)
class FoundResult:
    """A result file and its neighbours.

    Attributes:
        path: the result file.
        title: its folder relative to the top folder, plus the file name if the folder holds
            several results.
        results: content of the file.
        pictures: picture files that belong to it, except those drawn from its charts.
        texts: text files that belong to it, except its Markdown tables.
    """

    path: Path
    title: str
    results: Results
    pictures: Sequence[Path]
    texts: Sequence[Path]


@dataclass(frozen=True)
class NotShown:
    """A file that is not shown, by its path from the top folder, and the reason."""

    name: str
    reason: str


def find_results(folder: Path) -> tuple[list[FoundResult], list[NotShown]]:
    """Find the results, sorted by path, and the files that are not results or are too large.

    Skips hidden files and links that lead out of the folder.

    Raises:
        InputError: no such folder, or no result in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    top = folder.resolve()
    found: list[FoundResult] = []
    absent: list[NotShown] = []
    by_folder: dict[Path, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        is_hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if not is_hidden and path.is_file() and path.resolve().is_relative_to(top):
            by_folder.setdefault(path.parent, []).append(path)
    for parent, paths in by_folder.items():
        own: dict[Path, Results] = {}
        for path in _records(paths):
            try:
                own[path] = read_results(path)
            except InputError as error:
                reason = str(error).removeprefix(str(path)).lstrip(": ")
                absent.append(NotShown(path.relative_to(folder).as_posix(), reason))
        beside = _neighbours(own, paths) if own else {}
        for path, results in own.items():
            title = top.name if parent == folder else parent.relative_to(folder).as_posix()
            title = f"{title}: {_stem(path)}" if len(own) > 1 else title
            pictures, texts, too_large = beside[path]
            found.append(FoundResult(path, title, results, pictures, texts))
            absent += [
                NotShown(large.relative_to(folder).as_posix(), "is too large")
                for large in too_large
            ]
    if not found:
        seen = "".join(f"; {missing.name} {missing.reason}" for missing in absent[:3])
        raise InputError(f"{folder} holds no results{seen}")
    return found, absent


def _records(paths: Sequence[Path]) -> list[Path]:
    """The JSON files, and the compressed ones without an uncompressed copy."""
    plain = [path for path in paths if path.suffix == ".json"]
    packed = [path for path in paths if path.name.endswith(f".json{PACKED}")]
    return plain + [path for path in packed if path.with_suffix("") not in plain]


def _stem(path: Path) -> str:
    return path.name.removesuffix(PACKED).removesuffix(".json")


def _neighbours(
    results: Mapping[Path, Results], paths: Sequence[Path]
) -> dict[Path, tuple[list[Path], list[Path], list[Path]]]:
    """Pictures, texts and oversized files of each result, assigned by similarity of names."""
    found: dict[Path, tuple[list[Path], list[Path], list[Path]]]
    found = {path: ([], [], []) for path in results}
    drawn = {chart.name for result in results.values() for chart in result.charts}
    left = _MAX_PICTURES_BYTES
    for path in paths:
        suffix = path.suffix.lower()
        is_table = suffix == ".md" and path.stem.startswith("table")
        is_picture = suffix in PICTURES and path.stem not in drawn
        if not is_picture and (suffix not in _TEXTS or is_table):
            continue
        most = MAX_PICTURE_BYTES if is_picture else MAX_TEXT_BYTES
        size = path.stat().st_size
        left -= size if is_picture and size <= most else 0
        kind = 2 if size > most or left < 0 else 0 if is_picture else 1
        owner = max(results, key=lambda result: _likeness(_stem(result), path.stem))
        found[owner][kind].append(path)
    return found


def _likeness(result: str, other: str) -> int:
    """Number of words, separated by underscores, that the two names have in common."""
    return len(set(result.split("_")) & set(other.split("_")))
