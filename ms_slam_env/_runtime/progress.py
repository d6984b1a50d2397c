"""Progress on standard error: a bar in a terminal, plain lines in a log."""

from __future__ import annotations

import sys
import time
from typing import Any

from tqdm import tqdm

EVERY_S = 30.0
"""Seconds between the lines of a log."""


class Bar(tqdm):
    """A tqdm bar that, without a terminal, writes a line every 30 s and at its end.

    Redrawing the bar would fill a log with carriage returns.
    """

    monitor_interval = 10  # seconds, for tqdm's thread that redraws during long iterations

    def __init__(self, *args: Any, **options: Any) -> None:
        self._in_terminal = sys.stderr.isatty()
        self._written_at = time.monotonic()
        if not self._in_terminal:
            options = {"mininterval": EVERY_S, "maxinterval": EVERY_S, **options}
            options["bar_format"] = (
                "{desc}: {n_fmt} of {total_fmt}, {elapsed} elapsed, {remaining} left{postfix}"
            )
        super().__init__(*args, **options)

    def display(self, msg: str | None = None, pos: int | None = None) -> Any:
        """Draw the bar; in a log, write a line if the last one is old enough."""
        if self._in_terminal:
            return super().display(msg, pos)
        if time.monotonic() - self._written_at >= EVERY_S:
            self._write_line()
        return True

    def clear(self, nolock: bool = False) -> None:
        """Make room for another line; in a log there is nothing to clear."""
        if self._in_terminal:
            super().clear(nolock)

    def set_description(self, desc: str | None = None, refresh: bool | None = True) -> None:
        """Change the text without tqdm's colon: both formats have one."""
        self.set_description_str(desc, refresh)

    def close(self) -> None:
        """Close the bar; in a log, write a last line."""
        if not self.disable and not self._in_terminal:
            self._write_line()
            self.disable = True
            self._decr_instances(self)  # type: ignore[attr-defined]
        super().close()

    def _write_line(self) -> None:
        self._written_at = time.monotonic()
        self.fp.write(f"{self}\n")
        self.fp.flush()
