"""Workers of a Dask cluster. Dask is imported only here, when a cluster is used."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import platform
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, InvalidStateError
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from pcbench.errors import InputError, WorkerError
from pcbench.extras import installed_versions, require
from pcbench.tasks.calls import Call, ConnectionLost, WorkerLost, portable
from pcbench.threads import ONE_THREAD, one_blas_thread

_CONNECT_S = 10.0
_RECONNECT_S = 60.0  # for a scheduler that is started again
_RETRY_INTERVAL_S = 1.0
_CLOSE_S = 3.0
# For each thread of the cluster: while the answer to one task travels, the next one runs. An adaptive cluster starts
# more workers only if tasks wait.
_TASKS_PER_THREAD = 2


class ClusterWorkers:
    """Workers of a Dask cluster. Dask itself repeats the tasks of lost workers.

    Args:
        cluster: address of the scheduler, or its scheduler file.
        count: largest number of tasks that run at the same time; None: as many as the cluster has threads.
        on_progress: called with messages while this process waits for the cluster.

    Raises:
        MissingExtra: Dask is not installed.
        InputError: no scheduler answers at this address.
    """

    def __init__(self, cluster: str, count: int | None, on_progress: Callable[[str], None]) -> None:
        self._cluster, self._count, self._on_progress = cluster, count, on_progress
        self._threads, self._next_count = 0, 0.0
        self._waits_for_workers = False
        self._outcomes: set[Future[int]] = set()  # of running tasks
        require("distributed", "cluster")
        try:
            self._connect()
        except (OSError, ValueError, ImportError) as error:
            raise InputError(
                "expected the address of a running Dask scheduler, such as tcp://host:8786, or its scheduler file, "
                f"got {cluster!r} ({_one_line(error)})"
            ) from error

    @property
    def slots(self) -> int:
        """Number of tasks to submit before the first has finished."""
        return self._count or max(1, self._threads) * _TASKS_PER_THREAD

    def submit(self, call: Call) -> Future[int]:
        """Run a call; its future has the size of the result's file in bytes, or raises WorkerLost or ConnectionLost."""
        outcome: Future[int] = Future()
        self._outcomes.add(outcome)
        outcome.add_done_callback(self._outcomes.discard)

        def finish(future: Future[int | Exception]) -> None:
            try:
                answer = future.result()
            except (Exception, CancelledError) as error:
                answer = self._explain(error)
            with suppress(InvalidStateError):  # `_reconnect` has ended it
                if isinstance(answer, Exception):
                    outcome.set_exception(answer)
                else:
                    outcome.set_result(answer)

        try:
            self._executor.submit(run_call, pickle.dumps(call), _versions()).add_done_callback(finish)
        except Exception as error:  # the client was closed after it had lost the connection
            outcome.set_exception(self._explain(error))
        return outcome

    def keep_connected(self) -> None:
        """Connect again if the connection was lost, and wait for a scheduler that is started again.

        Raises:
            WorkerError: no scheduler answers for a minute.
        """
        if self._client.status != "running":
            self._reconnect()
        if time.monotonic() < self._next_count:
            return
        self._next_count = time.monotonic() + _RETRY_INTERVAL_S
        try:
            self._threads = _count_threads(self._client)
        except Exception:  # the connection was lost at this moment: the next call connects again
            return
        if self._threads == 0 and not self._waits_for_workers:
            self._on_progress(f"waiting for workers of the cluster {self._cluster}")
        self._waits_for_workers = self._threads == 0

    def stop(self) -> None:
        """Cancel all tasks that have not started; those that run end by themselves."""
        _close_client(self._client)

    def _connect(self) -> None:
        distributed: Any = require("distributed", "cluster")
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # TaskRunner reports a lost connection
        where = {"scheduler_file": self._cluster} if Path(self._cluster).is_file() else {"address": self._cluster}
        client = distributed.Client.__new__(distributed.Client)  # a client that cannot connect has to be closed too
        try:
            with warnings.catch_warnings(), _no_collection():
                # `run_call` compares the versions, and says what to do.
                warnings.simplefilter("ignore", distributed.versions.VersionMismatchWarning)
                client.__init__(**where, timeout=_CONNECT_S, name="pcbench", set_as_default=False)
            executor, threads = client.get_executor(), _count_threads(client)
        except BaseException:
            _close_client(client)
            raise
        self._client, self._executor, self._threads = client, executor, threads

    def _reconnect(self) -> None:
        """Replace the client by a new one; tasks of the old one count as lost, because it forgets some of them."""
        self._on_progress(f"waiting for the scheduler of the cluster {self._cluster}")
        self.stop()
        for outcome in list(self._outcomes):
            with suppress(InvalidStateError):  # it has just ended
                outcome.set_exception(ConnectionLost())
        deadline = time.monotonic() + _RECONNECT_S
        while True:
            try:
                self._connect()
                return
            except OSError as error:
                if time.monotonic() > deadline:
                    raise WorkerError(
                        f"the scheduler of the cluster {self._cluster} has not answered for {_RECONNECT_S:.0f} s: "
                        "start it and run the same command again; finished tasks are kept"
                    ) from error
                time.sleep(_RETRY_INTERVAL_S)

    def _explain(self, error: BaseException) -> Exception:
        """Return the error of a task for `TaskRunner`."""
        distributed: Any = require("distributed", "cluster")
        if isinstance(error, distributed.KilledWorker):
            return WorkerLost("see the logs of the workers", killed=True, times=error.allowed_failures + 1)
        if isinstance(error, (CancelledError, distributed.CancelledError, distributed.comm.CommClosedError)):
            return ConnectionLost()
        if self._client.status != "running":
            return ConnectionLost()
        missing = isinstance(error, ModuleNotFoundError) and f"{error.name}.".startswith("pcbench.")
        if missing or "deserialization of the task graph" in str(error):
            return WorkerError(
                f"pcbench cannot be imported on the cluster {self._cluster}: install pcbench {_versions()['pcbench']} "
                f"for its scheduler and its workers ({_one_line(error)})"
            )
        return error if isinstance(error, Exception) else WorkerError(_one_line(error))


