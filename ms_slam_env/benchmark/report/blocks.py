"""What a report is made of, before it is HTML."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Prose:
    """A paragraph, or a small heading."""

    text: str
    heading: bool = False


@dataclass(frozen=True)
class Cell:
    """One cell of a table: what is shown, and the number it is sorted by (None: by the text)."""

    text: str
    number: float | None = None


@dataclass(frozen=True)
class Table:
    """A table that sorts.

    Attributes:
        title: above it.
        columns: headings.
        rows: cells, as many in each row as there are columns.
        meanings: of headings, by heading.
        note: a sentence below the title.
        folded: shown only on demand.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    meanings: dict[str, str] = field(default_factory=dict)
    note: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Plot:
    """One state of a figure, as Plotly's JSON.

    Attributes:
        label: of this state where a figure has several to choose from.
        data: Plotly traces.
        layout: Plotly layout; colours of text, grid and background come from the page.
    """

    label: str
    data: list[dict[str, Any]]
    layout: dict[str, Any]


@dataclass(frozen=True)
class Figure:
    """An interactive figure.

    Attributes:
        title: above it.
        caption: what the marks are.
        plots: its states; several are chosen between by a list named ``choice``.
        height_px: of the drawing.
        choice: what the states differ in.
    """

    title: str
    caption: str
    plots: tuple[Plot, ...]
    height_px: int = 420
    choice: str = "Measure"


@dataclass(frozen=True)
class Picture:
    """A picture file, embedded.

    Attributes:
        name: of the file.
        media_type: such as image/png.
        content: the bytes of the file.
    """

    name: str
    media_type: str
    content: bytes


@dataclass(frozen=True)
class Pictures:
    """Pictures of a folder."""

    pictures: tuple[Picture, ...]
    folded: bool


@dataclass(frozen=True)
class Code:
    """A text file, shown on demand."""

    name: str
    text: str


Block = Prose | Table | Figure | Pictures | Code


@dataclass(frozen=True)
class Section:
    """One result.

    Attributes:
        title: the folder, and the file where a folder has several.
        kind: what was run, in a few words.
        about: what the kind of result shows, one or two sentences.
        blocks: in the order of reading.
        provenance: command, versions, commit, time, as label and text.
    """

    title: str
    kind: str
    about: str
    blocks: tuple[Block, ...]
    provenance: tuple[tuple[str, str], ...]
