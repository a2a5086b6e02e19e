"""Run the tasks of a stage on workers: bounded, repeated if a worker is lost, continued after a killed run."""

from __future__ import annotations

import errno
import os
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, TypeVar

from pcbench.errors import InputError, PcbenchError, WorkerError, reason_of
from pcbench.scratch import PARTIAL_SUFFIX
from pcbench.systems import cpu_count, release_free_memory
from pcbench.tasks.calls import Call, ConnectionLost, WorkerLost
from pcbench.tasks.codec import result_type
from pcbench.tasks.processes import LocalWorkers
from pcbench.tasks.progress import StageProgress
from pcbench.tasks.results import SUFFIX, StageResults, Task, is_intact

T = TypeVar("T")

_NAME = re.compile(r"[\w-]{1,200}", re.ASCII)
_MAX_LOSSES = 3  # of one task
_POLL_INTERVAL_S = 1.0  # Windows delivers Ctrl-C only between waits
_MAX_VISIBILITY_CHECKS = 30


@dataclass(frozen=True)
class Workers:
    """Workers that run tasks: processes of this machine, or those of a Dask cluster.

    Attributes:
        count: largest number of tasks that run at the same time. None: the number of CPUs of this machine, or as many
            as the cluster has threads.
        cluster: address of a Dask scheduler, such as tcp://host:8786, or its scheduler file; its workers must see the
            same files. None: processes on this machine.
    """

    count: int | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.count is not None and self.count < 1:
            raise InputError(f"expected at least one worker, got {self.count}")


class Pool(Protocol):
    """Workers of this machine or of a cluster."""

    @property
    def slots(self) -> int:
        """Number of tasks to submit before the first has finished."""

    def submit(self, call: Call) -> Future[int]:
        """Run a call; its future has the size of the result's file in bytes.

        The future raises WorkerLost if the worker ended, and ConnectionLost if the cluster has forgotten the task.
        """

    def keep_connected(self) -> None:
        """Connect again if the connection was lost.

        Raises:
            WorkerError: it cannot be restored.
        """

    def stop(self) -> None:
        """End all running tasks at once."""


