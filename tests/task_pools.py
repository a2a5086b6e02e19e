"""Workers in this process, in which tests can replace functions."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest

from pcbench.tasks import runner


class ThreadWorkers:
    """Runs calls in one thread of this process, as `pcbench.tasks.processes.LocalWorkers` does in processes."""

    slots = 1

    def __init__(self, *_):
        self._thread = ThreadPoolExecutor(1)

    def submit(self, call):
        return self._thread.submit(lambda message: pickle.loads(message).run(), pickle.dumps(call))

    def keep_connected(self):
        pass

    def stop(self):
        self._thread.shutdown(wait=True, cancel_futures=True)


@pytest.fixture
def tasks_in_process(monkeypatch):
    monkeypatch.setattr(runner, "_start", ThreadWorkers)
