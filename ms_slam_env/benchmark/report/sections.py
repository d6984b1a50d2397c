"""A result becomes a section: figures of its kind, the tables of its folder, pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.report.blocks import (
    Block,
    Code,
    Picture,
    Pictures,
    Prose,
    Section,
    Table,
)
from ms_slam_env.benchmark.report.discovery import PICTURES, Result
from ms_slam_env.benchmark.report.glossary import Meanings, meaning
from ms_slam_env.benchmark.report.kinds import kind_of
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.benchmark.report.kinds.generic import Generic, facts, row_tables, settings
from ms_slam_env.benchmark.report.markdown import blocks_of

_MAX_PICTURE_BYTES = 4_000_000
_FIELDS = ("command", "time", "commit", "python", "versions", "platform", "cpu", "gpu")


def section_of(result: Result) -> Section:
    """The section of a result.

    Raises:
        OSError: a file of the folder cannot be read.
    """
    kind: Kind = kind_of(result.content)
    written = [b for path in result.texts for b in blocks_of(_text_of(path))]
    written = [b for b in written if not (isinstance(b, Prose) and b.text.startswith("Made by "))]
    try:
        drawn, own = kind.figures(result), kind.tables(result)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        kind = Generic()  # the file looks like a known kind but is not of its form
        drawn, own = kind.figures(result), []
    has_table = any(isinstance(block, Table) for block in (*written, *own))
    values = facts(result.content, folded=has_table)
    files = [block for block in own if isinstance(block, Code)]
    own = [block for block in own if not isinstance(block, Code)]
    blocks: list[Block] = [*drawn, *own, *written, *files]
    if values is not None:
        blocks.append(values)
    blocks += row_tables(result.content, folded=has_table)
    given = settings(result.content)
    if given is not None:
        blocks.append(given)
    meanings = kind.meanings(result.content)
    blocks = [_explained(block, meanings) for block in blocks]
    pictures = tuple(
        Picture(path.name, PICTURES[path.suffix.lower()], path.read_bytes())
        for path in result.pictures
        if path.stat().st_size <= _MAX_PICTURE_BYTES
    )
    if pictures:
        blocks.append(Pictures(pictures, folded=bool(drawn) and not isinstance(kind, Generic)))
    return Section(
        result.title, kind.name, kind.about, tuple(blocks), provenance_lines(result.provenance)
    )


def _explained(block: Block, own: Meanings) -> Block:
    """A table with the meanings that its columns have in this kind of result."""
    if not isinstance(block, Table) or not own:
        return block
    names = dict.fromkeys((*block.columns, *block.meanings))
    found = {name: meaning(name, own) for name in names}
    return replace(block, meanings={name: text for name, text in found.items() if text})


def _text_of(path: Path) -> str:
    """Text of a file that another program may have written in another encoding."""
    return path.read_text(encoding="utf-8", errors="replace")


def provenance_lines(provenance: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Label and text of what made a result."""
    lines = []
    for key in (*_FIELDS, *(key for key in provenance if key not in _FIELDS)):
        value = provenance.get(key)
        if isinstance(value, Mapping):
            value = ", ".join(f"{name} {version}" for name, version in value.items())
        if value not in (None, ""):
            lines.append((key.replace("_", " "), str(value)))
    return tuple(lines)
