"""Temporary files, and claims to outputs: nobody's work is swept, and nothing of a killed run stays."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from wording import refused

from pcbench.io.files import atomic_write
from pcbench.scratch import claim, naming, scratch_file, scratch_folder, sweep

BUSY = """
import sys
from pathlib import Path
from pcbench.scratch import scratch_folder
failed = 0
for _ in range(1000):
    try:
        with scratch_folder(Path(sys.argv[1])) as folder:
            assert folder.is_dir()
    except FileNotFoundError:
        failed += 1
print(failed)
"""

HOLD = """
import sys, time
from pathlib import Path
from pcbench.scratch import claim, scratch_file, scratch_folder
out = Path(sys.argv[1])
with claim(out), scratch_folder(out) as folder, scratch_file(out.with_suffix(".ply")) as (_, file):
    (folder / "half").write_text("half")
    print("ready", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other(tmp_path):
    """Another process that claims and fills `tmp_path / "out"`."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "out"], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_what_a_living_run_has_is_left_and_what_a_killed_one_had_is_swept(tmp_path, other):
    theirs = sorted(p.name for p in tmp_path.iterdir())
    assert len(theirs) == 3
    old = time.time() - 10**6
    for path in tmp_path.iterdir():
        os.utime(path, (old, old))  # age alone is no proof
    with refused(), claim(tmp_path / "out"):
        pass
    with atomic_write(tmp_path / "mine.txt") as file:
        file.write(b"mine")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*theirs, "mine.txt"])
    other.send_signal(signal.SIGKILL)
    other.wait()
    with claim(tmp_path / "out"), scratch_folder(tmp_path / "out") as folder:
        (folder / "whole").touch()
        folder.rename(tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "out"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["whole"]


def test_a_sweep_between_making_and_locking_is_survived(tmp_path, monkeypatch):
    """Another run sweeps just before the folder is opened to be locked, three times: it is made again."""
    real, sweeps = os.open, iter([True] * 3)

    def interrupted(path, *arguments, **options):
        if Path(path).name.startswith(".pcbench-") and next(sweeps, False):
            with monkeypatch.context() as undone:
                undone.setattr(os, "open", real)
                sweep(tmp_path)
        return real(path, *arguments, **options)

    monkeypatch.setattr(os, "open", interrupted)
    with scratch_folder(tmp_path / "out") as folder:
        assert folder.is_dir()
    assert next(sweeps, None) is None
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_still_an_error(tmp_path):
    with pytest.raises(FileNotFoundError), scratch_folder(tmp_path / "missing" / "out"):
        pass


def test_two_processes_in_one_folder_do_not_lose_their_own(tmp_path):
    """Neither process asks the other: each sweeps the folder 1,000 times."""
    run = [sys.executable, "-c", BUSY, tmp_path / "out"]
    processes = [subprocess.Popen(run, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate()[0] for process in processes] == ["0\n", "0\n"]
    assert list(tmp_path.iterdir()) == []


def test_what_another_machine_left_is_swept_after_a_day(tmp_path):
    young, old = (f".pcbench-00000000-{letter * 16}" for letter in "ab")
    for name in (young, old):
        (tmp_path / name).mkdir()
        (tmp_path / f"{name}.tmp").write_text("half")
    long_ago = time.time() - 2 * 86_400
    for path in tmp_path.glob(f"{old}*"):
        os.utime(path, (long_ago, long_ago))
    sweep(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {young, f"{young}.tmp"}


def test_what_a_user_has_named_alike_stays(tmp_path):
    names = [
        ".pcbench.txt",
        ".pcbench-notes",
        ".pcbench-list.lock",
        ".pcbench-00000000-old",
        ".pcbench-0123456789abcdef",
    ]
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "kept").write_text("a user's own")
        os.utime(tmp_path / name, (0, 0))
    sweep(tmp_path)
    assert sorted(p.parent.name for p in tmp_path.glob("*/kept")) == sorted(names)


def test_nothing_stays_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), claim(tmp_path / "out"), scratch_folder(tmp_path / "out") as folder:
        (folder / "half").touch()
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), scratch_file(tmp_path / "a") as (_, file):
        file.write(b"half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_said_of_the_output(tmp_path):
    with pytest.raises(OSError) as caught, naming(tmp_path / "out", tmp_path / "scratch"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "out"))
    with pytest.raises(PermissionError) as caught, naming(tmp_path / "out", tmp_path / "scratch"):
        raise PermissionError(errno.EACCES, "denied", tmp_path / "scratch" / "a" / "b.ply")
    assert caught.value.filename == str(tmp_path / "out" / "a" / "b.ply")
    with pytest.raises(FileNotFoundError) as caught, naming(tmp_path / "out", tmp_path / "scratch"):
        (tmp_path / "elsewhere").read_text()
    assert caught.value.filename == str(tmp_path / "elsewhere")


def test_a_limit_of_file_sizes_is_said_of_the_output(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError) as caught, atomic_write(tmp_path / "a.ply") as file:
            file.write(bytes(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path / "a.ply"))
    assert list(tmp_path.iterdir()) == []
