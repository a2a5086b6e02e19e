"""Child processes: what they find, what they may take, and that nothing of them is left."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import ends

import pcbench
from pcbench.children import Limits, run_module, run_script


@pytest.fixture
def script(tmp_path):
    def write(*lines):
        file = tmp_path / "child.py"
        file.write_text("\n".join(lines))
        return file

    return write


def test_how_it_ended_and_what_it_said(script):
    ended = run_script(script("import sys", "print('one\\ntwo')", "sys.exit('first\\nlast\\n\\n')"))
    assert (ended.code, ended.timed_out, ended.output, ended.last_words) == (1, False, "one\ntwo\n", "last")
    ended = run_script(script("import os", "os.abort()"))
    assert (ended.code, ended.last_words) == (-signal.SIGABRT, "")
    assert run_script(script("import sys", "print(sys.argv[1:], sys.stdin.read() == '')"), "a", "b c").output == (
        "['a', 'b c'] True\n"
    )


def test_cpu_seconds(script):
    ended = run_script(script("import time", "while time.process_time() < 0.3: pass"))
    assert 0.3 <= ended.cpu_s < 30


def test_limits(script):
    lines = (
        "import os, resource",
        "kinds = resource.RLIMIT_AS, resource.RLIMIT_CPU, resource.RLIMIT_CORE",
        "print(*(resource.getrlimit(kind)[0] for kind in kinds), len(os.sched_getaffinity(0)))",
    )
    own = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_CPU, resource.RLIMIT_CORE)]
    free = run_script(script(*lines)).output.split()
    assert [int(word) for word in free] == [*own, len(os.sched_getaffinity(0))]
    limited = run_script(script(*lines), limits=Limits(memory=1 << 30, cpu_seconds=7, one_cpu=True))
    assert limited.output.split() == [str(1 << 30), "7", "0", "1"]
    assert run_script(script("bytearray(1 << 31)"), limits=Limits(memory=1 << 30)).last_words == "MemoryError"


def test_what_it_started_ends_with_it(script):
    body = ("import subprocess, time", "print(subprocess.Popen(['sleep', '600']).pid)")
    ended = run_script(script(*body))
    assert (ended.code, ended.timed_out) == (0, False)
    assert ends(int(ended.output))
    for seconds in (1, 10, 100):  # a busy machine may not have come to its first line after one
        ended = run_script(script(*body, "time.sleep(600)"), limits=Limits(seconds=seconds))
        assert (ended.code, ended.timed_out) == (-signal.SIGKILL, True)
        if ended.output:
            break
    assert ends(int(ended.output))


def test_it_ends_with_its_parent(script, tmp_path):
    pid = tmp_path / "pid"
    child = script("import os, time", f"open({str(pid)!r}, 'w').write(str(os.getpid()) + ' ')", "time.sleep(600)")
    code = f"from pcbench.children import run_script; run_script({str(child)!r})"
    parent = subprocess.Popen([sys.executable, "-c", code])
    try:
        for _ in range(600):
            if pid.exists() and pid.read_text().endswith(" "):
                break
            time.sleep(0.1)
    finally:
        parent.kill()
        parent.wait()
    assert ends(int(pid.read_text()))


def test_a_module_is_of_this_very_package_and_not_of_the_current_folder(tmp_path, monkeypatch):
    # Were either of these imported, its line would be the last.
    for name in ("pcbench", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong module')")
    monkeypatch.chdir(tmp_path)
    ended = run_module("pcbench.cli", "--version")
    assert (ended.code, ended.errors) == (0, "")
    assert pcbench.__version__ in ended.output


def test_a_script_imports_what_this_program_would(script, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "module_of_mine.py").write_text("VALUE = 3")
    file = script("import module_of_mine", "print(module_of_mine.VALUE)")
    assert "No module named" in run_script(file).last_words
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "elsewhere")])
    assert run_script(file).output == "3\n"


def test_where_the_output_goes(script, tmp_path):
    buffer = bytearray(4)
    ended = run_script(script("print('abcdefgh', end='')"), into=memoryview(buffer))
    assert (bytes(buffer), ended.received, ended.output) == (b"abcd", 4, "")
    ended = run_script(script("print('ab', end='')"), into=memoryview(buffer))
    assert (bytes(buffer), ended.received) == (b"abcd", 2)
    (tmp_path / "in").write_text("from a file")
    with (tmp_path / "in").open("rb") as file:
        assert run_script(script("import sys", "print(sys.stdin.read())"), stdin=file).output == "from a file\n"
    with (tmp_path / "log").open("wb") as log:
        run_module("pcbench.cli", "no-such-command", log=log)
    assert "no-such-command" in Path(tmp_path / "log").read_text()
