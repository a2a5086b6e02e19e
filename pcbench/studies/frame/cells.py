"""Independent runs of a study: one after another in this process, or as tasks of workers."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pcbench.errors import PcbenchError
from pcbench.progress import Step
from pcbench.scratch import scratch_folder
from pcbench.tasks import Task, TaskRunner, Workers
from pcbench.tasks.codec import result_type

C = TypeVar("C", contravariant=True)
R = TypeVar("R", covariant=True)
S = TypeVar("S", contravariant=True)
MEMORY_ADVICE = "use fewer workers (--workers)"


class CellFunction(Protocol[S, C, R]):
    """Function of a module that runs a cell."""

    def __call__(self, shared: S, cell: C, step: Callable[[str], None], /) -> R:
        """Run a cell.

        Args:
            shared: what all cells of the study share.
            cell: the cell.
            step: progress callback.
        """


def map_cells(
    function: CellFunction[S, C, R],
    shared: S,
    cells: Sequence[C],
    *,
    out: Path,
    workers: Workers | None,
    step: Callable[[str], None],
    cell_seconds: float,
    on_failure: Callable[[C, PcbenchError], R] | None = None,
) -> Generator[R, None, None]:
    """Yield the results of a study's cells in their order.

    Each cell stores its own result in the folder of the study, so that a later run resumes. If it runs on a worker, it
    and all processes that it starts have one thread, and other cells run beside it: its time is not comparable with the
    time of a cell that ran alone.

    Args:
        function: runs a cell; a function of a module. Its annotation states the type of its result.
        shared: first argument of the function, small, because it travels with each cell.
        cells: cells that do not depend on each other.
        out: folder of the study, for temporary files.
        workers: where the cells run; None: in this process, one after another.
        step: progress callback.
        cell_seconds: rough duration of a cell, for progress bars.
        on_failure: returns the result of a cell that raised an InputError or ended its workers, such as one that needs
            too much memory; None: such a cell ends the study. Without workers it is not called.
    """
    if workers is None:
        for number, cell in enumerate(cells, 1):
            left = cell_seconds * (len(cells) - number)
            yield function(shared, cell, _Steps(step, f"{number} of {len(cells)}", left))
        return
    with (
        scratch_folder(out / "cells") as folder,
        TaskRunner(workers, folder, step, unit="runs", memory_advice=MEMORY_ADVICE) as runner,
    ):
        tasks = [Task(f"cell-{n}", (Path.cwd(), function, shared, cell)) for n, cell in enumerate(cells)]
        failures: dict[str, PcbenchError] = {}
        skip = None if on_failure is None else lambda task, error: failures.update({task.name: error})
        results = iter(
            runner.run(
                "cells",
                _run_cell,
                tasks,
                title="done",
                skip=skip,
                skip_losses=on_failure is not None,
                kind=result_type(function),
            )
        )
        for task, cell in zip(tasks, cells, strict=True):
            if on_failure is not None and task.name in failures:
                yield on_failure(cell, failures[task.name])
            else:
                yield next(results)[1]


class _Steps:
    """Adds the number of a cell to its steps, and the time of the following cells."""

    def __init__(self, step: Callable[[str], None], number: str, after: float) -> None:
        self._step, self._number, self._after = step, number, after

    def __call__(self, text: str) -> None:
        inner = text if isinstance(text, Step) else Step(text)
        self._step(Step(f"{self._number}: {inner}", inner.expected, inner.after + self._after))


def _run_cell(folder: Path, function: CellFunction[Any, Any, Any], shared: Any, cell: Any) -> Any:
    """Run a cell in a worker, in the folder of the study's process, because paths may be relative."""
    os.chdir(folder)
    return function(shared, cell, lambda _: None)
