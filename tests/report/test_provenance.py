"""Provenance of a result: the commit, and whether the code had uncommitted changes."""

import subprocess

import pytest

from pcbench.report.document import _commit


@pytest.fixture
def source_tree(tmp_path):
    """Create a source tree with one commit."""
    (tmp_path / "pcbench").mkdir()
    (tmp_path / "pcbench/kernel.cu").write_text("1")
    (tmp_path / "notes.txt").write_text("1")
    (tmp_path / ".gitignore").write_text("*.so\n")
    user = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    for arguments in (("init", "-q"), ("add", "."), (*user, "commit", "-q", "-m", "first")):
        subprocess.run(["git", "-C", tmp_path, *arguments], check=True, capture_output=True)
    return tmp_path


def test_changes_outside_the_code_are_ignored(source_tree):
    (source_tree / "notes.txt").write_text("2")  # not code
    (source_tree / "pcbench/_core.so").write_text("built")
    commit = _commit(source_tree)
    assert len(commit) == 40
    assert int(commit, 16)


@pytest.mark.parametrize("path", ["pcbench/kernel.cu", "pcbench/new.py"])
def test_uncommitted_changes_are_reported(source_tree, path):
    clean = _commit(source_tree)
    (source_tree / path).write_text("2")
    assert _commit(source_tree) == f"{clean} with uncommitted changes"


def test_no_repository_has_no_commit(tmp_path):
    assert _commit(tmp_path) is None
