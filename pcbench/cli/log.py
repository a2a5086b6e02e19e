"""The log file of a run: steps, settings, versions, warnings and errors, with their times."""

from __future__ import annotations

import logging
import os
import platform
import shlex
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any

import click

from pcbench import __version__
from pcbench.errors import InputError
from pcbench.extras import LIBRARIES, installed_versions
from pcbench.regular_files import open_regular

LOGGER = logging.getLogger("pcbench")
LOGGER.addHandler(logging.NullHandler())  # otherwise Python prints unhandled warnings

_FIRST_LINE = "# pcbench log\n"  # identifies a log
_ENVIRONMENT_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "CUDA_VISIBLE_DEVICES", "COLUMNS")


class _LogFile(logging.FileHandler):
    """A log file. It keeps the function that showed Python's warnings before the log started."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.path, self.show_warning = path.resolve(), warnings.showwarning
        formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
        formatter.converter = time.gmtime
        self.setFormatter(formatter)

    def handleError(self, record: logging.LogRecord) -> None:
        """Report once that the log cannot be continued, for example on a full disk; the run continues without it."""
        end_log()
        click.echo(f"warning: {self.path}: the log ends here: {sys.exc_info()[1]}", err=True)

    def close(self) -> None:
        """Close the file; on a full disk, the remaining text is lost."""
        with suppress(OSError):
            super().close()


def start_log(path: Path) -> None:
    """Log to a new file, or continue an earlier log, until `end_log`.

    Raises:
        InputError: the file exists and is not a log.
        OSError: it cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(_FIRST_LINE)
    except FileExistsError:
        _check_is_log(path)
    except OSError as error:  # on a full disk it has no file name
        raise OSError(error.errno, error.strerror, str(path)) from error
    handler = _LogFile(path)
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.DEBUG)
    LOGGER.propagate = False

    def show(message: Any, category: Any, filename: str, lineno: int, *rest: Any, **options: Any) -> None:
        LOGGER.warning("%s: %s (%s, line %d)", category.__name__, message, filename, lineno)
        handler.show_warning(message, category, filename, lineno, *rest, **options)

    warnings.showwarning = show
    LOGGER.info("command: %s", shlex.join(["pcbench", *sys.argv[1:]]))
    LOGGER.info("folder: %s", Path.cwd())
    LOGGER.info("pcbench %s, Python %s, %s", __version__, platform.python_version(), platform.platform())
    names = ("numpy", "scipy", *(library.name for library in LIBRARIES.values()))
    LOGGER.info("libraries: %s", ", ".join(f"{name} {version}" for name, version in installed_versions(names).items()))
    LOGGER.info(
        "environment: %s",
        ", ".join(f"{k}={os.environ[k]}" for k in _ENVIRONMENT_VARIABLES if k in os.environ) or "default",
    )


def end_log() -> None:
    """Close the log, if there is one."""
    for handler in LOGGER.handlers[:]:
        if isinstance(handler, _LogFile):
            warnings.showwarning = handler.show_warning
            LOGGER.removeHandler(handler)
            handler.close()
            LOGGER.setLevel(logging.NOTSET)
            LOGGER.propagate = True


def log_settings(command: click.Command) -> None:
    """Make a command, or the commands of a group, log their arguments and options before they run."""
    for inner in command.commands.values() if isinstance(command, click.Group) else ():
        log_settings(inner)
    if command.callback is not None and not isinstance(command, click.Group):
        command.callback = _log_calls(command.callback)


def _log_calls(callback: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(callback)
    def run(*arguments: Any, **options: Any) -> Any:
        context = click.get_current_context()
        for name, value in context.params.items():
            source = context.get_parameter_source(name)
            LOGGER.info("setting: %s = %r (%s)", name, value, "" if source is None else source.name.lower())
        for handler in LOGGER.handlers:
            if isinstance(handler, _LogFile):
                _check_not_log(handler.path, context.params.values())
        start = time.monotonic()
        result = callback(*arguments, **options)
        LOGGER.info("finished in %.1f s", time.monotonic() - start)
        return result

    return run


def _check_not_log(log: Path, values: Any) -> None:
    """Refuse arguments that name the log file."""
    for value in values:
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, str | Path) and os.path.realpath(part) == str(log):
                raise InputError(f"{part}: this is the log file: choose another name for one of them")


def _check_is_log(path: Path) -> None:
    try:
        with open_regular(path) as file:
            first = file.read(len(_FIRST_LINE))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if first and first != _FIRST_LINE.encode():
        raise InputError(
            f"{path}: expected a new file or an earlier log of pcbench, got another file: choose a new name"
        )
