"""Progress of a reconstruction: a plugin prints lines, and the parent process may display them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import TypeVar

from pcbench.progress import duration

LINE_PREFIX = "progress: "
_POLL_INTERVAL_S = 0.5  # between reads of the log

T = TypeVar("T")


def progress(text: str) -> None:
    """Report the progress of a reconstruction from within a plugin."""
    print(f"{LINE_PREFIX}{text}", file=sys.stderr, flush=True)


def with_time_left(items: Sequence[T], what: str) -> Iterator[T]:
    """Yield the items; report after each how many are done and the estimated time left.

    Items finished by an earlier run take no time, so the rate is that of the items that took more than 0.1 s.

    Args:
        items: the items to process.
        what: name of the work, for the reports.
    """
    worked, slow = 0.0, 0
    for k, item in enumerate(items, start=1):
        start = time.monotonic()
        yield item
        took = time.monotonic() - start
        if took > 0.1:
            worked, slow = worked + took, slow + 1
        time_left = f", {duration(worked / slow * (len(items) - k))} left" if slow and k < len(items) else ""
        progress(f"{what}: {k} of {len(items)} images{time_left}")


@contextmanager
def follow_log(log: Path, show: Callable[[str], None] | None) -> Iterator[None]:
    """Call `show` with each text that `progress` adds to a log while the block runs."""
    if show is None:
        yield
        return
    ended = Event()

    def follow() -> None:
        rest = ""
        with log.open(errors="replace") as file:
            while True:
                last = ended.wait(_POLL_INTERVAL_S)
                *lines, rest = (rest + file.read()).split("\n")
                for line in lines:
                    if line.startswith(LINE_PREFIX):
                        show(line.removeprefix(LINE_PREFIX))
                if last:
                    return

    thread = Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
