"""Temporary files and output locks: files in use are never removed, and leftovers of killed runs are."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from wording import check_error

from pcbench.scratch import (
    atomic_write,
    attribute_errors_to,
    lock_output,
    remove_leftovers,
    scratch_file,
    scratch_folder,
    workspace_file,
)

REPEATED_SCRATCH_SCRIPT = """
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

LOCKED_OUTPUT_SCRIPT = """
import sys, time
from pathlib import Path
from pcbench.scratch import lock_output, scratch_file, scratch_folder
out = Path(sys.argv[1])
with lock_output(out), scratch_folder(out) as folder, scratch_file(out.with_suffix(".ply")) as (_, file):
    (folder / "half").write_text("half")
    print("ready", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other_process(tmp_path):
    """Another process that locks and fills `tmp_path / "out"`."""
    process = subprocess.Popen(
        [sys.executable, "-c", LOCKED_OUTPUT_SCRIPT, tmp_path / "out"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_only_leftovers_of_killed_runs_are_removed(tmp_path, other_process):
    other_files = sorted(p.name for p in tmp_path.iterdir())
    assert len(other_files) == 3
    old_time = time.time() - 10**6
    for path in tmp_path.iterdir():
        os.utime(path, (old_time, old_time))  # old files in use are no leftovers
    with check_error(), lock_output(tmp_path / "out"):
        pass
    with atomic_write(tmp_path / "mine.txt") as file:
        file.write(b"mine")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*other_files, "mine.txt"])
    other_process.send_signal(signal.SIGKILL)
    other_process.wait()
    with lock_output(tmp_path / "out"), scratch_folder(tmp_path / "out") as folder:
        (folder / "complete").touch()
        folder.rename(tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "out"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["complete"]


def test_removal_between_creation_and_lock_is_retried(tmp_path, monkeypatch):
    """Another run removes the folder three times before it can be locked; it is created again."""
    original_open, removals = os.open, iter([True] * 3)

    def open_after_removal(path, *arguments, **options):
        if Path(path).name.startswith(".pcbench-") and next(removals, False):
            with monkeypatch.context() as patch:
                patch.setattr(os, "open", original_open)
                remove_leftovers(tmp_path)
        return original_open(path, *arguments, **options)

    monkeypatch.setattr(os, "open", open_after_removal)
    with scratch_folder(tmp_path / "out") as folder:
        assert folder.is_dir()
    assert next(removals, None) is None
    assert list(tmp_path.iterdir()) == []


def test_missing_parent_folder_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError), scratch_folder(tmp_path / "missing" / "out"):
        pass


def test_two_processes_in_one_folder_keep_their_files(tmp_path):
    """Each process removes leftovers from the shared folder 1,000 times."""
    command = [sys.executable, "-c", REPEATED_SCRATCH_SCRIPT, tmp_path / "out"]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate()[0] for process in processes] == ["0\n", "0\n"]
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_other_machines_are_removed_after_a_day(tmp_path):
    recent_name, old_name = (f".pcbench-00000000-{letter * 16}" for letter in "ab")
    for name in (recent_name, old_name):
        (tmp_path / name).mkdir()
        (tmp_path / f"{name}.tmp").write_text("half")
    old_time = time.time() - 2 * 86_400
    for path in tmp_path.glob(f"{old_name}*"):
        os.utime(path, (old_time, old_time))
    remove_leftovers(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {recent_name, f"{recent_name}.tmp"}


def test_similar_names_are_not_removed(tmp_path):
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
    remove_leftovers(tmp_path)
    assert sorted(p.parent.name for p in tmp_path.glob("*/kept")) == sorted(names)


def test_nothing_remains_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), lock_output(tmp_path / "out"), scratch_folder(tmp_path / "out") as folder:
        (folder / "half").touch()
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), scratch_file(tmp_path / "a") as (_, file):
        file.write(b"half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_two_writers_of_a_workspace_file_do_not_mix(tmp_path):
    """The slower one neither changes the file that the faster one has finished, nor leaves anything."""
    path = tmp_path / "000001.points.npy"
    with workspace_file(path) as slow:
        slow.write(b"slow")
        with workspace_file(path) as fast:
            fast.write(b"fast")
        slow.write(b"er")
        slow.flush()
        assert path.read_bytes() == b"fast"
    assert path.read_bytes() == b"slower"
    with pytest.raises(ZeroDivisionError), workspace_file(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"slower"
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_error_names_the_output(tmp_path):
    with pytest.raises(OSError) as caught, attribute_errors_to(tmp_path / "out", tmp_path / "scratch"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "out"))
    with pytest.raises(PermissionError) as caught, attribute_errors_to(tmp_path / "out", tmp_path / "scratch"):
        raise PermissionError(errno.EACCES, "denied", tmp_path / "scratch" / "a" / "b.ply")
    assert caught.value.filename == str(tmp_path / "out" / "a" / "b.ply")
    with pytest.raises(FileNotFoundError) as caught, attribute_errors_to(tmp_path / "out", tmp_path / "scratch"):
        (tmp_path / "elsewhere").read_text()
    assert caught.value.filename == str(tmp_path / "elsewhere")


def test_file_size_error_names_the_output(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError) as caught, atomic_write(tmp_path / "a.ply") as file:
            file.write(bytes(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path / "a.ply"))
    assert list(tmp_path.iterdir()) == []
