"""The command line's errors: one line, an exit code, and nothing half-written."""

import os
import subprocess
import sys

import numpy as np
import pytest
from command_line import is_one_line
from wording import check_text

from pcbench import Cloud, read_cloud, write_cloud

BAD_INPUTS = {
    "missing file": ("compare ref.ply no.ply", "no.ply"),
    "a folder without clouds": ("compare ref.ply hollow", "hollow: "),
    "empty file": ("compare ref.ply empty.ply", "empty"),
    "wrong magic": ("compare ref.ply magic.ply", "magic.ply"),
    "truncated": ("compare ref.ply cut.ply", "of 1500 vert"),
    "negative count": ("compare ref.ply negative.ply", "negative.ply"),
    "absurd count": ("compare ref.ply absurd.ply", "absurd.ply"),
    "unknown extension": ("compare ref.ply a.docx", ".ply"),
    "no points": ("compare ref.ply none.ply", "none.ply"),
    "all NaN": ("compare ref.ply nan.ply", "NaN"),
    "no matrix": ("compare ref.ply a.ply --register matrix:empty.ply", "empty.ply"),
    "no such matrix": ("compare ref.ply a.ply --register matrix:no.txt", "no.txt"),
    "no such method": ("compare ref.ply a.ply --register magic", "unknown registration"),
    "no such crop": ("compare ref.ply a.ply --crop circle:1", "circle"),
    "empty crop": ("compare ref.ply a.ply --crop sphere:999,0,0,1", "leaves none"),
    "an ascii STL facet of two vertices": ("compare two.stl a.ply", "two.stl: facet 0"),
    "no overlap": ("compare ref.ply far.ply", "does not overlap"),
    "no overlap as it is": ("compare ref.ply far.ply --register none", "does not overlap"),
    "bad thresholds": ("compare ref.ply a.ply --thresholds a,b", "--thresholds"),
    "negative threshold": ("compare ref.ply a.ply --thresholds=-1", "thresholds as one or more lengths above 0"),
    "unknown preset": ("compare ref.ply a.ply --preset x", "unknown preset"),
    "no settings": ("compare --settings no.json", "no.json: cannot read settings: no such file: check the name"),
    "not settings": ("compare --settings ref.ply", "ref.ply"),
    "crop keeps nothing": ("crop a.ply out.ply --crop box:900,900,900,901,901,901", "leaves none"),
    "register far": ("register ref.ply far.ply --out out.ply", "does not overlap"),
    "info of nothing": ("info no.ply", "no.ply"),
    "crop to nothing": ("crop a.ply out.ply --crop none", "expected --crop box:"),
    "crop by the reference": ("crop a.ply out.ply --crop reference", "expected --crop box:"),
    "words as returns": ("convert a.ply out.ply --returns foo", "as first, last or numbers"),
    "a folder as output": ("crop a.ply . --crop box:0,0,0,9,9,9", "got a folder"),
    "no control points": ("register ref.ply a.ply --register points:no.txt", "no such file: check the name"),
}


@pytest.mark.parametrize("name", BAD_INPUTS)
def test_bad_input_is_one_line(files, run, name):
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex %s\n"
    body = b"property float x\nproperty float y\nproperty float z\nend_header\n"
    (files / "hollow").mkdir()
    (files / "empty.ply").touch()
    (files / "magic.ply").write_bytes(b"PK\x03\x04 not a cloud")
    (files / "cut.ply").write_bytes((files / "a.ply").read_bytes()[:-40])
    (files / "negative.ply").write_bytes(header % b"-5" + body)
    (files / "absurd.ply").write_bytes(header % b"99999999999999" + body + b"\0" * 12)
    (files / "none.ply").write_bytes(header % b"0" + body)
    (files / "nan.ply").write_bytes(header % b"2" + body + np.full(6, np.nan, "<f4").tobytes())
    (files / "a.docx").write_bytes(b"x")
    facet = "facet normal 0 0 0 outer loop vertex 0 0 0 vertex 1 0 0 endloop endfacet"
    (files / "two.stl").write_text(f"solid a\n{facet}\nendsolid a\n")
    write_cloud("far.ply", Cloud(read_cloud("a.ply").points + 1e5))
    before = sorted(p.name for p in files.iterdir())
    arguments, expected = BAD_INPUTS[name]
    out = ("--out", "report") if arguments.startswith("compare") else ()
    code, stdout, err = run(*arguments.split(), *out)
    assert code == 2
    assert is_one_line(err), err
    assert expected in err
    assert not stdout
    assert sorted(p.name for p in files.iterdir()) == before


