"""The count of instructions reads callgrind's files, and its table names what has grown."""

import json
import subprocess
import sys

import pytest
from repository import ROOT
from wording import check_text

BENCH = ROOT / "benchmarks"

# A library is named at its first occurrence. The line after `calls=` is the inclusive cost of the called function.
FILE = """\
# callgrind format
version: 1
cmd: python 1 2
desc: Trigger: Client Request: registering
positions: line
events: Ir
summary: 999

ob=(1) /home/a/pcbench/.venv/lib/python3.11/site-packages/numpy/_core/_multiarray.so
fl=(1) a.c
fn=(1) add
10 5
+2 7
* 1
cob=(2) /home/a/pcbench/.venv/lib/python3.11/site-packages/pcbench/native/_core.so
cfn=(2) query
calls=3 20
13 500

ob=(2)
fn=(2)
20 400
-1 30
ob=(3) /usr/lib/libpython3.11.so.1.0
fn=(3) call
1 2000
ob=(1)
fn=(1)
5 10000
ob=(4) /usr/lib/libc.so.6
fn=(4) copy
1 60000

totals: 999
"""


@pytest.fixture
def instructions(monkeypatch):
    monkeypatch.syspath_prepend(BENCH)
    import instructions

    return instructions


def test_counts_of_each_library_leave_out_inclusive_costs(instructions):
    label, costs = instructions.read_counts(FILE.splitlines())
    assert label == "registering"
    assert costs == {"numpy": 10_013, "compiled core": 430, "Python": 2000, "system libraries": 60_000}


def counts(instructions, commit, *stages, numpy="2.0"):
    named = dict(zip(("registering", "measuring"), stages, strict=True))
    return instructions.Counts(commit, {"numpy": numpy}, named, {"numpy": sum(stages)})


def test_growth_above_a_tenth_is_in_capitals(instructions):
    before = counts(instructions, "aaa", 100_000_000, 300_000_000)
    within = instructions.table(counts(instructions, "bbb", 109_000_000, 320_000_000), before)
    assert within == within.lower() and "instructions than" not in within
    beyond = check_text(instructions.table(counts(instructions, "bbb", 112_000_000, 290_000_000), before))
    assert "REGISTERING" in beyond and "MEASURING" not in beyond


def test_other_versions_and_stages_are_named(instructions):
    before = counts(instructions, "aaa", 100_000_000, 300_000_000)
    now = counts(instructions, "bbb", 100_000_000, 300_000_000, numpy="2.1")
    check_text(instructions.table(now._replace(stages={"registering": 100_000_000, "mapping": 1_000_000}), before))
    check_text(instructions.table(now, None))


def test_without_valgrind_nothing_fails(tmp_path):
    command = [sys.executable, BENCH / "instructions.py"]
    process = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    check_text(process.stdout)


def test_committed_counts_have_all_fields(instructions):
    committed = instructions.Counts(**json.loads(instructions.BASELINE.read_text()))
    assert not committed.commit.endswith("-dirty")
    assert sum(committed.stages.values()) == sum(committed.libraries.values()) > 0


def test_counts_of_uncommitted_code_are_not_written(instructions, monkeypatch, capsys, tmp_path):
    now = counts(instructions, "aaa-dirty", 100_000_000, 300_000_000)
    monkeypatch.setattr(instructions, "count", lambda: now)
    monkeypatch.setattr(instructions, "BASELINE", tmp_path / "counts.json")
    monkeypatch.setattr(sys, "argv", ["instructions.py", "--renew"])
    instructions.main()
    assert not instructions.BASELINE.exists()
    check_text(capsys.readouterr().out)
    monkeypatch.setattr(instructions, "count", lambda: now._replace(commit="aaa"))
    instructions.main()
    assert instructions.Counts(**json.loads(instructions.BASELINE.read_text())) == now._replace(commit="aaa")
