"""What pcbench raises when the user, not the program, has to act, and what it says of a result that it does give.

The command line prints either as one line.
"""

import logging
from dataclasses import dataclass


class PcbenchError(Exception):
    """Base of every error a user can mend: the message says what was expected, what came, and what to do."""


class InputError(PcbenchError, ValueError):
    """A file, an array or an option is not what it has to be."""


class RegistrationError(PcbenchError):
    """The candidate could not be brought onto the reference."""


class ReconstructionError(PcbenchError):
    """A reconstructor gave no cloud: the images do not allow it, or it broke down."""


class MissingExtra(PcbenchError, ImportError):
    """An optional library is not installed or does not load.

    Args:
        library: its name on the package index.
        extra: the extra of pcbench that installs it.
        reason: why it cannot be used, where it is installed.
        remedy: what to do; by default, install the extra.
    """

    def __init__(self, library: str, extra: str, reason: str = "", remedy: str = "") -> None:
        because = f" ({reason})" if reason else ""
        remedy = remedy or f"pip install 'pcbench[{extra}]'"
        super().__init__(f"{library} is needed for this{because}: {remedy}")


@dataclass(frozen=True)
class Notice:
    """A warning that belongs to a result: what a reader should know before trusting it.

    Attributes:
        code: a short name in lower case with hyphens, such as `no-convergence`: what programs decide by.
        text: one sentence for a reader.
    """

    code: str
    text: str

    def __str__(self) -> str:
        return self.text


def recorded(error: BaseException) -> str:
    """The message of an error that becomes part of a result instead of ending the run.

    The traceback goes to the logger `pcbench`, at the level of debugging: `pcbench --log FILE` keeps it.
    """
    logging.getLogger("pcbench").debug("recorded in the result: %s", error, exc_info=error)
    return str(error)
