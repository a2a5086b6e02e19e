"""Fenced blocks of a Markdown page, and the comparison of printed text with the text on the page.

The fence of a block and the comment before it define how it is tested:

- ``console``: lines that start with `$ ` are run in order; the lines below a command are its expected output.
- ``python``: all blocks of a page are run in order in one namespace; a ``text`` block directly after one is its output.
- A block with `title="NAME"` on its fence is a file of that name, written before the next blocks are run.
- `<!-- made by: COMMAND -->` before a block: the command creates it, but takes too long for a test.
- `<!-- part of: FILE -->` before a block: its lines are in this file of the repository.
- `<!-- checked by: FILE::FUNCTION -->` before a block: a separate test checks it.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

# Results may differ slightly between machines, because linear algebra libraries add in different orders.
_RELATIVE = 0.01
_FENCE = re.compile(r"^(?P<fence>`{3,})(?P<info>[^`\n]*)\n(?P<text>.*?)^(?P=fence)[ \t]*$", re.MULTILINE | re.DOTALL)
_MARK = re.compile(r"<!-- (made by|part of|checked by): (.+?) -->\s*\Z")
_NUMBER = r"[-−+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    line: int
    language: str
    title: str | None
    mark: tuple[str, str] | None  # kind and content of the comment before it, such as ("made by", COMMAND)
    text: str
    follows: bool  # whether only empty lines separate it from the previous block


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page."""
    markdown, result, end = page.read_text(), [], -1
    for match in _FENCE.finditer(markdown):
        preceding_text, info = markdown[: match.start()], match["info"].strip()
        title = re.search(r'title="([^"]+)"', info)
        mark = _MARK.search(preceding_text)
        follows = end >= 0 and not markdown[end : match.start()].strip()
        result.append(
            Block(
                line=preceding_text.count("\n") + 1,
                language=info.split()[0] if info else "",
                title=title and title[1],
                mark=mark and (mark[1], mark[2]),
                text=match["text"],
                follows=follows,
            )
        )
        end = match.end()
    return result


def commands(block: Block) -> list[tuple[str, str]]:
    """Return the commands of a console block and the text below each of them."""
    result: list[tuple[str, list[str]]] = []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            result.append((line[2:], []))
        elif result and result[-1][0].endswith("\\"):
            result[-1] = (result[-1][0][:-1] + line.strip(), [])
        else:
            assert result, f"expected a console block that starts with '$ ', got {line!r}"
            result[-1][1].append(line)
    return [(command, "\n".join(lines)) for command, lines in result]


def matches(expected: str, output: str) -> bool:
    """Compare texts: `...` matches anything, white space matches other white space, and numbers match close numbers."""
    expected, output = (" ".join(text.split()) for text in (expected, output))
    pattern, numbers = "", []
    for token in re.split(rf"(\.\.\.|{_NUMBER})", expected):
        if token == "...":
            pattern += ".*?"
        elif re.fullmatch(_NUMBER, token):
            pattern += f"({_NUMBER})"
            numbers.append(token)
        else:
            pattern += re.escape(token)
    match = re.fullmatch(pattern, output, re.DOTALL)
    return match is not None and all(map(_are_close, numbers, match.groups()))


def _are_close(a: str, b: str) -> bool:
    x, y = (float(text.replace(",", "").replace("−", "-")) for text in (a, b))
    return math.isclose(x, y, rel_tol=_RELATIVE) or abs(x - y) <= 1.01 * 10.0 ** -_decimals(a)


def _decimals(text: str) -> int:
    """Return the number of decimals, of which the last may differ by one; integers must be equal."""
    mantissa, _, exponent = text.partition("e")
    if "." not in mantissa:
        return 9
    return len(mantissa.partition(".")[2]) - int(exponent or 0)