def test_usage_errors(run):
    for arguments in (
        ("compare",),
        ("compare", "ref.ply"),
        ("crop", "ref.ply"),
        ("frobnicate",),
        ("compare", "--nonsense"),
    ):
        code, _, err = run(*arguments)
        assert code == 2
        assert "Traceback" not in err


def test_usage_errors_are_one_line_too(files, run):
    for arguments in (("compare", "ref.ply"), ("compare", "--seed", "x"), ("demo", "--points", "5"), ("nonsense",)):
        code, _, err = run(*arguments)
        assert code == 2
        assert is_one_line(err), err
    assert run("compare", "ref.ply", "a.ply", "--seed", "-1")[0] == 2


def test_an_unwritable_output_is_refused_before_the_computation(files, run):
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "report", "--json", "no/x.json")
    assert code == 2
    assert is_one_line(err)
    assert not (files / "report").exists()
    assert run("register", "ref.ply", "a.ply", "--out", "b2.ply", "--matrix", "no/m.txt")[0] == 2
    assert not (files / "b2.ply").exists()


def test_outputs_never_replace_inputs(report, files, run):
    before = {p.name: p.read_bytes() for p in files.glob("*.ply")}
    for arguments in (
        ("compare", "ref.ply", "a.ply", "--json", "ref.ply"),
        ("compare", "ref.ply", "a.ply", "--out", "."),
        ("register", "ref.ply", "a.ply", "--out", "a.ply"),
    ):
        code, _, err = run(*arguments)
        assert code == 2
        assert is_one_line(err)
    assert {p.name: p.read_bytes() for p in files.glob("*.ply")} == before
    code, _, err = run("compare", "ref.ply", "report/a_deviation.ply", "--out", "report")
    assert code == 2
    check_text(err)


def test_a_full_disk_leaves_no_files(files):
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "sys.argv = 'pcbench compare ref.ply a.ply --out report --no-figures'.split()\n"
        "from pcbench.cli import main; main()"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert process.returncode == 2
    assert is_one_line(process.stderr), process.stderr
    assert {p.name for p in files.iterdir()} == {"ref.ply", "a.ply", "b.ply"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_refused(files, run):
    (files / "locked").mkdir(mode=0o555)
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "locked/report")
    assert code == 2
    assert is_one_line(err)


def test_an_output_folder_below_a_file_is_refused(files, run):
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "a.ply/report")
    assert code == 2
    assert is_one_line(err)


def test_an_interrupt_leaves_no_files(files, run, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("pcbench.measure.pair.register", interrupt)
    code, _, err = run("compare", "ref.ply", "a.ply", "--out", "report")
    assert code == 130
    assert err.strip() == "interrupted"
    assert {p.name for p in files.iterdir()} == {"ref.ply", "a.ply", "b.ply"}


@pytest.mark.long
def test_an_ascii_terminal_and_a_terminated_run(files):
    command = [sys.executable, "-m", "pcbench.cli", "compare", "ref.ply", "a.ply", "--no-figures"]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "20", "TERM": "dumb"}
    process = subprocess.run(command, env=environment, capture_output=True, check=True)
    assert b"RMS off the surface" in process.stdout
    script = (
        "import os, signal, sys, pcbench.measure.pair\n"
        "pcbench.measure.pair.register = lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM)\n"
        "sys.argv = 'pcbench compare ref.ply a.ply --out report'.split()\n"
        "from pcbench.cli import main; main()"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=False).returncode == 143
    assert {p.name for p in files.iterdir()} == {"ref.ply", "a.ply", "b.ply"}


def test_a_candidate_name_that_is_too_long_is_refused_before_reading(files, run):
    """File names have at most 255 bytes, and the report's file names extend the candidate's name."""
    write_cloud("a" * 220 + ".ply", read_cloud("a.ply"))
    assert run("compare", "ref.ply", "a" * 220 + ".ply", "--no-figures", "--out", "kept", "-q")[0] == 0
    code, _, err = run("compare", "no.ply", "é" * 111 + ".ply", "--out", "report")
    assert code == 2
    assert is_one_line(err)
    assert " 220 bytes" in check_text(err)


@pytest.mark.parametrize("command", [("info", "a.ply"), ("convert", "a.ply", "other.ply")])
def test_a_limit_of_open_files_is_named_with_its_remedy(files, run, command):
    resource = pytest.importorskip("resource", reason="this system has no limits of open files")
    assert run(*command)[0] == 0  # all modules are loaded
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    descriptor = os.open(os.devnull, os.O_RDONLY)  # the lowest that is free
    os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, (descriptor, before[1]))
    try:
        code, _, err = run(*command)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert code == 2
    check_text(err)
