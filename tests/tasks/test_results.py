"""Files with the results of tasks: damage is noticed, and nothing is half-written."""

import errno
import hashlib
import os
import pickle
import resource
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from wording import check_error

from pcbench.errors import InputError
from pcbench.tasks.codec import types_in, write_array
from pcbench.tasks.files import files_written, record_file, task_file
from pcbench.tasks.results import StageResults, Task, is_intact, read_result, write_result


class Sums(NamedTuple):
    count: int
    values: np.ndarray


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.result"
    size = write_result(path, "key", Sums(3, np.arange(100.0)))
    assert path.stat().st_size == size
    return path


def test_results_return(file):
    sums = read_result(file, "key", types_in(Sums))
    assert isinstance(sums, Sums) and sums.count == 3
    np.testing.assert_array_equal(sums.values, np.arange(100.0))
    assert [path.name for path in file.parent.iterdir()] == ["a.result"]


def test_each_truncation_and_changed_byte_is_noticed(file):
    data = file.read_bytes()
    assert is_intact(file, "key")
    for size in (0, 1, 15, 16, 47, 48, 79, 80, len(data) // 2, len(data) - 32, len(data) - 1):
        file.write_bytes(data[:size])
        assert not is_intact(file, "key")
    for position in range(0, len(data), 7):
        file.write_bytes(data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :])
        assert not is_intact(file, "key")
    file.write_bytes(data + b"\0")
    assert not is_intact(file, "key")


def test_results_belong_to_one_key(file):
    assert not is_intact(file, "another key")
    with pytest.raises(InputError):
        read_result(file, "another key", {})


def test_missing_and_damaged_results_are_refused(file):
    file.write_bytes(file.read_bytes()[:-1])
    with check_error():
        read_result(file, "key", types_in(Sums))
    file.unlink()
    assert not is_intact(file, "key")
    with check_error():
        read_result(file, "key", types_in(Sums))


def test_a_result_that_cannot_be_stored_leaves_no_file(tmp_path):
    with pytest.raises(TypeError):
        write_result(tmp_path / "a.result", "key", [np.zeros(10_000), lambda: None])
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_names_the_result_and_keeps_the_former(file):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(OSError) as caught:
            write_result(file, "key", np.zeros(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(file))
    assert list(file.parent.iterdir()) == [file]
    assert read_result(file, "key", types_in(Sums)).count == 3


class Attack:
    def __reduce__(self):
        return os.mkdir, ("attacked",)


@pytest.mark.parametrize("version", [b"pcbench result 1", b"pcbench result 2"])
@pytest.mark.parametrize("form", ["pickle", "pickled array", "huge array", "cut array", "type", "nested"])
def test_a_result_of_somebody_else_runs_no_code(file, monkeypatch, version, form):
    """The attacker knows the key and the format: the checksum is right."""
    monkeypatch.chdir(file.parent)
    if form == "pickle":
        content = pickle.dumps(Attack())
    elif form.endswith("array"):
        array = BytesIO()
        np.save(array, np.array([Attack()]) if form == "pickled array" else np.zeros(1))
        content = array.getvalue().replace(b"(1,), }        ", b"(10000000000,),}" if form == "huge array" else b"(1,")
        text = b'[["array",0],1,[]]'
        content = len(text).to_bytes(8, "little") + text + content
    else:
        text = b'[["type","pathlib.Path",{"args":"x"}],0,[]]' if form == "type" else b"[" * 100_000
        content = len(text).to_bytes(8, "little") + text
    content = version + hashlib.sha256(b"key").digest() + content
    file.write_bytes(content + hashlib.sha256(content).digest())
    with pytest.raises(InputError):
        read_result(file, "key", types_in(Sums))
    assert not Path("attacked").exists() and not is_intact(file, "key")


def test_the_files_of_a_task_belong_to_its_result(tmp_path):
    with files_written() as files:
        with task_file(tmp_path / "a.npy") as file:
            write_array(file, np.arange(6.0).reshape(3, 2).T)
        (tmp_path / "b.txt").write_text("text")
        record_file(tmp_path / "b.txt")
    result = tmp_path / "results" / "a.result"
    result.parent.mkdir()
    write_result(result, "key", 1, files)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.arange(6.0).reshape(3, 2).T)
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in ("a.npy", "b.txt", "results"):
        (tmp_path / path).rename(moved / path)
    result = moved / "results" / "a.result"
    assert is_intact(result, "key")
    for name in ("a.npy", "b.txt"):
        content = (moved / name).read_bytes()
        for damaged in (
            content[:-1],
            content + b"x",
            bytes(len(content)),
            content[:-1] + bytes([content[-1] ^ 1]),
            None,
        ):
            (moved / name).unlink()
            if damaged is not None:
                (moved / name).write_bytes(damaged)
            else:
                (moved / name).mkdir()  # also: what is no file
            assert not is_intact(result, "key")
        (moved / name).rmdir()
        assert not is_intact(result, "key")
        (moved / name).write_bytes(content)
        assert is_intact(result, "key")


def test_results_are_loaded_when_they_are_needed(tmp_path):
    tasks = [Task("b", ()), Task("a", ())]
    files = {task.name: tmp_path / f"{task.name}.result" for task in tasks}
    for name, path in files.items():
        write_result(path, "key", name * 2)
    results = StageResults(tasks, files, "key")
    assert len(results) == 2 and results.get("a") == "aa"
    values = iter(results)
    assert next(values) == (tasks[0], "bb")
    files["a"].unlink()
    with pytest.raises(InputError):
        next(values)
    with pytest.raises(KeyError):
        results.get("c")


def test_a_pipe_in_place_of_a_result_is_not_waited_for(file):
    file.unlink()
    os.mkfifo(file)
    assert not is_intact(file, "key")
    with pytest.raises(InputError):
        read_result(file, "key", types_in(Sums))
