"""Let Ctrl-C and SIGTERM end a command, even if a library swallows the exception."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_AGAIN_S = 0.2


class Terminated(KeyboardInterrupt):
    """Raised on SIGTERM, which ends a command like Ctrl-C and keeps the same partial work."""


def recorded(error: BaseException) -> str:
    """Text to record for an error that ended some work: its message, or the signal's name."""
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted by {'SIGTERM' if isinstance(error, Terminated) else 'SIGINT'}"
    return str(error) or type(error).__name__


class Interrupts:
    """Context in which SIGINT and SIGTERM raise KeyboardInterrupt until it is handled.

    SIGTERM raises its subclass `Terminated`.

    Some libraries lose an interrupt, because they use ``except BaseException`` in callbacks or
    around imports (trimesh has dozens). So a timer checks every 0.2 s whether the exception is
    still being handled somewhere up the stack, and raises it again if not. A second signal
    interrupts the handling of the first.

    Outside the main thread, and for signals that the process was started to ignore, the context
    has no effect.

    Attributes:
        signal: signal received; None if none.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._raised: KeyboardInterrupt | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._interrupt)
        if hasattr(signal, "setitimer"):
            self._before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._insist)
        return self

    def __exit__(self, *exception: object) -> None:
        self._set_timer(0.0)
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        self._raised = Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
        self._set_timer(_AGAIN_S)
        raise self._raised

    def _insist(self, number: int, frame: FrameType | None) -> None:
        error = sys.exc_info()[1]
        while error is not None and error is not self._raised:
            error = error.__context__
        if error is None and self._raised is not None:
            raise self._raised

    def _set_timer(self, seconds: float) -> None:
        if signal.SIGALRM in self._before:
            signal.setitimer(signal.ITIMER_REAL, seconds, seconds)


@contextmanager
def sigterm_exits() -> Iterator[None]:
    """Let SIGTERM end the process like ``sys.exit``, so that cleanup runs.

    Used in workers. Has no effect outside the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def kept(what: str) -> Iterator[None]:
    """Add to an interrupt in this context the text ``what``, which says what work is kept."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        interrupt.args = interrupt.args or (what,)
        raise
