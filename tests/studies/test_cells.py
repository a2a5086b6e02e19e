"""Independent runs of a study, in this process and on workers."""

import os

import pytest
import task_functions

from pcbench.errors import InputError
from pcbench.studies.frame.cells import map_cells
from pcbench.tasks import Workers


def run(function, shared, cells, out, workers=None, steps=None):
    announce = (lambda _: None) if steps is None else steps.append
    return list(map_cells(function, shared, cells, out=out, workers=workers, step=announce, cell_seconds=10.0))


def test_cells_give_the_same_results_here_and_on_workers(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.chdir(tmp_path)
    shared = {"folder": str(tmp_path), "factor": 3}
    steps = []
    here = run(task_functions.cell, shared, [4, 5, 6], out, steps=steps)
    assert here == [(value, str(tmp_path), os.getpid()) for value in (12, 15, 18)]
    assert steps == ["1 of 3: cell 4", "2 of 3: cell 5", "3 of 3: cell 6"]
    assert [step.after for step in steps] == [20.0, 10.0, 0.0]
    for count in (1, 2):
        there = run(task_functions.cell, shared, [4, 5, 6], out, Workers(count))
        assert [row[:2] for row in there] == [row[:2] for row in here]
        assert os.getpid() not in {pid for *_, pid in there}
    assert list(out.iterdir()) == []


def test_a_killed_worker_does_not_end_a_study(tmp_path):
    assert run(task_functions.ended_cell, str(tmp_path), [0, 1, 2], tmp_path, Workers(2)) == [0, 1, 2]
    assert sorted(task_functions.calls(tmp_path)) == [0, 1, 1, 2]


def test_errors_end_a_study(tmp_path):
    for workers in (None, Workers(1)):
        with pytest.raises(InputError) as caught:
            run(task_functions.refused_cell, str(tmp_path), [1, 2, 3], tmp_path, workers)
        assert str(caught.value) == "2: expected another number"
    assert task_functions.calls(tmp_path) == [1, 1]


def test_a_cell_that_fails_can_have_a_result(tmp_path):
    cells = map_cells(
        task_functions.refused_cell,
        str(tmp_path),
        [1, 2, 3],
        out=tmp_path,
        workers=Workers(1),
        step=lambda _: None,
        cell_seconds=1.0,
        on_failure=lambda cell, error: (cell, str(error)),
    )
    assert list(cells) == [1, (2, "2: expected another number"), 3]
