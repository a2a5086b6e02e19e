"""Order of candidates as far as their differences are significant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import TypeVar

Item = TypeVar("Item")


def leaders(order: Sequence[Item], differ: Callable[[Item, Item], bool]) -> list[Item]:
    """Return the first of an order and those after it, up to the one that differs significantly from the first.

    A later one without a significant difference has a wide interval: it is no leader, because a better one is none.

    Args:
        order: candidates from the best value to the worst, at least one.
        differ: whether the difference of two candidates is significant.
    """
    first, *others = order
    return [first, *takewhile(lambda other: not differ(first, other), others)]
