"""The option --fail-if: end with an exit code 3 if a condition on the results holds."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pcbench.cli.help import option
from pcbench.cli.log import LOGGER
from pcbench.cli.streams import finish_output
from pcbench.errors import InputError, one_line
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.report.conditions import Condition, NamedValues

_Command = TypeVar("_Command", bound=Callable[..., Any])

CONDITION_HOLDS = 3
"""Exit code of a command that succeeded, and of whose results a condition holds."""


def fail_if_option(what: str, example: str) -> Callable[[_Command], _Command]:
    """Return the option `--fail-if CONDITION`, whose parameter `fail_if` is a tuple of conditions.

    Args:
        what: the document whose names the conditions have.
        example: a condition, for the help text.
    """
    return option(
        "--fail-if",
        "fail_if",
        multiple=True,
        metavar="CONDITION",
        callback=_parse,
        help=f"End with exit code {CONDITION_HOLDS} if this holds for {what}, such as '{example}' (repeatable).",
        group=OptionGroup.OUTPUT,
    )


def fail_if_any(conditions: Sequence[Condition], subjects: Sequence[NamedValues], inner: Sequence[str] = ()) -> None:
    """End the process with `CONDITION_HOLDS`, after a line on stderr for each condition that holds, if any does.

    Args:
        conditions: the conditions.
        subjects: what they are tested on.
        inner: keys that a name may omit, see `pcbench.report.conditions.number_of`.

    Raises:
        InputError: a name does not exist in the results.
    """
    if not conditions:
        return
    from pcbench.report.conditions import failures

    lines = failures(conditions, subjects, inner)
    for line in map(one_line, lines):
        LOGGER.error("%s", line)
        click.echo(line, err=True)
    if lines:
        finish_output()
        sys.exit(CONDITION_HOLDS)


def check_names_of(kind: type, conditions: Sequence[Condition], inner: Sequence[str] = ()) -> None:
    """Check, before anything is computed, that the names of conditions exist in results of a type.

    Args:
        kind: type whose fields are the keys of the JSON object.
        conditions: the conditions.
        inner: keys that a name may omit.

    Raises:
        InputError: a name does not exist.
    """
    if not conditions:
        return
    from pcbench.io.json_values import json_example
    from pcbench.report.conditions import check_names

    check_names(conditions, json_example(kind), inner)


def _parse(context: click.Context, option: click.Parameter, texts: tuple[str, ...]) -> tuple[Condition, ...]:
    if not texts:
        return ()
    from pcbench.report.conditions import Condition

    try:
        return tuple(map(Condition.parse, texts))
    except InputError as error:
        raise click.BadParameter(str(error)) from None
