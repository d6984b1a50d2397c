"""Where an environment's time goes; kept out of ``info`` so that infos stay reproducible."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Timings:
    """Seconds spent in each stage: in its last call, and in total with the number of calls.

    Stages nest: ``observation`` contains the ``lookahead`` that the variant of that name asks for.
    """

    def __init__(self) -> None:
        self.total: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)
        self.last: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Charge the enclosed block to stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.last[name] = elapsed
            self.total[name] += elapsed
            self.calls[name] += 1

    def clear(self) -> None:
        """Forget everything."""
        self.total.clear()
        self.calls.clear()
        self.last.clear()

    def mean_ms(self) -> dict[str, float]:
        """Mean milliseconds a call of each stage."""
        return {name: 1e3 * self.total[name] / self.calls[name] for name in self.total}
