"""Tasks on a Dask cluster: lost workers, a scheduler that is started again, and clusters that cannot be used."""

import gc
import json
import os
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import task_functions
from docs_blocks import blocks
from optional import import_or_skip
from repository import ROOT, TESTS
from wording import check_error, check_text

from pcbench import Cloud, write_cloud
from pcbench.errors import InputError, WorkerError
from pcbench.tasks import Task, TaskRunner, Workers, cluster
from pcbench.tasks.calls import ConnectionLost


@pytest.fixture(scope="module", autouse=True)
def distributed():
    """Import Dask, which takes half a second, only in the worker that runs these tests."""
    return import_or_skip("distributed")


def local_cluster(**options):
    return import_or_skip("distributed").LocalCluster(
        threads_per_worker=1, dashboard_address=":0", host="127.0.0.1", **options
    )


def with_threads(count):
    """Return a cluster of workers in this process, which start in a tenth of the time of processes."""
    return local_cluster(n_workers=count, processes=False, protocol="tcp://")


@pytest.fixture(scope="module")
def address():
    with with_threads(2) as local:
        yield local.scheduler_address


@pytest.fixture(scope="module")
def address_of_processes():
    with local_cluster(n_workers=2, processes=True) as local:
        yield local.scheduler_address


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "results"


@pytest.fixture
def runner(address, folder):
    with TaskRunner(Workers(cluster=address), folder) as runner:
        yield runner


@pytest.fixture
def runner_of_processes(address_of_processes, folder):
    with TaskRunner(Workers(cluster=address_of_processes), folder) as runner:
        yield runner


def numbered(count, *before, after=()):
    return [Task(f"task-{x}", (*before, x, *after)) for x in range(count)]


def values(results):
    return [value for _, value in results]


def test_results_are_stored_and_ordered(runner, tmp_path):
    tasks = [Task(f"task-{x}", (str(tmp_path), x, 0.3 if x == 0 else 0.0)) for x in range(8)]
    for _ in range(2):
        assert values(runner.run("stage", task_functions.slow, tasks)) == list(range(8))
    assert sorted(task_functions.calls(tmp_path)) == list(range(8))


@pytest.mark.long
def test_all_workers_have_tasks_and_one_thread(runner_of_processes, tmp_path):
    runner = runner_of_processes
    runner.run("slow", task_functions.slow, numbered(8, str(tmp_path), after=(0.1,)))
    assert len(task_functions.worker_ids(tmp_path)) == 2
    (result,) = values(runner.run("stage", task_functions.thread_counts, [Task("a", ())]))
    assert result == (0, 1, "1")


def test_errors_and_skipped_tasks(runner):
    with pytest.raises(InputError) as caught:
        runner.run("stage", task_functions.refused, numbered(3, after=((1,),)))
    assert str(caught.value) == "1: expected another number"
    skipped = []
    results = runner.run(
        "stage", task_functions.refused, numbered(3, after=((1,),)), skip=lambda task, _: skipped.append(task.name)
    )
    assert values(results) == [0, 2] and skipped == ["task-1"]
    with pytest.raises(ZeroDivisionError):
        runner.run("wrong", task_functions.wrong, numbered(1))


@pytest.mark.long
def test_tasks_of_a_killed_worker_run_again(runner_of_processes, tmp_path):
    tasks = numbered(6, str(tmp_path), after=(2, 1))
    assert values(runner_of_processes.run("stage", task_functions.ended, tasks)) == list(range(6))
    assert task_functions.calls(tmp_path).count(2) == 2


@pytest.mark.long
def test_a_task_that_ends_its_workers_is_an_error(tmp_path, folder):
    """On a separate cluster: Dask does not always start workers again that end while they start."""
    with (
        local_cluster(n_workers=2, processes=True) as local,
        TaskRunner(Workers(cluster=local.scheduler_address), folder) as runner,
    ):
        with check_error(WorkerError):
            runner.run("stage", task_functions.ended, [Task("task-0", (str(tmp_path), 0, 0, 99))])
    assert task_functions.calls(tmp_path) == [0, 0, 0, 0]


