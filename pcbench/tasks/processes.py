"""Local worker processes as a `concurrent.futures.Executor`.

The standard library's ProcessPoolExecutor fails all its tasks when one process is lost, and does not tell which task
ended it. Here, a lost process fails its own task only, and the next task gets a new process.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import tempfile
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from pcbench.children import last_line, start_module
from pcbench.systems import SIGKILL, end_tree, reap, signal_name
from pcbench.tasks.calls import Call, WorkerLost, receive, send
from pcbench.threads import ONE_THREAD

_GRACE_S = 5.0
_MAX_ERROR_BYTES = 10_000


class LocalWorkers:
    """Worker processes on this machine, started when they are needed. Each runs one task at a time in one thread.

    Args:
        count: largest number of processes.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._local = threading.local()
        self._lock = threading.Lock()
        self._workers: set[_WorkerProcess] = set()
        self._stopped = False
        # Each thread has a worker and waits for its answers. On Linux a worker ends with the thread that started it.
        self._threads = ThreadPoolExecutor(count, "pcbench-worker")

    @property
    def slots(self) -> int:
        """Number of tasks to submit before the first has finished."""
        return self._count

    def submit(self, call: Call) -> Future[int]:
        """Run a call; its future has the size of the result's file in bytes, or raises WorkerLost."""
        return self._threads.submit(self._run, pickle.dumps(call))

    def keep_connected(self) -> None:
        """Local processes need no connection."""

    def stop(self) -> None:
        """End all processes at once, with all that they started."""
        with self._lock:
            self._stopped = True
            for worker in self._workers:
                worker.terminate()
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.end()

    def _run(self, message: bytes) -> int:
        worker: _WorkerProcess | None = getattr(self._local, "worker", None)
        if worker is None:
            worker = self._start()
        try:
            answer = worker.ask(message)
        except (EOFError, OSError):
            self._local.worker = None
            with self._lock:
                self._workers.discard(worker)
            raise worker.end() from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _start(self) -> _WorkerProcess:
        with self._lock:
            if self._stopped:
                raise WorkerLost("stopped", killed=False)
            worker = self._local.worker = _WorkerProcess()
            self._workers.add(worker)
            return worker


class _WorkerProcess:
    """A process that runs `pcbench.tasks.worker`."""

    def __init__(self) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed by `end`
        self._process = start_module(
            "pcbench.tasks.worker",
            environment=ONE_THREAD,  # parallelism comes from the number of processes
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )

    def ask(self, message: bytes) -> int | Exception:
        """Send a call and return its answer.

        Raises:
            EOFError, OSError: the process has ended.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        send(self._process.stdin, message)
        answer: int | Exception = pickle.loads(receive(self._process.stdout))
        return answer

    def terminate(self) -> None:
        """Ask the process to end, without waiting for it."""
        with suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGTERM)  # Popen.terminate might reap it, and `end` needs its id

    def end(self) -> WorkerLost:
        """End the process and all that it started, and return how it ended: a signal, or an exit code and its error."""
        end_tree(self._process, _GRACE_S)
        code, _ = reap(self._process)
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # the pipe is closed, but a message was not written completely
                assert pipe is not None
                pipe.close()
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _MAX_ERROR_BYTES))
        error = last_line(self._errors.read().decode(errors="replace"))
        self._errors.close()
        ending = signal_name(-code) if code < 0 else f"exit code {code}"
        return WorkerLost(f"{ending}: {error}" if error else ending, killed=code == -SIGKILL)
