"""Warnings, progress and one-line errors of the command line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from time import monotonic
from typing import NoReturn, Protocol

import click

from pcbench.cli.log import LOGGER
from pcbench.errors import one_line
from pcbench.progress import TimeEstimate, duration

_MESSAGE_INTERVAL_S = 9.0  # between progress lines in a pipe or a file


def warn(text: object) -> None:
    """Print a warning as one line on stderr."""
    line = one_line(str(text))
    LOGGER.warning("%s", line)
    click.echo(f"warning: {line}", err=True)


class PageOutcome(Protocol):
    """Results whose page or requested pictures may be missing."""

    @property
    def without_page(self) -> str | None:
        """Why the page is missing; None if it was written."""

    @property
    def without_figures(self) -> str | None:
        """Why requested pictures are missing; None if they were drawn."""


def warn_of_missing(outcome: PageOutcome) -> None:
    """Print why the page or requested pictures are missing, if they are."""
    for problem in filter(None, (outcome.without_page, outcome.without_figures)):
        warn(problem)


def warn_unless(quiet: bool) -> Callable[[str], None]:
    """Return the function that file readers call with their warnings: `warn`, or only the log if `quiet`."""
    return (lambda text: LOGGER.warning("%s", text)) if quiet else warn


def notice_unless(quiet: bool) -> Callable[[str], None]:
    """Return a function that prints a line on stderr, or only logs it if `quiet`."""

    def notice(text: str) -> None:
        line = one_line(text)
        LOGGER.info("%s", line)
        if not quiet:
            with suppress(OSError):  # stderr has no reader
                click.echo(line, err=True)

    return notice


def name_files(kind: str, out: Path, *files: str) -> str:
    """Return a line that names the files of a study's folder, its page first if there is one."""
    from pcbench.report.html import PAGE
    from pcbench.report.words import join_words

    page = [f"{PAGE} (a page to read or mail)"] if (out / PAGE).is_file() else []
    return f"{kind}: {out}/ has {join_words([*page, *files])}"


def report_error(message: str) -> None:
    """Print an error as one line on stderr."""
    line = one_line(message)
    LOGGER.error("%s", line, exc_info=sys.exc_info()[0] is not None)
    with suppress(OSError):  # stderr has no reader
        click.echo(f"error: {line}", err=True)


def fail(message: str) -> NoReturn:
    """End the process with one line on stderr and exit code 2."""
    report_error(message)
    sys.exit(2)


@dataclass(frozen=True)
class StepDisplay:
    """A display of the current step.

    Attributes:
        show: shows a step.
        paused: context in which other output may be printed.
    """

    show: Callable[[str], None]
    paused: Callable[[], AbstractContextManager[None]] = nullcontext

    def __call__(self, text: str) -> None:
        """Show a step, and log it."""
        LOGGER.info("step: %s", text)
        self.show(text)


class EarlyOutput:
    """Results that are printed during a run; a failure to print them does not end the run."""

    def __init__(self, display: StepDisplay) -> None:
        self._display = display
        self._error: OSError | None = None

    def print(self, write: Callable[[], None]) -> None:
        """Print results by a function, between steps."""
        try:
            with self._display.paused():
                write()
                sys.stdout.flush()
        except OSError as error:
            self._error = error
        except SystemExit:  # rich ends the process if the pipe has no reader
            self._error = BrokenPipeError()

    def check(self) -> None:
        """Raise the error of an earlier print, such as BrokenPipeError, if there was one."""
        if self._error is not None:
            raise self._error


@contextmanager
def steps(quiet: bool) -> Iterator[StepDisplay]:
    """Show the current step, the elapsed time and, if `pcbench.progress` can estimate it, the remaining time.

    On a terminal one line is updated; elsewhere a line is printed on stderr every nine seconds.
    """
    display = _silent() if quiet else _on_terminal() if sys.stderr.isatty() else _in_lines()
    with display as shown:
        yield shown


@contextmanager
def _silent() -> Iterator[StepDisplay]:
    yield StepDisplay(lambda _: None)


@contextmanager
def _in_lines() -> Iterator[StepDisplay]:
    """Print a line on stderr at intervals; a short command prints none."""
    estimate, lock, ended = TimeEstimate(monotonic()), Lock(), Event()
    start, current = monotonic(), "starting"

    def step(text: str) -> None:
        nonlocal current
        with lock:
            estimate.begin(text, monotonic())
            current = text

    def print_lines() -> None:
        while not ended.wait(_MESSAGE_INTERVAL_S):
            with lock:
                now = monotonic()
                left = estimate.seconds_left(now)
                words = "" if left is None else f" (about {duration(left)} left)"
                line = f"[{_clock(now - start)}] {current}{words}"
            with suppress(OSError, ValueError):  # stderr has no reader
                click.echo(line, err=True)

    thread = Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield StepDisplay(step)
    finally:
        ended.set()
        thread.join()


@contextmanager
def _on_terminal() -> Iterator[StepDisplay]:
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
            left = estimate.seconds_left(monotonic())
            return Text("" if left is None else f"{duration(left)} left")

    columns = (SpinnerColumn(), Bar(), TimeElapsedColumn(), Left(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)

        def step(text: str) -> None:
            estimate.begin(text, monotonic())
            progress.update(task, description=escape(text))

        @contextmanager
        def paused() -> Iterator[None]:
            progress.stop()  # otherwise rich would write what is printed to the standard error
            try:
                yield
            finally:
                progress.start()

        yield StepDisplay(step, paused)


def _clock(seconds: float) -> str:
    """Format a duration as minutes and seconds, such as 12:05."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02}"
