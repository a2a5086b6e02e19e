"""How docstrings become the reference: names that are explained together, and nothing that is said twice."""

import re
from typing import Any

import griffe

_ENTRY = re.compile(r"^(?P<indent> +)(?P<names>\w+(?:, \w+)+): (?P<text>.*)$")


class ShortReference(griffe.Extension):
    """Splits "lower, upper: the corners" into two entries, and leaves out what a page would say twice."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = separated(obj.docstring.value)

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        # What a room offers under its own name stands once, with the module that it comes from.
        rooms = [member for member in pkg.members.values() if not member.is_alias and member.is_module]
        while rooms:
            room = rooms.pop()
            room.exports = None
            rooms += [member for member in room.members.values() if not member.is_alias and member.is_module]


def separated(docstring: str) -> str:
    """The docstring with an entry for each of several names that are explained together."""
    out, lines = [], docstring.splitlines()
    position = 0
    while position < len(lines):
        entry = _ENTRY.match(lines[position])
        position += 1
        if entry is None:
            out.append(lines[position - 1])
            continue
        more = []
        while position < len(lines) and lines[position].startswith(entry["indent"] + " "):
            more.append(lines[position])
            position += 1
        for name in entry["names"].split(", "):
            out += [f"{entry['indent']}{name}: {entry['text']}", *more]
    return "\n".join(out)
