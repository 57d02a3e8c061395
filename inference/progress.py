"""Tell people that something is going on: progress bars after two seconds, compilation as it happens."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE = 2.0  # [s]
_watched: set[str] = set()


@contextmanager
def announce(what: str, after: float = 1.0) -> Iterator[None]:
    """Print one line if the block takes longer than `after` seconds; watched the first time in a process only."""
    if what in _watched:
        yield
        return
    _watched.add(what)
    message = f"{what} (the first run on a machine only) ..."
    timer = threading.Timer(after, lambda: print(message, file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class Progress:
    """A bar that appears once the work has lasted two seconds; silent where `show` is False."""

    def __init__(self, what: str, total: int, show: bool = True) -> None:
        self.what, self.total, self.show = what, total, show
        self.begin, self.done = time.perf_counter(), 0
        self.bar: Any = None

    def __enter__(self) -> Progress:
        return self

    def advance(self, steps: int) -> None:
        """Count steps done."""
        self.done += steps
        if not self.show or time.perf_counter() - self.begin < PATIENCE:
            return
        if self.bar is None:
            from rich.console import Console
            from rich.progress import Progress as Bar

            self.bar = Bar(console=Console(stderr=True), transient=True)
            self.bar.start()
            self.task = self.bar.add_task(self.what, total=self.total)
        self.bar.update(self.task, completed=self.done)

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()
