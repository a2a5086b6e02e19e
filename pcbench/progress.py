"""How far a long work is: steps tell what is done next, and how long it and what follows may take."""

from __future__ import annotations

from collections.abc import Callable, Sequence


class Step(str):
    """What is done next, in a few words.

    Attributes:
        expected: seconds that it takes, roughly, on an ordinary machine; None where nobody knows. What counts is how
            steps of one work compare: who shows them learns from those that are done how quick this machine is.
        after: seconds that all following steps take.
    """

    expected: float | None
    after: float

    def __new__(cls, text: str, expected: float | None = None, after: float = 0.0) -> Step:
        step = super().__new__(cls, text)
        step.expected, step.after = expected, after
        return step


class Plan:
    """The steps of one work, announced one after another.

    Args:
        tell: gets each step.
        expected: seconds of each step.
    """

    def __init__(self, tell: Callable[[str], None], expected: Sequence[float]) -> None:
        self._tell, self._left = tell, list(expected)

    def __call__(self, text: str) -> None:
        """Begin the next step."""
        expected = self._left.pop(0) if self._left else None
        self._tell(Step(text, expected, sum(self._left)))

    def within(self) -> Callable[[str], None]:
        """What gets the steps that the next step consists of."""
        if self._left:
            self._left.pop(0)
        after = sum(self._left)

        def tell(text: str) -> None:
            of = text if isinstance(text, Step) else Step(text)
            self._tell(Step(text, of.expected, of.after + after))

        return tell


class TimeEstimate:
    """How far a work is, from its steps and a clock: `begin` each step, then ask at any time.

    All times are in seconds on one clock.
    """

    _DOUBT = 3.0  # seconds: before so much was expected and done, the machine counts as an ordinary one

    def __init__(self, now: float) -> None:
        self._start = self._step_start = now
        self._step = Step("")
        self._expected_done = self._took = 0.0

    def begin(self, text: str, now: float) -> None:
        """A step begins, and with it the one before ends."""
        if self._step.expected is not None:
            self._expected_done += self._step.expected
            self._took += now - self._step_start
        self._step = text if isinstance(text, Step) else Step(text)
        self._step_start = now

    def left(self, now: float) -> float | None:
        """Seconds; None where the step says nothing about it."""
        if self._step.expected is None:
            return None
        pace = (self._took + self._DOUBT) / (self._expected_done + self._DOUBT)
        current, spent = pace * self._step.expected, now - self._step_start
        # What takes longer than expected takes, as far as anybody knows, a quarter longer yet.
        return max(current - spent, 0.25 * min(spent, 4 * current)) + pace * self._step.after

    def share(self, now: float) -> float | None:
        """Of the work, from 0 to 1; None where nobody knows."""
        left = self.left(now)
        spent = now - self._start
        return None if left is None else spent / max(spent + left, 1e-9)


def duration(seconds: float) -> str:
    """A duration in words, such as 40 s, 3 min or 2 h 10 min; at least one second."""
    if seconds < 90:
        return f"{max(1.0, seconds):.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    if 60 * hours + minutes < 90:
        return f"{60 * hours + minutes} min"
    return f"{hours} h {minutes} min" if minutes else f"{hours} h"