def _count_threads(client: Any) -> int:
    return sum(client.sync(client.scheduler.ncores, callback_timeout=_CONNECT_S).values())


def _close_client(client: Any) -> None:
    """Close a client and end its thread, also if its constructor failed or the connection is lost.

    Otherwise the garbage collector closes it at any moment, and waits forever if the same thread holds Dask's lock.
    """
    with _no_collection(), suppress(Exception):  # there may be no connection
        client.close(_CLOSE_S)
    with _no_collection(), suppress(Exception):  # what a failed `close` or constructor leaves
        client._loop_runner.stop()
    client.status = "closed"  # nothing is left to close for the garbage collector


@contextmanager
def _no_collection() -> Iterator[None]:
    """Let the garbage collector close unused clients of others now, and not while Dask holds its lock."""
    was_enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def run_call(message: bytes, versions: Mapping[str, str]) -> int | Exception:
    """Run a pickled call on a worker of a cluster.

    Args:
        message: pickled `Call`, which is unpickled only after the number of threads has been limited.
        versions: versions of the process that sent it, of which the worker must have the same.

    Returns:
        The size of the result's file in bytes, or the exception that the function raised.
    """
    os.environ.update(ONE_THREAD)
    if (own := _versions()) != versions:
        differences = [
            f"{name} {own.get(name)} instead of {versions[name]}"
            for name in versions
            if own.get(name) != versions[name]
        ]
        return WorkerError(f"a worker on {platform.node()} has {', '.join(differences)}: install the same versions")
    try:
        with one_blas_thread():
            call: Call = pickle.loads(message)
            return call.run()
    except Exception as error:
        return portable(error)


@cache
def _versions() -> dict[str, str]:
    """Return the versions that results depend on, and that must agree for messages to be understood."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"Python": python, **installed_versions(("pcbench", "numpy", "scipy", "distributed"))}


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
