"""Ctrl-C and SIGTERM end a command, also where a library swallows the exception."""

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
    """SIGTERM, which ends a command as Ctrl-C does: what is kept then, is kept now."""


def recorded(error: BaseException) -> str:
    """What is recorded of an error that ended some work: its text, of an interrupt the signal."""
    if isinstance(error, KeyboardInterrupt):
        return f"interrupted by {'SIGTERM' if isinstance(error, Terminated) else 'SIGINT'}"
    return str(error) or type(error).__name__


class Interrupts:
    """While this context lasts, SIGINT and SIGTERM raise KeyboardInterrupt until it is handled.

    That of SIGTERM is `Terminated`.

    Libraries have ``except BaseException`` around their imports (trimesh has dozens), in callbacks
    and the like, which lose an interrupt. So a timer looks every 0.2 s whether the exception is
    still under way, being handled somewhere up the stack, and raises it again where it is not. A
    second signal interrupts what the first one set off.

    Outside the main thread, and for a signal that the process was started to ignore, this changes
    nothing.

    Attributes:
        signal: that came; None if none did.
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
    """Let SIGTERM end the process as ``sys.exit`` does: what is to be done at the end is done.

    Workers are ended by it. Outside the main thread this changes nothing.
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
    """Let an interrupt in here say ``what`` is kept of the work."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        interrupt.args = interrupt.args or (what,)
        raise
