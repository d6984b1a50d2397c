"""Time spent in the stages of an environment, outside ``info`` so that infos are reproducible."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Timings:
    """Seconds spent in each stage: in its last call, and in total with the number of calls.

    Stages nest: ``observation`` contains the ``lookahead`` of the observation variant of that name.
    ``total`` includes nested stages; ``own`` does not, so that the ``own`` times of all stages add
    up to the time spent in any stage.
    """

    def __init__(self) -> None:
        self.total: dict[str, float] = defaultdict(float)
        self.own: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)
        self.last: dict[str, float] = {}
        self._nested: list[float] = []  # seconds in nested stages, for each open stage

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time of the enclosed block for stage ``name``."""
        start = time.perf_counter()
        self._nested.append(0.0)
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.last[name] = elapsed
            self.total[name] += elapsed
            self.own[name] += elapsed - self._nested.pop()
            self.calls[name] += 1
            if self._nested:
                self._nested[-1] += elapsed

    def clear(self) -> None:
        """Reset all times."""
        self.total.clear()
        self.own.clear()
        self.calls.clear()
        self.last.clear()
