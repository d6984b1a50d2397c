"""Results in a folder: their JSON files, each with the texts and pictures that belong to it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ms_slam_env.errors import InputError

PROVENANCE_KEYS = ("command", "time", "commit", "python", "versions", "platform", "cpu", "gpu")
PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".gif": "image/gif"}
_MAX_JSON_BYTES = 200e6


@dataclass(frozen=True)
class Result:
    """One result file and its neighbours.

    Attributes:
        path: of the JSON file.
        title: its folder from the top one on, with the file where the folder has several.
        content: of the JSON file, without ``provenance``.
        provenance: command, time, commit, versions; empty where the file names none.
        texts: Markdown files that belong to it.
        pictures: picture files that belong to it.
    """

    path: Path
    title: str
    content: dict[str, Any]
    provenance: dict[str, Any]
    texts: tuple[Path, ...] = field(default=())
    pictures: tuple[Path, ...] = field(default=())

    @property
    def folder(self) -> Path:
        """Folder of the file."""
        return self.path.parent


def find_results(folder: Path) -> list[Result]:
    """Every result in ``folder`` and the folders below it, by path.

    A result is a JSON file that holds an object, or a list of objects.

    Raises:
        InputError: no such folder, no result in it, a file that is not JSON.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    by_folder: dict[Path, list[Path]] = {}
    for path in sorted(folder.rglob("*.json")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.is_file() and not hidden:
            by_folder.setdefault(path.parent, []).append(path)
    results = []
    for parent, paths in by_folder.items():
        contents = {path: read_result(path) for path in paths}
        known = {path: content for path, content in contents.items() if content is not None}
        texts, pictures = neighbours(parent, list(known))
        for path, content in known.items():
            title = parent.relative_to(folder).as_posix()
            title = folder.resolve().name if title == "." else title
            results.append(
                Result(
                    path,
                    title if len(known) == 1 else f"{title}: {path.stem}",
                    *split_provenance(content),
                    texts[path],
                    pictures[path],
                )
            )
    if not results:
        raise InputError(f"{folder} holds no results: no JSON file with an object in it")
    return results


def read_result(path: Path) -> dict[str, Any] | None:
    """Content of a result file; None if it holds neither an object nor objects.

    Raises:
        InputError: not JSON, not text, or too large to be a result.
    """
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(f"{path} has more than {_MAX_JSON_BYTES / 1e6:.0f} MB: not a result")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path} is not a JSON file: {reason}") from None
    if isinstance(content, list) and content and all(isinstance(row, dict) for row in content):
        return {"rows": content}
    return content if isinstance(content, dict) and content else None


def split_provenance(content: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Content without provenance, and provenance, under its own key or among the others."""
    given = content.get("provenance")
    if isinstance(given, dict):
        return {key: value for key, value in content.items() if key != "provenance"}, given
    if "versions" not in content:  # else "time" and the like may be results
        return content, {}
    rest = {key: value for key, value in content.items() if key not in PROVENANCE_KEYS}
    return rest, {key: content[key] for key in PROVENANCE_KEYS if key in content}


def neighbours(
    folder: Path, results: list[Path]
) -> tuple[dict[Path, tuple[Path, ...]], dict[Path, tuple[Path, ...]]]:
    """Texts and pictures of each of the result files of a folder.

    A file belongs to the result whose name ends like its own (``table_320x240.md`` to
    ``kidnapping_320x240.json``), else to the first one.
    """
    texts: dict[Path, list[Path]] = {path: [] for path in results}
    pictures: dict[Path, list[Path]] = {path: [] for path in results}
    for path in sorted(folder.iterdir()) if results else ():
        suffix = path.suffix.lower()
        if suffix == ".md" or suffix in PICTURES:
            owner = max(results, key=lambda result: _likeness(result.stem, path.stem))
            (texts if suffix == ".md" else pictures)[owner].append(path)
    return (
        {path: tuple(found) for path, found in texts.items()},
        {path: tuple(found) for path, found in pictures.items()},
    )


def _likeness(result: str, other: str) -> int:
    """How many words, parted by underscores, the two names have in common."""
    return len(set(result.split("_")) & set(other.split("_")))