def test_tasks_in_flight_are_bounded(address, tmp_path):
    running = tmp_path / "running"
    running.mkdir()
    with TaskRunner(Workers(1, address), tmp_path / "results") as runner:
        tasks = [Task(f"task-{x}", (str(running),)) for x in range(6)]
        assert values(runner.run("stage", task_functions.concurrency, tasks)) == [1] * 6
    pool = cluster.ClusterWorkers(address, None, lambda _: None)
    try:
        pool._client.wait_for_workers(2, 120)
        pool.keep_connected()
        assert pool.slots == 4  # two workers with one thread each
    finally:
        pool.stop()


# Clusters that cannot be used


def test_no_scheduler(folder, monkeypatch):
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.05)
    for address in ("tcp://127.0.0.1:9", "nonsense://a", "no-such-file.json"):
        with TaskRunner(Workers(cluster=address), folder) as runner, check_error():
            runner.run("stage", task_functions.square, numbered(1))


@pytest.fixture
def eager_collector():
    """Collect garbage at each allocation."""
    thresholds = gc.get_threshold()
    gc.set_threshold(1)
    yield
    gc.set_threshold(*thresholds)


def unclosed():
    """Return the threads of event loops, and the clients that are not closed."""
    client = import_or_skip("distributed").Client
    clients = {item for item in gc.get_objects() if isinstance(item, client) and item.status != "closed"}
    return clients | {thread for thread in threading.enumerate() if thread.name == "IO loop"}


def test_clients_that_cannot_connect_leave_nothing_to_the_collector(monkeypatch, eager_collector):
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.05)
    before = unclosed()
    with pytest.raises(InputError):
        cluster.ClusterWorkers("tcp://127.0.0.1:9", None, lambda _: None)
    assert unclosed() <= before
    assert gc.isenabled()


@pytest.mark.long
def test_lost_connections_leave_nothing_to_the_collector(monkeypatch, eager_collector):
    before = unclosed()
    with with_threads(0) as local:
        pool = cluster.ClusterWorkers(local.scheduler_address, None, lambda _: None)
        monkeypatch.setattr(pool._client, "close", lambda _: 1 / 0)
        lost = pool._client
        pool._reconnect()
        assert lost.status == "closed" and pool._client.status == "running"
        pool.stop()
        pool.stop()
    assert unclosed() <= before


def test_a_client_whose_workers_cannot_be_counted_is_closed(address, monkeypatch):
    before = unclosed()
    monkeypatch.setattr(cluster, "_count_threads", lambda client: client.no_such_attribute)
    with pytest.raises(AttributeError):
        cluster.ClusterWorkers(address, None, lambda _: None)
    assert unclosed() <= before


def test_dask_is_missing(tmp_path):
    """In a separate process, because modules of distributed cannot be loaded a second time."""
    (tmp_path / "distributed.py").write_text("raise ModuleNotFoundError(name='distributed')")
    code = (
        "import task_functions\n"
        "from pathlib import Path\n"
        "from pcbench.errors import MissingExtra\n"
        "from pcbench.tasks import Task, TaskRunner, Workers\n"
        "with TaskRunner(Workers(cluster='tcp://127.0.0.1:9'), Path('results')) as runner:\n"
        "    try:\n"
        "        runner.run('stage', task_functions.square, [Task('a', (1,))])\n"
        "    except MissingExtra as error:\n"
        "        print(error)\n"
    )
    path = os.pathsep.join([str(tmp_path), str(ROOT), str(TESTS), os.environ.get("PYTHONPATH", "")])
    output = subprocess.check_output(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, text=True
    )
    check_text(output)


