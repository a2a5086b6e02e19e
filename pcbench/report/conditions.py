"""Conditions on the numbers of a JSON document, such as `d2_rms.c2r > 0.2`, by which a command tells a script to stop.

    condition   = comparison { ( "and" | "or" ) comparison }        "and" binds more tightly
    comparison  = NAME ( ">" | ">=" | "<" | "<=" | "==" | "!=" ) NUMBER [ "%" ]

A NAME consists of the document's keys with dots between them. `fscore@0.1` is the entry of a list for the threshold
0.1, `parts[0]` the first entry, and `points[A7]` the one with that `name`. The name of an object that has a `value`
stands for this value. A document is only read, and nothing in a condition is ever executed.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, cast

from pcbench.errors import InputError, similar_names

_MAX_LENGTH = 1000  # characters of a condition
_MAX_NEAR_NAMES, _MIN_SIMILARITY = 5, 0.5
_MAX_LISTED = 12  # entries of an object in a message

_SHORT_KEYS = {"c2r": "candidate_to_reference", "r2c": "reference_to_candidate", "max": "symmetric_max"}
_SHORT_NAMES = {key: short for short, key in _SHORT_KEYS.items()}

_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "==": operator.eq,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
}
_UNSIGNED = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_STEP = r"[A-Za-z_][\w-]*(?:@[0-9]+(?:\.[0-9]+)?(?:e[+-]?[0-9]+)?|\[[^\[\]]*\])*"
_COMPARISON = re.compile(
    rf"\s*(?P<name>{_STEP}(?:\.{_STEP})*)\s*(?P<operator>{'|'.join(_OPERATORS)})\s*"
    rf"(?P<number>[+-]?{_UNSIGNED})\s*(?P<percent>%?)(?:\s+(?P<word>and|or)\s+|\s*$)",
    re.ASCII,
)
_SELECTED = re.compile(r"(?P<key>[^@\[]+)|@(?P<threshold>[^@\[]+)|\[(?P<item>[^\[\]]*)\]")
_FORM = "expected NAME OPERATOR NUMBER, such as 'd2_rms.c2r > 0.2', joined by and/or"


class NamedValues(NamedTuple):
    """Values on which conditions are tested: those of a candidate, an epoch or a cloud.

    Attributes:
        name: its name in messages; empty if there is only one.
        values: its JSON object.
    """

    name: str
    values: Mapping[str, Any]


class Clause(NamedTuple):
    """The comparison of the number with a name with a limit."""

    name: str
    operator: str
    limit: float

    def holds(self, value: float | None) -> bool | None:
        """Return whether it holds for a value; None if the value is missing."""
        return None if value is None else _OPERATORS[self.operator](value, self.limit)


@dataclass(frozen=True, repr=False)
class Condition:
    """A condition: it holds if all comparisons of at least one alternative hold.

    Attributes:
        text: the condition as it was given.
        alternatives: comparisons that `or` separates, each a group of those that `and` joins.
    """

    text: str
    alternatives: tuple[tuple[Clause, ...], ...]

    @classmethod
    def parse(cls, text: str) -> Condition:
        """Return the condition of a text.

        Raises:
            InputError: the text is no condition.
        """
        if len(text) > _MAX_LENGTH:
            raise InputError(f"expected a condition of at most {_MAX_LENGTH} characters, got {len(text):,}")
        alternatives: list[list[Clause]] = [[]]
        position = 0
        while True:
            match = _COMPARISON.match(text, position)
            if match is None:
                raise InputError(f"{_FORM}; got {text[position:].strip()[:60]!r}{_hint(text[position:])}")
            alternatives[-1].append(Clause(match["name"], match["operator"], _limit(match)))
            if match["word"] is None:
                return cls(text.strip(), tuple(map(tuple, alternatives)))
            if match["word"] == "or":
                alternatives.append([])
            position = match.end()

    def __repr__(self) -> str:
        return repr(self.text)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all numbers, each once."""
        return tuple(dict.fromkeys(clause.name for group in self.alternatives for clause in group))

    def holds(self, values: Mapping[str, float | None]) -> bool | None:
        """Return whether it holds for numbers by name; None if that depends on a missing one."""
        groups = [_all_hold([clause.holds(values[clause.name]) for clause in group]) for group in self.alternatives]
        return True if True in groups else None if None in groups else False


