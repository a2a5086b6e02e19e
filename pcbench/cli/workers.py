"""Options of studies whose runs can go on at the same time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pcbench.cli.help import option
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.tasks import Workers

_Command = TypeVar("_Command", bound=Callable[..., Any])


def workers_options(default: str) -> Callable[[_Command], _Command]:
    """Return the options `--workers` and `--cluster`.

    Args:
        default: what happens without them.
    """

    def add(command: _Command) -> _Command:
        command = option(
            "--cluster",
            metavar="ADDRESS",
            help="Run on a Dask cluster: the address of its scheduler, or its scheduler file (extra `cluster`).",
            group=OptionGroup.LARGE_DATA,
        )(command)
        return option(
            "--workers",
            type=click.IntRange(1, 10_000),
            metavar="N",
            help=f"Number of runs at the same time, each with one thread.  [default: {default}]",
            group=OptionGroup.LARGE_DATA,
        )(command)

    return add


def chosen_workers(count: int | None, cluster: str | None) -> Workers | None:
    """Return where runs go on at the same time; None without any of the options."""
    from pcbench.tasks import Workers

    return None if count is None and cluster is None else Workers(count, cluster)
