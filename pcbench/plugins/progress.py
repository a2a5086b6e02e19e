"""How far a reconstruction is: lines that a plugin prints, and that whoever runs it may show."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import TypeVar

from pcbench.progress import duration

MARK = "progress: "  # what the lines begin with
_PERIOD_S = 0.5  # between looks into the log

T = TypeVar("T")


def progress(text: str) -> None:
    """Say how far a reconstruction is; from within a plugin."""
    print(f"{MARK}{text}", file=sys.stderr, flush=True)


def with_time_left(items: Sequence[T], what: str) -> Iterator[T]:
    """The items, with a line after each on how many are done and how much time is left.

    What was kept from an earlier run takes no time: the rate is that of the items that took a tenth of a second.
    """
    worked, slow = 0.0, 0
    for k, item in enumerate(items, start=1):
        start = time.monotonic()
        yield item
        took = time.monotonic() - start
        if took > 0.1:
            worked, slow = worked + took, slow + 1
        left = f", {duration(worked / slow * (len(items) - k))} left" if slow and k < len(items) else ""
        progress(f"{what}: {k} of {len(items)} images{left}")


@contextmanager
def followed(log: Path, show: Callable[[str], None] | None) -> Iterator[None]:
    """While the block runs, call `show` with each text that `progress` adds to a log."""
    if show is None:
        yield
        return
    ended = Event()

    def follow() -> None:
        rest = ""
        with log.open(errors="replace") as file:
            while True:
                last = ended.wait(_PERIOD_S)
                *lines, rest = (rest + file.read()).split("\n")
                for line in lines:
                    if line.startswith(MARK):
                        show(line.removeprefix(MARK))
                if last:
                    return

    thread = Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
