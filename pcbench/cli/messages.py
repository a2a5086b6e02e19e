"""What the command line says beside results: warnings, progress, and errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    """A line on the terminal that says what is being done and for how long; nothing where stderr is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda text: progress.update(task, description=escape(text))
