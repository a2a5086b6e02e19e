"""Progress of a stage: finished share, speed and time left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import monotonic

from pcbench.progress import Step
from pcbench.tasks.results import Task

_INTERVAL_S = 2.0  # between steps


class StageProgress:
    """Reports steps such as `nearest points: 12 of 100 M points, 1.5 M points/s`, with the expected time left.

    Args:
        title: name of the stage.
        unit: unit of the sizes of tasks.
        tasks: all tasks.
        missing: those whose results are not stored already.
        report: progress callback.
    """

    def __init__(
        self,
        title: str,
        unit: str,
        tasks: Sequence[Task],
        missing: Sequence[Task],
        report: Callable[[str], None],
    ) -> None:
        self._title, self._unit, self._report_step = title, unit, report
        self._total = sum(task.size for task in tasks)
        self._missing = sum(task.size for task in missing)
        self._finished = 0.0  # by this run
        self._start = self._last_report = monotonic()
        self._report(0.0)

    def finish(self, task: Task) -> None:
        """Count a task as finished."""
        self._finished += task.size
        now = monotonic()
        if now - self._last_report >= _INTERVAL_S:
            self._last_report = now
            self._report(now - self._start)

    def _report(self, seconds: float) -> None:
        done = self._total - self._missing + self._finished
        factor, prefix = (1e6, "M ") if self._total >= 1e6 else (1.0, "")
        text = f"{self._title}: {_number(done / factor)} of {_number(self._total / factor)} {prefix}{self._unit}"
        if not self._finished:
            self._report_step(Step(text))
            return
        speed = self._finished / seconds
        seconds_left = (self._missing - self._finished) / speed
        # The next step is expected after the interval, so that the estimate of all steps is the time left.
        next_s = min(seconds_left, _INTERVAL_S)
        text = f"{text}, {_number(speed / factor)} {prefix}{self._unit}/s"
        self._report_step(Step(text, next_s, seconds_left - next_s))


def _number(value: float) -> str:
    """Format a number with three digits, or without decimals if it is larger."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
