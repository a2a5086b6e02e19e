"""The option --json: write the result as one JSON document, to a file or to standard output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from pcbench.cli.help import option
from pcbench.errors import InputError
from pcbench.options import OptionGroup

_Command = TypeVar("_Command", bound=Callable[..., Any])


def json_option(what: str) -> Callable[[_Command], _Command]:
    """Return the option `--json FILE`; `what` names the document in the help text."""
    return option(
        "--json",
        "json_file",
        type=click.Path(),
        metavar="FILE",
        help=f"Write {what} to FILE; - for standard output.",
        group=OptionGroup.OUTPUT,
    )


@dataclass(frozen=True)
class JsonOutput:
    """The destination of a JSON document.

    Attributes:
        target: the value of `--json`: a file's name, `-` for standard output, or None for nowhere.
    """

    target: str | None

    @property
    def on_stdout(self) -> bool:
        """Return whether the document goes to standard output, which then gets nothing else."""
        return self.target == "-"

    @property
    def file(self) -> Path | None:
        """The file, if the destination is one."""
        return None if self.target is None or self.on_stdout else Path(self.target)

    def check(self, inputs: Sequence[Path], others: Sequence[Path] = (), folder: Path | None = None) -> None:
        """Check that the file can be written, before anything is computed.

        Args:
            inputs: input files and folders, which must not be replaced.
            others: files that the same command writes.
            folder: folder that the same command writes, if any.

        Raises:
            InputError: its folder does not exist, or an input or another result would be replaced.
        """
        from pcbench.io.outputs import check_output

        if self.file is None:
            return
        check_output(self.file, inputs, others)
        if folder is not None and self.file.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{self.file}: the folder {folder} is for other results: choose a file outside")

    def write(self, values: Any) -> None:
        """Write values that `pcbench.report.to_json` accepts to the destination, if there is one.

        Raises:
            OSError: the file cannot be written.
        """
        from pcbench.report import to_json
        from pcbench.scratch import atomic_write

        if self.on_stdout:
            click.echo(to_json(values), nl=False)
        elif self.file is not None:
            with atomic_write(self.file) as file:
                file.write(to_json(values).encode())