class TaskRunner:
    """Runs the tasks of one stage after another; use it in a `with` block, at whose end its workers end.

    Workers are separate processes, also if there is only one: a task that runs out of memory does not end this process.
    Each has one OpenMP thread and one BLAS thread.

    Args:
        workers: where tasks run.
        folder: folder of the results, created if it does not exist. Results of stages are in its subfolders. The caller
            ensures that only one run uses it (`pcbench.scratch.lock_output`).
        on_progress: progress callback, called with steps of `pcbench.progress`.
        unit: unit of the sizes of tasks, for progress.
        memory_advice: what a user can do if a task needs too much memory.
    """

    def __init__(
        self,
        workers: Workers,
        folder: Path,
        on_progress: Callable[[str], None] = lambda _: None,
        *,
        unit: str = "points",
        memory_advice: str = "use fewer workers (--workers) or smaller tiles (--tiles)",
    ) -> None:
        self._workers, self._folder, self._on_progress = workers, folder.absolute(), on_progress
        self._unit, self._memory_advice = unit, memory_advice
        self._pool: Pool | None = None

    def __enter__(self) -> TaskRunner:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def run(
        self,
        stage: str,
        function: Callable[..., T],
        tasks: Sequence[Task],
        *,
        key: str = "",
        title: str = "",
        skip: Callable[[Task, PcbenchError], None] | None = None,
        skip_losses: bool = False,
        kind: Any = None,
    ) -> StageResults[T]:
        """Run a function with the arguments of each task, unless its result is stored already.

        If a task fails, running tasks are ended, and the results of finished ones are kept.

        Args:
            stage: name of the stage and of its subfolder.
            function: function of a module that workers can import. Its annotation states the type of its result, which
                `pcbench.tasks.codec` stores.
            tasks: independent tasks; no two have the same name.
            key: identifies everything that the results depend on, such as digests of inputs, settings and code. Results
                with another key are not used.
            title: name of the stage in progress messages; by default `stage`.
            skip: called with each task whose function raised an InputError, and with the error. Such a task has no
                result, and runs again the next time. None: the error ends the stage.
            skip_losses: whether tasks that end their workers, or need more memory than there is, are skipped as well.
            kind: type of the results if the function's annotation does not state it.

        Returns:
            The results in the order of the tasks, which are read from disk when they are needed.

        Raises:
            WorkerError: a task ended three workers, a task needs more memory than there is, or the cluster is lost.
            OSError: a result cannot be written, for example because the disk is full.
            Exception: the error of a task, unless it was skipped.
        """
        _check_names(stage, tasks)
        release_free_memory()  # the workers share the memory with this process
        folder = self._folder / stage
        folder.mkdir(exist_ok=True)
        files = {task.name: folder / f"{task.name}{SUFFIX}" for task in tasks}
        _remove_other_files(folder, {file.name for file in files.values()})
        missing = _missing(tasks, files, key)
        progress = StageProgress(title or stage, self._unit, tasks, missing, self._on_progress)
        skipped: set[str] = set()
        try:
            with _full_disk_explained(self._folder):
                calls = {task.name: Call(function, task.arguments, files[task.name], key) for task in missing}
                for task, error in self._outcomes(missing, calls):
                    if error is not None:
                        if skip is None or not (skip_losses or isinstance(error, InputError)):
                            raise error
                        skip(task, error)
                        skipped.add(task.name)
                    progress.finish(task)
        except BaseException:  # also Ctrl-C and SIGTERM
            self._stop()
            raise
        kind = kind or result_type(function)
        return StageResults([task for task in tasks if task.name not in skipped], files, key, kind)

    def _outcomes(self, tasks: Sequence[Task], calls: Mapping[str, Call]) -> Iterator[tuple[Task, PcbenchError | None]]:
        """Run calls on workers, and yield each task when it is done, with the error that only it has."""
        pending, running = deque(tasks), dict[Future[int], Task]()
        losses = Counter[str]()
        while pending or running:
            pool = self._pool = self._pool or _start(self._workers, self._on_progress)
            while pending and len(running) < pool.slots:
                task = pending.popleft()
                running[pool.submit(calls[task.name])] = task
            done, _ = wait(running, _POLL_INTERVAL_S, FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    _check_visible(calls[task.name].file, future.result())
                except InputError as error:
                    yield task, error
                except ConnectionLost:
                    pending.appendleft(task)
                except WorkerLost as loss:
                    losses[task.name] += loss.times
                    if losses[task.name] >= _MAX_LOSSES:
                        yield task, WorkerError(self._explain(task, losses[task.name], loss))
                    else:
                        pending.appendleft(task)
                except MemoryError:
                    yield task, WorkerError(f"task {task.name} needs too much memory: {self._memory_advice}")
                else:
                    yield task, None
            pool.keep_connected()

    def _explain(self, task: Task, losses: int, loss: WorkerLost) -> str:
        if os.strerror(errno.EMFILE) in str(loss):
            return f"task {task.name} ended {losses} workers: {reason_of(OSError(errno.EMFILE, ''))}"
        cause = "probably out of memory" if loss.killed else "which also happens if memory is short"
        return f"task {task.name} ended {losses} workers ({loss}), {cause}: {self._memory_advice}"

    def _stop(self) -> None:
        if self._pool is not None:
            self._pool.stop()
            self._pool = None


def _start(workers: Workers, on_progress: Callable[[str], None]) -> Pool:
    if workers.cluster is None:
        return LocalWorkers(workers.count or cpu_count())
    from pcbench.tasks.cluster import ClusterWorkers  # imports Dask

    return ClusterWorkers(workers.cluster, workers.count, on_progress)


def _check_names(stage: str, tasks: Sequence[Task]) -> None:
    names = Counter([task.name for task in tasks])
    for name in (stage, *names):
        if not _NAME.fullmatch(name):
            raise ValueError(f"expected a name of letters, digits, hyphens and underscores, got {name!r}")
    if repeated := [name for name, count in names.items() if count > 1]:
        raise ValueError(f"expected tasks with different names, got {repeated[0]!r} more than once")


def _remove_other_files(folder: Path, names: Container[str]) -> None:
    """Remove results of tasks that the stage no longer has, and what killed workers left."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith((SUFFIX, PARTIAL_SUFFIX)) and entry.name not in names:
                Path(entry.path).unlink(missing_ok=True)


def _missing(tasks: Sequence[Task], files: Mapping[str, Path], key: str) -> list[Task]:
    """Return the tasks without an intact result of an earlier run; threads compute the digests of what is there."""
    kept = [name for name, file in files.items() if file.exists()]
    with ThreadPoolExecutor(cpu_count()) as pool:
        intact = dict(zip(kept, pool.map(lambda name: is_intact(files[name], key), kept), strict=True))
    return [task for task in tasks if not intact.get(task.name)]


def _check_visible(file: Path, size: int) -> None:
    """Check that a worker's file is in this machine's folder; shared disks show it after some seconds.

    Raises:
        WorkerError: it is not.
    """
    for _ in range(_MAX_VISIBILITY_CHECKS):
        try:
            if file.stat().st_size == size:
                return
        except FileNotFoundError:
            pass
        time.sleep(_POLL_INTERVAL_S)
    raise WorkerError(f"{file}: a worker wrote this file, but it is not here: workers must see the same disk")


@contextmanager
def _full_disk_explained(folder: Path) -> Iterator[None]:
    """Say what to do if the disk is full."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        advice = "the disk is full: free some space and run it again; finished tasks are kept"
        raise OSError(error.errno, advice, str(folder)) from error
