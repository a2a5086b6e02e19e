"""The folder of a study: rejection of foreign folders, and records."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from view_folders import write_view_folder
from wording import check_error

from pcbench.report.markup import csv_text, markdown_table
from pcbench.studies.bench.runs import KIND as BENCH
from pcbench.studies.bend.bend import KIND as BEND
from pcbench.studies.frame.folder import MARK, check_folder, folders_by_name, study_folder
from pcbench.studies.frame.records import read_record, write_record
from pcbench.studies.gao.gao import KIND as GAO
from pcbench.studies.views.runs import ViewsJob, run_views
from pcbench.studies.views.scores import KIND as VIEWS

KINDS = (BENCH, BEND, GAO, VIEWS)


@dataclass(frozen=True)
class Job:
    scene: Path = Path("photos")
    seeds: tuple[int, ...] = (0, 1)


@dataclass(frozen=True)
class Run:
    value: float | None
    rows: tuple[int, int]


def read_files(folder):
    return {path.name: path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("runs/notes.txt", "mine"),
        ("scores.json", "{}"),
        ("bench.json", '{"schema": "other/1"}'),
        ("experiment.json", "[1]"),
        ("views.md", "mine"),
        ("study.json", '{"study": "cells"}'),
        (".lock", ""),
    ],
)
def test_foreign_folder_is_rejected(tmp_path, kind, name, text):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    with check_error(), study_folder(tmp_path, kind, Job()):
        pass
    assert read_files(tmp_path) == {Path(name).name: text}


def test_views_leave_foreign_folder_unchanged(tmp_path):
    write_view_folder(tmp_path / "a", "near", 9)
    foreign_files = {"views.md": "mine", "scores.csv": "mine", "scores.json": "{}"}
    (tmp_path / "out/runs").mkdir(parents=True)
    for name, text in foreign_files.items():
        (tmp_path / "out" / name).write_text(text)
    with check_error():
        run_views(ViewsJob((tmp_path / "a",)), tmp_path / "out")
    assert read_files(tmp_path / "out") == foreign_files


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_study_recognises_its_folder(tmp_path, kind):
    out = tmp_path / "new/out"
    with study_folder(out, kind, Job()):
        with check_error(), study_folder(out, kind, Job()):
            pass
    assert json.loads((out / MARK).read_text()) == {
        "schema": "pcbench.study/1",
        "study": kind.name,
        "settings": {"scene": "photos", "seeds": [0, 1]},
    }
    with study_folder(out, kind, Job()):
        pass
    for other in KINDS:
        if other is not kind:
            with check_error():
                check_folder(out, other)
    (tmp_path / "file").write_text("mine")
    with check_error():
        check_folder(tmp_path / "file", kind)


def test_records_are_returned_for_the_same_inputs_only(tmp_path):
    path = tmp_path / "run.json"
    assert read_record(path, {"a": 1}, Run) is None
    write_record(path, {"a": 1, "b": (2, 3)}, Run(None, (1, 2)))
    assert read_record(path, {"b": (2, 3), "a": 1}, Run) == Run(None, (1, 2))
    assert read_record(path, {"a": 2, "b": (2, 3)}, Run) is None
    edited = path.read_text().replace("1,\n", "7,\n")
    assert edited != path.read_text()
    for content in ("", "{", "[]", "{}", edited):
        path.write_text(content)
        assert read_record(path, {"a": 1, "b": (2, 3)}, Run) is None


def test_csv_markdown_and_unique_folder_names():
    assert csv_text(["a", "b"], [(1, None), ("x,y", 0.5)]) == 'a,b\n1,\n"x,y",0.5\n'
    assert markdown_table([["a|b", "n"], ["x", "1"]], 1) == "| a\\|b | n |\n| --- | ---: |\n| x | 1 |"
    paths = [Path(text) for text in ("/x/city", "/y/city", "/z/runs", "/z/city_2")]
    assert list(folders_by_name(paths, ["runs"])) == ["city", "city_2", "runs_2", "city_2_2"]
