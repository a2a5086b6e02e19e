"""The choice of ladders for a plan, by a part of a text."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar

from pcbench.errors import InputError


class _PlannedLadder(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def quick(self) -> tuple[Any, ...]: ...


LadderT = TypeVar("LadderT", bound=_PlannedLadder)


def choose(
    ladders: Iterable[LadderT],
    only: str | None,
    *,
    quick: bool,
    texts_of: Callable[[LadderT], Iterable[str]],
    searched: str,
) -> tuple[LadderT, ...]:
    """Return the ladders of the full or of the quick plan that contain one of several texts; without texts, all.

    Args:
        ladders: all ladders.
        only: texts separated by commas; None for all ladders of the plan.
        quick: whether the plan is the quick one, which has the ladders with `quick` levels.
        texts_of: function that returns the texts of a ladder to search.
        searched: these texts in words, for the error.

    Raises:
        InputError: no ladder of the plan matches.
    """
    known = tuple(ladders)
    planned = tuple(ladder for ladder in known if ladder.quick or not quick)
    if only is None:
        return planned
    words = [word.strip() for word in only.split(",") if word.strip()]
    matching = [ladder for ladder in known if any(word in text for word in words for text in texts_of(ladder))]
    found = tuple(ladder for ladder in matching if ladder.quick or not quick)
    if not found:
        names = ", ".join(ladder.name for ladder in planned)
        if matching:
            raise InputError(f"--only {only} is not in the quick plan: leave out --quick, or choose from {names}")
        raise InputError(f"expected --only as part of a ladder's {searched}, got {only!r}: {names}")
    return found
