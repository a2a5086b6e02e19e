"""What the command line says beside results: warnings, progress, and errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import NoReturn

import click


def warn(text: object) -> None:
    """One line on stderr."""
    click.echo(f"warning: {' '.join(str(text).splitlines())}", err=True)


def warn_unless(quiet: bool) -> Callable[[str], None]:
    """What readers call with their warnings."""
    return (lambda _: None) if quiet else warn


def fail(message: str) -> NoReturn:
    """End the process with one line on stderr and exit code 2."""
    click.echo(f"error: {' '.join(message.split())}", err=True)
    sys.exit(2)


@contextmanager
def steps(quiet: bool) -> Iterator[Callable[[str], None]]:
    """A line on the terminal: what is being done, for how long, how far it is and how long it takes yet, as far as the
    steps tell (`pcbench.progress`); nothing where stderr is no terminal.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
    from rich.progress_bar import ProgressBar
    from rich.text import Text

    from pcbench.progress import TimeEstimate

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


def duration(seconds: float) -> str:
    """As short as it may be: 8 s, 3 min, 2 h."""
    for size, name in ((3600, "h"), (60, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{max(1.0, seconds):.0f} s"
