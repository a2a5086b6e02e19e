"""Limits of the number of threads of numpy's BLAS library."""

import threading

import numpy as np
import pytest

from pcbench import compare, threads


@pytest.fixture
def blas():
    found = threads._blas_threads()
    if found is None:
        pytest.skip("numpy is not linked to OpenBLAS, or its functions cannot be looked up")
    before = found.get()
    found.set(2)
    if found.get() != 2:
        pytest.skip("OpenBLAS was built without threads")
    yield found
    found.set(before)


def test_blas_is_limited_within_blocks(blas):
    with threads.one_blas_thread():
        assert blas.get() == 1
        with threads.one_blas_thread():
            assert blas.get() == 1
        assert blas.get() == 1
    assert blas.get() == 2


def test_the_limit_ends_after_an_error(blas):
    with pytest.raises(np.linalg.LinAlgError), threads.one_blas_thread():
        np.linalg.inv(np.zeros((2, 2)))
    assert blas.get() == 2


def test_the_limit_ends_with_the_last_of_overlapping_blocks(blas):
    entered, leave = threading.Event(), threading.Event()

    def other() -> None:
        with threads.one_blas_thread():
            entered.set()
            leave.wait(30)

    thread = threading.Thread(target=other)
    with threads.one_blas_thread():
        thread.start()
        assert entered.wait(30)
    assert blas.get() == 1
    leave.set()
    thread.join()
    assert blas.get() == 2


def test_another_library_is_left_alone(monkeypatch):
    monkeypatch.setattr(threads, "_blas_threads", lambda: None)
    with threads.one_blas_thread():
        assert np.linalg.inv(np.eye(2)).tolist() == [[1, 0], [0, 1]]


def test_candidates_are_compared_with_one_thread(blas):
    threads_by_step = []
    points = np.random.default_rng(0).random((200, 3))
    compare(
        points,
        points + 0.01,
        register="none",
        deformation=False,
        on_step=lambda step: threads_by_step.append((step, blas.get())),
    )
    assert {count for step, count in threads_by_step if step.startswith("candidate")} == {1}
    assert blas.get() == 2
