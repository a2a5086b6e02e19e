"""Tasks on local processes: order, bounds, errors, lost workers, and runs that continue."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import task_functions
from processes import has_ended
from repository import ROOT, TESTS
from wording import check_error, check_text

from pcbench.errors import InputError, PcbenchError, RegistrationError, WorkerError
from pcbench.progress import Step
from pcbench.tasks import Task, TaskRunner, Workers


def numbered(count, *before, after=()):
    return [Task(f"task-{x}", (*before, x, *after)) for x in range(count)]


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "results"


@pytest.fixture
def runner(folder):
    with TaskRunner(Workers(2), folder) as runner:
        yield runner


def values(results):
    return [value for _, value in results]


def test_results_have_the_order_of_the_tasks(runner, tmp_path):
    tasks = [Task(f"task-{x}", (str(tmp_path), x, 0.2 if x == 0 else 0.0)) for x in range(8)]
    results = runner.run("stage", task_functions.slow, tasks)
    assert values(results) == list(range(8))
    assert [task for task, _ in results] == tasks
    assert task_functions.calls(tmp_path) != list(range(8))  # the first ended last
    assert len(task_functions.worker_ids(tmp_path)) == 2
    arrays = runner.run("arrays", task_functions.array, numbered(3))
    np.testing.assert_array_equal(arrays.get("task-2")["values"], [0.0, 1.0])


def test_stored_results_are_not_computed_again(runner, folder, tmp_path):
    tasks = numbered(5, str(tmp_path))
    for key in ("one", "one", "two"):
        assert values(runner.run("stage", task_functions.logged, tasks, key=key)) == list(range(5))
    assert sorted(task_functions.calls(tmp_path)) == sorted([*range(5), *range(5)])  # `two` used nothing of `one`
    runner.run("other", task_functions.logged, tasks, key="two")
    assert len(task_functions.calls(tmp_path)) == 15


def test_damaged_and_missing_results_are_computed_again(runner, folder, tmp_path):
    tasks = numbered(4, str(tmp_path))
    runner.run("stage", task_functions.logged, tasks)
    file = folder / "stage" / "task-1.result"
    file.write_bytes(file.read_bytes()[:-5])
    (folder / "stage" / "task-3.result").unlink()
    (folder / "stage" / ".task-3.result-00.partial").touch()
    assert values(runner.run("stage", task_functions.logged, tasks)) == list(range(4))
    assert sorted(task_functions.calls(tmp_path)) == [0, 1, 1, 2, 3, 3]
    runner.run("stage", task_functions.logged, tasks[:2])
    assert sorted(path.name for path in (folder / "stage").iterdir()) == ["task-0.result", "task-1.result"]


def test_no_tasks(runner):
    assert values(runner.run("stage", task_functions.square, [])) == []


def test_names_are_checked(runner):
    for tasks in ([Task("a", ()), Task("a", ())], [Task("a/b", ())], [Task("", ())]):
        with pytest.raises(ValueError, match="expected"):
            runner.run("stage", task_functions.square, tasks)
    with check_error():
        Workers(0)


def test_tasks_in_flight_are_bounded(runner, tmp_path):
    running = tmp_path / "running"
    running.mkdir()
    counts = values(
        runner.run("stage", task_functions.concurrency, [Task(f"task-{x}", (str(running),)) for x in range(12)])
    )
    assert max(counts) <= 2


def test_workers_have_one_thread(runner, monkeypatch):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "4")
    (result,) = values(runner.run("stage", task_functions.thread_counts, [Task("a", ())]))
    assert result == (0, 1, "1")


def test_output_of_libraries_does_not_disturb(runner, capfd):
    assert values(runner.run("stage", task_functions.printed, numbered(3))) == [0, 1, 2]
    assert capfd.readouterr() == ("", "")


def test_workers_end_with_the_block(folder, tmp_path):
    with TaskRunner(Workers(2), folder) as runner:
        runner.run("stage", task_functions.slow, numbered(4, str(tmp_path), after=(0.05,)))
    assert all(has_ended(pid) for pid in task_functions.worker_ids(tmp_path))


# Errors of functions


@pytest.mark.parametrize("error", [InputError("one"), RegistrationError("two"), OSError(errno.EACCES, "no", "file")])
def test_errors_keep_their_type_and_text(runner, error):
    with pytest.raises(type(error)) as caught:
        runner.run("stage", task_functions.wrong_argument, [Task("a", (error,))])
    assert str(caught.value) == str(error)


def test_programming_errors_show_where_they_happened(runner):
    with pytest.raises(ZeroDivisionError) as caught:
        runner.run("stage", task_functions.wrong, numbered(1))
    assert "return 1 // (x - x)" in caught.value.__notes__[0]


def test_results_that_cannot_be_stored_are_programming_errors(runner):
    with pytest.raises(TypeError, match="got function"):
        runner.run("stage", task_functions.function_in_result, [Task("a", ())])


def test_finished_results_stay_after_an_error(folder, tmp_path):
    with TaskRunner(Workers(1), folder) as runner:
        with check_error(OSError):
            runner.run("stage", task_functions.full_disk, numbered(6, str(tmp_path), after=(4,)))
        assert task_functions.calls(tmp_path) == [0, 1, 2, 3]
        results = runner.run("stage", task_functions.full_disk, numbered(6, str(tmp_path), after=(None,)))
    assert values(results) == list(range(6))
    assert task_functions.calls(tmp_path) == list(range(6))


def test_a_file_that_is_too_large(runner, folder):
    with pytest.raises(OSError) as caught:
        runner.run("stage", task_functions.limited_file, [Task("a", (1 << 20,))])
    assert caught.value.filename == str(folder / "stage" / "a.result")
    assert list((folder / "stage").iterdir()) == []


def test_skipped_tasks_have_no_result(runner):
    skipped = []
    results = runner.run(
        "stage",
        task_functions.refused,
        numbered(5, after=((1, 3),)),
        skip=lambda task, error: skipped.append((task.name, str(error))),
    )
    assert values(results) == [0, 2, 4] and len(results) == 3
    assert sorted(skipped) == [("task-1", "1: expected another number"), ("task-3", "3: expected another number")]
    with pytest.raises(KeyError):
        results.get("task-1")


def test_tasks_that_end_their_workers_are_skipped_if_wanted(runner, tmp_path):
    skipped = []
    results = runner.run(
        "stage",
        task_functions.ended,
        [Task(f"task-{x}", (tmp_path, x, 1, 9)) for x in range(3)],
        skip=lambda task, error: skipped.append((task.name, type(error))),
        skip_losses=True,
    )
    assert values(results) == [0, 2] and skipped == [("task-1", WorkerError)]


def test_too_little_memory_says_what_to_do(runner):
    with check_error(WorkerError):
        runner.run("stage", task_functions.wrong_argument, [Task("a", (MemoryError(),))])


# Lost workers


def test_a_killed_worker_is_replaced(runner, tmp_path):
    tasks = numbered(6, str(tmp_path), after=(2, 2))
    assert values(runner.run("stage", task_functions.ended, tasks)) == list(range(6))
    assert sorted(task_functions.calls(tmp_path)) == [0, 1, 2, 2, 2, 3, 4, 5]


def test_a_task_that_ends_three_workers_is_an_error(runner, tmp_path):
    with check_error(WorkerError):
        runner.run("stage", task_functions.ended, numbered(6, str(tmp_path), after=(2, 99)))
    assert task_functions.calls(tmp_path).count(2) == 3
    for name, function, arguments in (
        ("crash", task_functions.ended_by, (signal.SIGSEGV,)),
        ("exit", task_functions.exited, ()),
    ):
        with check_error(WorkerError):
            runner.run(name, function, [Task("a", arguments)])


def test_a_worker_that_cannot_start_is_an_error(folder, tmp_path, monkeypatch):
    (tmp_path / "numpy").mkdir()
    (tmp_path / "numpy" / "__init__.py").write_text("raise ImportError('numpy is broken')")
    monkeypatch.syspath_prepend(tmp_path)
    with TaskRunner(Workers(1), folder) as runner, pytest.raises(ImportError, match="numpy is broken"):
        runner.run("stage", task_functions.square, numbered(1))


# Runs that are ended

SCRIPT = """
import sys
from pathlib import Path
import task_functions
from pcbench.tasks import Task, TaskRunner, Workers
folder = Path(sys.argv[1])
with TaskRunner(Workers(2), folder / "results") as runner:
    runner.run("stage", task_functions.slow, [Task(f"task-{x}", (str(folder), x, 0.2)) for x in range(12)])
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_an_ended_run_leaves_no_process_and_continues(tmp_path, folder, number):
    path = os.pathsep.join([str(ROOT), str(TESTS), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path)], env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE
    )
    stage = folder / "stage"
    while not stage.exists() or len(list(stage.glob("*.result"))) < 3:
        assert process.poll() is None
        time.sleep(0.02)
    start = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == -number
    assert (b"KeyboardInterrupt" in errors) == (number == signal.SIGINT)
    assert time.monotonic() - start < 5
    assert all(has_ended(pid) for pid in task_functions.worker_ids(tmp_path))
    finished = [path.name for path in stage.glob("*.result")]
    assert 3 <= len(finished) < 12
    with TaskRunner(Workers(2), folder) as runner:
        results = runner.run("stage", task_functions.slow, numbered(12, str(tmp_path), after=(0.2,)))
    assert values(results) == list(range(12))
    calls = task_functions.calls(tmp_path)
    assert sum(calls.count(int(name[5:-7])) for name in finished) == len(finished)  # none of them ran again
    assert len(list(stage.iterdir())) == 12


