"""Runs in child processes: crashes and time-outs are outcomes, and records are reused."""

import json
import shutil
import time
from dataclasses import replace

import pytest
from children_here import stress_runs_here
from task_pools import tasks_in_process  # noqa: F401  # a fixture
from wording import check_error

from pcbench.studies.stress import runs
from pcbench.studies.stress.cells import RunPlan
from pcbench.studies.stress.subject import CRASH, RIGHT, TIME_OUT
from pcbench.systems import cpu_count
from pcbench.tasks import Workers, runner

# A child whose methods misbehave on some levels of the ladder.
CHILD = """
import os, sys, time
from dataclasses import replace
from pcbench.errors import MissingExtra
from pcbench.studies.stress import child
from pcbench.studies.stress.methods import METHODS

def misbehave(reference, candidate, seed):
    count = len(candidate)
    if count > 1000:
        return METHODS["similarity"].run(reference, candidate, seed)
    if count > 700:
        os.abort()
    if count > 400:
        time.sleep(60)
    if count > 220:
        raise ValueError("no pose")
    raise MissingExtra("a library", "open3d")

METHODS["icp"] = replace(METHODS["icp"], run=misbehave)
child.main(sys.argv[1])
"""
PLANS = [RunPlan("registration", "object", "density", level, None, "icp", 0, 3000) for level in (1.0, 2.0, 3.0, 5.0)]

# Enough registrations for two batches, and the other subjects that have several cells for each run.
SEEDS = [RunPlan("registration", "object", "density", 1.0, None, "icp", seed, 3000) for seed in range(6)]
OTHERS = [
    RunPlan("metrics", "object", "density", 1.0, None, "pcbench", 0, 3000),
    RunPlan("verdicts", "object", "density", 1.0, None, "deform", 0, 3000),
]


@pytest.fixture(scope="module", autouse=True)
def _small_batches():
    """Let few runs be two batches."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "_BATCH_RUNS", (4, 10))
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the records of runs, and their results by plan."""
    out = tmp_path_factory.mktemp("records")
    plans = [*SEEDS, *OTHERS]
    with stress_runs_here():
        return out, dict(zip(plans, runs.run_all(plans, runs.RunSettings(out, time_limit_s=60.0)), strict=True))


@pytest.fixture
def settings(tmp_path, monkeypatch, tasks_in_process):  # noqa: F811
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "misbehaving_child.py").write_text(CHILD)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"))
    monkeypatch.setattr(runs, "_CHILD", "misbehaving_child")
    (tmp_path / "out").mkdir()
    return runs.RunSettings(tmp_path / "out", time_limit_s=4.0)


@pytest.mark.long
def test_crashes_and_time_outs_are_outcomes_and_the_next_runs_go_on(settings, monkeypatch):
    results = runs.run_all(PLANS, settings)
    found = [(result.cells[0].outcome, result.cells[0].message) for result in results]
    assert found == [
        (RIGHT, ""),
        (CRASH, "SIGABRT"),
        (TIME_OUT, "stopped after 4 s"),
        (CRASH, "ValueError: no pose"),
    ]
    assert results[0].pose is not None and results[0].cells[0].cpu_s > 0
    assert not (settings.out / "work").exists()

    def fail(*_, **__):
        raise AssertionError("a child was started although all runs have records")

    monkeypatch.setattr(runs, "run_module", fail)
    again = runs.run_all(PLANS, settings)
    assert [result.cells for result in again] == [result.cells for result in results]
    with pytest.raises(AssertionError, match="a child was started"):  # a record holds for its settings only
        runs.run_all(PLANS, replace(settings, time_limit_s=5.0))


DAMAGES = (
    lambda record: record.pop("cells"),
    lambda record: record.update(cells=[]),
    lambda record: record["cells"][0].pop("error"),
    lambda record: record["cells"][0].update(outcome=CRASH, message="SIGKILL"),
)


def test_damaged_records_and_killed_runs_are_repeated(made, tmp_path):
    out, results = made
    shutil.copytree(out, tmp_path / "out")
    settings = runs.RunSettings(tmp_path / "out", time_limit_s=60.0)
    for plan, damage in zip(SEEDS, DAMAGES, strict=False):
        path = plan.record(settings.out)
        record = json.loads(path.read_text())
        damage(record)
        path.write_text(json.dumps(record))
    with stress_runs_here():
        repeated = runs.run_all(SEEDS, settings)
    for plan, again in zip(SEEDS, repeated, strict=True):
        assert again.pose == results[plan].pose and again.cells[0].outcome == RIGHT


@pytest.mark.long
def test_an_interrupted_study_stops_after_the_current_runs(tmp_path, monkeypatch):
    """Batches of ten runs are on their way; the complete runs keep their records."""
    plans = [replace(PLANS[0], level=1 + 0.01 * number) for number in range(400)]
    records = tmp_path / "runs"

    def interrupt(*_, **__):
        while len(list(records.iterdir())) < 2:
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        runs.run_all(plans, runs.RunSettings(tmp_path, time_limit_s=60.0))
    count = len(list(records.iterdir()))
    assert 2 <= count <= 2 + 2 * cpu_count()
    assert not (tmp_path / "work").exists()
    time.sleep(0.5)
    assert len(list(records.iterdir())) == count  # the child processes have ended too


def test_a_library_that_cannot_be_loaded_ends_the_study(settings):
    plan = replace(PLANS[0], level=7.0)
    with check_error():
        runs.run_all([plan], settings)
    assert not plan.record(settings.out).exists()


def test_metrics_and_verdicts_have_records_too(made):
    metrics, verdicts = (made[1][plan] for plan in OTHERS)
    assert len(metrics.cells) == 2 and len(verdicts.cells) == 3
    assert all(cell.value > 0 and cell.exact > 0 for cell in metrics.cells)
    assert {cell.pose_is_right for cell in verdicts.cells} == {True}


@pytest.mark.long
def test_any_number_of_workers_gives_the_same_results_in_any_folder(made, tmp_path):
    results = runs.run_all(SEEDS, runs.RunSettings(tmp_path, time_limit_s=60.0), workers=Workers(1))
    for plan, alone in zip(SEEDS, results, strict=True):
        others = made[1][plan]
        assert alone.pose == others.pose
        assert [replace(cell, cpu_s=None, memory_bytes=None) for cell in alone.cells] == [
            replace(cell, cpu_s=None, memory_bytes=None) for cell in others.cells
        ]
