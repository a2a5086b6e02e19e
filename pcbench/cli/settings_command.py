"""Commands whose options are the fields of settings, described by `pcbench.options`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import click

from pcbench.cli.help import GroupedCommand, GroupedOption
from pcbench.cli.options import FiniteRange
from pcbench.options import Option, options_of


class SettingsCommand(GroupedCommand):
    """A command with an option for each field of settings that has one.

    Settings are imported when their options are needed, because they import numpy.

    Attributes:
        settings: classes of settings, each as `module:name`.
        after: name of the parameter after which their options are listed.
    """

    def __init__(self, *arguments: Any, settings: Sequence[str], after: str, **others: Any) -> None:
        super().__init__(*arguments, **others)
        self.settings, self.after = settings, after
        self._options: list[click.Parameter] | None = None

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters of the command, with those of the settings."""
        params = super().get_params(ctx)
        if self._options is None:
            self._options = [_option(name, option) for name, option in self._described()]
        position = 1 + next(k for k, param in enumerate(params) if param.name == self.after)
        return [*params[:position], *self._options, *params[position:]]

    def _described(self) -> list[tuple[str, Option]]:
        limit_openblas()
        classes = [
            getattr(import_module(module), name) for module, _, name in (s.partition(":") for s in self.settings)
        ]
        return [item for settings in classes for item in options_of(settings).items()]


def _option(name: str, option: Option) -> click.Option:
    """Return the option of click that sets the field of a name."""
    kind: Any = click.Path() if option.metavar == "FILE" else None
    if (bounds := option.bounds) is not None:
        range_type = click.IntRange if bounds.kind is int else FiniteRange
        kind = range_type(min=bounds.low, max=bounds.high, min_open=bounds.is_open)  # type: ignore[arg-type]
    return GroupedOption(
        [option.flag, name],
        help=option.help,
        metavar=option.metavar,
        type=kind,
        is_flag=option.is_flag,
        multiple=option.is_repeatable,
        show_default=option.shows_default,
        default=False if option.is_flag else option.default if option.shows_default else None,
        group=option.group,
        values=option.values,
    )


def limit_openblas() -> None:
    """Limit OpenBLAS to one thread, before numpy is imported: threads slow down operations on small matrices."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
