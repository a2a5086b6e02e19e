"""Fill a template of a page that opens from disk: what all pages share.

Names of files and candidates come from users and may contain markup: the templates escape every text, and JSON inside
a page has no character that could end its element. A question mark replaces each unprintable character, such as those
that reverse the direction of text. A page loads nothing, and runs only the script that it contains.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pcbench.errors import PcbenchError, record_error
from pcbench.extras import require
from pcbench.report.words import one_line, printable
from pcbench.scratch import atomic_write

if TYPE_CHECKING:
    from jinja2 import Environment

PAGE = "report.html"  # file name of a page in its folder
# `<`, `>` and `&` could end a script element or start another; JSON allows their escapes in strings.
_JSON_ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


@dataclass(frozen=True)
class Opening:
    """The top of a page.

    Attributes:
        kind: what the page is about, such as "Point cloud comparison".
        title: heading of the page.
        subtitle: one line below the heading; empty for none.
        answer: sentences, the main result first.
        warnings: sentences on what not to trust.
        remarks: sentences that explain the answer.
    """

    kind: str
    title: str
    subtitle: str
    answer: Sequence[str]
    warnings: Sequence[str] = ()
    remarks: Sequence[str] = ()


class InputRow(NamedTuple):
    """An input file: its role, path, SHA-256 and coordinate system in words, empty for a file without coordinates."""

    role: str
    path: str
    sha256: str
    system: str = ""


@dataclass(frozen=True)
class Origin:
    """The bottom of a page: how the results were made.

    Attributes:
        provenance: version, commit, command and time, see `pcbench.report.document.provenance`; None if unknown.
        repeat: command that repeats the run in the folder of the page, if there is one.
        inputs: the input files.
    """

    provenance: Mapping[str, Any] | None
    repeat: str | None = None
    inputs: Sequence[InputRow] = ()


def render(
    template: str, opening: Opening, origin: Origin, *, script: str = "", refresh_s: int | None = None, **content: Any
) -> str:
    """Return a page.

    Args:
        template: file name of a template that extends `base.html`.
        opening: the top of the page.
        origin: the bottom of the page.
        script: JavaScript that the page runs; without one, its policy forbids scripts.
        refresh_s: seconds after which a browser loads the page again; None: it does not.
        content: values for the template's own parts.
    """
    return _environment(require("jinja2")).get_template(template).render(
        kind=opening.kind,
        title=opening.title,
        subtitle=opening.subtitle,
        answer=one_line_each(opening.answer),
        warnings=one_line_each(opening.warnings),
        remarks=one_line_each(opening.remarks),
        provenance=origin.provenance,
        repeat=origin.repeat,
        inputs=origin.inputs,
        style=source("style.css"),
        script=script,
        refresh_s=refresh_s,
        script_hash=base64.b64encode(hashlib.sha256(f"\n{script}\n".encode()).digest()).decode(),
        **content,
    )  # fmt: skip


def one_line_each(sentences: Iterable[str]) -> list[str]:
    """Return sentences on one line each, with a question mark for each unprintable character."""
    return [one_line(sentence) for sentence in sentences]


def source(name: str) -> str:
    """Return the text of a file of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def script_json(values: Any) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(values, allow_nan=False, ensure_ascii=True, separators=(",", ":")).translate(_JSON_ESCAPES)


@cache
def _environment(jinja2: Any) -> Environment:
    """Return the environment of all templates, which compiles each of them once."""
    made: Environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(source),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=lambda value: printable(value) if type(value) is str else value,  # not sources, which are marked safe
    )
    return made


def write_page(path: Path, make: Callable[[], str]) -> str | None:
    """Write a page, and return the reason if that fails: a failed page does not discard the results.

    Args:
        path: file of the page; an earlier one is replaced, or deleted if this fails.
        make: returns the page.

    Raises:
        OSError: the file cannot be written.
    """
    path.unlink(missing_ok=True)
    try:
        text = make()
    except PcbenchError as error:
        return f"{path.name} was not written: {record_error(error)}"
    except Exception as error:
        return f"{path.name} was not written: {type(error).__name__}: {record_error(error)}"
    with atomic_write(path) as file:
        file.write(text.encode(errors="backslashreplace"))
    return None
