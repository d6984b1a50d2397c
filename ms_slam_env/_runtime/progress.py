"""Progress on standard error: a bar in a terminal, plain lines in a log."""

from __future__ import annotations

import sys
import time
from typing import Any

from tqdm import tqdm

EVERY_S = 30.0
"""Seconds between the lines of a log."""


class Bar(tqdm):
    """A tqdm that writes a line every 30 s, and at its end, where there is no terminal.

    A bar that is drawn over itself would fill a log with carriage returns.
    """

    monitor_interval = 10  # seconds, of tqdm's thread, which sees to an iteration that takes long

    def __init__(self, *args: Any, **options: Any) -> None:
        self._in_terminal = sys.stderr.isatty()
        self._written_at = time.monotonic()
        if not self._in_terminal:
            options = {"mininterval": EVERY_S, "maxinterval": EVERY_S, **options}
            options["bar_format"] = (
                "{desc}: {n_fmt} of {total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
            )
        super().__init__(*args, **options)

    def display(self, msg: str | None = None, pos: int | None = None) -> Any:
        """Draw the bar; in a log write a line, unless the last was a moment ago."""
        if self._in_terminal:
            return super().display(msg, pos)
        if time.monotonic() - self._written_at >= EVERY_S:
            self._write_line()
        return True

    def clear(self, nolock: bool = False) -> None:
        """Make room for another line; in a log there is nothing to be cleared."""
        if self._in_terminal:
            super().clear(nolock)

    def close(self) -> None:
        """End the bar, in a log with a last line."""
        if not self.disable and not self._in_terminal:
            self._write_line()
            self.disable = True
            self._decr_instances(self)  # type: ignore[attr-defined]
        super().close()

    def _write_line(self) -> None:
        self._written_at = time.monotonic()
        self.fp.write(f"{self}\n")
        self.fp.flush()
