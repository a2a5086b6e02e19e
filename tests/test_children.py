"""Child processes: their start, their limits and their cleanup."""

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from processes import has_ended
from wording import check_text

import pcbench
from pcbench import children
from pcbench.children import Limits, run_module, run_script


@pytest.fixture
def script(tmp_path):
    def write_script(*lines):
        file = tmp_path / "child.py"
        file.write_text("\n".join(lines))
        return file

    return write_script


def test_exit_code_and_output(script):
    result = run_script(script("import sys", "print('one\\ntwo')", "sys.exit('first\\nlast\\n\\n')"))
    assert (result.code, result.timed_out, result.output, result.last_error_line) == (1, False, "one\ntwo\n", "last")
    result = run_script(script("import os", "os.abort()"))
    assert (result.code, result.last_error_line) == (-signal.SIGABRT, "")
    assert run_script(script("import sys", "print(sys.argv[1:], sys.stdin.read() == '')"), "a", "b c").output == (
        "['a', 'b c'] True\n"
    )


def test_cpu_seconds(script):
    result = run_script(script("import time", "while time.process_time() < 0.3: pass"))
    assert 0.3 <= result.cpu_s < 30


def test_limits(script):
    lines = (
        "import os, resource",
        "kinds = resource.RLIMIT_AS, resource.RLIMIT_CPU, resource.RLIMIT_CORE",
        "print(*(resource.getrlimit(kind)[0] for kind in kinds), len(os.sched_getaffinity(0)))",
    )
    own_limits = [
        resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_CPU, resource.RLIMIT_CORE)
    ]
    child_limits = run_script(script(*lines)).output.split()
    assert [int(word) for word in child_limits] == [*own_limits, len(os.sched_getaffinity(0))]
    result = run_script(script(*lines), limits=Limits(memory=1 << 30, cpu_seconds=7, one_cpu=True))
    assert result.output.split() == [str(1 << 30), "7", "0", "1"]
    assert run_script(script("bytearray(1 << 31)"), limits=Limits(memory=1 << 30)).last_error_line == "MemoryError"


def test_descendants_end_with_the_child(script):
    lines = ("import subprocess, time", "print(subprocess.Popen(['sleep', '600']).pid)")
    result = run_script(script(*lines))
    assert (result.code, result.timed_out) == (0, False)
    assert has_ended(int(result.output))
    for seconds in (1, 10, 100):  # on a busy machine the first line may take longer than one second
        result = run_script(script(*lines, "time.sleep(600)"), limits=Limits(seconds=seconds))
        assert (result.code, result.timed_out) == (-signal.SIGKILL, True)
        if result.output:
            break
    assert has_ended(int(result.output))


DAEMON_CODE = (
    "import os, sys, time",
    "def daemon(file):",
    "    if not os.fork():",
    "        os.setsid()",
    "        if not os.fork():",
    "            file.write(f'{os.getpid()} ')",
    "            file.flush()",
    "            time.sleep(600)",
    "        os._exit(0)",
    "    os.wait()",
)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has subreapers")
@pytest.mark.parametrize("end", ["", "time.sleep(600)", "os.abort()", "os.killpg(0, 9)"])
def test_daemons_end_with_the_child(script, tmp_path, end):
    """The daemons have a new session, no parent, and ignore SIGTERM."""
    pids_file = tmp_path / "pids"
    lines = (*DAEMON_CODE, "import signal", "signal.signal(signal.SIGTERM, signal.SIG_IGN)")
    lines += (f"file = open({str(pids_file)!r}, 'w')", "daemon(file)", "daemon(file)")
    lines += (f"while open({str(pids_file)!r}).read().count(' ') < 2:", "    time.sleep(0.01)", end)
    for seconds in (2, 20, 100):  # however busy the machine is
        result = run_script(script(*lines), limits=Limits(seconds=seconds if "sleep" in end else None))
        pids = [int(word) for word in pids_file.read_text().split()]
        if len(pids) == 2:
            break
    assert len(pids) == 2
    assert all(has_ended(pid) for pid in pids)
    assert (result.code, result.timed_out) == {
        "": (0, False),
        "time.sleep(600)": (-signal.SIGKILL, True),
        "os.abort()": (-signal.SIGABRT, False),
        "os.killpg(0, 9)": (-signal.SIGKILL, False),
    }[end]


def test_other_processes_keep_running(script):
    process = subprocess.Popen(["sleep", "600"])
    try:
        run_script(script("import os", "os.fork()"))
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()


