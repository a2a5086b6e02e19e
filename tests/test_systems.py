"""Simulated operating systems: names that Windows and macOS lack are removed before the package is imported."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from processes import has_ended
from repository import ROOT

from pcbench import systems
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud

# Modules and names of `os` and `signal` that the system lacks, and its value of `sys.platform`.
_MACOS = (
    "os.sched_getaffinity os.sched_setaffinity os.waitid os.P_PID os.WNOWAIT os.posix_fadvise os.posix_fallocate",
    "darwin",
)
_WINDOWS = (
    "fcntl resource termios pwd grp os.fork os.setsid os.killpg os.waitid os.wait os.wait4 os.P_PID os.WNOWAIT "
    "os.WNOHANG os.WEXITED os.geteuid os.getuid os.sched_getaffinity os.sched_setaffinity os.register_at_fork "
    "os.uname os.sysconf os.pread os.preadv os.pwrite os.pwritev os.posix_fadvise os.posix_fallocate os.sendfile "
    "os.mkfifo os.fchown os.statvfs os.getpgid os.getloadavg os.O_DIRECTORY os.O_NOFOLLOW os.O_NONBLOCK "
    "signal.SIGKILL signal.SIGHUP signal.SIGALRM signal.setitimer",
    "win32",
)

# Libraries are imported before names are removed, and subprocess keeps them, so that only pcbench is affected.
SIMULATION = """
import ctypes.util, fcntl, importlib, json, multiprocessing, os, pkgutil, platform, shutil, signal, subprocess, sys
import tempfile, types
import numpy, scipy, scipy.optimize, scipy.sparse, scipy.spatial, scipy.special, scipy.stats, click, rich.console
import rich.progress, rich.table
shutil._use_fd_functions = False  # rmtree would use flags that are removed
subprocess.os, subprocess.signal = (types.SimpleNamespace(**vars(module)) for module in (os, signal))
missing, sys.platform = sys.argv[1].split(), sys.argv[2]
flock = fcntl.flock

def locking(descriptor, mode, count):  # the C library of Windows raises a different error
    try:
        flock(descriptor, fcntl.LOCK_EX if mode == 1 else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise PermissionError(13, "Permission denied") from error

for name in missing:
    owner, _, attribute = name.rpartition(".")
    if owner:
        delattr(sys.modules[owner], attribute)
    else:
        sys.modules[name] = None
if sys.platform == "win32":
    sys.modules["msvcrt"] = types.SimpleNamespace(locking=locking, LK_LOCK=1, LK_NBLCK=2)
"""


@pytest.fixture(params=[_MACOS, _WINDOWS], ids=["macos", "windows"])
def run_simulated(request):
    """Return a function that runs Python lines on the simulated system and returns their output."""

    def run_lines(lines, *arguments, setup=""):
        command = [sys.executable, "-c", setup + SIMULATION + lines, *request.param, *map(str, arguments)]
        process = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        assert process.returncode == 0, process.stderr
        return process.stdout

    return run_lines


@pytest.mark.long
def test_every_module_imports(run_simulated):
    heavy_imports = """
import contextlib
with contextlib.suppress(ImportError):
    import torch
with contextlib.suppress(ImportError):
    import cuda.core
"""
    lines = """
count = 0
for package in ("pcbench", "reconstructors"):
    for found in pkgutil.walk_packages([package], package + "."):
        if found.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            if error.name.split(".")[0] not in ("torch", "PIL", "cuda", "pycolmap"):
                raise
        count += 1
print(count)
"""
    sources = [p for package in ("pcbench", "reconstructors") for p in (ROOT / package).rglob("*.py")]
    # The two packages themselves and cli/__main__.py are not imported.
    assert int(run_simulated(lines, setup=heavy_imports)) >= len(sources) - 3


@pytest.mark.long
def test_compare_gives_the_same_numbers(run_simulated, tmp_path):
    rng = np.random.default_rng(5)
    points = np.c_[rng.uniform(0, 4, (3000, 2)), rng.normal(0, 0.01, 3000)]
    for name, cloud_points in (("reference", points), ("candidate", points + [0, 0, 0.02])):
        write_cloud(tmp_path / f"{name}.ply", Cloud(cloud_points))
    lines = """
from pcbench import cli
sys.argv = ["pcbench", "compare", *sys.argv[3:], "--register", "none", "--no-figures", "--quiet"]
cli.main()
"""
    clouds = [tmp_path / f"{name}.ply" for name in ("reference", "candidate")]
    run_simulated(lines, *clouds, "--out", tmp_path / "there")
    code = "from pcbench import cli; cli.main()"
    arguments = [*clouds, "--register", "none", "--no-figures", "--quiet", "--out", tmp_path / "here"]
    subprocess.run([sys.executable, "-c", code, "compare", *arguments], check=True)
    simulated_result, native_result = (
        json.loads((tmp_path / name / "comparison.json").read_text()) for name in ("there", "here")
    )
    assert simulated_result["candidates"][0]["metrics"] == native_result["candidates"][0]["metrics"]
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".pcbench-")]


def test_locked_output_is_refused(run_simulated, tmp_path):
    lines = """
from pathlib import Path
from pcbench.errors import InputError
from pcbench.scratch import lock_output, scratch_folder
out = Path(sys.argv[3])
with lock_output(out):
    try:
        with lock_output(out):
            print("locked twice")
    except InputError:
        print("refused")
with lock_output(out), scratch_folder(out) as folder:
    folder.rename(out)
"""
    assert run_simulated(lines, tmp_path / "out") == "refused\n"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.long
def test_children_run_and_end_at_the_time_limit(run_simulated, tmp_path):
    """Without process groups a fake `taskkill` ends the child."""
    (tmp_path / "taskkill").write_text('#!/bin/sh\nkill -15 "$4"\n')
    (tmp_path / "taskkill").chmod(0o755)
    (tmp_path / "sleeper.py").write_text("import os, time\nprint(os.getpid(), flush=True)\ntime.sleep(600)")
    (tmp_path / "quick.py").write_text("raise SystemExit(3)")
    lines = """
os.environ["PATH"] = sys.argv[3] + os.pathsep + os.environ["PATH"]
from pcbench.children import Limits, run_script
print(run_script(sys.argv[3] + "/quick.py", limits=Limits(cpu_seconds=60, memory=1 << 40, one_cpu=True)).code)
ended = run_script(sys.argv[3] + "/sleeper.py", limits=Limits(seconds=5))
print(ended.timed_out, ended.output.strip())
"""
    exit_code, timeout_line = run_simulated(lines, tmp_path).splitlines()
    timed_out, pid = timeout_line.split()
    assert (exit_code, timed_out) == ("3", "True")
    assert has_ended(int(pid))


def test_memory_and_cpus():
    assert systems.peak_memory() > 1 << 20
    assert systems.peak_memory_with_children() > 1 << 20
    assert systems.cpu_count() <= (os.cpu_count() or 1)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems cannot reset the peak")
def test_peak_memory_after_a_reset_is_that_of_later_allocations():
    np.ones(20_000_000)  # 160 MB, freed at once
    start = systems.reset_peak_memory()
    if start is None:
        pytest.skip("this system does not let a process reset its peak memory")
    assert systems.peak_memory_since_reset() < start + 80e6
    np.ones(20_000_000)
    assert start + 140e6 < systems.peak_memory_since_reset() < start + 240e6


@pytest.mark.parametrize("number, name", [(2, "SIGINT"), (systems.SIGKILL, "SIGKILL"), (500, "signal 500")])
def test_signal_names(number, name):
    assert systems.signal_name(number) == name