def check_names(
    conditions: Iterable[Condition],
    example: Mapping[str, Any],
    inner: Sequence[str] = (),
    absent: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Check that the names of conditions exist in an example of a document.

    Args:
        conditions: the conditions.
        example: a JSON object with the keys of the real one. Below null, and in empty lists, any name is accepted, and
            any entry of a list.
        inner: keys that a name may omit, see `number_of`.
        absent: for each key of the document that has no numbers, the reason.

    Raises:
        InputError: a name does not exist, has several values, or has no number.
    """
    for condition in conditions:
        for name in condition.names:
            if reason := absent.get(name.partition(".")[0]):
                raise InputError(f"--fail-if {condition.text!r}: {reason}")
            try:
                number_of(example, re.sub(r"\[[^\[\]]*\]", "[0]", name), inner)
            except InputError as error:
                raise InputError(f"--fail-if {condition.text!r}: {error}") from None


def failures(conditions: Iterable[Condition], subjects: Sequence[NamedValues], inner: Sequence[str] = ()) -> list[str]:
    """Return a line for each condition that holds for a subject, or that a missing number makes unknown.

    Args:
        conditions: the conditions.
        subjects: what they are tested on.
        inner: keys that a name may omit, see `number_of`.

    Raises:
        InputError: a name does not exist, or has several values.
    """
    lines = []
    for condition in conditions:
        outcomes = [
            (subject, numbers, condition.holds(numbers))
            for subject in subjects
            for numbers in [_numbers(condition, subject.values, inner)]
        ]
        for outcome, words in ((True, "holds"), (None, "is unknown, which counts as a failure")):
            those = [_place(condition, subject, numbers) for subject, numbers, holds in outcomes if holds is outcome]
            if those:
                lines.append(f"--fail-if {condition.text!r} {words}: {'; '.join(those)}")
    return lines


def number_of(values: Mapping[str, Any], name: str, inner: Sequence[str] = ()) -> float | None:
    """Return the number with a name in a JSON object; True is 1 and False is 0. None: it is missing (null).

    Args:
        values: the JSON object.
        name: keys with dots between them, as in a condition.
        inner: keys of objects whose own keys need not be preceded by them, such as `metrics`.

    Raises:
        InputError: there is no such name, or it has several values or a text.
    """
    holders = (values, *(values.get(key) for key in inner))
    whole = next((holder for holder in holders if isinstance(holder, Mapping) and name in holder), None)
    steps = [name] if whole is not None else re.findall(_STEP, name, re.ASCII)  # a key may have dots itself
    start = next((key for key in inner if not _has(values, steps[0]) and _has(values.get(key), steps[0])), None)
    node: Any = values if start is None else values[start]
    for step in steps:
        if node is None or node == []:
            return None
        if not _has(node, step):
            raise InputError(f"there is no {name!r}{_near(name, values, inner)}")
        node = _entry(node, step)
    if isinstance(node, Mapping) and "value" in node:  # a number with its interval and its unit
        node = node["value"]
    if isinstance(node, Mapping) and node:
        names = [f"{name}.{_SHORT_NAMES.get(key, key)}" for key in node]
        raise InputError(f"{name!r} has several values: expected one of {_listed(names)}")
    if isinstance(node, str | list) and node:
        kind = "a text" if isinstance(node, str) else f"a list: expected {name}[0] or another entry"
        raise InputError(f"expected a number with the name {name!r}, got {kind}")
    return float(node) if isinstance(node, int | float) else None


def _numbers(condition: Condition, values: Mapping[str, Any], inner: Sequence[str]) -> dict[str, float | None]:
    """Return the numbers of a condition by name."""
    try:
        return {name: number_of(values, name, inner) for name in condition.names}
    except InputError as error:
        raise InputError(f"--fail-if {condition.text!r}: {error}") from None


def _has(node: Any, step: str) -> bool:
    """Return whether an object has the entry of a step; an empty list and null may have any."""
    try:
        _entry(node, step)
    except LookupError:
        return False
    return True


def _entry(node: Any, step: str) -> Any:
    """Return the entry of a step, such as `fscore@0.1`; None if a list that it selects from has none.

    Raises:
        LookupError: there is none.
    """
    if not isinstance(node, Mapping):
        raise LookupError(step)
    if (key := step if step in node else _SHORT_KEYS.get(step, step)) in node:
        return node[key]
    node = cast(Any, node)
    for part in _SELECTED.finditer(step):
        if part["key"] is not None:
            node = node[part["key"]]
        elif node is None or node == []:
            return None
        elif part["threshold"] is not None:
            node = _selected(node, "threshold", float(part["threshold"]))
        else:
            node = _item(node, part["item"])
    return node


def _item(items: Any, text: str) -> Any:
    """Return the item of a list with a name or an index; None beyond its end, because lengths vary."""
    try:
        return _selected(items, "name", text)
    except LookupError:
        if not isinstance(items, list) or not re.fullmatch("[0-9]{1,9}", text):
            raise
        return items[int(text)] if int(text) < len(items) else None


def _selected(items: Any, key: str, value: Any) -> Any:
    for item in items if isinstance(items, list) else ():
        if isinstance(item, Mapping) and item.get(key) == value:
            return item
    raise LookupError(value)


def _near(name: str, values: Mapping[str, Any], inner: Sequence[str]) -> str:
    """Return the names in a document that are most similar to an unknown one, in words."""
    names = [_without(inner, full) for full in _names(values)]
    last = name.rpartition(".")[2]
    near = similar_names(name, names, _MAX_NEAR_NAMES, _MIN_SIMILARITY)
    near += [full for full in names if full.rpartition(".")[2] == last and full not in near]
    return f": did you mean {_listed(near[:_MAX_NEAR_NAMES])}?" if near else f": there are {_listed(names)}"


def _without(inner: Sequence[str], name: str) -> str:
    first, _, rest = name.partition(".")
    return rest if first in inner else name


def _names(node: Any, prefix: str = "") -> Iterator[str]:
    """Yield the names of all numbers below a node of a JSON document, and of those that are missing."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            short = str(_SHORT_NAMES.get(key, key))
            yield from _names(value, f"{prefix}.{short}" if prefix else short)
    elif isinstance(node, list) and node:
        threshold = node[0].get("threshold") if isinstance(node[0], Mapping) else None
        yield from _names(node[0], f"{prefix}[0]" if threshold is None else f"{prefix}@{threshold:g}")
    elif node is None or isinstance(node, int | float):
        yield prefix


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _MAX_LISTED
    return ", ".join(names[:_MAX_LISTED]) + (f" and {more} others" if more > 0 else "")


def _all_hold(outcomes: Sequence[bool | None]) -> bool | None:
    return False if False in outcomes else None if None in outcomes else True


def _place(condition: Condition, subject: NamedValues, numbers: Mapping[str, float | None]) -> str:
    """Return the subject and the numbers of a condition in words."""
    texts = ", ".join(
        f"{name} = {_number_text(value, condition)}" if value is not None else f"{name} has no value"
        for name, value in numbers.items()
    )
    return f"{subject.name}: {texts}" if subject.name else texts


def _number_text(value: float, condition: Condition) -> str:
    """Return a number with six digits, or with all if these hide its difference from a limit."""
    text = f"{value:.6g}"
    limits = (clause.limit for group in condition.alternatives for clause in group)
    return repr(value) if any(float(text) == limit != value for limit in limits) else text


def _limit(match: re.Match[str]) -> float:
    number = float(match["number"])
    if not math.isfinite(number):
        raise InputError(f"expected a finite number in a condition, got {match['number']!r}")
    return number / 100 if match["percent"] else number


def _hint(rest: str) -> str:
    """Return what is probably wrong with a text that is no comparison."""
    if re.fullmatch(rf"\s*{_STEP}(\.{_STEP})*\s*", rest, re.ASCII):
        return " (quote the condition, because a shell takes > and < for redirections)"
    if re.search(r"[^<>=!]=[^<>=]", rest):
        return " (equality is ==)"
    if re.search(r"[0-9],[0-9]", rest):
        return " (the decimal separator is a point)"
    if "(" in rest:
        return " (there are no parentheses; give --fail-if several times instead)"
    return ""
