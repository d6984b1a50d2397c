"""Base of the kinds of results that a report knows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from ms_slam_env.benchmark.report.blocks import Block, Figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.glossary import Meanings


class Kind(ABC):
    """A kind of result: how it is recognised and which figures it has.

    Attributes:
        name: in a few words.
        about: what such a result shows, for somebody who does not know it.
    """

    name: str
    about: str

    @abstractmethod
    def fits(self, content: dict[str, Any]) -> bool:
        """Whether JSON ``content`` is of this kind."""

    @abstractmethod
    def figures(self, result: Result) -> list[Figure]:
        """Interactive figures, in the order of importance."""

    def tables(self, result: Result) -> list[Block]:
        """Tables that the folder's Markdown and the JSON rows do not hold already."""
        return []

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """Of columns that mean something else here than in the glossary; see ``meaning``."""
        return ()
