"""Griffe extension for the reference pages: splits joint docstring entries and removes duplicate pages."""

import re
from typing import Any

import griffe

_ENTRY = re.compile(r"^(?P<indent> +)(?P<names>\w+(?:, \w+)+): (?P<text>.*)$")


class ShortReference(griffe.Extension):
    """Splits entries such as "lower, upper: the corners" in two, and lists each object only in its own module."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Split the joint entries of a docstring."""
        if obj.docstring is not None:
            obj.docstring.value = split_entries(obj.docstring.value)

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Remove the exports of packages, so that each object is listed only once, in the module that defines it."""
        packages = [member for member in pkg.members.values() if not member.is_alias and member.is_module]
        while packages:
            package = packages.pop()
            package.exports = None
            packages += [member for member in package.members.values() if not member.is_alias and member.is_module]


def split_entries(docstring: str) -> str:
    """Return the docstring with a separate entry for each name of a joint entry."""
    out, lines = [], docstring.splitlines()
    position = 0
    while position < len(lines):
        entry = _ENTRY.match(lines[position])
        position += 1
        if entry is None:
            out.append(lines[position - 1])
            continue
        continuation = []
        while position < len(lines) and lines[position].startswith(entry["indent"] + " "):
            continuation.append(lines[position])
            position += 1
        for name in entry["names"].split(", "):
            out += [f"{entry['indent']}{name}: {entry['text']}", *continuation]
    return "\n".join(out)