def test_workers_with_other_versions(runner, monkeypatch):
    own, main = cluster._versions(), threading.main_thread()
    other = {**own, "numpy": "1.0"}  # of the client: the workers are other threads
    monkeypatch.setattr(cluster, "_versions", lambda: other if threading.current_thread() is main else own)
    with pytest.raises(WorkerError) as caught:
        runner.run("stage", task_functions.square, numbered(1))
    assert "\n" not in str(caught.value)
    check_text(str(caught.value).replace(os.uname().nodename, "HOST"))


def test_pcbench_is_missing_on_the_cluster(runner):
    runner.run("stage", task_functions.square, numbered(1))
    error = ModuleNotFoundError("No module named 'pcbench'", name="pcbench")
    check_text(str(runner._pool._explain(error)).replace(runner._pool._cluster, "ADDRESS"))


def test_workers_that_do_not_see_the_folder(runner, monkeypatch):
    monkeypatch.setattr("pcbench.tasks.runner._MAX_VISIBILITY_CHECKS", 1)
    monkeypatch.setattr("pcbench.tasks.runner._POLL_INTERVAL_S", 0.1)

    class Elsewhere:
        """A worker with another disk."""

        slots = 1

        def submit(self, call):
            future = Future()
            future.set_result(100)
            return future

        def stop(self):
            pass

    runner._pool = Elsewhere()
    with check_error(WorkerError):
        runner.run("stage", task_functions.square, numbered(1))


# A scheduler that is started again


def _port():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


class Cluster:
    """A scheduler and two workers as separate programs, as on a real cluster."""

    def __init__(self, folder):
        self.port, self.folder = _port(), folder
        self.processes = []

    @property
    def address(self):
        return f"tcp://127.0.0.1:{self.port}"

    def start(self):
        path = os.pathsep.join([str(ROOT), str(TESTS), os.environ.get("PYTHONPATH", "")])
        programs = (
            ("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-show"),
            *[("dask_worker", self.address, "--no-nanny", "--nthreads", "1", "--no-dashboard")] * 2,
        )
        with (self.folder / "log.txt").open("ab") as log:
            for name, *arguments in programs:
                self.processes.append(
                    subprocess.Popen(
                        [sys.executable, "-m", f"distributed.cli.{name}", *arguments],
                        env={**os.environ, "PYTHONPATH": path},
                        cwd=self.folder,
                        stdout=log,
                        stderr=log,
                    )
                )
        for _ in range(600):
            with socket.socket() as client:
                if client.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.1)
        raise AssertionError((self.folder / "log.txt").read_text())

    def kill_scheduler(self):
        self.processes[0].kill()

    def stop(self):
        for process in self.processes:
            process.kill()
            process.wait()
        self.processes.clear()


@contextmanager
def programs(folder):
    folder.mkdir()
    started = Cluster(folder)
    started.start()
    try:
        yield started
    finally:
        started.stop()


@pytest.mark.long
def test_a_scheduler_that_is_started_again(tmp_path, folder, capfd):
    steps = []
    restarted = False

    with programs(tmp_path / "cluster") as started:

        def progress(text):
            nonlocal restarted
            steps.append(text)
            if not restarted and len(task_functions.calls(tmp_path)) >= 4:
                restarted = True
                started.kill_scheduler()
            if text.startswith("waiting for the scheduler"):
                started.stop()
                started.start()

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("pcbench.tasks.progress._INTERVAL_S", 0.0)
            with TaskRunner(Workers(cluster=started.address), folder, progress) as runner:
                tasks = [Task(f"task-{x}", (str(tmp_path), x, 0.2)) for x in range(20)]
                assert values(runner.run("stage", task_functions.slow, tasks)) == list(range(20))
    assert restarted
    assert any(text.startswith("waiting for the scheduler") for text in steps)
    calls = task_functions.calls(tmp_path)
    assert set(calls) == set(range(20)) and len(calls) <= 20 + 4  # only the tasks in flight ran again
    assert capfd.readouterr().err == ""


