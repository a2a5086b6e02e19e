"""Commands whose help lists options in groups, and whose values are completed.

The options that matter most have no group and come first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from pcbench.options import OptionGroup, Values

_Command = TypeVar("_Command", bound=Callable[..., Any])

_MAX_NAME_WIDTH = 21  # columns of an option's name and value; the help of longer ones starts on the next line


class GroupedOption(click.Option):
    """An option of a group in the help of its command.

    Attributes:
        group: its group; None: it is listed before all groups.
    """

    def __init__(
        self, *arguments: Any, group: OptionGroup | None = None, values: Values | None = None, **others: Any
    ) -> None:
        """Create an option of click; `values` are offered when the user completes its value."""
        if values is not None:
            others["shell_complete"] = completion(values)
        super().__init__(*arguments, **others)
        self.group = group
        numbers = {click.types.IntParamType: "N", click.types.FloatParamType: "NUMBER"}
        if self.metavar is None:
            self.metavar = next((text for kind, text in numbers.items() if isinstance(self.type, kind)), None)

    def get_help_extra(self, ctx: click.Context) -> Any:
        """Return what the help says in brackets, without the range of a number, which its error message states."""
        extra = super().get_help_extra(ctx)
        extra.pop("range", None)
        return extra


class GroupedCommand(click.Command):
    """A command whose help lists options in the groups of `pcbench.options.OptionGroup`."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options without a group, then one section for each group, with their help in one column."""
        sections: dict[OptionGroup | None, list[tuple[str, str]]] = {None: [], **{group: [] for group in OptionGroup}}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record is not None:
                sections[getattr(parameter, "group", None)].append(record)
        names = [name for records in sections.values() for name, _ in records]
        width = min(max(map(len, names)), _MAX_NAME_WIDTH)
        for group, records in sections.items():
            if records:
                with formatter.section(group or "Options"):
                    formatter.write_dl([(f"{name:{width}}", text) for name, text in records], col_max=width)


class GroupOfCommands(click.Group):
    """Commands that share their first word, such as `synth`."""

    command_class = GroupedCommand


class CommandLine(click.Group):
    """All commands, listed by what they are for.

    Attributes:
        sections: commands by the title of their section in the help.
    """

    def __init__(self, *arguments: Any, **others: Any) -> None:
        super().__init__(*arguments, **others)
        self.sections: dict[str, list[click.Command]] = {}

    def add_section(self, title: str, *commands: click.Command) -> None:
        """Add commands, and a section that lists them."""
        self.sections[title] = [*commands]
        for each in commands:
            self.add_command(each)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a section for each of `sections`, with the purposes of the commands in one column."""
        width = max(map(len, self.commands))
        limit = formatter.width - width - 6
        for title, commands in self.sections.items():
            with formatter.section(title):
                formatter.write_dl([(f"{each.name:{width}}", each.get_short_help_str(limit)) for each in commands])


def command(**attributes: Any) -> Callable[[Callable[..., Any]], click.Command]:
    """Return the decorator that makes a `GroupedCommand` of a function; arguments as for `click.command`."""
    decorator: Callable[[Callable[..., Any]], click.Command] = click.command(**{"cls": GroupedCommand, **attributes})
    return decorator


def option(
    *names: str, group: OptionGroup | None = None, values: Values | None = None, **attributes: Any
) -> Callable[[_Command], _Command]:
    """Return the decorator that adds an option.

    Args:
        *names: as for `click.option`.
        group: its group in the help; None for the options that matter most.
        values: values that completion offers; see `pcbench.options.Option`.
        **attributes: as for `click.option`.
    """
    return click.option(*names, cls=GroupedOption, group=group, values=values, **attributes)


def argument(*names: str, values: Values, **attributes: Any) -> Callable[[_Command], _Command]:
    """Return the decorator that adds an argument whose values are completed; others as for `click.argument`."""
    return click.argument(*names, shell_complete=completion(values), **attributes)


def completion(values: Values) -> Callable[[click.Context, click.Parameter, str], list[CompletionItem]]:
    """Return the function of click that completes a value, or the last one of a list with commas.

    Of a value such as `points:FILE` it offers the part up to the colon. If no value fits, it offers files, because many
    options also accept one.
    """

    def complete(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        given = incomplete[: incomplete.rfind(",") + 1]
        names = values() if callable(values) else values
        offers = [given + f"{name}{colon}" for name, colon, _ in (value.partition(":") for value in names)]
        fitting = [CompletionItem(offer) for offer in offers if offer.startswith(incomplete)]
        return fitting or [CompletionItem(incomplete, type="file")]

    return complete
