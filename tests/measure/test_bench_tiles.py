"""The bench of comparisons in tiles counts all processes, and its clouds are the same each time."""

import subprocess
import sys

import numpy as np
import pytest
from optional import import_or_skip
from repository import ROOT

from pcbench import read_cloud

BENCH = ROOT / "benchmarks"
BUSY = "import time; any(time.process_time() > 0.4 for _ in iter(int, 1))"  # for 0.4 s of processor time
# A child whose own child is busy, and which is killed before that one ends.
KILLS_A_PARENT = f"""
import subprocess, sys, time
parent = subprocess.Popen([sys.executable, "-c", '''
import subprocess, sys, time
subprocess.Popen([sys.executable, "-c", {BUSY!r}])
print("started", flush=True)
time.sleep(60)
'''], stdout=subprocess.PIPE)
parent.stdout.readline()
parent.kill()
parent.wait()
"""


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(BENCH)
    import large_clouds
    import process_tree

    return large_clouds, process_tree


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_that_lost_their_parent_are_counted(bench):
    _, process_tree = bench
    usage = process_tree.measure([sys.executable, "-c", KILLS_A_PARENT])
    assert 0.4 <= usage.cpu < 2.4


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_is_that_of_all_processes(bench):
    _, process_tree = bench
    fill = "import time; data = b'1' * (100 << 20); time.sleep(1)"
    both = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {fill!r}])"
    usage = process_tree.measure([sys.executable, "-c", both])
    assert 100 << 20 < usage.peak < 200 << 20
    assert usage.peak_main < 50 << 20


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_failures_are_reported(bench):
    _, process_tree = bench
    with pytest.raises(process_tree.CommandFailed, match="wrong input"):
        process_tree.measure([sys.executable, "-c", "raise SystemExit('wrong input')"])


@pytest.mark.long
def test_large_clouds_are_tiles_of_one_surface(bench, tmp_path):
    import_or_skip("lazrs")
    large_clouds, _ = bench
    for folder in "a", "b":
        large_clouds.write_clouds(tmp_path / folder, 20_000)
    reference, again, candidate = (
        read_cloud(tmp_path / path).points for path in ("a/reference", "b/reference", "a/candidate")
    )
    assert len(reference) == len(candidate) == 20_000
    assert np.array_equal(reference, again)
    assert len(list((tmp_path / "a" / "reference").iterdir())) == 4
    area = np.prod(np.ptp(reference[:, :2], axis=0))
    assert np.isclose(len(reference) / area, large_clouds.DENSITY, rtol=0.02)
    assert np.allclose(candidate.mean(axis=0) - reference.mean(axis=0), large_clouds.SHIFT, atol=0.5)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_whole_bench_runs(tmp_path):
    import_or_skip("lazrs")
    command = [
        sys.executable,
        BENCH / "tiles.py",
        "--sizes",
        "5e3,1e4",
        "--most-in-memory",
        "5e3",
        "--most-of-peers",
        "0",
    ]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "failed" not in output
    for name in ("pcbench in memory, icp", "wall seconds, 1 worker / 2 workers", "CPU seconds grow as points^"):
        assert name in output
