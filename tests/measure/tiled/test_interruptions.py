"""Comparisons in tiles whose processes are killed: nothing is lost, nothing is computed twice, no bit changes."""

import os
import subprocess
import sys

import numpy as np
import pytest
import tiled_runs
from command_line import read_comparison, without_timings
from optional import import_or_skip
from processes import has_ended
from tiled_pairs import Pair, noisy, surface

pytestmark = [pytest.mark.long, pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")]
SIZE = {"tile_points": 200, "workers": 2}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    rng = np.random.default_rng(0)
    points = surface(rng, 6000)
    pair = Pair(tmp_path_factory.mktemp("files"), points, noisy(rng, points[::2]))
    return pair.paths["ref"], pair.paths["a"]


@pytest.fixture(scope="module")
def expected(files, tmp_path_factory):
    """Result of two workers that nobody disturbs."""
    folder = tmp_path_factory.mktemp("expected")
    assert tiled_runs.start(*files, folder / "work", folder / "out.json", **SIZE).wait() == 0
    return (folder / "out.json").read_text()


def test_other_workers_and_tiles_give_the_same_bits(files, expected, tmp_path):
    process = tiled_runs.start(*files, tmp_path / "work", tmp_path / "out.json", tile_points=900, workers=1)
    assert process.wait() == 0
    assert (tmp_path / "out.json").read_text() == expected


@pytest.mark.parametrize("stage", ["normals", "candidate-1-forth"])
def test_workers_that_are_killed_are_replaced(files, expected, tmp_path, stage):
    work = tmp_path / "work"
    process = tiled_runs.start(*files, work, tmp_path / "out.json", **SIZE)
    tiled_runs.wait_for_results(work, stage, 5, process)
    workers = tiled_runs.children(process.pid)
    assert len(workers) == 2
    tiled_runs.kill(*workers)
    assert process.wait() == 0
    assert (tmp_path / "out.json").read_text() == expected


def test_a_killed_run_continues(files, expected, tmp_path):
    work = tmp_path / "work"
    times = {}
    for stage, count in (("normals", 5), ("candidate-1-back", 5)):
        process = tiled_runs.start(*files, work, tmp_path / "out.json", **SIZE)
        tiled_runs.wait_for_results(work, stage, count, process)
        workers = tiled_runs.children(process.pid)
        tiled_runs.kill(process.pid)
        process.wait()
        assert all(map(has_ended, workers))
        kept = {file: file.stat().st_mtime_ns for file in work.rglob("*.result")}
        assert times.items() <= kept.items() and len(times) < len(kept)
        times = kept
    assert not (tmp_path / "out.json").exists()
    assert tiled_runs.start(*files, work, tmp_path / "out.json", **SIZE).wait() == 0
    assert (tmp_path / "out.json").read_text() == expected
    after = {file: file.stat().st_mtime_ns for file in work.rglob("*.result")}
    assert times.items() <= after.items()
    # A finished run computes nothing again.
    assert tiled_runs.start(*files, work, tmp_path / "out.json", **SIZE).wait() == 0
    assert {file: file.stat().st_mtime_ns for file in work.rglob("*.result")} == after
    assert (tmp_path / "out.json").read_text() == expected


def test_a_killed_command_continues(files, tmp_path):
    """The same on the command line, with the workspace that it chooses itself."""
    reference, candidate = files
    found = []
    for name in ("undisturbed", "killed"):
        out = tmp_path / name
        command = [sys.executable, "-m", "pcbench.cli", "compare", str(reference), str(candidate), "--out", str(out)]
        command += ["--tiles", "300", "--workers", "2", "--no-figures", "--quiet"]
        if name == "killed":
            process = subprocess.Popen(command)
            work = out.with_name(f".{name}.pcbench-tiles")
            tiled_runs.wait_for_results(work, "candidate-1-forth", 3, process)
            tiled_runs.kill(process.pid)
            process.wait()
            assert work.is_dir() and not out.exists()
        subprocess.run(command, check=True)
        assert not list(tmp_path.glob(".*"))
        found.append(without_timings(read_comparison(out)))
    assert found[0] == found[1]


def test_a_cluster_whose_worker_is_killed(files, expected, tmp_path):
    distributed = import_or_skip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as cluster:
        work = tmp_path / "work"
        options = {"tile_points": 500, "cluster": cluster.scheduler_address}
        process = tiled_runs.start(*files, work, tmp_path / "out.json", **options)
        tiled_runs.wait_for_results(work, "candidate-1-forth", 3, process)
        tiled_runs.kill(next(iter(cluster.workers.values())).pid)
        assert process.wait() == 0
    assert (tmp_path / "out.json").read_text() == expected


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the administrator can write everywhere")
def test_a_folder_that_cannot_be_written(files, tmp_path):
    work = tmp_path / "work"
    work.mkdir()
    work.chmod(0o500)
    command = [sys.executable, "-m", "pcbench.cli", "compare", *map(str, files), "--tiles", "300"]
    command += ["--workspace", str(work)]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode != 0 and str(work) in found.stderr and "Traceback" not in found.stderr
