"""Griffe extension for the reference pages: splits joint docstring entries, moves them to the attributes that they
describe, shows defaults instead of calls, and removes duplicate pages."""

import re
from collections.abc import Collection
from typing import Any

import griffe

_ENTRY = re.compile(r"^(?P<indent> +)(?P<names>\w+(?:, \w+)+): (?P<text>.*)$")
_SECTION = re.compile(r"(?:Attributes|Args):")
_ATTRIBUTE = re.compile(r"(?P<indent> *)(?P<name>\w+): (?P<text>.*)")
_LONGEST_VALUE = 200  # characters of a constant that a page shows


class ShortReference(griffe.Extension):
    """Shows each object once, in its own module, and each attribute once, with its description and its default."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Split the joint entries of a docstring."""
        if obj.docstring is not None:
            obj.docstring.value = split_entries(obj.docstring.value)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Show the default of a setting instead of the call that declares its option, and no long constants."""
        value = attr.value
        if isinstance(value, griffe.ExprCall) and str(value.function) == "setting":
            attr.value = value.arguments[0]
        elif (
            value is not None and attr.parent is not None and attr.parent.is_module and len(str(value)) > _LONGEST_VALUE
        ):
            attr.value = "..."

    def on_class_members(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        """Move descriptions of attributes from the class to the attributes."""
        if cls.docstring is None:
            return
        described = {
            name: member for name, member in cls.members.items() if member.is_attribute and not member.docstring
        }
        text, entries = moved_entries(split_entries(cls.docstring.value), described)
        cls.docstring.value = text
        for name, entry in entries.items():
            described[name].docstring = griffe.Docstring(entry, parent=described[name])

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


def moved_entries(docstring: str, names: Collection[str]) -> tuple[str, dict[str, str]]:
    """Return the docstring of a class without its entries for attributes, and these as one line by name.

    Entries are those of the sections "Attributes" and "Args", or, as in reconstructors, a paragraph of lines that start
    with the name of a setting.
    """
    kept: list[str] = []
    entries: dict[str, list[str]] = {}
    name, indent = "", ""
    for line in docstring.splitlines():
        entry = _ATTRIBUTE.fullmatch(line)
        if entry is not None and entry["name"] in names and (not entry["indent"] or entry["indent"] == " " * 4):
            name, indent = entry["name"], entry["indent"]
            entries[name] = [entry["text"]]
        elif name and line.strip() and (line.startswith(indent + " ") or not indent):
            entries[name].append(line.strip())
        else:
            name = ""
            kept.append(line)
    followed = zip(kept, [*kept[1:], ""], strict=True)
    text = "\n".join(line for line, after in followed if not (_SECTION.fullmatch(line) and not after.startswith("  ")))
    return text.strip(), {name: " ".join(lines) for name, lines in entries.items()}
