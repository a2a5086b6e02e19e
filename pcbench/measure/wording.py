"""Numbers with nouns and units in sentences."""

from __future__ import annotations


def pluralize(count: int, noun: str) -> str:
    """Return a count with its noun: "1 point", "2,000 points"."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def with_unit(text: str, unit: str | None) -> str:
    """Return a number with its unit, if that is known: "0.3 m", "0.3"."""
    return f"{text} {unit}" if unit else text


def ratio_in_words(ratio: float, what: str) -> str:
    """Return a ratio in words: "4 times as much", or "as much" if it rounds to 1."""
    shown = f"{ratio:.2g}"
    return f"as {what}" if shown == "1" else f"{shown} times as {what}"