def test_log_has_a_maximum_size_and_reports_omitted_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr("pcbench.children.MAX_LOG_BYTES", 1000)
    monkeypatch.setattr("pcbench.children._MAX_TAIL_BYTES", 100)
    (tmp_path / "loud.py").write_text("for n in range(10**5): print(n)\nprint('the end')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with (tmp_path / "log").open("wb") as log:
        result = run_module("loud", log=log)
    text = (tmp_path / "log").read_text()
    assert (result.code, result.output) == (0, "")
    assert text.startswith("0\n1\n2\n")
    assert text.endswith("99999\nthe end\n")
    assert len(text) < 1400
    omitted_bytes = int(re.search(r"\n\[(\d+) [^]]*\]\n", text)[1])
    notice = text[text.index("\n[") : text.index("]\n") + 2]
    check_text(notice)
    assert omitted_bytes + len(text) - len(notice) == 588_890 + len("the end\n")


def test_unwritable_log_is_named():
    with Path("/dev/full").open("wb", buffering=0) as log, pytest.raises(OSError) as caught:
        run_module("pcbench.cli", "no-such-command", log=log)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, "/dev/full")


def test_child_ends_with_its_parent(script, tmp_path):
    pids_file = tmp_path / "pid"
    lines = (*DAEMON_CODE, f"file = open({str(pids_file)!r}, 'w')", "daemon(file)", "file.write(f'{os.getpid()} ')")
    child_script = script(*lines, "file.flush()", "time.sleep(600)")
    code = f"from pcbench.children import run_script; run_script({str(child_script)!r})"
    parent = subprocess.Popen([sys.executable, "-c", code])
    try:
        for _ in range(600):
            if pids_file.exists() and pids_file.read_text().count(" ") == 2:
                break
            time.sleep(0.1)
    finally:
        parent.kill()
        parent.wait()
    pids = [int(word) for word in pids_file.read_text().split()]
    assert len(pids) == 2
    assert all(has_ended(pid) for pid in pids)


ONLY_ON_LINUX = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only Linux ends children with their parent"
)


@ONLY_ON_LINUX
def test_child_ends_if_its_parent_ends_at_once(script, tmp_path):
    """The parent ends before the child has requested a signal for that."""
    start_file = tmp_path / "started"
    child_script = script("import time", f"open({str(start_file)!r}, 'w').close()", "time.sleep(600)")
    code = (
        "import os, subprocess",
        "from pcbench.children import run_script",
        "class Popen(subprocess.Popen):",
        "    def __init__(self, *arguments, **options):",
        "        super().__init__(*arguments, **options)",
        "        print(self.pid, flush=True)",
        "        os._exit(1)",
        "subprocess.Popen = Popen",
        f"run_script({str(child_script)!r})",
    )
    for _ in range(3):  # however fast a child starts
        parent = subprocess.run([sys.executable, "-c", "\n".join(code)], stdout=subprocess.PIPE, text=True)
        pid = int(parent.stdout)
        try:
            assert has_ended(pid)
        finally:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
    assert not start_file.exists()


@ONLY_ON_LINUX
def test_program_does_not_start_without_its_waiting_process(script, tmp_path):
    """The waiting process is killed before the program's process has requested a signal for that."""
    start_file = tmp_path / "started"
    program = script(f"open({str(start_file)!r}, 'w').close()")
    code = (
        "import os, runpy, sys, time",
        "fork = os.fork",
        "def killed_after_fork():",
        "    watch = os.getpid()",
        "    if child := fork():",
        "        print(child, flush=True)",
        "        os.kill(watch, 9)",
        "    while os.getppid() == watch: time.sleep(0.01)",
        "    return 0",
        "os.fork = killed_after_fork",
        f"sys.argv = ['start.py', str(os.getppid()), '0', '0', '0', {str(program)!r}]",
        f"runpy.run_path({children._START_SCRIPT!r}, run_name='__main__')",
    )
    waiting_process = subprocess.run([sys.executable, "-c", "\n".join(code)], stdout=subprocess.PIPE, text=True)
    assert waiting_process.returncode == -signal.SIGKILL
    assert has_ended(int(waiting_process.stdout))
    assert not start_file.exists()


def test_module_is_not_imported_from_the_current_folder(tmp_path, monkeypatch):
    # If one of these were imported, the child would fail with its message.
    for name in ("pcbench", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong module')")
    monkeypatch.chdir(tmp_path)
    result = run_module("pcbench.cli", "--version")
    assert (result.code, result.errors) == (0, "")
    assert pcbench.__version__ in result.output


def test_script_imports_resolve_as_in_this_process(script, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "module_of_mine.py").write_text("VALUE = 3")
    file = script("import module_of_mine", "print(module_of_mine.VALUE)")
    assert "module_of_mine" in run_script(file).last_error_line
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "elsewhere")])
    assert run_script(file).output == "3\n"


def test_output_redirection(script, tmp_path):
    buffer = bytearray(4)
    result = run_script(script("print('abcdefgh', end='')"), into=memoryview(buffer))
    assert (bytes(buffer), result.received, result.output) == (b"abcd", 4, "")
    result = run_script(script("print('ab', end='')"), into=memoryview(buffer))
    assert (bytes(buffer), result.received) == (b"abcd", 2)
    with (tmp_path / "log").open("wb") as log:
        run_module("pcbench.cli", "no-such-command", log=log)
    assert "no-such-command" in Path(tmp_path / "log").read_text()
