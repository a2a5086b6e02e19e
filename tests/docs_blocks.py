"""The fenced blocks of a page of Markdown, and how a printed text is held against what a page shows.

What a block is, its fence and the comment before it say:

- ``console``: lines that start with `$ ` are run, in order; the lines below a command are what it prints.
- ``python``: run, in order, all blocks of a page in one namespace; a ``text`` block right after it is what it prints.
- any block with `title="NAME"` on its fence is a file of that name, written before what follows it on the page is run.
- `<!-- made by: COMMAND -->` before a block: too long for a test; a committed command makes it.
- `<!-- part of: FILE -->` before a block: its lines stand in this file of the repository.
- `<!-- checked by: FILE::FUNCTION -->` before a block: a test of its own looks after it.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

# A printed digit may differ on another machine: another order of additions in a linear algebra library moves the last.
_RELATIVE = 0.01
_FENCE = re.compile(r"^(?P<fence>`{3,})(?P<info>[^`\n]*)\n(?P<text>.*?)^(?P=fence)[ \t]*$", re.MULTILINE | re.DOTALL)
_MARK = re.compile(r"<!-- (made by|part of|checked by): (.+?) -->\s*\Z")
_NUMBER = r"[-−+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"


@dataclass(frozen=True)
class Block:
    line: int
    language: str
    title: str | None
    mark: tuple[str, str] | None  # ("made by", COMMAND), ...
    text: str
    follows: bool  # nothing but empty lines lies between this block and the one before


def blocks(page: Path) -> list[Block]:
    markdown, found, end = page.read_text(), [], -1
    for match in _FENCE.finditer(markdown):
        before, info = markdown[: match.start()], match["info"].strip()
        title = re.search(r'title="([^"]+)"', info)
        mark = _MARK.search(before)
        follows = end >= 0 and not markdown[end : match.start()].strip()
        found.append(
            Block(
                line=before.count("\n") + 1,
                language=info.split()[0] if info else "",
                title=title and title[1],
                mark=mark and (mark[1], mark[2]),
                text=match["text"],
                follows=follows,
            )
        )
        end = match.end()
    return found


def commands(block: Block) -> list[tuple[str, str]]:
    """Each command of a console block, and what stands below it."""
    found: list[tuple[str, list[str]]] = []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif found and found[-1][0].endswith("\\"):
            found[-1] = (found[-1][0][:-1] + line.strip(), [])
        else:
            assert found, f"expected a console block that starts with '$ ', got {line!r}"
            found[-1][1].append(line)
    return [(command, "\n".join(lines)) for command, lines in found]


def agrees(shown: str, printed: str) -> bool:
    """Is this what was printed? `...` stands for anything, any white space for any other, and numbers for near ones."""
    shown, printed = (" ".join(text.split()) for text in (shown, printed))
    pattern, numbers = "", []
    for part in re.split(rf"(\.\.\.|{_NUMBER})", shown):
        if part == "...":
            pattern += ".*?"
        elif re.fullmatch(_NUMBER, part):
            pattern += f"({_NUMBER})"
            numbers.append(part)
        else:
            pattern += re.escape(part)
    match = re.fullmatch(pattern, printed, re.DOTALL)
    return match is not None and all(map(_near, numbers, match.groups()))


def _near(a: str, b: str) -> bool:
    x, y = (float(text.replace(",", "").replace("−", "-")) for text in (a, b))
    return math.isclose(x, y, rel_tol=_RELATIVE) or abs(x - y) <= 1.01 * 10.0 ** -_decimals(a)


def _decimals(text: str) -> int:
    """Digits after the point: a difference of one in the last is none. Whole numbers are taken as they are."""
    mantissa, _, exponent = text.partition("e")
    if "." not in mantissa:
        return 9
    return len(mantissa.partition(".")[2]) - int(exponent or 0)