def test_a_script_needs_no_main_block(tmp_path):
    """Unlike multiprocessing's processes, workers do not run the user's script again."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.replace("0.2", "0.0") + "print('once')\n")
    path = os.pathsep.join([str(ROOT), str(TESTS)])
    output = subprocess.check_output([sys.executable, script, tmp_path], env={**os.environ, "PYTHONPATH": path})
    assert output == b"once\n"


# Progress


def test_progress_estimates_the_time_left(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("pcbench.tasks.progress._INTERVAL_S", 0.0)
    steps = []
    tasks = [Task(f"task-{x}", (str(tmp_path), x, 0.1), 2e6) for x in range(4)]
    with TaskRunner(Workers(1), folder, steps.append) as runner:
        runner.run("stage", task_functions.slow, tasks[:1], title="nearest points")
        runner.run("stage", task_functions.slow, tasks, title="nearest points")
    check_text("\n".join(steps))
    assert [text.split(",")[0] for text in steps[2:]] == [
        f"nearest points: {done} of 8 M points" for done in (2, 4, 6, 8)
    ]
    assert all(isinstance(step, Step) for step in steps)
    assert steps[2].expected is None and steps[-1].expected == steps[-1].after == 0
    assert steps[3].after > steps[4].after > 0


def test_all_errors_travel_between_processes():
    import pickle

    from pcbench.errors import MissingExtra
    from pcbench.opengl import NoFiguresError

    assert isinstance(NoFiguresError("text"), PcbenchError)
    errors = [kind("text") for kind in (InputError, RegistrationError, WorkerError, NoFiguresError)]
    for error in [*errors, MissingExtra("open3d", "open3d", "too old", "install it")]:
        copy = pickle.loads(pickle.dumps(error))
        assert type(copy) is type(error) and str(copy) == str(error)


def test_dask_is_not_imported_without_a_cluster():
    code = "import sys, pcbench.tasks; sys.exit(any(name in sys.modules for name in ('dask', 'distributed', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_results_are_in_an_absolute_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with TaskRunner(Workers(1), Path("results")) as runner:
        monkeypatch.chdir(ROOT)
        assert values(runner.run("stage", task_functions.square, numbered(2))) == [0, 1]
    assert (tmp_path / "results" / "stage" / "task-1.result").exists()
