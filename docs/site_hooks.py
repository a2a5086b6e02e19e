"""Hooks of mkdocs: included files, the age of tables, printed answers that wrap, links of pictures, and what the search
puts first."""

import re
import sys
from html import unescape
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parent))  # mkdocs loads this file alone

from written_tables import TABLE, read_run

_ROOT = Path(__file__).resolve().parent.parent
_INCLUDE = re.compile(r"^--8<-- \"(?P<file>[^\"]+)\"$", re.MULTILINE)
_ANSWER = re.compile(r'(<div class="language-(?:console|text) highlight">.*?<code>)(.*?)(</code>)', re.DOTALL)
_COLUMNS = re.compile(r"\S {2,}\S|^ {8,}\S")
_NUMBERS = re.compile(r"[-+.\de]+(?: [-+.\de]+)+")  # a row of a matrix
_COLORS = re.compile(r'</?span(?: class="[^"]*")?>')  # not the marks of lines, which have an id
_WIDTH = 132  # columns at which commands wrap the sentences of the pages
_INDENTED_WIDTH = 116  # the same for sentences that continue below with two spaces
_INLINE_CODE = re.compile(r"(?<!</span>)<code>([^<]*)</code>")
_OPTION = re.compile(r"(?<![\w-])--?[A-Za-z][\w-]*")
_WHOLE = r'<span class="option">\g<0></span>'
_PICTURE = re.compile(r'<img\b[^>]*?\bsrc="([^"]+)"[^>]*>')
# Titles count a thousand times as much as text: what explains a term comes before its names, and before records of it.
_BOOSTS = {"reference": 0.002, "trials": 0.01}


def on_page_markdown(markdown: str, *, page: Any, **kwargs: Any) -> str:
    """Include the files that the page names by `--8<-- "FILE"`, and name the commits of printed tables.

    Links of included files start at the root of the repository.
    """
    markdown = TABLE.sub(_with_age, markdown)
    if boost := _BOOSTS.get(page.file.src_uri.partition("/")[0]):
        page.meta.setdefault("search", {}).setdefault("boost", boost)
    return _INCLUDE.sub(lambda include: included_text((_ROOT / include["file"]).read_text()), markdown)


def on_page_content(html: str, **kwargs: Any) -> str:
    """Let sentences of console blocks wrap anywhere, keep rows and options whole, and link pictures to their files.

    style.css keeps the rows of printed tables whole. A page shows wide pictures smaller than they are.
    """
    html = _INLINE_CODE.sub(lambda code: f"<code>{_OPTION.sub(_WHOLE, code[1])}</code>", html)
    html = _PICTURE.sub(r'<a href="\1">\g<0></a>', html)
    return _ANSWER.sub(lambda block: block[1] + "\n".join(_wrapping(block[2].split("\n"))) + block[3], html)


def included_text(text: str) -> str:
    """Return a file of the root for a page in `docs/`: `docs/architecture.md` becomes `architecture.md`."""
    return text.replace("](docs/", "](")


def _with_age(table: re.Match[str]) -> str:
    """Return a table with its commit below, if it names none or is older than its code."""
    run = read_run(_ROOT, table["command"])
    if run is None:
        return f"{table[0]}\n\n*This table is older than the stored runs: `make measured` has not written it yet.*"
    age = "; code that this table measures has changed since" if run.changed_files(_ROOT) else ""
    if not age and "commit " in table["lines"]:
        return table[0]
    return f"{table[0]}\n\n*Commit {run.commit} of {run.day}{age}.*"


def _wrapping(lines: list[str]) -> list[str]:
    """Return lines of HTML with rows marked, and with each sentence that the command wrapped on one line."""
    found: list[str] = []
    sentence = ""  # the last line as text, if a sentence may continue below it
    for line in lines:
        text = _text(line)
        gaps = len(_COLUMNS.findall(text))
        if text.startswith("# "):  # a comment of an answer, which the highlighter takes for a command of root
            line = f'<span class="go">{_COLORS.sub("", line)}</span>'
        # A longer line with one gap is a name with its explanation.
        if gaps > 1 or (gaps and len(text) <= _WIDTH) or _NUMBERS.fullmatch(text):
            found.append(f'<span class="row">{line}</span>')
            sentence = ""
        elif sentence and _continues(sentence, text):
            found[-1] += ("" if sentence.endswith("-") else " ") + re.sub(r"(^|>) +", r"\1", line, count=1)
            sentence = text
        else:
            is_command = text.startswith("$ ") or (bool(found) and _text(found[-1]).endswith("\\"))
            found.append(line)
            sentence = "" if is_command else text
    return found


def _continues(line: str, following: str) -> bool:
    words = following.split()
    width = _INDENTED_WIDTH if following.startswith("  ") else _WIDTH
    is_full = bool(words) and width < len(line) + 1 + len(words[0]) and len(line) <= _WIDTH
    return is_full and not line.endswith((".", "\\"))


def _text(line: str) -> str:
    return unescape(re.sub(r"<[^>]+>", "", line))
