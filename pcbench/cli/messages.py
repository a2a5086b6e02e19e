"""What the command line says beside results: warnings, progress, and errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Lock, Thread
from time import monotonic
from typing import NoReturn

import click

from pcbench.cli.log import LOGGER
from pcbench.progress import TimeEstimate, duration

_MAX_SILENCE_S = 9.0  # in a pipe or a file, where nothing moves


def warn(text: object) -> None:
    """One line on stderr."""
    line = " ".join(str(text).splitlines())
    LOGGER.warning("%s", line)
    click.echo(f"warning: {line}", err=True)


def warn_unless(quiet: bool) -> Callable[[str], None]:
    """What readers call with their warnings."""
    return (lambda text: LOGGER.warning("%s", text)) if quiet else warn


def fail(message: str) -> NoReturn:
    """End the process with one line on stderr and exit code 2."""
    line = " ".join(message.split())
    LOGGER.error("%s", line, exc_info=sys.exc_info()[0] is not None)
    with suppress(OSError):  # nobody reads it
        click.echo(f"error: {line}", err=True)
    sys.exit(2)


@contextmanager
def steps(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show what is being done, for how long, how far it is and how long it takes yet, as far as the steps tell
    (`pcbench.progress`): a line that changes on a terminal, and elsewhere a line every few seconds on stderr.
    """
    shown = _silent() if quiet else _on_terminal() if sys.stderr.isatty() else _in_lines()
    with shown as show:

        def step(text: str) -> None:
            LOGGER.info("step: %s", text)
            show(text)

        yield step


@contextmanager
def _silent() -> Iterator[Callable[[str], None]]:
    yield lambda _: None


@contextmanager
def _in_lines() -> Iterator[Callable[[str], None]]:
    """A line on stderr whenever nothing was said for a while; what is done at once says nothing."""
    estimate, lock, ended = TimeEstimate(monotonic()), Lock(), Event()
    start, current = monotonic(), "starting"

    def step(text: str) -> None:
        nonlocal current
        with lock:
            estimate.begin(text, monotonic())
            current = text

    def speak() -> None:
        while not ended.wait(_MAX_SILENCE_S):
            with lock:
                now = monotonic()
                left = estimate.left(now)
                words = "" if left is None else f" (about {duration(left)} left)"
                line = f"[{_clock(now - start)}] {current}{words}"
            with suppress(OSError, ValueError):  # nobody reads it
                click.echo(line, err=True)

    thread = Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield step
    finally:
        ended.set()
        thread.join()


@contextmanager
def _on_terminal() -> Iterator[Callable[[str], None]]:
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
    from rich.progress_bar import ProgressBar
    from rich.text import Text

    estimate = TimeEstimate(monotonic())

    class Bar(ProgressColumn):
        def render(self, task: Task) -> ProgressBar:
            share = estimate.share(monotonic())
            return ProgressBar(total=1.0, completed=share or 0.0, width=24, pulse=share is None)

    class Left(ProgressColumn):
        def render(self, task: Task) -> Text:
            left = estimate.left(monotonic())
            return Text("" if left is None else f"{duration(left)} left")

    columns = (SpinnerColumn(), Bar(), TimeElapsedColumn(), Left(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)

        def step(text: str) -> None:
            estimate.begin(text, monotonic())
            progress.update(task, description=escape(text))

        yield step


def _clock(seconds: float) -> str:
    """Minutes and seconds, such as 12:05."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02}"
