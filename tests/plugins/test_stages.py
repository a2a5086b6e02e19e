"""Stages: made once for the same inputs and code, and made again where their files are no longer what was made."""

import json
import os
import sqlite3
import subprocess
import sys

import pytest

from pcbench.plugins import stages
from pcbench.plugins.stages import library_versions, stage, stage_key


class Maker:
    """Fills a folder and counts how often it had to."""

    def __init__(self):
        self.calls = 0

    def __call__(self, folder):
        self.calls += 1
        (folder / "inner").mkdir()
        (folder / "a.bin").write_bytes(bytes(range(200)))
        (folder / "inner/b.txt").write_text("b")


def test_stages_are_made_once_for_each_input(tmp_path):
    made = []

    def make(folder):
        made.append(folder)
        (folder / "a.txt").write_text(str(len(made)))

    first = stage(tmp_path, "features", {"n": 1}, make)
    assert stage(tmp_path, "features", {"n": 1}, make) == first
    assert len(made) == 1
    assert (first / "a.txt").read_text() == "1"
    key = stage_key(first)
    stage(tmp_path, "features", {"n": 2}, make)
    assert (first / "a.txt").read_text() == "2"
    assert stage_key(first) != key
    assert stage_key(tmp_path / "none") is None

    def killed(folder):
        (folder / "half.txt").write_text("")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage(tmp_path, "features", {"n": 3}, killed)
    assert stage_key(first) is None  # neither the old result nor half a new one
    stage(tmp_path, "features", {"n": 3}, make)
    assert sorted(p.name for p in first.iterdir()) == ["a.txt", "stage.json"]


@pytest.fixture
def made(tmp_path):
    """A stage, how it is asked for again, and its maker."""
    maker = Maker()

    def ask():
        return stage(tmp_path, "maps", {"n": 1, "among": {1: 0, 10: 0, 2: 0}}, maker)

    return ask(), ask, maker


def cut(folder):
    os.truncate(folder / "a.bin", 100)


def change(folder):
    (folder / "a.bin").write_bytes(bytes(reversed(range(200))))


def remove(folder):
    (folder / "inner/b.txt").unlink()


def spoil_record(folder):
    (folder / "stage.json").write_text("{")


def forge_record(folder):
    (folder / "stage.json").write_text('{"inputs": 3}')


@pytest.mark.parametrize("damage", [cut, change, remove, spoil_record, forge_record])
def test_damaged_files_make_a_stage_again(made, damage):
    folder, ask, maker = made
    key = stage_key(folder)
    assert ask() == folder
    assert maker.calls == 1
    damage(folder)
    assert ask() == folder
    assert maker.calls == 2
    assert (folder / "a.bin").read_bytes() == bytes(range(200))
    assert (folder / "inner/b.txt").read_text() == "b"
    assert stage_key(folder) == key  # the same content again: what was made of it stays


def test_files_beside_those_that_were_made_do_not_matter(made):
    folder, ask, maker = made
    (folder / "journal").write_text("of a reader")
    ask()
    assert maker.calls == 1


def test_a_database_that_was_opened_is_the_same_and_one_with_other_rows_is_not(tmp_path):
    def fill(folder):
        calls.append(1)
        execute(folder / "d.db", "PRAGMA journal_mode=wal; CREATE TABLE t (x); INSERT INTO t VALUES (1)")

    def execute(path, script):
        connection = sqlite3.connect(path)
        connection.executescript(script)
        connection.close()

    calls = []
    folder = stage(tmp_path, "features", {}, fill)
    before = (folder / "d.db").read_bytes()
    execute(folder / "d.db", "PRAGMA user_version = 0")  # as COLMAP does when it opens one
    assert (folder / "d.db").read_bytes() != before
    stage(tmp_path, "features", {}, fill)
    assert len(calls) == 1
    execute(folder / "d.db", "UPDATE t SET x = 2")
    stage(tmp_path, "features", {}, fill)
    assert len(calls) == 2


def test_a_linked_file_belongs_to_another_stage(tmp_path):
    (tmp_path / "other").write_text("1")

    def link(folder):
        calls.append(1)
        (folder / "link").symlink_to("../other")

    calls = []
    for _ in range(2):
        stage(tmp_path, "linking", {}, link)
        (tmp_path / "other").write_text("2")
    assert len(calls) == 1


def test_what_follows_a_stage_depends_on_its_content(tmp_path):
    def key(text):
        (tmp_path / text).mkdir()
        return stage_key(stage(tmp_path / text, "first", {}, lambda folder: (folder / "x").write_text(text)))

    assert key("one") != key("other")


def test_other_code_makes_a_stage_again(made, monkeypatch):
    folder, ask, maker = made
    assert json.loads((folder / "stage.json").read_text())["inputs"]["versions"] == library_versions()
    monkeypatch.setattr(stages, "code_digest", lambda: "edited")
    ask()
    assert maker.calls == 2


def test_a_file_that_cannot_be_written_leaves_no_stage(tmp_path):
    """A limit on the size of files, as a full disk would be."""
    code = """
import resource, sys
from pathlib import Path
from pcbench.plugins.stages import stage
stage(Path(sys.argv[1]), "s", {}, lambda folder: (folder / "a").write_bytes(bytes(int(sys.argv[2]))))
"""
    limited = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n" + code
    done = subprocess.run([sys.executable, "-c", limited, tmp_path, "2000"], capture_output=True, text=True)
    assert "File too large" in done.stderr
    assert stage_key(tmp_path / "s") is None
    assert subprocess.run([sys.executable, "-c", code, tmp_path, "2000"]).returncode == 0
    assert (tmp_path / "s/a").stat().st_size == 2000
