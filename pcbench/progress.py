"""Progress of long operations: steps with their expected durations, and an estimate of the time left."""

from __future__ import annotations

from collections.abc import Callable, Sequence


class Step(str):
    """Name of the next step of an operation, with its expected duration.

    Attributes:
        expected: approximate duration in seconds on an ordinary machine; None if unknown. The estimate
            corrects for the speed of the machine after the first steps, so mainly the ratios between the steps of one
            operation matter.
        after: expected duration in seconds of all following steps.
    """

    expected: float | None
    after: float

    def __new__(cls, text: str, expected: float | None = None, after: float = 0.0) -> Step:
        """Return a step with its expected duration and that of the steps after it."""
        step = super().__new__(cls, text)
        step.expected, step.after = expected, after
        return step


class ProgressPlan:
    """Steps of an operation, announced one after another.

    Args:
        report: progress callback that receives each step.
        expected: expected duration in seconds of each step.
    """

    def __init__(self, report: Callable[[str], None], expected: Sequence[float]) -> None:
        self._report, self._remaining = report, list(expected)

    def __call__(self, text: str) -> None:
        """Start the next step."""
        expected = self._remaining.pop(0) if self._remaining else None
        self._report(Step(text, expected, sum(self._remaining)))

    def within(self) -> Callable[[str], None]:
        """Return a progress callback for the substeps of the next step, which is counted as started."""
        if self._remaining:
            self._remaining.pop(0)
        after = sum(self._remaining)

        def report_substep(text: str) -> None:
            substep = text if isinstance(text, Step) else Step(text)
            self._report(Step(text, substep.expected, substep.after + after))

        return report_substep


class TimeEstimate:
    """Estimate of the progress and the time left of an operation, from its steps and a timer.

    Call `begin` at the start of each step; the estimates are available at any time. All times are in seconds of one
    timer.
    """

    _PRIOR_S = 3.0  # weight of the assumption that the machine has ordinary speed, in seconds of expected work

    def __init__(self, now: float) -> None:
        self._start = self._step_start = now
        self._step = Step("")
        self._expected_done_s = self._elapsed_done_s = 0.0

    def begin(self, text: str, now: float) -> None:
        """Start a step and end the one before."""
        if self._step.expected is not None:
            self._expected_done_s += self._step.expected
            self._elapsed_done_s += now - self._step_start
        self._step = text if isinstance(text, Step) else Step(text)
        self._step_start = now

    def seconds_left(self, now: float) -> float | None:
        """Return the estimated time left in seconds; None if the step has no expected duration."""
        if self._step.expected is None:
            return None
        pace = (self._elapsed_done_s + self._PRIOR_S) / (self._expected_done_s + self._PRIOR_S)
        current, elapsed = pace * self._step.expected, now - self._step_start
        # A step near or beyond its expected end is assumed to need a quarter of its elapsed time, at most `current`.
        return max(current - elapsed, 0.25 * min(elapsed, 4 * current)) + pace * self._step.after

    def share(self, now: float) -> float | None:
        """Return the finished share of the operation, from 0 to 1; None if it is unknown."""
        left = self.seconds_left(now)
        elapsed = now - self._start
        return None if left is None else elapsed / max(elapsed + left, 1e-9)


def duration(seconds: float) -> str:
    """Format a duration, such as 40 s, 3 min or 2 h 10 min; at least one second."""
    if seconds < 90:
        return f"{max(1.0, seconds):.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    if 60 * hours + minutes < 90:
        return f"{60 * hours + minutes} min"
    return f"{hours} h {minutes} min" if minutes else f"{hours} h"
