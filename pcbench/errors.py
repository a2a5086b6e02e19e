"""Errors that a user can resolve, and notices that accompany a result.

The command line prints each on one line.
"""

from __future__ import annotations

import difflib
import errno
import logging
from collections.abc import Iterable
from dataclasses import dataclass

_MAX_MESSAGE_LENGTH = 1000  # characters; longer messages quote their input at length


class PcbenchError(Exception):
    """Base class of all errors that a user can resolve: the message says what was expected, what came, what to do.

    The message is one printable line of at most 1,000 characters, whatever the input that it quotes.
    """

    def __str__(self) -> str:
        return one_line(super().__str__(), _MAX_MESSAGE_LENGTH)


class InputError(PcbenchError, ValueError):
    """A file, an array or an option is invalid."""


class RegistrationError(PcbenchError):
    """The candidate could not be registered to the reference."""


class ReconstructionError(PcbenchError):
    """A reconstructor computed no cloud: the images do not allow it, or it failed."""


class WorkerError(PcbenchError):
    """A task ended its workers again and again, or a cluster cannot be used."""


class MissingExtra(PcbenchError, ImportError):
    """An optional library is not installed or cannot be loaded.

    Args:
        library: name of the library on the package index.
        extra: extra of pcbench that installs it.
        reason: why an installed library cannot be used.
        remedy: what to do; by default, install the extra.
    """

    def __init__(self, library: str, extra: str, reason: str = "", remedy: str = "") -> None:
        because = f" ({reason})" if reason else ""
        remedy = remedy or f"pip install 'pcbench[{extra}]'"
        self._arguments = (library, extra, reason, remedy)
        super().__init__(f"{library} is needed for this{because}: {remedy}")

    def __reduce__(self) -> tuple[type[MissingExtra], tuple[str, ...]]:
        """Pickle the arguments instead of the message, so that workers can return the error."""
        return type(self), self._arguments


@dataclass(frozen=True)
class Notice:
    """A warning that accompanies a result: what a reader should know before relying on it.

    Attributes:
        code: identifier for programs, in lower case with hyphens, such as `no-convergence`.
        text: one sentence for readers.
    """

    code: str
    text: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", one_line(self.text, _MAX_MESSAGE_LENGTH))

    def __str__(self) -> str:
        return self.text


def similar_names(name: object, names: Iterable[str], most: int = 3, least: float = 0.6) -> list[str]:
    """Return the names that are similar to one that does not exist, the most similar one first.

    Args:
        name: the name that does not exist.
        names: those that do.
        most: number of names that are returned at most.
        least: similarity from 0 to 1 from which a name is returned.
    """
    by_lower_case = {each.lower(): each for each in reversed(list(names))}  # of equal ones, the first
    matches = difflib.get_close_matches(str(name).lower(), by_lower_case, most, least)
    return [by_lower_case[each] for each in matches]


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return "; did you mean ...?", for the end of an error about a name that does not exist; "" if none is similar."""
    similar = similar_names(name, names)
    return f"; did you mean {' or '.join(similar)}?" if similar else ""


def one_line(text: str, max_length: int | None = None) -> str:
    """Return a text on one line, with a question mark for each character that controls a terminal.

    Bytes of file names that are no Unicode stay.

    Args:
        text: the text.
        max_length: number of characters above which the middle is left out; the end has the remedy.
    """
    line = " ".join(text.split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() or "\udc80" <= c <= "\udcff" else "?" for c in line)
    if max_length is None or len(line) <= max_length:
        return line
    tail = max_length // 3
    return f"{line[: max_length - tail - 5]} ... {line[-tail:]}"


def lacks_files(error: BaseException) -> bool:
    """Return whether the limit of open files was reached, whatever file the error names."""
    return isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE)


def reason_of(error: BaseException) -> str:
    """Return why a file cannot be opened and what to do; the error's own text if it has no such reason."""
    if lacks_files(error):
        return "too many open files: allow more with ulimit -n 1024, and run the same command again"
    if isinstance(error, FileNotFoundError):
        return "no such file: check the name and the folder"
    if isinstance(error, PermissionError):
        return "no permission: change its permissions, or name another file"
    if isinstance(error, IsADirectoryError):
        return "it is a folder: name a file"
    if isinstance(error, OSError) and error.errno == errno.EFBIG:
        return "too large for this disk or for ulimit -f: allow more with ulimit -f unlimited, or use another disk"
    return getattr(error, "strerror", None) or str(error)


def describe_damage(error: BaseException) -> str:
    """Return what is wrong with a file of pcbench, from the error of the code that interprets its values."""
    if isinstance(error, KeyError):
        return f"{error} is missing"
    if isinstance(error, ValueError):  # its text says what was expected, as that of InputError does
        return str(error)
    return "a value has another form than pcbench writes"


def record_error(error: BaseException) -> str:
    """Log an error that becomes part of a result instead of ending the run, and return its message.

    The traceback is logged by the logger `pcbench` at debug level: `pcbench --log FILE` records it.
    """
    logging.getLogger("pcbench").debug("recorded in the result: %s", error, exc_info=error)
    return str(error)
