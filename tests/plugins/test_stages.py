"""Stages run once for the same inputs and code, and again if their files have changed."""

import json
import os
import sqlite3
import subprocess
import sys

import pytest

from pcbench.plugins import stages
from pcbench.plugins.stages import library_versions, stage, stage_key


class StageMaker:
    """Fills a folder and counts its calls."""

    def __init__(self):
        self.calls = 0

    def __call__(self, folder):
        self.calls += 1
        (folder / "inner").mkdir()
        (folder / "a.bin").write_bytes(bytes(range(200)))
        (folder / "inner/b.txt").write_text("b")


def test_stages_are_made_once_per_input(tmp_path):
    calls = []

    def make(folder):
        calls.append(folder)
        (folder / "a.txt").write_text(str(len(calls)))

    stage_folder = stage(tmp_path, "features", {"n": 1}, make)
    assert stage(tmp_path, "features", {"n": 1}, make) == stage_folder
    assert len(calls) == 1
    assert (stage_folder / "a.txt").read_text() == "1"
    key = stage_key(stage_folder)
    stage(tmp_path, "features", {"n": 2}, make)
    assert (stage_folder / "a.txt").read_text() == "2"
    assert stage_key(stage_folder) != key
    assert stage_key(tmp_path / "none") is None

    def interrupted_make(folder):
        (folder / "half.txt").write_text("")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage(tmp_path, "features", {"n": 3}, interrupted_make)
    assert stage_key(stage_folder) is None  # neither the old result nor an incomplete new one
    stage(tmp_path, "features", {"n": 3}, make)
    assert sorted(p.name for p in stage_folder.iterdir()) == ["a.txt", "stage.json"]


@pytest.fixture
def repeatable_stage(tmp_path):
    """Return a stage, a function that requests it again, and its maker."""
    maker = StageMaker()

    def request():
        return stage(tmp_path, "maps", {"n": 1, "among": {1: 0, 10: 0, 2: 0}}, maker)

    return request(), request, maker


def truncate(folder):
    os.truncate(folder / "a.bin", 100)


def change(folder):
    (folder / "a.bin").write_bytes(bytes(reversed(range(200))))


def remove(folder):
    (folder / "inner/b.txt").unlink()


def damage_record(folder):
    (folder / "stage.json").write_text("{")


def replace_record(folder):
    (folder / "stage.json").write_text('{"inputs": 3}')


def pipe_record(folder):
    (folder / "stage.json").unlink()
    os.mkfifo(folder / "stage.json")  # opening it would wait for a writer


@pytest.mark.parametrize("damage", [truncate, change, remove, damage_record, replace_record, pipe_record])
def test_damaged_files_outdate_a_stage(repeatable_stage, damage):
    folder, request, maker = repeatable_stage
    key = stage_key(folder)
    assert request() == folder
    assert maker.calls == 1
    damage(folder)
    assert request() == folder
    assert maker.calls == 2
    assert (folder / "a.bin").read_bytes() == bytes(range(200))
    assert (folder / "inner/b.txt").read_text() == "b"
    assert stage_key(folder) == key  # the content is the same again: later stages stay valid


def test_additional_files_do_not_outdate_a_stage(repeatable_stage):
    folder, request, maker = repeatable_stage
    (folder / "journal").write_text("of a reader")
    request()
    assert maker.calls == 1


def test_changes_of_a_database_outdate_a_stage_but_opening_does_not(tmp_path):
    def make_database(folder):
        calls.append(1)
        execute(folder / "d.db", "PRAGMA journal_mode=wal; CREATE TABLE t (x); INSERT INTO t VALUES (1)")

    def execute(path, script):
        connection = sqlite3.connect(path)
        connection.executescript(script)
        connection.close()

    calls = []
    folder = stage(tmp_path, "features", {}, make_database)
    old_bytes = (folder / "d.db").read_bytes()
    execute(folder / "d.db", "PRAGMA user_version = 0")  # changes the header as COLMAP does at each opening
    assert (folder / "d.db").read_bytes() != old_bytes
    stage(tmp_path, "features", {}, make_database)
    assert len(calls) == 1
    execute(folder / "d.db", "UPDATE t SET x = 2")
    stage(tmp_path, "features", {}, make_database)
    assert len(calls) == 2


def test_linked_files_are_ignored(tmp_path):
    (tmp_path / "other").write_text("1")

    def make_link(folder):
        calls.append(1)
        (folder / "link").symlink_to("../other")

    calls = []
    for _ in range(2):
        stage(tmp_path, "linking", {}, make_link)
        (tmp_path / "other").write_text("2")
    assert len(calls) == 1


def test_stage_key_depends_on_content(tmp_path):
    def key(text):
        (tmp_path / text).mkdir()
        return stage_key(stage(tmp_path / text, "first", {}, lambda folder: (folder / "x").write_text(text)))

    assert key("one") != key("other")


def test_edited_code_outdates_a_stage(repeatable_stage, monkeypatch):
    folder, request, maker = repeatable_stage
    assert json.loads((folder / "stage.json").read_text())["inputs"]["versions"] == library_versions()
    monkeypatch.setattr(stages, "code_digest", lambda: "edited")
    request()
    assert maker.calls == 2


def test_failed_write_leaves_no_stage(tmp_path):
    """A limit on file sizes simulates a full disk."""
    code = """
import resource, sys
from pathlib import Path
from pcbench.plugins.stages import stage
stage(Path(sys.argv[1]), "s", {}, lambda folder: (folder / "a").write_bytes(bytes(int(sys.argv[2]))))
"""
    limited_code = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n" + code
    process = subprocess.run([sys.executable, "-c", limited_code, tmp_path, "2000"], capture_output=True, text=True)
    assert "File too large" in process.stderr
    assert stage_key(tmp_path / "s") is None
    assert subprocess.run([sys.executable, "-c", code, tmp_path, "2000"]).returncode == 0
    assert (tmp_path / "s/a").stat().st_size == 2000
