"""The Markdown that the benchmarks write (headings, tables, paragraphs, lists) as blocks."""

from __future__ import annotations

import re

from ms_slam_env.benchmark.report.blocks import Block, Cell, Prose, Table
from ms_slam_env.benchmark.report.glossary import meaning, with_unit

_RULE = re.compile(r"^\|?[\s:|-]+\|?$")
_NUMBER = re.compile(r"^[<>≤≥~]?\s*(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)")
_SPLIT = re.compile(r"(?<!\\)\|")


def blocks_of(text: str) -> list[Block]:
    """Blocks in the order of the text; a heading right above a table becomes its title."""
    found: list[Block] = []
    paragraph: list[str] = []
    lines = text.splitlines()
    index = 0

    def end_paragraph() -> None:
        if paragraph:
            found.append(Prose(" ".join(paragraph)))
            paragraph.clear()

    while index < len(lines):
        line = lines[index].strip()
        following = lines[index + 1].strip() if index + 1 < len(lines) else ""
        if line.startswith("|") and _RULE.match(following) and "-" in following:
            end_paragraph()
            stop = index + 2
            while stop < len(lines) and lines[stop].strip().startswith("|"):
                stop += 1
            title = ""
            if found and isinstance(found[-1], Prose) and found[-1].heading:
                title = found[-1].text
                found.pop()
            found.append(table(title, line, lines[index + 2 : stop]))
            index = stop
            continue
        if line.startswith("#"):
            end_paragraph()
            found.append(Prose(line.lstrip("#").strip(), heading=True))
        elif not line:
            end_paragraph()
        elif line.startswith(("- ", "* ")):
            end_paragraph()
            paragraph.append(f"• {line[2:]}")
        else:
            paragraph.append(line)
        index += 1
    end_paragraph()
    return found


def table(title: str, header: str, lines: list[str]) -> Table:
    """A table from its lines; rows are cut or filled to the width of the header."""
    columns = tuple(with_unit(text) for text in _cells(header))
    rows = []
    for line in lines:
        cells = [cell(text) for text in _cells(line)][: len(columns)]
        rows.append((*cells, *[Cell("")] * (len(columns) - len(cells))))
    meanings = {column: text for column in columns if (text := meaning(column))}
    return Table(title, columns, tuple(rows), meanings)


def cell(text: str) -> Cell:
    """A cell, sorted by the number that it begins with, if any."""
    match = _NUMBER.match(text)
    rest = text[match.end() :] if match else ""
    is_number = match is not None and not re.match(r"[\w:]", rest)
    return Cell(text, float(match[1]) if match is not None and is_number else None)


def _cells(line: str) -> list[str]:
    inner = line.strip().removeprefix("|").removesuffix("|")
    return [part.strip().replace("\\|", "|").replace("`", "") for part in _SPLIT.split(inner)]