@pytest.mark.long
def test_a_scheduler_that_does_not_return(tmp_path, folder, monkeypatch, capfd):
    monkeypatch.setattr(cluster, "_RECONNECT_S", 2.0)
    monkeypatch.setattr(cluster, "_CONNECT_S", 5.0)
    with programs(tmp_path / "cluster") as started:
        with TaskRunner(Workers(cluster=started.address), folder) as runner:
            runner.run("first", task_functions.slow, numbered(2, str(tmp_path), after=(0.0,)))
            started.kill_scheduler()
            with pytest.raises(WorkerError) as caught:
                runner.run("second", task_functions.slow, numbered(2, str(tmp_path), after=(0.0,)))
    check_text(str(caught.value).replace(started.address, "ADDRESS"))
    assert capfd.readouterr().err == ""


def test_a_cluster_without_workers(tmp_path, folder):
    steps = []
    with with_threads(0) as local:

        def progress(text):
            steps.append(text.replace(local.scheduler_address, "ADDRESS"))
            if text.startswith("waiting"):
                local.scale(1)

        with TaskRunner(Workers(cluster=local.scheduler_address), folder, progress) as runner:
            assert values(runner.run("stage", task_functions.square, numbered(3))) == [0, 1, 4]
    check_text("\n".join(steps[:2]))  # a slow machine also prints the rate
    assert steps[1] == "waiting for workers of the cluster ADDRESS"


def test_lost_tasks_are_submitted_again(runner, address):
    """The scheduler may forget a task although the connection has returned."""
    lost = []

    class Forgetful(cluster.ClusterWorkers):
        def submit(self, call):
            if len(lost) < 2:
                lost.append(call)
                future = Future()
                future.set_exception(ConnectionLost())
                return future
            return super().submit(call)

    runner._pool = Forgetful(address, None, lambda _: None)
    assert values(runner.run("stage", task_functions.square, numbered(3))) == [0, 1, 4]
    assert len(lost) == 2


def test_the_scheduler_file_is_an_address(address, tmp_path, folder):
    (tmp_path / "scheduler.json").write_text(json.dumps({"address": address}))
    with TaskRunner(Workers(cluster=str(tmp_path / "scheduler.json")), folder) as runner:
        assert values(runner.run("stage", task_functions.square, numbered(2))) == [0, 1]


# The scripts of the page


def _script(name, folder):
    page = ROOT / "docs" / "howto" / "cluster.md"
    (text,) = (block.text for block in blocks(page) if block.title == name)
    (folder / name).write_text(text)
    return folder / name


def _run_python(arguments, folder):
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    commands = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return subprocess.check_output(
        [sys.executable, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "PATH": commands},
        text=True,
        stderr=subprocess.STDOUT,
    )


@pytest.mark.long
def test_the_local_cluster_of_the_page(tmp_path):
    rng = np.random.default_rng(0)
    for name, count in (("reference", 20_000), ("candidate", 10_000)):
        plane = rng.uniform(0, 20, (count, 2))
        write_cloud(tmp_path / f"{name}.ply", Cloud(np.column_stack([plane, np.sin(plane[:, 0])])))
    output = _run_python([_script("local_cluster.py", tmp_path)], tmp_path)
    assert "tiles of at most 5,000 points" in output
    assert (tmp_path / "report" / "comparison.json").exists()


@pytest.mark.long
def test_the_job_of_the_page(tmp_path):
    pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed")
    script = _script("slurm.py", tmp_path)
    text = script.read_text()
    script.write_text(text[: text.index("        cluster.scale")])
    output = _run_python([script], tmp_path)
    assert "#SBATCH -p compute" in output and "--nthreads 1 --memory-limit 4.00GiB" in output


@pytest.mark.long
def test_the_pods_of_the_page(tmp_path):
    pytest.importorskip("dask_kubernetes", reason="dask-kubernetes is not installed")
    spec = json.loads(_run_python([_script("kubernetes.py", tmp_path)], tmp_path))
    assert spec["spec"]["worker"]["replicas"] == 64
    for part in ("scheduler", "worker"):
        (container,) = spec["spec"][part]["spec"]["containers"]
        assert container["volumeMounts"][0]["mountPath"] == "/clouds"
