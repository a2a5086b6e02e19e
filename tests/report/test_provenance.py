"""Provenance of a result: the commit, and whether the code had uncommitted changes."""

import subprocess

import pytest

from pcbench.report.document import _commit


@pytest.fixture
def tree(tmp_path):
    """Create a source tree with one commit."""
    (tmp_path / "pcbench").mkdir()
    (tmp_path / "pcbench/kernel.cu").write_text("1")
    (tmp_path / "notes.txt").write_text("1")
    (tmp_path / ".gitignore").write_text("*.so\n")
    user = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    for words in (("init", "-q"), ("add", "."), (*user, "commit", "-q", "-m", "first")):
        subprocess.run(["git", "-C", tmp_path, *words], check=True, capture_output=True)
    return tmp_path


def test_a_commit_with_its_code_unchanged(tree):
    (tree / "notes.txt").write_text("2")  # not code
    (tree / "pcbench/_core.so").write_text("built")
    commit = _commit(tree)
    assert len(commit) == 40
    assert int(commit, 16)


@pytest.mark.parametrize("edited", ["pcbench/kernel.cu", "pcbench/new.py"])
def test_uncommitted_changes_are_reported(tree, edited):
    clean = _commit(tree)
    (tree / edited).write_text("2")
    assert _commit(tree) == f"{clean} with uncommitted changes"


def test_no_repository_has_no_commit(tmp_path):
    assert _commit(tmp_path) is None
